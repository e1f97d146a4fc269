"""Designs motions that make missing effects distinguishable, for a robot that is suspended or clamped.

Every run moves about one posture with one controller gain. It consists of slow triangular reversals (friction,
backlash), a chirp to 10 Hz (delay, lag, inertia), steps that may saturate the motors (torque limits), and a swing with
the motors off (mass and friction without the actuators). Posture and gain differ from run to run, so that a log can be
split by condition, with every kind of motion in every part.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from envs.logs import Controller
from envs.models import suspended

_CHIRP_HZ = (0.5, 10.0)
_SHARES = {"triangle": 0.35, "chirp": 0.3, "steps": 0.2, "swing": 0.15}  # of a run's time


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


def excitation(
    spec: mujoco.MjSpec, joints: Sequence[str], runs: int, seconds: float, rate_hz: float, seed: int = 0
) -> list[TargetRun]:
    """Makes the target runs of a log in which effects are distinguishable.

    Args:
      spec: the robot; postures are drawn within its joint ranges.
      joints: names, in the order of the targets' columns.
      runs: number of runs, 4 or more.
      seconds: length of a run in s.
      rate_hz: rows per second.
      seed: of postures, paces and steps.

    Returns:
      Runs, split into train, select and sealed so that every split has both controller gains.

    Raises:
      ValueError: fewer runs than can be split.
    """
    if runs < 4:
        raise ValueError(f"runs: got {runs}, expected 4 or more: two for train, one for select and one for sealed")
    rng = np.random.default_rng(seed)
    low, high, home = _ranges(suspended(spec), joints)
    splits = ("train", "select", "train", "sealed")
    motions = []
    for number in range(runs):
        posture = home + 0.25 * (high - low) * rng.uniform(-1, 1, len(joints))
        room = np.minimum(np.minimum(high - posture, posture - low), 0.6)
        target, enabled = _medley(posture, np.maximum(room, 0.05), seconds, rate_hz, rng)
        split = splits[number % len(splits)]
        # The gain alternates within every split. Of four runs one is for select, and it has the lower gain.
        earlier = sum(motion.split == split for motion in motions)
        gain = (1.0, 0.5)[(earlier + (split == "select")) % 2]
        motions.append(
            TargetRun(
                f"run_{number:03d}",
                f"posture{number}_gain{gain:g}",
                gain,
                split,
                np.arange(len(target)) / rate_hz,
                target,
                enabled,
            )
        )
    return motions


def _ranges(model: mujoco.MjModel, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns least, largest and middle positions; a joint without limits turns by a right angle each way."""
    found = [model.joint(name) for name in joints]
    limited = np.array([bool(model.jnt_limited[joint.id]) for joint in found])
    span = np.array([joint.range for joint in found])
    low, high = np.where(limited[:, None], span, [-np.pi / 2, np.pi / 2]).T
    middle = np.where(limited, 0.5 * (low + high), np.array([joint.qpos0[0] for joint in found]))
    return low, high, middle


def _medley(posture, room, seconds, rate_hz, rng) -> tuple[np.ndarray, np.ndarray]:
    rows = {name: round(share * seconds * rate_hz) for name, share in _SHARES.items()}
    count = len(posture)
    pieces = []
    # Joints move at different paces, so that coupling between them shows.
    time = np.arange(rows["triangle"]) / rate_hz
    pace = rng.uniform(0.8, 1.6, count) / (rows["triangle"] / rate_hz) * 1.5
    phase = (time[:, None] * pace + rng.uniform(0, 1, count)) % 1.0
    pieces.append(posture + 0.7 * room * (4 * np.abs(phase - 0.5) - 1))
    time = np.arange(rows["chirp"]) / rate_hz
    length = rows["chirp"] / rate_hz
    ratio = _CHIRP_HZ[1] / _CHIRP_HZ[0]
    cycles = _CHIRP_HZ[0] * length / np.log(ratio) * (ratio ** (time / length) - 1)
    fade = 0.4 / (1 + 3 * time / length)
    pieces.append(posture + (fade[:, None] * room) * np.sin(2 * np.pi * (cycles[:, None] + rng.uniform(0, 1, count))))
    every = max(1, round(0.15 * rate_hz))
    levels = rng.uniform(-1, 1, (-(-rows["steps"] // every), count))
    pieces.append(posture + 0.8 * room * np.repeat(levels, every, axis=0)[: rows["steps"]])
    pieces.append(np.repeat(posture[None], rows["swing"], axis=0))
    target = np.concatenate(pieces)
    enabled = np.ones(len(target))
    enabled[-rows["swing"] :] = 0.0
    return target, enabled


def scaled(controller: Controller, gain: float) -> Controller:
    """Returns a controller whose proportional and derivative gains are multiplied by a factor; limits stay.

    Two gains make effects of the controller (delay, gain error) distinguishable from those of the body.
    """
    gains = {name: values * (gain if name in ("kp", "kd") else 1.0) for name, values in controller.gains.items()}
    return replace(controller, gains=gains)
