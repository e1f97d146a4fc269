"""What one unit of each coordinate stands for, measured on what the robot did."""

from collections.abc import Sequence

import numpy as np

from envs.logs import Run
from envs.regimes import control_torque
from envs.rig import Rig
from envs.segments import smoothed


def measure_scales(rig: Rig, runs: Sequence[Run]) -> dict[str, np.ndarray]:
    """Measures scales that make coordinates of one unit matter about equally, whatever the robot's size.

    A unit of friction is the torque that the joint had, a unit of inertia what it felt of the robot, and so on. Hand
    the result to `Rig.scaled`.

    Args:
      rig: the robot.
      runs: what it did; sealed runs must not be among them.

    Returns:
      [places] by the name of the scale (`jaxtune.types.Scale`).
    """
    torque, speed, limit, pose = [], [], [], []
    for run in runs:
        position, velocity = np.moveaxis(smoothed(run), 1, 0)
        wanted, most = control_torque(run, position, velocity)
        torque.append(wanted)
        speed.append(velocity)
        limit.append(np.where(np.isfinite(most), most, 0.0))
        pose.append(position)
    mass, inertia = rig.inertias(np.concatenate(pose).mean(axis=0))
    return {
        "torque": _rms(torque),
        "damping": _rms(torque) / _rms(speed),
        "stiffness": _rms(torque) / 0.02,  # a joint that winds up by 20 mrad under the torque that it had
        "inertia": inertia,
        "mass": mass,
        "drag": mass * 9.81,  # N s/m that weigh as much as the link at 1 m/s
        "speed": _rms(speed),
        "slow": 0.1 * _rms(speed),
        "motor": np.maximum(np.concatenate(limit).max(axis=0), 1e-6) / _rms(speed),
    }


def _rms(values: Sequence[np.ndarray]) -> np.ndarray:
    return np.sqrt((np.concatenate(values) ** 2).mean(axis=0)) + 1e-6
