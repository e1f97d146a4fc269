"""Cuts logs into segments: short pieces, each simulated from a measured state.

Over a short piece the simulation stays close to the robot. In a long one a wrong effect can compensate for a missing
one. Each segment carries the history before it, so that effects with a memory (delays, lags, backlash) start with what
they would remember. `envs.smoothing` estimates the states of a run, from which segments are made.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import chex
import jax
import numpy as np

from envs.effects.memory import LONGEST_S
from envs.logs import Run
from envs.readings import aligned, hermite, noise, quantum_of
from envs.smoothing import smoothed, velocity_lag

__all__ = [
    "HISTORY_S",
    "Cut",
    "Segment",
    "cut",
    "noise",
    "quantum_of",
    "rows_together",
    "smoothed",
    "velocity_lag",
    "whole",
]

COMPARED = ("q", "dq", "tau", "abs_tau", "gravity")
"""Signals that may be compared with a simulation."""

HISTORY_S = LONGEST_S + 0.02
"""Length of the history before a segment, in s: the longest delay and some time for lags to settle."""


@chex.dataclass(frozen=True)
class Segment:
    """A piece of a run on the simulation's grid: `before` steps of history, then `after` steps to be simulated.

    The controller's law is `envs.logs.Impedance`'s, with `feed` added to its torque.
    """

    target: jax.Array  # [before + after, joints] rad; a row's target holds until the next row, or leads to it linearly
    # [before + after, joints] rad, from the held target to the linear one, where it is unknown which of them the robot
    # had; else zero
    between: jax.Array
    feed: jax.Array  # [before + after, joints] Nm, torque that was sent directly, where there are no targets
    stiffness: jax.Array  # [before + after, joints] Nm/rad of the controller, zero where it is off
    damping: jax.Array  # [before + after, joints] Nm s/rad
    limit: jax.Array  # [before + after, joints] Nm, of stiffness and damping together
    emf: jax.Array  # [before + after, joints] Nm s/rad, back electromotive force, not limited
    sample: jax.Array  # [before + after] true where the controller reads the joint anew
    # [before + 1 + ahead, 2, joints] rad and rad/s, smoothed. Index `before` is the start; the `LONGEST_S / dt` steps
    # `ahead` of it are what undoing a sensor's delay needs.
    measured: jax.Array
    row_step: jax.Array  # [rows] the last step at or before each row; 0 is the segment's start
    row_share: jax.Array  # [rows] share of a step between that step and the row


@dataclass(frozen=True)
class Cut:
    """Segments of several runs, all of one length, and the measured signals at their rows.

    Simulate `segments` in one batch (`Rig.simulate`) and compare the readings with `signals`.
    """

    segments: Segment
    """[segments, ...] on every field."""
    signals: dict[str, np.ndarray]
    """[segments, rows, components] by name."""
    run: np.ndarray
    """[segments] index of the run that each is from."""
    row: np.ndarray
    """[segments, rows] index of each row in its run."""


def cut(runs: Sequence[Run], horizon_s: float, dt: float, bin_s: float = 0.01) -> Cut:
    """Cuts runs into consecutive segments of one length.

    Args:
      runs: of one robot and one rate.
      horizon_s: length of a segment in s, rounded to whole bins.
      dt: step of the simulation in s.
      bin_s: length of the bins that residuals are averaged over later; a segment is a whole number of them.

    Returns:
      The segments and the signals that all runs have, at the times of the rows (`envs.readings.aligned`). `tau` is left
      out if a run has no targets, because its torques were then sent, not measured.

    Raises:
      ValueError: no run is longer than a segment and its history.
    """
    period = float(np.median([np.median(np.diff(run.time)) for run in runs]))
    together = rows_together(period, bin_s)
    rows = max(1, round(horizon_s / period / together)) * together
    pieces = []
    for number, run in enumerate(runs):
        # Every segment needs a history, the first one too.
        first = int(np.searchsorted(run.time, run.time[0] + HISTORY_S))
        pieces += [(number, start) for start in range(first, len(run.time) - rows, rows)]
    if not pieces:
        longest = max(run.time[-1] - run.time[0] for run in runs)
        raise ValueError(f"runs: the longest has {longest:.3g} s, expected more than {horizon_s + HISTORY_S:.3g} s")
    # As many steps as the longest segment needs, because rows are not exactly periodic.
    after = 1 + max(int(np.ceil((runs[n].time[i + rows] - runs[n].time[i]) / dt - 1e-6)) for n, i in pieces)
    # Smoothing is done once for a run, not once for a segment.
    prepared = [_Prepared(run, dt) for run in runs]
    segments = [prepared[number].segment(start, start + 1 + np.arange(rows), after) for number, start in pieces]
    names = [name for name in COMPARED if all(name in run.signals for run in runs)]
    if not all("target" in run.signals for run in runs):
        names = [name for name in names if name != "tau"]
    row = np.array([np.arange(start + 1, start + 1 + rows) for _, start in pieces])
    signals = {name: [aligned(run, name) for run in runs] for name in names}
    return Cut(
        segments=jax.tree.map(lambda *leaves: np.stack(leaves), *segments),
        signals={
            name: np.stack([values[n][i] for (n, _), i in zip(pieces, row, strict=True)]).astype(np.float32)
            for name, values in signals.items()
        },
        run=np.array([number for number, _ in pieces]),
        row=row,
    )


def whole(runs: Sequence[Run], dt: float) -> Cut:
    """Takes every run as one segment, from the first state that has a history to the run's end.

    Use it to simulate or draw whole runs. So that all have one shape, the last row of a shorter run is repeated.

    Args:
      runs: of one robot.
      dt: step of the simulation in s.
    """
    prepared = [_Prepared(run, dt) for run in runs]
    first = [int(np.searchsorted(run.time, run.time[0] + HISTORY_S)) for run in runs]
    counts = [len(run.time) - 1 - start for run, start in zip(runs, first, strict=True)]
    rows = np.array(
        [
            np.minimum(start + 1 + np.arange(max(counts)), len(run.time) - 1)
            for run, start in zip(runs, first, strict=True)
        ]
    )
    lengths = [run.time[-1] - run.time[start] for run, start in zip(runs, first, strict=True)]
    after = 1 + int(np.ceil(max(lengths) / dt - 1e-6))
    segments = [one.segment(start, row, after) for one, start, row in zip(prepared, first, rows, strict=True)]
    return Cut(
        segments=jax.tree.map(lambda *leaves: np.stack(leaves), *segments),
        signals={"q": np.stack([aligned(run, "q")[row] for run, row in zip(runs, rows, strict=True)])},
        run=np.arange(len(runs)),
        row=rows,
    )


def rows_together(period_s: float, bin_s: float) -> int:
    """Computes how many rows a bin has, one at least. Residuals are averaged over a bin (`cut`).

    Args:
      period_s: time between rows.
      bin_s: length of a bin.
    """
    return max(1, round(bin_s / period_s))


class _Prepared:
    """A run with smoothed states and its controller's numbers at every row, ready to be cut."""

    def __init__(self, run: Run, dt: float):
        self._run, self._dt = run, dt
        self._states = smoothed(run)
        joints = run.signals["q"].shape[1]
        controller = run.impedance()
        none = np.zeros((len(run.time), joints))
        self._held = {
            "target": run.signals.get("target", none),
            "feed": none if "target" in run.signals else run.signals["tau"],
            "stiffness": controller.stiffness,
            "damping": controller.damping,
            "limit": controller.limit,
            "emf": controller.back_emf,
        }

    def segment(self, start: int, rows: np.ndarray, after: int) -> Segment:
        """Makes the segment that starts at row `start`, has `after` steps and is read at `rows`, all later."""
        run, dt = self._run, self._dt
        before, ahead = round(HISTORY_S / dt), round(LONGEST_S / dt)
        begin = run.time[start]
        grid = begin + dt * np.arange(-before, after)
        # A row's values act from its time stamp until the next.
        last = np.clip(np.searchsorted(run.time, grid + 1e-9, side="right") - 1, 0, len(run.time) - 1)
        held = {name: values[last].astype(np.float32) for name, values in self._held.items()}
        further = self._further(grid, last)
        if run.controller.between_rows == "linear":
            held["target"] = held["target"] + further
        unknown = run.controller.between_rows == "unknown"
        # Where the controller's ticks lie between rows is unknown; they are counted from the run's first row.
        period = 1.0 / run.controller.rate_hz
        ticks = np.floor((grid - run.time[0]) / period + 1e-6)
        at = (run.time[rows] - begin) / dt
        step = np.minimum(np.floor(at + 1e-6).astype(np.int32), after - 1)
        return Segment(
            **held,
            between=further if unknown else np.zeros_like(further),
            sample=np.append(True, np.diff(ticks) > 0),
            measured=self._at(begin + dt * np.arange(-before, ahead + 1)),
            row_step=step,
            row_share=np.clip(at - step, 0.0, 1.0).astype(np.float32),
        )

    def _further(self, grid: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Returns how far a target that leads to the next row linearly is from the last row's, [times, joints] rad."""
        time, target = self._run.time, self._held["target"]
        following = np.minimum(last + 1, len(time) - 1)
        share = (grid - time[last]) / np.maximum(time[following] - time[last], 1e-9)
        return (np.clip(share, 0.0, 1.0)[:, None] * (target[following] - target[last])).astype(np.float32)

    def _at(self, times: np.ndarray) -> np.ndarray:
        """Interpolates smoothed states at other times."""
        position, velocity = np.moveaxis(self._states, 1, 0)
        return np.stack(hermite(self._run.time, position, velocity, times), axis=1).astype(np.float32)
