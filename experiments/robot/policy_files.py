"""Writes policy files that a robot's computer can run without JAX.

`policy.onnx` is the network from observation to action, with its normaliser. `policy.npz` holds the same numbers for
`network.py`, which needs only NumPy. Both contain under `meta`, as JSON, everything around the network. A robot with a
player of its own (`Kind.player`) gets that too.
"""

import json
import shutil
from pathlib import Path
from types import ModuleType

import jax
import numpy as np

from experiments.common.checkpoint import check_finite
from experiments.walking.learner import Learner
from jaxtune import network
from jaxtune.ppo import PPO, PPOState


def require_onnx() -> ModuleType:
    """Imports the optional package `onnx`, which only exporting needs.

    Call it before long work whose result will be exported, so that a missing package is noticed at once.

    Raises:
      ValueError: the package is not installed; says how to install it.
    """
    try:
        import onnx
    except ModuleNotFoundError as error:
        raise ValueError("onnx: is not installed; expected `pip install 'jaxtune[onnx]'`") from error
    return onnx


def export(out: Path, ppo: PPOState, learner: Learner) -> None:
    """Writes the files that a robot needs: `policy.onnx`, `policy.npz`, `network.py`, and its player if it has one.

    Args:
      out: folder for them, made where it is missing.
      ppo: the learnt policy.
      learner: of the robot and the preset that it was trained with.

    Raises:
      ValueError: the package `onnx` is not installed, or the policy holds a number that is not finite.
    """
    onnx = require_onnx()
    (mean, std), layers = jax.device_get(PPO.layers(ppo))
    check_finite("policy", {"mean": mean, "std": std, "layers": layers})
    kind = learner.kind
    text = json.dumps(kind.meta(learner.preset, learner.robot) | {"layers": len(layers)})
    out.mkdir(parents=True, exist_ok=True)
    onnx.save(_graph(onnx, mean, std, layers, text), out / "policy.onnx")
    arrays = {
        f"{name}_{i}": part
        for i, layer in enumerate(layers)
        for name, part in zip(("kernel", "bias"), layer, strict=True)
    }
    np.savez(out / "policy.npz", meta=np.array(text), mean=mean, std=std, **arrays)
    shutil.copy(network.__file__, out / "network.py")
    if kind.player:
        shutil.copy(kind.player, out / "player.py")


def _graph(onnx, mean: np.ndarray, std: np.ndarray, layers, text: str):
    """Builds the graph, observation [batch, obs] to action [batch, act], the normaliser included."""
    make, tensor = onnx.helper.make_node, onnx.numpy_helper.from_array
    nodes = [make("Sub", ["obs", "mean"], ["centred"]), make("Div", ["centred", "std"], ["value_0"])]
    weights = [tensor(mean, "mean"), tensor(std, "std")]
    for index, (kernel, bias) in enumerate(layers):
        last = index + 1 == len(layers)
        weights += [tensor(kernel, f"kernel_{index}"), tensor(bias, f"bias_{index}")]
        out = "action" if last else f"dense_{index}"
        nodes.append(make("Gemm", [f"value_{index}", f"kernel_{index}", f"bias_{index}"], [out]))
        if not last:
            nodes.append(make("Elu", [out], [f"value_{index + 1}"]))
    edge = lambda name, size: onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", size])  # noqa: E731
    graph = onnx.helper.make_graph(
        nodes, "policy", [edge("obs", len(mean))], [edge("action", len(layers[-1][1]))], weights
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.helper.set_model_props(model, {"meta": text})
    onnx.checker.check_model(model, full_check=True)
    return model
