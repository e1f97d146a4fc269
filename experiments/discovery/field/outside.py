"""Effects that the library does not have, so that the right answer is `unnamed`; each in one or two generators."""

import numpy as np

from experiments.discovery.field.forms import Forms, Now, Setting
from experiments.discovery.field.robots import Robot

OUTSIDE = Forms()


@OUTSIDE.add("outside")
def _cogging(setting: Setting):
    """A torque with 18 waves a turn, and a second harmonic."""
    return lambda torque, now: torque + setting.size * (np.sin(18 * now.q) + 0.4 * np.sin(36 * now.q + 1.0))


@OUTSIDE.add("torque")
def _temperature_fade(setting: Setting):
    """The motor loses a share of its torque in the course of each run."""
    return lambda torque, now: torque * (1.0 - setting.size * now.share**1.5)


@OUTSIDE.add("outside")
def _detent(setting: Setting):
    """A magnet that holds the joint where it comes within 0.15 rad, at two angles."""

    def pull(away: np.ndarray) -> np.ndarray:
        return away / 0.15 * np.exp(0.5 - 0.5 * (away / 0.15) ** 2)

    return lambda torque, now: torque - setting.size * (pull(now.q - 0.2) + pull(now.q + 0.5))


@OUTSIDE.add("numbers")
def _loose_foot(robot: Robot, place: int, size: float) -> Robot:
    """A ball on a string of 6 cm below a link."""

    def more(values: np.ndarray, value) -> np.ndarray:
        return np.concatenate([values, np.asarray(value, float)[None]])

    below = 1.6 * robot.com[place]
    fields = {
        "pos": below,
        "axis": [0, 1, 0],
        "mass": size,
        "com": [0, 0, -0.06],
        "inertia": np.eye(3) * 4e-4 * size,
        "armature": 1e-5,
        "damping": 6e-4 * size,
        "friction": 0.0,
        "kp": 0.0,
        "kd": 0.0,
        "limit": 0.0,
    }
    numbers = {name: more(getattr(robot, name), value) for name, value in fields.items()}
    names = {"joints": (*robot.joints, "loose"), "bodies": (*robot.bodies, "loose"), "parents": (*robot.parents, place)}
    return type(robot)(limited=robot.limited, **names, **numbers)


@OUTSIDE.add("sensor")
def _gear_error(setting: Setting):
    """The gear's teeth are uneven: what is read has an error with 7 waves a turn."""

    def act(read: np.ndarray, now: Now) -> np.ndarray:
        q, v = read
        return np.stack([q + setting.size * np.sin(7 * q), v * (1 + 7 * setting.size * np.cos(7 * q))])

    return act


@OUTSIDE.add("links")
def _joint_coupling(setting: Setting, links, at: list[int]):
    """A cable over both joints: a torque in proportion to the position of the joint next to it, on both."""
    del links
    first, second = at[0], at[0] - 1 if at[0] > 0 else 1
    stiffness = setting.size[:, 0] * setting.kp[:, 0]

    def act(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        del v
        torque = np.zeros_like(q)
        pull = -stiffness * np.sin(1.5 * (q[:, first] + q[:, second]))
        torque[:, first], torque[:, second] = pull, 0.5 * pull
        return torque

    return act


@OUTSIDE.add("torque")
def _dropout(setting: Setting):
    """The motor is without power for a part of each of four periods of a run."""
    return lambda torque, now: np.where((4.0 * now.share + 0.37) % 1.0 < setting.size, 0.1 * torque, torque)


@OUTSIDE.add("torque")
def _worn_gear(setting: Setting):
    """The gear passes less torque over a third of its turn."""
    return lambda torque, now: torque * (1.0 - setting.size * (0.5 + 0.5 * np.tanh(8 * np.sin(2 * now.q + 0.5))))
