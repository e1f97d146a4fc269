"""What a log is: names of signals and controllers, runs, splits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from envs.logs.controller import Controller, Impedance

JOINT_SIGNALS = ("q", "dq", "target", "tau", "action")
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
SPLITS = ("train", "select", "sealed")
_SHARES = dict(zip(SPLITS, (2, 1, 1), strict=True))


@dataclass(frozen=True, kw_only=True)
class Run:
    """One continuous recording."""

    name: str
    condition: str
    """What it has in common with other runs; its own name where nothing was said."""
    split: str | None
    """train, select or sealed, where the log says so."""
    controller: Controller
    time: np.ndarray
    """[rows] s, strictly increasing."""
    signals: Mapping[str, np.ndarray]
    """[rows], [rows, joints] or [rows, components] by the name of the signal; those that were recorded."""
    other: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Columns that the format does not know, [rows] by name, as they are."""

    def impedance(self) -> Impedance:
        """The controller at every row, [rows, joints], switched off where the motors were.

        A run without targets, whose torques were sent directly, has no stiffness, no damping and no limit.
        """
        if "target" not in self.signals:
            none = np.zeros(self.signals["q"].shape)
            return Impedance(stiffness=none, damping=none, limit=none + np.inf, back_emf=none)
        on = self.signals.get("enabled", np.ones(len(self.time)))
        return self.controller.impedance(on, self.signals.get("volts"))


@dataclass(frozen=True, kw_only=True)
class Log:
    """Runs of one robot."""

    robot: str
    """A built-in model, or the path of an MJCF file."""
    base: str
    """fixed or free."""
    rate_hz: float
    joints: tuple[str, ...]
    policy: Mapping[str, Any] | None
    runs: tuple[Run, ...]


def splits(log: Log) -> dict[str, tuple[Run, ...]]:
    """Runs by split. Conditions without one fill up train, select and sealed, in shares of 2 to 1 to 1.

    Raises:
      ValueError: a split would be empty, or a condition is in two.
    """
    said = {}
    for run in log.runs:
        if run.split is not None and said.setdefault(run.condition, run.split) != run.split:
            raise ValueError(f"runs: condition '{run.condition}' is in '{said[run.condition]}' and in '{run.split}'")
    for condition in sorted({run.condition for run in log.runs} - set(said)):
        counts = list(said.values())
        said[condition] = min(_SHARES, key=lambda split: counts.count(split) / _SHARES[split])
    chosen = {split: tuple(run for run in log.runs if said[run.condition] == split) for split in SPLITS}
    for split, runs in chosen.items():
        if not runs:
            raise ValueError(
                f"runs: no run is left for '{split}'; got {len(log.runs)} run(s) of conditions "
                f"{', '.join(sorted(said))}, expected three conditions that differ in split or leave it open"
            )
    return chosen


def column_names(signal: str, joints: Sequence[str]) -> list[str]:
    """Columns of a signal, in the order of its last axis."""
    parts = joints if signal in JOINT_SIGNALS else VECTOR_SIGNALS.get(signal)
    return [signal] if parts is None else [f"{signal}.{part}" for part in parts]
