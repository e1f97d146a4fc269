"""Designs motions that make missing effects distinguishable, for a robot that is suspended or clamped.

Every run of the `medley` moves about one posture with one controller gain. It consists of slow triangular reversals
(friction, backlash), a chirp to 10 Hz (delay, lag, inertia), steps that may saturate the motors (torque limits), and a
swing with the motors off (mass and friction without the actuators). Posture and gain differ from run to run, so that a
log can be split by condition, with every kind of motion in every part.

The other motions have one of these each. `deciding` chooses the one in which two suspects differ most.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from envs.diagnosis.contacts import touching
from envs.logs import Controller, Log
from envs.models import suspended

_CHIRP_HZ = (0.5, 10.0)
_LEAST_ROWS = 10  # of a piece
_LOOK_S = 0.02  # between targets that are tested for contacts
_TRIES, _SMALLER = 40, 0.95  # motions that are drawn until none touches, and by how much each is smaller


class Unplayable(ValueError):
    """Bodies of a robot touch in every motion that was drawn, or it flies apart."""


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
            target, enabled = _targets(chosen, posture, room, seconds, rate_hz, rng)
            target = _slowed(np.where(still, target[0], target), max_speed / rate_hz)
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


def _slowed(target: np.ndarray, most: float) -> np.ndarray:
    """Cuts the steps between rows of targets [rows, joints] to a largest size."""
    if not np.isfinite(most):
        return target
    slow = target.copy()
    for row in range(1, len(slow)):
        slow[row] = slow[row - 1] + np.clip(target[row] - slow[row - 1], -most, most)
    return slow


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
    low, high = np.where(limited[:, None], span, [-np.pi / 2, np.pi / 2]).T
    middle = np.where(limited, 0.5 * (low + high), np.array([joint.qpos0[0] for joint in found]))
    return low, high, middle


def _targets(motion: Motion, posture, room, seconds, rate_hz, rng) -> tuple[np.ndarray, np.ndarray]:
    """Puts the pieces of a run together; returns targets [rows, joints] and whether the motors are on [rows]."""
    rows = {name: round(share * seconds * rate_hz) for name, share in motion.shares.items()}
    offsets = [_PIECES[name](count, len(posture), rate_hz, rng) for name, count in rows.items()]
    on = [np.full(count, float(name != "swing")) for name, count in rows.items()]
    return posture + motion.size * room * np.concatenate(offsets), np.concatenate(on)


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


def scaled(controller: Controller, gain: float) -> Controller:
    """Returns a controller whose gains of position and velocity errors are multiplied by a factor; limits stay.

    Two gains make effects of the controller (delay, gain error) distinguishable from those of the body.
    """
    gains = {
        name: values * (gain if name in ("kp", "kd", "gain") else 1.0) for name, values in controller.gains.items()
    }
    return replace(controller, gains=gains)
