"""Writes a policy that a robot's computer can run without JAX: `python -m experiments.export --out DIR`.

`policy.onnx` is the network with its normaliser, observation in and action out; `policy.npz` is the same for
`experiments.player`. Both carry, as JSON under `meta`, what is around the network: the observation's layout and scales,
the gait clock, the reference that an action is added to, joints, gains and rate.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import jax
import mujoco
import numpy as np

from envs import sensing
from envs.biteno import constants, env
from experiments import player
from experiments.config import Preset, chosen, preset
from experiments.loop import Loop
from experiments.train import console, run, starting_policy
from jaxtune.ppo import PPO, PPOState


@dataclass(frozen=True, kw_only=True)
class Args:
    """Exports a policy to ONNX and NumPy."""

    out: Path
    """Folder of policy.onnx, policy.npz and player.py."""
    policy: str = "walk"
    """Policy: walk (ships with the package) or a folder of experiments.train."""
    preset: str = "cpu"
    """Sizes that it was trained with."""


def meta(sizes: Preset) -> dict:
    """What is around the network, as JSON."""
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


def needed():
    """The package `onnx`, an extra: who only tunes in simulation needs none.

    Raises:
      ValueError: it is not there.
    """
    try:
        import onnx
    except ModuleNotFoundError as error:
        raise ValueError("onnx: is not installed; expected `pip install 'jaxtune[onnx]'`") from error
    return onnx


def export(out: Path, learner: PPOState, sizes: Preset) -> None:
    """Writes the three files.

    Raises:
      ValueError: the package `onnx` is not there.
    """
    onnx = needed()
    (mean, std), layers = jax.device_get(PPO.layers(learner))
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
    """Observation [batch, obs] to action [batch, act]."""
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


def main(args: Args) -> None:
    """Loads and writes."""
    sizes = preset(args.preset)
    loop = Loop(sizes, chosen("foot_friction"))
    export(args.out, starting_policy(args.policy, loop).learner, sizes)
    console.print(f"policy.onnx, policy.npz and player.py in {args.out}")


if __name__ == "__main__":
    run(main, Args)
