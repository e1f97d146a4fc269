"""Cuts logs into segments: short pieces, each simulated from a measured state.

Over a short piece the simulation stays close to the robot. In a long one a wrong effect can compensate for a missing
one. Each segment carries the history before it, so that effects with a memory (delays, lags, backlash) start with what
they would remember. The module also estimates the states and the noise of a run, from which segments are made.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import chex
import jax
import numpy as np

from envs.effects.memory import LONGEST_S
from envs.logs import Run

_SMOOTHING_S = 0.012  # half width of the local fit behind `smoothed`
_MIN_HALF_ROWS = 2  # a parabola needs three rows
HISTORY_S = LONGEST_S + 0.02
"""Length of the history before a segment, in s: the longest delay and some time for lags to settle."""


@chex.dataclass(frozen=True)
class Segment:
    """A piece of a run on the simulation's grid: `before` steps of history, then `after` steps to be simulated.

    The controller's law is `envs.logs.Impedance`'s, with `feed` added to its torque.
    """

    target: jax.Array  # [before + after, joints] rad; a row's target holds until the next row
    between: jax.Array  # [before + after, joints] rad, linear less held targets
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


def smoothed(run: Run) -> np.ndarray:
    """Estimates positions and velocities at every row by local parabolas.

    A parabola is fitted by least squares to the positions within 12 ms (two rows at least) on both sides, and to the
    velocities where they were recorded, each weighted by its noise:

        q(t + s) = q + dq s + ddq s^2 / 2,   dq(t + s) = dq + ddq s

    Args:
      run: with `q` and perhaps `dq`.

    Returns:
      [rows, 2, joints] rad, rad/s.
    """
    time, position = run.time, run.signals["q"]
    half = max(_MIN_HALF_ROWS, round(_SMOOTHING_S / np.median(np.diff(time))))
    # At both ends of the run the fit is one-sided: the first or last row counts several times.
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
    scale = np.array([1.0, 1.0 / width, 1.0 / width**2])  # without it the normal equations are badly conditioned
    design = design * scale
    normal = np.einsum("rki,rkj->rij", design, design) + 1e-9 * np.eye(3)
    fit = np.linalg.solve(normal, np.einsum("rki,rkj->rij", design, value)) * scale[:, None]
    return fit[:, :2]


def velocity_lag(run: Run) -> float:
    """Estimates by how many seconds recorded velocities lag behind the slopes of recorded positions.

    A lag means that the robot filtered its velocities before they were logged. Discovery then leaves them out, because
    their lag would pass for one of the robot's own. The search is on a grid of 1 ms from -10 to 50 ms, by least
    squares over all joints.

    Args:
      run: with `q` and `dq`.
    """
    # Slopes of the positions alone: with `dq` among the signals the fit would follow it.
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
    """Estimates the standard deviation of white noise in a signal, from its third differences.

        1.4826 median |third difference| / sqrt(20)

    Motion that is smooth over four rows drops out of a third difference, whose variance is 20 times that of the noise.
    The estimate is never below the noise of the signal's rounding, quantum / sqrt(12), and never zero.

    Args:
      values: [rows, ...].
    """
    differences = np.diff(values, n=3, axis=0) / np.sqrt(20.0)
    quantum = quantum_of(values)
    return float(max(1.4826 * np.median(np.abs(differences)), quantum / np.sqrt(12.0), 1e-6))


def quantum_of(values: np.ndarray) -> float:
    """Finds the step of rounding in a signal: an encoder's count, or the last digit of a file.

    Args:
      values: [rows, ...].

    Returns:
      The smallest step between consecutive rows if the other steps are multiples of it; zero for an unrounded signal.
    """
    steps = np.unique(np.round(np.abs(np.diff(values, axis=0)), 9))
    steps = steps[steps > 1e-7]
    if not len(steps):
        return 0.0
    # Where values are rounded, their steps are multiples of the smallest.
    share = steps[: max(3, len(steps) // 2)] / steps[0]
    return float(steps[0]) if np.abs(share - np.round(share)).max() < 0.05 else 0.0


def cut(runs: Sequence[Run], horizon_s: float, dt: float, bin_s: float = 0.01) -> Cut:
    """Cuts runs into consecutive segments of one length.

    Args:
      runs: of one robot and one rate.
      horizon_s: length of a segment in s, rounded to whole bins.
      dt: step of the simulation in s.
      bin_s: length of the bins that residuals are averaged over later; a segment is a whole number of them.

    Returns:
      The segments and the signals that all runs have. `tau` is left out if a run has no targets, because its torques
      were then sent, not measured.

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
        signals={"q": np.stack([run.signals["q"][row] for run, row in zip(runs, rows, strict=True)])},
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
            "between": none,
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
        # A row's target acts from its time stamp until the next.
        last = np.clip(np.searchsorted(run.time, grid + 1e-9, side="right") - 1, 0, len(run.time) - 1)
        # Where the controller's ticks lie between rows is unknown; they are counted from the run's first row.
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
        """Interpolates smoothed states at other times, by a cubic through positions and velocities of two rows."""
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
