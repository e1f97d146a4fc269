"""Finds defects of time stamps and rows, which can be seen without the robot's model."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from envs.clock import SAME_S
from envs.diagnosis.finding import Finding
from envs.diagnosis.repeats import repeated, slope
from envs.logs import Run
from envs.readings import noise, quantum_of

_LEAST_RATE_HZ = 100.0
_LEAST_HOLE = 1.6  # usual steps of the clock
_SHORT = 3.25  # usual steps: the longest gap over which readings can be interpolated
_FEW = 0.01  # share of the steps that may be short gaps
_BRIEF_S = 0.02  # the longest hole at which a run is cut
_LEAST_S, _MOST_ROWS = 0.5, 0.9  # the shortest piece that is kept, and the share of a run that all pieces must have
_SOON, _IN_STEP = 3, 0.3  # rows after a late one, and usual steps from their place, by which the clock is in step again
_APART = 1.4  # ratio of two steps, one of which is a hole and the other none
_PACE, _AS_FAR = 0.95, 1.4  # quantile of the steps up to which they may be a pace of the clock; least ratio of motion


def structure(run: Run) -> tuple[list[Finding], Run]:
    """Finds a rate that is too low, duplicated rows, missing rows and a clock that jumps.

    Args:
      run: as it was read; its time stamps increase.

    Returns:
      The findings, and the longest piece of the run without any of these defects (but short gaps), for checks that need
      consecutive rows.
    """
    found = []
    steps = np.diff(run.time)
    period = float(np.median(steps))
    if 1.02 / period < _LEAST_RATE_HZ:  # a clock may be 2 % off
        text = f"a rate too low: {1 / period:.3g} rows a second; record {_LEAST_RATE_HZ:g} or more"
        found.append(Finding("low rate", "t", (), 1.0 / period, text))
    twice = repeated(run)
    if twice.any():
        text = (
            f"duplicated rows: {twice.sum()} repeat the row before while joints move, the first is row "
            f"{np.argmax(twice) + 2}; remove them"
        )
        found.append(Finding("duplicated rows", "t", (), float(twice.sum()), text))
    holes, gaps = _holes(run)
    if len(gaps):
        text = (
            f"short gaps: {len(gaps)} of up to {steps[gaps].max():.4g} s, where {period:.4g} s from row to row are "
            f"usual, the first after row {gaps[0] + 1}"
        )
        found.append(Finding("short gaps", "t", (), float(len(gaps)), text))
    cut = _BRIEF_S + SAME_S if pieces(run)[0] is not run else 0.0
    for row in holes:
        moved = _moves_on(run, row)
        kind, what = ("missing rows", "rows are missing") if moved else ("clock jump", "the clock jumps")
        text = f"{what} after row {row + 1}: {steps[row]:.4g} s to the next row, where {period:.4g} s are usual"
        text += "; discover cuts the run there" if steps[row] <= cut else ""
        found.append(Finding(kind, "t", (), float(steps[row]), text))
    return found, _longest(run, np.union1d(holes, np.flatnonzero(twice)))


def pieces(run: Run) -> list[Run]:
    """Cuts a run at holes of up to 20 ms, in which a recorder missed rows, so that nothing is interpolated over them.

    Longer holes are a reason to look at the recording, and so are many: then the run is left as it is.

    Args:
      run: as it was read.

    Returns:
      Pieces of half a second and more, all with the name of the run, which together have nine tenths of its rows or
      more; the run itself where that cannot be, or where there is no such hole.
    """
    holes, _ = _holes(run)
    brief = run.time[holes + 1] - run.time[holes] <= _BRIEF_S + SAME_S
    edges = [0, *(holes[brief] + 1), len(run.time)]
    found = [slice(a, b) for a, b in pairwise(edges) if run.time[b - 1] - run.time[a] >= _LEAST_S]
    if not brief.any() or sum(rows.stop - rows.start for rows in found) < _MOST_ROWS * len(run.time):
        return [run]
    return [_rows(run, rows) for rows in found]


def _rows(run: Run, rows: slice) -> Run:
    signals, other = ({name: values[rows] for name, values in of.items()} for of in (run.signals, run.other))
    return replace(run, time=run.time[rows], signals=signals, other=other)


def _holes(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Rows after which others are missing, and those with short gaps, over which readings can be interpolated."""
    steps = np.diff(run.time)
    period = float(np.median(steps))
    holes = np.flatnonzero(steps > max(_LEAST_HOLE * period, _longest_usual(steps)))
    holes = np.setdiff1d(holes, _pace(run, steps, holes))
    # A row that was read late, with the time at which it was read, is no defect.
    short = [row for row in holes if steps[row] <= _SHORT * period]
    gaps = np.array([row for row in short if not _in_step_again(run.time, row, period)], int)
    if len(gaps) > _FEW * len(steps):
        return np.setdiff1d(holes, np.setdiff1d(short, gaps)), gaps[:0]
    return np.setdiff1d(holes, short), gaps


def _pace(run: Run, steps: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Finds long steps that are a pace of the clock: frequent ones, over which the robot moves no further than usual.

    Stamps of whole milliseconds at 700 rows a second are 1 or 2 ms apart.
    """
    frequent = holes[steps[holes] <= 1.01 * np.quantile(steps, _PACE)]
    moved = np.abs(np.diff(run.signals["q"], axis=0)) / np.maximum(np.ptp(run.signals["q"], axis=0), 1e-9)
    usual = np.delete(moved, holes, axis=0).mean()
    return frequent if len(frequent) and moved[frequent].mean() < _AS_FAR * usual else frequent[:0]


def _longest_usual(steps: np.ndarray) -> float:
    """Finds the longest step of a clock that is not a hole, from the median upwards.

    A clock that jitters, or has several paces, has steps of all lengths in between. A hole stands apart from them.
    """
    longer = np.sort(steps[steps >= np.median(steps)])
    apart = np.flatnonzero(longer[1:] > _APART * longer[:-1])
    return float(longer[apart[0]] if len(apart) else longer[-1])


def _in_step_again(time: np.ndarray, row: int, period: float) -> bool:
    """Whether one of the rows after a long step comes when it would have come without that step."""
    later = time[row + 2 : row + 2 + _SOON] - time[row]
    return bool((np.abs(later / period - np.arange(2, 2 + len(later))) < _IN_STEP).any())


def _moves_on(run: Run, row: int) -> bool:
    """Whether the robot moved further over a hole than in one row: then rows are missing, else the clock jumped."""
    before, after = slice(max(0, row - 5), row + 1), slice(row + 1, row + 7)
    period = float(np.median(np.diff(run.time)))
    for name in ("q", "dq"):
        if name not in run.signals:
            continue
        values = run.signals[name]
        speed = 0.5 * (slope(run.time[before], values[before]) + slope(run.time[after], values[after]))
        # Means over a few rows on both sides, or noise would be mistaken for motion.
        apart = run.time[after].mean() - run.time[row + 1] + run.time[row] - run.time[before].mean() + period
        missed = values[after].mean(axis=0) - values[before].mean(axis=0) - apart * speed
        if (np.abs(missed) > 4.0 * noise(values) + quantum_of(values) + 2.0 * period * np.abs(speed)).any():
            return True
    return False


def _longest(run: Run, cuts: np.ndarray) -> Run:
    """Takes the longest piece between cuts; a cut lies after the row that it names."""
    edges = np.concatenate([[0], cuts + 1, [len(run.time)]])
    index = int(np.argmax(np.diff(edges)))
    return _rows(run, slice(edges[index], edges[index + 1]))
