"""Measures the scales of a rig's coordinates: the physical size that one unit of each stands for.

Discovery searches many effects at once, whose units differ (Nm, kg, s). Scaled by what the robot did in the log, a
coordinate of one is a large effect for all of them, on a servo as on a biped.
"""

from collections.abc import Sequence

import numpy as np

from envs.logs import Run
from envs.regimes import control_torque
from envs.rig import Rig
from envs.segments import smoothed

_WOUND = 0.02  # rad, by which a spring winds up under the rms torque
_LOAD = 0.05  # of the mass of all links
_LEVER_M = 0.001  # a centre of mass on its joint's axis is not dragged
_DRIVEN = 0.01  # least share of the torque that moves a joint's inertia; a passive joint gets none


def measure_scales(rig: Rig, runs: Sequence[Run]) -> dict[str, np.ndarray]:
    """Measures scales with which one unit of every coordinate matters about equally, whatever the robot's size.

    With rms values over all rows, tau the controller's torque and dq the joint's speed, per joint or body:

        torque     rms(tau); of a joint that no torque drives, what its inertia takes, rms(inertia ddq)   Nm
        damping    torque / rms(dq)            Nm s/rad
        quadratic  torque / rms(dq)^2          Nm s^2/rad^2
        stiffness  torque / (0.02 angle)       Nm/rad
        spring     torque / rms angle from where the model's springs rest    Nm/rad
        hardening  1 / (0.02 angle)^2          1/rad^2
        inertia    diagonal of the joint-space inertia in the mean pose, kg m^2
        mass       mass of the body, or a twentieth of all links' where that is more: what a light wrist
                   carries goes by what the arm can lift   kg
        drag       least of torque / (lever v) over the joints that move the body's centre of mass by 1 mm a
                   rad or more (else the joint next to it), with the rms v of the centre in the mean pose   N s/m
        air        drag / v                    N s^2/m^2
        speed      rms(dq)                     rad/s
        slow       0.1 rms(dq)                 rad/s
        motor      largest limit / rms(dq)     Nm s/rad
        of_before  torque / torque of the joint that carries this one
        of_after   the same of the one that it carries
        angle      1 rad of a hinge; of a slide 0.05 m, which a pinion of that radius moves it by

    Hand the result to `Rig.scaled`.

    Args:
      rig: the robot.
      runs: of the log, without sealed ones: they set the sizes at which effects are tried, and must not see the test.

    Returns:
      [places] by the name of the scale (`jaxtune.types.Scale`).
    """
    torque, speed, rise, limit, pose = [], [], [], [], []
    for run in runs:
        position, velocity = np.moveaxis(smoothed(run), 1, 0)
        wanted, most = control_torque(run, position, velocity)
        torque.append(wanted)
        speed.append(velocity)
        rise.append(np.gradient(velocity, run.time, axis=0))
        # An infinite limit is no limit; without any, `motor` is tiny.
        limit.append(np.where(np.isfinite(most), most, 0.0))
        pose.append(position)
    mean_pose = np.concatenate(pose).mean(axis=0)
    mass, inertia = rig.inertias(mean_pose)
    moves = inertia * _rms(rise)
    torque = np.where(_rms(torque) > _DRIVEN * moves, _rms(torque), moves)
    wound = _WOUND * rig.units
    angles = [one - rig.mj_model.qpos_spring[rig.qpos] for one in pose]
    pace = _rms(speed)
    drag, fast = _drag(rig, mean_pose, torque, pace)
    before, after = rig.chain.beside
    return {
        "torque": torque,
        "damping": torque / pace,
        "quadratic": torque / pace**2,
        "stiffness": torque / wound,
        "spring": torque / np.maximum(_rms(angles), wound),
        "hardening": 1.0 / wound**2,
        "inertia": inertia,
        "mass": np.maximum(mass, _LOAD * mass.sum()),
        "drag": drag,
        "air": drag / fast,
        "speed": pace,
        "slow": 0.1 * pace,
        "angle": rig.units,
        "motor": np.maximum(np.concatenate(limit).max(axis=0), 1e-6) / pace,
        # Any number will do where there is none.
        "of_before": torque / np.append(torque, 1.0)[before],
        "of_after": torque / np.append(torque, 1.0)[after],
    }


def _drag(rig: Rig, pose: np.ndarray, torque: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The drag of every body that takes all of a joint's torque, [bodies] N s/m, and its speed, [bodies] m/s."""
    levers = rig.levers(pose)
    for mine, name in zip(levers, rig.places["body"], strict=True):
        # On the axes of all its joints nothing drags, so any size will do.
        if mine.max() < _LEVER_M:
            mine[rig.moves("body", name)[0]] = _LEVER_M
    moved = levers >= _LEVER_M
    fast = np.sqrt((np.where(moved, levers * speed, 0.0) ** 2).sum(axis=1))
    share = np.divide(torque, levers, out=np.full_like(levers, np.inf), where=moved)
    return share.min(axis=1) / fast, fast


def _rms(values: Sequence[np.ndarray]) -> np.ndarray:
    return np.sqrt((np.concatenate(values) ** 2).mean(axis=0)) + 1e-6
