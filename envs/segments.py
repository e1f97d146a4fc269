"""Logs cut into segments: short pieces that a simulation starts anew from measured states.

Over a short piece the simulation cannot run away, a wrong effect cannot make up for a missing one over time, and
whether the base is held or free makes no difference. A piece brings along what came before it, so that everything that
remembers (delays, lags, play in gears) starts with what it would remember.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import chex
import jax
import numpy as np

from envs.effects.memory import LONGEST_S
from envs.logs import Run

_SMOOTHING_S = 0.012  # half width of the fit that finds measured states
_MIN_HALF_ROWS = 2
HISTORY_S = LONGEST_S + 0.02


@chex.dataclass(frozen=True)
class Segment:
    """A piece of a run on the simulation's grid: `before` steps of history, then `after` steps to be simulated."""

    target: jax.Array  # [before + after, joints] rad, held between rows
    feed: jax.Array  # [before + after, joints] Nm, torque that was sent where no target was
    stiffness: jax.Array  # [before + after, joints] Nm/rad of the controller, zero where it is off
    damping: jax.Array  # [before + after, joints] Nm s/rad
    limit: jax.Array  # [before + after, joints] Nm, of both
    emf: jax.Array  # [before + after, joints] Nm s/rad, beyond the limit
    sample: jax.Array  # [before + after] 1 where the controller looks anew
    measured: jax.Array  # [before + 1 + ahead, 2, joints] rad and rad/s, smoothed; the segment starts at `before`
    row_step: jax.Array  # [rows] the step before each row
    row_share: jax.Array  # [rows] how far it is on the way to the next


@dataclass(frozen=True)
class Cut:
    """Segments of one length of several runs, and what was measured in them."""

    segments: Segment
    """[segments, ...] on every field."""
    signals: dict[str, np.ndarray]
    """[segments, rows, components] by name."""
    run: np.ndarray
    """[segments] index of the run."""
    row: np.ndarray
    """[segments, rows] index of the row."""


def smoothed(run: Run) -> np.ndarray:
    """Positions and velocities by a local parabola through positions and, where they are, velocities.

    Returns:
      [rows, 2, joints] rad, rad/s.
    """
    time, position = run.time, run.signals["q"]
    half = max(_MIN_HALF_ROWS, round(_SMOOTHING_S / np.median(np.diff(time))))
    index = np.clip(np.arange(len(time))[:, None] + np.arange(-half, half + 1), 0, len(time) - 1)
    offset = time[index] - time[:, None]
    ones, zeros = np.ones_like(offset), np.zeros_like(offset)
    design = np.stack([ones, offset, 0.5 * offset**2], axis=-1) / noise(position)
    value = position[index] / noise(position)
    if "dq" in run.signals:
        velocity, sd = run.signals["dq"], noise(run.signals["dq"])
        slopes = np.stack([zeros, ones, offset], axis=-1) / sd
        design, value = np.concatenate([design, slopes], axis=1), np.concatenate([value, velocity[index] / sd], axis=1)
    width = half * np.median(np.diff(time))
    scale = np.array([1.0, 1.0 / width, 1.0 / width**2])  # of the fit's numbers
    design = design * scale
    normal = np.einsum("rki,rkj->rij", design, design) + 1e-9 * np.eye(3)
    fit = np.linalg.solve(normal, np.einsum("rki,rkj->rij", design, value)) * scale[:, None]
    return fit[:, :2]


def velocity_lag(run: Run) -> float:
    """By how many seconds the recorded velocity is late against that of the positions."""
    own = smoothed(replace(run, signals={"q": run.signals["q"]}))[:, 1]
    lags = np.arange(-0.01, 0.051, 0.001)
    misfit = [
        sum(
            ((np.interp(run.time - lag, run.time, mine) - theirs) ** 2).mean()
            for mine, theirs in zip(own.T, run.signals["dq"].T, strict=True)
        )
        for lag in lags
    ]
    return float(lags[int(np.argmin(misfit))])


def noise(values: np.ndarray) -> float:
    """Standard deviation of what changes from row to row in [rows, ...], from third differences; never zero."""
    differences = np.diff(values, n=3, axis=0) / np.sqrt(20.0)
    quantum = quantum_of(values)
    return float(max(1.4826 * np.median(np.abs(differences)), quantum / np.sqrt(12.0), 1e-6))


def quantum_of(values: np.ndarray) -> float:
    """Smallest step between two values; rounding of floats aside, zero where nothing was rounded."""
    steps = np.unique(np.round(np.abs(np.diff(values, axis=0)), 9))
    steps = steps[steps > 1e-7]
    if not len(steps):
        return 0.0
    # Where values are rounded, their steps are multiples of the smallest.
    share = steps[: max(3, len(steps) // 2)] / steps[0]
    return float(steps[0]) if np.abs(share - np.round(share)).max() < 0.05 else 0.0


def cut(runs: Sequence[Run], horizon_s: float, dt: float, bin_s: float = 0.01) -> Cut:
    """Cuts runs into segments that follow on each other.

    Args:
      runs: of one robot.
      horizon_s: length of a segment.
      dt: step of the simulation.
      bin_s: a segment's rows are a multiple of as many as are taken together later.

    Raises:
      ValueError: no run is long enough.
    """
    period = float(np.median([np.median(np.diff(run.time)) for run in runs]))
    together = rows_together(period, bin_s)
    rows = max(1, round(horizon_s / period / together)) * together
    pieces = []
    for number, run in enumerate(runs):
        first = int(np.searchsorted(run.time, run.time[0] + HISTORY_S))
        pieces += [(number, start) for start in range(first, len(run.time) - rows, rows)]
    if not pieces:
        longest = max(run.time[-1] - run.time[0] for run in runs)
        raise ValueError(f"runs: the longest has {longest:.3g} s, expected more than {horizon_s + HISTORY_S:.3g} s")
    after = 1 + max(int(np.ceil((runs[n].time[i + rows] - runs[n].time[i]) / dt - 1e-6)) for n, i in pieces)
    prepared = [_Prepared(run, dt) for run in runs]
    segments = [prepared[number].segment(start, start + 1 + np.arange(rows), after) for number, start in pieces]
    names = [name for name in ("q", "dq", "tau", "gravity") if all(name in run.signals for run in runs)]
    if not all("target" in run.signals for run in runs):
        names = [name for name in names if name != "tau"]
    row = np.array([np.arange(start + 1, start + 1 + rows) for _, start in pieces])
    return Cut(
        segments=jax.tree.map(lambda *leaves: np.stack(leaves), *segments),
        signals={
            name: np.stack([runs[n].signals[name][i] for (n, _), i in zip(pieces, row, strict=True)]).astype(np.float32)
            for name in names
        },
        run=np.array([number for number, _ in pieces]),
        row=row,
    )


def whole(runs: Sequence[Run], dt: float) -> Cut:
    """Every run in one piece, from its first state with a history to its end.

    Runs are of equal shape: rows past a run's end are its last one again.
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
        signals={"q": np.stack([run.signals["q"][row] for run, row in zip(runs, rows, strict=True)])},
        run=np.arange(len(runs)),
        row=rows,
    )


def rows_together(period_s: float, bin_s: float) -> int:
    """How many rows make a bin."""
    return max(1, round(bin_s / period_s))


class _Prepared:
    """A run, its states smoothed and its controller as numbers."""

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
        """From row `start` on, read at `rows`, all later."""
        run, dt = self._run, self._dt
        before, ahead = round(HISTORY_S / dt), round(LONGEST_S / dt)
        begin = run.time[start]
        grid = begin + dt * np.arange(-before, after)
        # A row's target acts from its time stamp until the next.
        last = np.clip(np.searchsorted(run.time, grid + 1e-9, side="right") - 1, 0, len(run.time) - 1)
        period = 1.0 / run.controller.rate_hz
        ticks = np.floor((grid - run.time[0]) / period + 1e-6)
        at = (run.time[rows] - begin) / dt
        step = np.minimum(np.floor(at + 1e-6).astype(np.int32), after - 1)
        return Segment(
            **{name: values[last].astype(np.float32) for name, values in self._held.items()},
            sample=np.append(True, np.diff(ticks) > 0),
            measured=self._at(begin + dt * np.arange(-before, ahead + 1)),
            row_step=step,
            row_share=np.clip(at - step, 0.0, 1.0).astype(np.float32),
        )

    def _at(self, times: np.ndarray) -> np.ndarray:
        """Smoothed states at other times: a cubic through positions and slopes."""
        time, states = self._run.time, self._states
        times = np.clip(times, time[0], time[-1])
        left = np.clip(np.searchsorted(time, times, side="right") - 1, 0, len(time) - 2)
        width = (time[left + 1] - time[left])[:, None]
        s = (times - time[left])[:, None] / width
        (p0, v0), (p1, v1) = (np.moveaxis(states[left + i], 1, 0) for i in (0, 1))
        slope = 6 * (p1 - p0) / width * s * (1 - s) + v0 * (1 - s) * (1 - 3 * s) + v1 * s * (3 * s - 2)
        cubic = (
            p0 * (1 + 2 * s) * (1 - s) ** 2
            + p1 * s**2 * (3 - 2 * s)
            + width * (v0 * s * (1 - s) ** 2 - v1 * s**2 * (1 - s))
        )
        return np.stack([cubic, slope], axis=1).astype(np.float32)
