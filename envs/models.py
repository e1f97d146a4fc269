"""Loads the model of a robot by the name that a log gives it, and suspends it on a test rig.

A suspended robot has no free base and no contacts. Discovery works on it, because the motion of a base is rarely
measured and contact is chaotic.
"""

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
    """Loads the MJCF of a robot as a spec, which can be changed before it is compiled.

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
    """Compiles a robot as it is on a test rig: without its free joints, and with contacts switched off.

    Args:
      spec: of the robot; it is copied, not changed.

    Returns:
      The compiled model. It has no keyframes if a free joint was removed, because they contain the base's pose.
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
