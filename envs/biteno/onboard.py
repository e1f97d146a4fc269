"""What BITeno's computer must know around an exported policy; `player.py` is the code that runs there."""

from functools import cache

import mujoco
import numpy as np

from envs import sensing
from envs.biteno import constants
from envs.biteno.env import ACTION_LIMIT, TaskConfig

# In training an episode ends at a tilt of 45 degrees and begins within 0.1 rad of the stand; readings may be off.
_TILT_LIMIT_RAD = 1.0
_START_RAD = 0.4


@cache
def joint_ranges() -> np.ndarray:
    """Least and largest position of every joint, [2, joints] rad, to which the robot clips its targets."""
    model = mujoco.MjModel.from_xml_path(str(constants.MODEL_PATH))
    return np.array([model.joint(name).range for name in constants.JOINTS]).T


def meta(task: TaskConfig) -> dict:
    """Describes everything around the network, for the metadata of an exported policy.

    Args:
      task: in which the policy was trained.

    Returns:
      Joints, rate, layout and scales of the observation, the gait clock, the reference that an action is added to, the
      joint controller's gains, and beyond what the policy must not be used; all of it JSON.
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
        "joint_range_rad": joint_ranges().T.tolist(),
        "start_rad": _START_RAD,
        "tilt_limit_rad": _TILT_LIMIT_RAD,
        "command_max": list(task.command_max),
        "action_limit": ACTION_LIMIT,
        "action_scale": task.action_scale,
        "base": task.base,
        "clock": {"hz": constants.CLOCK_HZ, "duty": constants.DUTY, "offsets": [0.0, 0.5]},
        "leg": {
            "hip_y_m": constants.HIP_Y_M.tolist(),
            "link_m": constants.LINK_M,
            "stance_depth_m": constants.STANCE_DEPTH_M,
            "swing_height_m": constants.SWING_HEIGHT_M,
        },
        "controller": {"type": "pd", "kp": kp.tolist(), "kd": kd.tolist(), "torque_limit_nm": limit.tolist()},
    }
