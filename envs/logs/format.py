"""The format of a log in memory: names of its signals, runs, conditions and splits.

`envs/logs/README.md` has the table of columns with their units.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from envs.logs.controller import Controller, Impedance

JOINT_SIGNALS = ("q", "dq", "target", "tau", "abs_tau", "current", "action")
"""Signals with a column for every joint."""

VECTOR_SIGNALS = {
    "phase": ("left", "right"),
    "gyro": ("x", "y", "z"),
    "acc": ("x", "y", "z"),
    "gravity": ("x", "y", "z"),
    "vel": ("x", "y", "z"),
    "cmd": ("x", "y", "yaw"),
    "contact": ("left", "right"),
    "pos": ("x", "y", "z"),
    "quat": ("w", "x", "y", "z"),
}
"""Signals with a column for every component."""

SCALAR_SIGNALS = ("enabled", "volts")
"""Signals with one column."""

OBSERVATION = "obs"
"""The policy's own observation, with as many columns (`obs.0`, `obs.1`, ...) as it has components."""

MEASURED = ("q", "dq", "tau", "abs_tau", "current", "gyro", "acc", "gravity", "vel", "pos", "quat", "volts")
"""Signals that sensors read, of which `meta.yaml` may say what is known (`Run.known`)."""

FACTS = ("filter_hz", "offset_s", "noise_sd", "quantum")
"""What may be known of a signal: the corner frequency of the low-pass filter that it went through, in Hz; by how much
later than the row's `t` it was read (earlier where negative), in s; the standard deviation of its noise, and the step
of its rounding, both in the signal's unit."""

SPLITS = ("train", "select", "sealed")
"""Parts of a log: the runs that are fitted (train), the validation set (select), and the held-out test, which is read
once (sealed)."""

_SHARES = dict(zip(SPLITS, (2, 1, 1), strict=True))


@dataclass(frozen=True, kw_only=True)
class Run:
    """One continuous recording: its controller, time stamps and signals, in the model's names, units and signs.

    A run is never changed; to repair or cut one, make another with `dataclasses.replace`.
    """

    name: str
    condition: str
    """Label that runs of one experiment share (a motion, a gain); the run's own name where `meta.yaml` has none. Runs
    of one condition are always in the same split."""
    split: str | None
    """train, select or sealed, where `meta.yaml` sets it."""
    controller: Controller | None
    """None only in a log of observations and actions (`envs.logs.read_observed`) that does not say."""
    time: np.ndarray
    """[rows] s, strictly increasing."""
    signals: Mapping[str, np.ndarray]
    """[rows], [rows, joints] or [rows, components] by the name of the signal, those that were recorded. Angles are in
    rad, `dq` and `gyro` in rad/s, torques in Nm, supply in V, `vel` in m/s, `acc` in m/s^2, `cmd` in m/s, m/s and
    rad/s, phases in cycles. `gyro`, `acc`, `vel` and the unit vector `gravity` are in the body frame."""
    other: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Columns that the format does not know, [rows] by name, unchanged."""
    known: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    """What is known of a signal's columns, [columns] by signal and name (`FACTS`), NaN where it is not known. Signals
    are never changed by it: who uses them corrects them (`envs.readings`)."""

    def fact(self, signal: str, name: str) -> np.ndarray:
        """Returns what is known of a signal's columns, [columns], NaN where it is not known.

        Args:
          signal: one of the run's signals.
          name: one of `FACTS`.
        """
        columns = self.signals[signal].shape[1:] or (1,)
        return self.known.get(signal, {}).get(name, np.full(columns, np.nan))

    def impedance(self) -> Impedance:
        """Returns the controller's impedance at every row, [rows, joints]; zero where the motors were switched off.

        A run without targets, whose torques were sent directly, has no stiffness, no damping and no limit.
        """
        if "target" not in self.signals:
            none = np.zeros(self.signals["q"].shape)
            return Impedance(stiffness=none, damping=none, limit=none + np.inf, back_emf=none)
        on = self.signals.get("enabled", np.ones(len(self.time)))
        return self.controller.impedance(on, self.signals.get("volts"))

    def sent_torque(self) -> np.ndarray:
        """Returns the torque that was sent to the joints directly, [rows, joints] Nm: none where there are targets, or
        where the motors were switched off."""
        if "target" in self.signals:
            return np.zeros(self.signals["q"].shape)
        on = self.signals.get("enabled", np.ones(len(self.time)))
        return self.signals["tau"] * (on > 0)[:, None]


@dataclass(frozen=True, kw_only=True)
class Convention:
    """The units and signs of a log's files, where `meta.yaml` gives any; in memory signals have those of the model."""

    units: Mapping[str, str] = field(default_factory=dict)
    """As in `meta.yaml`."""
    sign: Mapping[str, int] = field(default_factory=dict)
    """As in `meta.yaml`."""
    factors: Mapping[str, np.ndarray] = field(default_factory=dict, compare=False)
    """[joints] by signal: factors from the numbers of a file to the model's, which follow from the two; 1 for signals
    that are not here."""


@dataclass(frozen=True, kw_only=True)
class Log:
    """Runs of one robot, as `envs.logs.read` returns them and `envs.logs.write` takes them.

    Discovery, the log doctor and `envs.targets.recorded` all start from one.
    """

    robot: str
    """Name of a built-in model, or the path of an MJCF file (`envs.models.spec`)."""
    base: str
    """`fixed` (suspended or clamped) or `free` (on the ground)."""
    rate_hz: float
    """Nominal rate of the rows in Hz. Where the time stamps differ from it, they are used."""
    joints: tuple[str, ...]
    """Names of the joints, in the order of the signals' last axis."""
    policy: Mapping[str, Any] | None
    """`rate_hz`, `action_scale` and `base` of the policy that was running; None where none was."""
    runs: tuple[Run, ...]
    convention: Convention = Convention()
    """In which the log was read, and is written."""
    notes: tuple[str, ...] = ()
    """Sentences about what was made of the log, as it was read and since; they are not written."""


def splits(log: Log) -> dict[str, tuple[Run, ...]]:
    """Divides the runs of a log into train, select (validation) and sealed (held-out test).

    Conditions for which the log sets no split are distributed over the three in shares of 2 to 1 to 1, the one that
    drives its motors hardest first, so that each split has hard and soft motions. What shows in hard steps alone, such
    as a torque limit, could otherwise be fitted and never confirmed. All runs of a condition go together, so that the
    test is on conditions that were not fitted.

    Returns:
      Runs by split; each split has one or more.

    Raises:
      ValueError: a split would be empty, or a condition is in two.
    """
    split_of = {}
    for run in log.runs:
        if run.split is not None and split_of.setdefault(run.condition, run.split) != run.split:
            raise ValueError(
                f"runs: condition '{run.condition}' is in '{split_of[run.condition]}' and in '{run.split}'"
            )
    hard = _hardness(log)
    # The split that is furthest below its share gets the next condition. Sorted, the result does not depend on files.
    for condition in sorted(hard.keys() - split_of.keys(), key=lambda name: (-hard[name], name)):
        counts = list(split_of.values())
        split_of[condition] = min(_SHARES, key=lambda split: counts.count(split) / _SHARES[split])
    chosen = {split: tuple(run for run in log.runs if split_of[run.condition] == split) for split in SPLITS}
    for split, runs in chosen.items():
        if not runs:
            raise ValueError(
                f"runs: no run is left for '{split}'; got {len(log.runs)} run(s) of conditions "
                f"{', '.join(sorted(split_of))}, expected three conditions that differ in split or leave it open"
            )
    return chosen


def with_splits(log: Log) -> Log:
    """Returns the log with the split of every run written into it.

    A log that is made from this one, such as a simulated one, is then split in the same way.

    Raises:
      ValueError: as `splits`.
    """
    split_of = {run.condition: split for split, runs in splits(log).items() for run in runs}
    return replace(log, runs=tuple(replace(run, split=split_of[run.condition]) for run in log.runs))


def _hardness(log: Log) -> dict[str, float]:
    """How hard each condition drives the motors, 0 to 1: the largest error of each joint's position, their mean.

    Errors are shares of the largest one that a joint has in any condition. Speeds take their place where a run has no
    targets.
    """
    largest: dict[str, np.ndarray] = {}
    told = all({"q", "target"} <= run.signals.keys() for run in log.runs)
    for run in log.runs:
        if told:
            driven = run.signals["target"] - run.signals["q"]
        elif "q" in run.signals:
            driven = np.diff(run.signals["q"], axis=0) / np.diff(run.time)[:, None]
        else:
            driven = np.zeros((1, len(log.joints)))
        most = np.abs(driven).max(axis=0)
        largest[run.condition] = np.maximum(largest.get(run.condition, 0.0), most)
    scale = np.maximum(np.max(list(largest.values()), axis=0), 1e-12)
    return {condition: float((most / scale).mean().round(6)) for condition, most in largest.items()}


def with_halves_swapped(log: Log) -> Log:
    """Returns the log with train in the place of select and sealed, and the other way round.

    A discovery from the other half of a log is a second opinion: what both name is not the chance of one split.

    Raises:
      ValueError: train has one condition only, which cannot be both select and sealed.
    """
    parts = splits(log)
    conditions = sorted({run.condition for run in parts["train"]})
    if len(conditions) < 2:
        raise ValueError(f"runs: 'train' has condition {conditions[0]} only, expected two or more to swap the halves")
    split_of = {name: ("select", "sealed")[number % 2] for number, name in enumerate(conditions)}
    return replace(log, runs=tuple(replace(run, split=split_of.get(run.condition, "train")) for run in log.runs))


def column_names(signal: str, joints: Sequence[str]) -> list[str]:
    """Lists the columns of a signal in a file, in the order of its last axis (`q.left_hip`, `gyro.x`, `volts`).

    Args:
      signal: name of a signal, one of the three groups above.
      joints: names of the joints of the log.
    """
    parts = joints if signal in JOINT_SIGNALS else VECTOR_SIGNALS.get(signal)
    return [signal] if parts is None else [f"{signal}.{part}" for part in parts]


def is_observation(column: Any) -> bool:
    """Tells whether a column is a component of the policy's observation, such as `obs.7`."""
    head, _, number = str(column).partition(".")
    return head == OBSERVATION and number.isdecimal() and number == str(int(number))


def alike(one: str, other: str) -> bool:
    """Says whether two texts are equal but for case, or become so if one letter is added, left out or replaced."""
    short, long = sorted((one.casefold(), other.casefold()), key=len)
    same = next((i for i, pair in enumerate(zip(short, long, strict=False)) if pair[0] != pair[1]), len(short))
    return len(long) - len(short) < 2 and long[same + 1 :] in (short[same:], short[same + 1 :])
