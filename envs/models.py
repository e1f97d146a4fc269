"""The model of a robot, by the name that a log gives it, and the same robot suspended: without its free base."""

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
    """Loads the MJCF of a robot, so that it can be compiled or changed before.

    Args:
      robot: the name of a built-in robot, or the path of an MJCF file, as in a log's `meta.yaml`.

    Raises:
      ValueError: it is neither, or the file is no MJCF.
    """
    path = BUILT_IN[robot][0] if robot in BUILT_IN else Path(robot)
    if not path.is_file():
        raise ValueError(f"robot: got '{robot}', expected {', '.join(BUILT_IN)} or the path of an MJCF file")
    return mujoco.MjSpec.from_file(str(path))


def suspended(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a robot as it hangs on a test rig: without its free joints and without contacts.

    Args:
      spec: of the robot; it is copied. Keyframes are dropped where a free joint is, because they contain its pose.
    """
    spec = spec.copy()
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if free:
        # Keyframes would have the wrong size without the base.
        for key in spec.keys:
            spec.delete(key)
    for joint in free:
        spec.delete(joint)
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model
