"""Finds defects of time stamps and rows, which can be seen without the robot's model."""

from dataclasses import replace

import numpy as np

from envs.diagnosis.finding import MEASURED, Finding
from envs.logs import Run
from envs.segments import noise, quantum_of

_LEAST_RATE_HZ = 100.0


def structure(run: Run) -> tuple[list[Finding], Run]:
    """Finds a rate that is too low, duplicated rows, missing rows and a clock that jumps.

    Args:
      run: as it was read; its time stamps increase.

    Returns:
      The findings, and the longest piece of the run without any of these defects, for checks that need consecutive
      rows.
    """
    found = []
    steps = np.diff(run.time)
    period = float(np.median(steps))
    if 1.02 / period < _LEAST_RATE_HZ:  # a clock may be 2 % off
        text = f"a rate too low: {1 / period:.3g} rows a second; record {_LEAST_RATE_HZ:g} or more"
        found.append(Finding("low rate", "t", (), 1.0 / period, text))
    twice = _repeated(run)
    if twice.any():
        text = f"duplicated rows: {twice.sum()}, the first is row {np.argmax(twice) + 2}; remove them"
        found.append(Finding("duplicated rows", "t", (), float(twice.sum()), text))
    # Longer than usual by itself, and by more than the usual jitter of the clock.
    holes = np.flatnonzero((steps > 1.6 * period) & (steps > period + 4.0 * _spread(steps)))
    for row in holes:
        moved = _moves_on(run, row)
        kind, what = ("missing rows", "rows are missing") if moved else ("clock jump", "the clock jumps")
        text = f"{what} after row {row + 1}: {steps[row]:.4g} s to the next row, where {period:.4g} s are usual"
        found.append(Finding(kind, "t", (), float(steps[row]), text))
    return found, _longest(run, np.union1d(holes, np.flatnonzero(twice)))


def _spread(values: np.ndarray) -> float:
    """Estimates the standard deviation from the median absolute deviation, which a few holes do not raise."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) + 1e-9


def _repeated(run: Run) -> np.ndarray:
    """Marks rows, without the first [rows - 1], in which every measured value is that of the row before."""
    measured = [run.signals[name] for name in (*MEASURED, "gyro", "acc", "vel") if name in run.signals]
    values = np.concatenate([one.reshape(len(run.time), -1) for one in measured], axis=1)
    same = np.diff(values, axis=0) == 0
    # With coarse encoders a column repeats itself whenever its joint is slow. How many whole rows would repeat by
    # chance follows if columns do so independently.
    often = same.mean(axis=0)
    by_chance = len(same) * np.prod(often[often < 0.3] if (often < 0.3).any() else often)
    every = same.all(axis=1)
    return every if every.sum() > 3.0 * by_chance + 1.0 else np.zeros_like(every)


def _moves_on(run: Run, row: int) -> bool:
    """Whether the robot moved further over a hole than in one row: then rows are missing, else the clock jumped."""
    before, after = slice(max(0, row - 5), row + 1), slice(row + 1, row + 7)
    period = float(np.median(np.diff(run.time)))
    for name in ("q", "dq"):
        if name not in run.signals:
            continue
        values = run.signals[name]
        slope = 0.5 * (_slope(run.time[before], values[before]) + _slope(run.time[after], values[after]))
        # Means over a few rows on both sides, or noise would be mistaken for motion.
        apart = run.time[after].mean() - run.time[row + 1] + run.time[row] - run.time[before].mean() + period
        missed = values[after].mean(axis=0) - values[before].mean(axis=0) - apart * slope
        if (np.abs(missed) > 4.0 * noise(values) + quantum_of(values) + 2.0 * period * np.abs(slope)).any():
            return True
    return False


def _slope(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least-squares slope of values [rows, ...]."""
    time = time - time.mean()
    return time @ (values - values.mean(axis=0)) / max(time @ time, 1e-12)


def _longest(run: Run, cuts: np.ndarray) -> Run:
    """Takes the longest piece between cuts; a cut lies after the row that it names."""
    edges = np.concatenate([[0], cuts + 1, [len(run.time)]])
    index = int(np.argmax(np.diff(edges)))
    rows = slice(edges[index], edges[index + 1])
    return replace(run, time=run.time[rows], signals={name: values[rows] for name, values in run.signals.items()})
