"""Writes policy files that a robot's computer can run without JAX.

`policy.onnx` is the network from observation to action, with its normaliser. `policy.npz` holds the same numbers for
`player.py`, which needs only NumPy. Both contain under `meta`, as JSON, everything around the network.
"""

import json
import shutil
from pathlib import Path
from types import ModuleType

import jax
import mujoco
import numpy as np

from envs import sensing
from envs.biteno import constants, env
from experiments.common.config import Preset
from experiments.robot import player
from jaxtune.ppo import PPO, PPOState


def meta(sizes: Preset) -> dict:
    """Describes everything around the network, for the metadata of the exported files.

    Args:
      sizes: the preset that the policy was trained with.

    Returns:
      Joints, rate, layout and scales of the observation, the gait clock, the reference that an action is added to, and
      the joint controller's gains; all of it JSON.
    """
    model = mujoco.MjModel.from_xml_path(str(constants.MODEL_PATH))
    kp, kd, limit = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2], model.actuator_forcerange[:, 1]
    return {
        "robot": "biteno",
        "joints": list(constants.JOINTS),
        "rate_hz": 1.0 / constants.POLICY_DT_S,
        "observation": [
            {"name": name, "size": len(scale), "scale": scale.tolist()} for name, scale in sensing.LAYOUT.items()
        ],
        "stand_rad": constants.STAND_RAD.tolist(),
        "action_limit": env.ACTION_LIMIT,
        "action_scale": sizes.task.action_scale,
        "base": sizes.task.base,
        "clock": {"hz": constants.CLOCK_HZ, "duty": constants.DUTY, "offsets": [0.0, 0.5]},
        "leg": {
            "hip_y_m": constants.HIP_Y_M.tolist(),
            "link_m": constants.LINK_M,
            "stance_depth_m": constants.STANCE_DEPTH_M,
            "swing_height_m": constants.SWING_HEIGHT_M,
        },
        "controller": {"type": "pd", "kp": kp.tolist(), "kd": kd.tolist(), "torque_limit_nm": limit.tolist()},
    }


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


def export(out: Path, ppo: PPOState, sizes: Preset) -> None:
    """Writes the three files that a robot needs: `policy.onnx`, `policy.npz` and `player.py`.

    Args:
      out: folder for them, made where it is missing.
      ppo: the learnt policy.
      sizes: the preset that it was trained with; `meta` takes reference and action scale from it.

    Raises:
      ValueError: the package `onnx` is not installed.
    """
    onnx = require_onnx()
    (mean, std), layers = jax.device_get(PPO.layers(ppo))
    text = json.dumps(meta(sizes) | {"layers": len(layers)})
    out.mkdir(parents=True, exist_ok=True)
    onnx.save(_graph(onnx, mean, std, layers, text), out / "policy.onnx")
    arrays = {
        f"{name}_{i}": part
        for i, layer in enumerate(layers)
        for name, part in zip(("kernel", "bias"), layer, strict=True)
    }
    np.savez(out / "policy.npz", meta=np.array(text), mean=mean, std=std, **arrays)
    shutil.copy(player.__file__, out / "player.py")


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
