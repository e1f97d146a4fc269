"""Draws motions that make missing effects distinguishable, for a robot that is suspended or clamped.

Posture and gain differ from run to run, so that a log can be split by condition, with every kind of motion
(`target_runs`) in every part. `deciding` chooses the motion in which two suspects differ most.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import mujoco
import numpy as np

from envs.diagnosis.contacts import touching
from envs.logs import Controller, Log
from envs.models import suspended
from experiments.discovery.target_runs import MOTIONS, TargetRun, slowed, targets

_LEAST_ROWS = 10  # of a piece
_LOOK_S = 0.02  # between targets that are tested for contacts
_TRIES, _SMALLER = 40, 0.95  # motions that are drawn until none touches, and by how much each is smaller


class Unplayable(ValueError):
    """Bodies of a robot touch in every motion that was drawn, or it flies apart."""


@dataclass(frozen=True, kw_only=True)
class Decision:
    """The motion that would decide between two suspects, of all candidates."""

    name: str
    """Of the motion, for `python -m experiments.excite --motion NAME`."""
    motion: list[TargetRun]
    scores: Mapping[str, float]
    """Of every candidate, by name; minus infinity where a score was no number."""


def deciding(
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    score: Callable[[list[TargetRun]], float],
    *,
    runs: int = 4,
    seconds: float = 3.0,
    rate_hz: float = 500.0,
    seed: int = 0,
    still: np.ndarray | bool = False,
    follow: Callable[[TargetRun], np.ndarray] | None = None,
) -> Decision | None:
    """Chooses the motion with the largest score, of all but the medleys.

    Args:
      spec: the robot.
      joints: names, in the order of the targets' columns.
      score: of a motion, larger where it decides better: say the difference of two suspects' simulations over noise.
      runs: number of runs, 4 or more.
      seconds: length of a run in s.
      rate_hz: rows per second.
      seed: of postures, paces and steps; `excite` writes the same targets with the same numbers.
      still: [joints] as in `excitation`.
      follow: as in `excitation`. Only motions that may be chosen are rehearsed, best first.

    Returns:
      The motion; None where no score is a number, or bodies touch in all motions.

    Raises:
      ValueError: fewer runs than can be split.
    """
    candidates = [name for name in MOTIONS if not name.endswith("medley")]
    motions = {}
    for name in candidates:
        with suppress(Unplayable):
            motions[name] = excitation(spec, joints, runs, seconds, rate_hz, seed, name, still)
    scores = {name: float(score(motion)) for name, motion in motions.items()}
    # A simulation that diverges under a suspect decides nothing.
    scores = {name: value if np.isfinite(value) else -np.inf for name, value in scores.items()}
    for name in sorted(scores, key=scores.__getitem__, reverse=True):
        if scores[name] == -np.inf:
            break
        with suppress(Unplayable):
            rehearsed = excitation(spec, joints, runs, seconds, rate_hz, seed, name, still, follow=follow)
            if any((one.target != other.target).any() for one, other in zip(rehearsed, motions[name], strict=True)):
                scores[name] = float(score(rehearsed))
            return Decision(name=name, motion=rehearsed, scores=scores)
    return None


def excitation(
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    runs: int,
    seconds: float,
    rate_hz: float,
    seed: int = 0,
    motion: str = "medley",
    still: np.ndarray | bool = False,
    max_speed: float = np.inf,
    follow: Callable[[TargetRun], np.ndarray] | None = None,
) -> list[TargetRun]:
    """Makes the target runs of a log in which effects are distinguishable.

    A motion in which bodies would touch is drawn again, and again smaller. What a robot on a free base touches beside
    itself is not known.

    Args:
      spec: the robot; postures are drawn within its joint ranges.
      joints: names, in the order of the targets' columns.
      runs: number of runs, 4 or more.
      seconds: length of a run in s.
      rate_hz: rows per second.
      seed: of postures, paces and steps.
      motion: a name of `MOTIONS`.
      still: [joints] true for those whose targets stay where they begin, as passive ones cannot follow any.
      max_speed: of targets, in rad/s (m/s for a slide); faster ones are cut to it.
      follow: where a run leads robots, [robots, n, joints] rad, which is looked at for contacts beside the targets.

    Returns:
      Runs, split into train, select and sealed so that every split has both of the motion's gains.

    Raises:
      ValueError: fewer runs than can be split, fewer rows than the motion needs, the motion is unknown, or a slide
        joint has no range.
      Unplayable: bodies touch wherever the robot moves, or `follow` says so.
    """
    if motion not in MOTIONS:
        raise ValueError(f"motion: got '{motion}', expected one of {', '.join(MOTIONS)}")
    if runs < 4:
        raise ValueError(f"runs: got {runs}, expected 4 or more: two for train, one for select and one for sealed")
    chosen = MOTIONS[motion]
    if not min(chosen.shares.values()) * seconds * rate_hz >= _LEAST_ROWS:
        raise ValueError(
            f"seconds: got {seconds:g} s at {rate_hz:g} rows a second, expected {_LEAST_ROWS} rows or more for every "
            f"part of '{motion}'"
        )
    rng = np.random.default_rng(seed)
    low, high, home = _ranges(suspended(spec, joints), joints)
    blocked = _Blocked(spec, joints)
    splits = ("train", "select", "train", "sealed")
    motions = []
    for number in range(runs):
        split = splits[number % len(splits)]
        # The gain alternates within every split. Of four runs one is for select, and it has the lower gain.
        earlier = sum(one.split == split for one in motions)
        gain = chosen.gains[(earlier + (split == "select")) % 2]
        for tried in range(_TRIES):
            posture = home + 0.25 * (high - low) * rng.uniform(-1, 1, len(joints))
            room = np.minimum(np.minimum(high - posture, posture - low), 0.6 * _SMALLER**tried)
            target, enabled = targets(chosen, posture, room, seconds, rate_hz, rng)
            target = slowed(np.where(still, target[0], target), max_speed / rate_hz)
            times = np.arange(len(target)) / rate_hz
            name, condition = f"run_{number:03d}", f"posture{number}_gain{gain:g}"
            drawn = TargetRun(name, condition, gain, split, times, target, enabled)
            pairs, where = blocked.by(drawn, round(seconds / _LOOK_S), follow)
            if not pairs:
                break
        else:
            swings = ", or choose a motion without a swing" if where != "targets" and not enabled.all() else ""
            raise Unplayable(
                "robot: in every motion that was drawn bodies touch by the model's geometry, at last "
                f"{' and '.join(pairs[0])} in {where}: narrow the joints' ranges, correct the geometry, mount the "
                f"robot away from it{swings}"
            )
        motions.append(drawn)
    return motions


class _Blocked:
    """Tells which bodies would be driven into each other, beside those that overlap as the model is drawn."""

    def __init__(self, spec: mujoco.MjSpec, joints: Sequence[str]):
        self._model, self._joints = spec.copy().compile(), joints
        columns = [int(self._model.joint(name).qposadr[0]) for name in joints]
        self._drawn = set(touching(self._model, joints, self._model.qpos0[None, columns]))

    def by(self, run: TargetRun, most: int, follow: Callable | None) -> tuple[list[tuple[str, str]], str]:
        """Lists pairs of bodies that touch, and says where: in the targets or, if not there, where they lead robots.

        Args:
          run: of targets.
          most: positions that are looked at, of the targets and of each robot.
          follow: as in `excitation`.
        """
        pairs = self._at(run.target, most)
        if pairs or follow is None:
            return pairs, "targets"
        return sorted(set().union(*(self._at(positions, most) for positions in follow(run)))), "the simulated motion"

    def _at(self, positions: np.ndarray, most: int) -> list[tuple[str, str]]:
        return sorted(set(touching(self._model, self._joints, positions, most)) - self._drawn)


def controller_of(log: Log) -> Controller:
    """Returns the controller of the first run in which a joint follows its target, else of the first run."""
    return next((run.controller for run in log.runs if not passive(run.controller).all()), log.runs[0].controller)


def passive(controller: Controller) -> np.ndarray:
    """Tells which joints cannot follow a target since their kp is zero, [joints]; one False for a servo."""
    return controller.gains.get("kp", np.ones(1)) == 0


def unlimited_slides(model: mujoco.MjModel, joints: Sequence[str]) -> list[str]:
    """Lists slide joints of which nobody says how far they may move."""
    found = [model.joint(name) for name in joints]
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    return [one.name for one in found if model.jnt_type[one.id] == slide and not model.jnt_limited[one.id]]


def _ranges(model: mujoco.MjModel, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns least, largest and middle positions; a hinge without limits turns by a right angle each way."""
    found = [model.joint(name) for name in joints]
    limited = np.array([bool(model.jnt_limited[joint.id]) for joint in found])
    if endless := unlimited_slides(model, joints):
        raise ValueError(f"robot: slide joint '{endless[0]}' has no range, expected one in the MJCF, in m")
    span = np.array([joint.range for joint in found])
    home = np.array([joint.qpos0[0] for joint in found])
    low, high = np.where(limited[:, None], span, home[:, None] + [-np.pi / 2, np.pi / 2]).T
    return low, high, np.where(limited, 0.5 * (low + high), home)
