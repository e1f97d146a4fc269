"""What a robot is told to do for a log in which effects can be distinguished: motions by name, as joint targets.

Every run of the `medley` moves about one posture with one controller gain. It consists of slow triangular reversals
(friction, backlash), a chirp to 10 Hz (delay, lag, inertia), steps that may saturate the motors (torque limits), and a
swing with the motors off (mass and friction without the actuators). The other motions have one of these each.
`excitation` draws postures for them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from envs.logs import Controller

_CHIRP_HZ = (0.5, 10.0)


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What the runs of a log do, whatever the robot; a row of `MOTIONS`."""

    shares: Mapping[str, float]
    """Parts of a run's time in their order, by the name of a piece (`_PIECES`)."""
    gains: tuple[float, float] = (1.0, 0.5)
    """Factors on kp and kd, which alternate within every split."""
    size: float = 1.0
    """Factor on the amplitudes of the pieces."""
    shows: str
    """What the motion makes visible, for a person."""


MOTIONS = {
    "medley": Motion(
        shares={"triangle": 0.35, "chirp": 0.3, "steps": 0.2, "swing": 0.15},
        shows="a little of everything, for a first log",
    ),
    "powered_medley": Motion(
        shares={"triangle": 0.4, "chirp": 0.35, "steps": 0.25},
        shows="the same without the swing, for a robot whose brakes close when its motors are off",
    ),
    "slow_triangles": Motion(shares={"triangle": 1.0}, shows="friction and backlash, at slow reversals"),
    "small_steps": Motion(shares={"steps": 1.0}, size=0.25, shows="deadband, backlash and delay, below all limits"),
    "large_steps": Motion(shares={"steps": 1.0}, shows="limits of torque and speed"),
    "chirp": Motion(shares={"chirp": 1.0}, gains=(1.0, 1.0), shows="delay, lag and inertia, up to 10 Hz"),
    "soft_chirp": Motion(shares={"chirp": 1.0}, gains=(0.5, 0.5), shows="inertia and compliance, at half the gains"),
    "swing": Motion(shares={"steps": 0.3, "swing": 0.7}, shows="mass and friction without the motors"),
    "holds": Motion(shares={"holds": 1.0}, shows="gravity, bias and scale of torque, in two postures a run"),
}
"""Motions by name: what `excite --motion` writes, and what `deciding` chooses among (all but the medleys)."""


@dataclass(frozen=True)
class TargetRun:
    """The joint targets of one run, before anything is measured; a robot or a simulation plays it."""

    name: str
    """Name of the run, which is that of its file."""
    condition: str
    """Posture and gain of the run; runs of one condition belong to one split."""
    gain: float
    """Factor on kp and kd of the joint controllers in this run."""
    split: str
    """train, select (validation) or sealed (held-out test)."""
    time: np.ndarray
    """[rows] s"""
    target: np.ndarray
    """[rows, joints] rad"""
    enabled: np.ndarray
    """[rows] 0 where the motors are off."""


def targets(
    motion: Motion, posture: np.ndarray, room: np.ndarray, seconds: float, rate_hz: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Puts the pieces of a run together.

    Args:
      motion: what the run does.
      posture: [joints] rad about which it moves.
      room: [joints] rad to either side.
      seconds: length of the run in s.
      rate_hz: rows per second.
      rng: for paces, phases and steps.

    Returns:
      Targets [rows, joints] rad, and whether the motors are on [rows].
    """
    rows = {name: round(share * seconds * rate_hz) for name, share in motion.shares.items()}
    offsets = [_PIECES[name](count, len(posture), rate_hz, rng) for name, count in rows.items()]
    on = [np.full(count, float(name != "swing")) for name, count in rows.items()]
    return posture + motion.size * room * np.concatenate(offsets), np.concatenate(on)


def slowed(target: np.ndarray, most: float) -> np.ndarray:
    """Cuts the steps between rows of targets [rows, joints] to a largest size."""
    if not np.isfinite(most):
        return target
    slow = target.copy()
    for row in range(1, len(slow)):
        slow[row] = slow[row - 1] + np.clip(target[row] - slow[row - 1], -most, most)
    return slow


def scaled(controller: Controller, gain: float) -> Controller:
    """Returns a controller whose gains of position and velocity errors are multiplied by a factor; limits stay.

    Two gains make effects of the controller (delay, gain error) distinguishable from those of the body.
    """
    gains = {
        name: values * (gain if name in ("kp", "kd", "gain") else 1.0) for name, values in controller.gains.items()
    }
    return replace(controller, gains=gains)


def _triangle(rows: int, joints: int, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    # Joints move at different paces, so that coupling between them shows.
    pace = rng.uniform(0.8, 1.6, joints) / (rows / rate_hz) * 1.5
    phase = (np.arange(rows)[:, None] / rate_hz * pace + rng.uniform(0, 1, joints)) % 1.0
    return 0.7 * (4 * np.abs(phase - 0.5) - 1)


def _chirp(rows: int, joints: int, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    share, length = np.arange(rows) / rows, rows / rate_hz
    ratio = _CHIRP_HZ[1] / _CHIRP_HZ[0]
    cycles = _CHIRP_HZ[0] * length / np.log(ratio) * (ratio**share - 1)
    fade = 0.4 / (1 + 3 * share)
    return fade[:, None] * np.sin(2 * np.pi * (cycles[:, None] + rng.uniform(0, 1, joints)))


def _steps(rows: int, joints: int, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    every = max(1, round(0.15 * rate_hz))
    levels = rng.uniform(-1, 1, (-(-rows // every), joints))
    return 0.8 * np.repeat(levels, every, axis=0)[:rows]


def _holds(rows: int, joints: int, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    # The way between both postures takes a third of the time, so that little is excited but gravity.
    side = np.where(rng.uniform(size=joints) < 0.5, -1.0, 1.0)
    return 0.8 * side * np.clip(3.0 * (2.0 * np.arange(rows)[:, None] / rows - 1.0), -1.0, 1.0)


def _rest(rows: int, joints: int, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    return np.zeros((rows, joints))


# Of rows, joints, rows per second and random numbers: targets as shares of the room, [rows, joints].
_PIECES = {"triangle": _triangle, "chirp": _chirp, "steps": _steps, "holds": _holds, "swing": _rest}
