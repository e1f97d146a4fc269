"""Models by the name that a log gives its robot."""

from pathlib import Path

import mujoco

from envs import pendulum
from envs.biteno import constants

BUILT_IN = {
    "biteno": (constants.MODEL_PATH, constants.JOINTS),
    "pendulum": (pendulum.MODEL_PATH, pendulum.JOINTS),
}
"""Path of the MJCF and the joints that may be logged; any other robot is the path of an MJCF file."""


def spec(robot: str) -> mujoco.MjSpec:
    """The model of a robot: a built-in name, or a path."""
    path = BUILT_IN[robot][0] if robot in BUILT_IN else Path(robot)
    return mujoco.MjSpec.from_file(str(path))
