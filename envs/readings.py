"""What the readings of a run are worth: their noise and rounding, when they were taken, and which are stale.

A log's columns are as the robot wrote them: read later than their row's time stamp, filtered, rounded, or repeated by a
bus that is slower than the log. Every column has its own noise, rounding and times here.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import comb

import numpy as np
from scipy.stats import norm, truncnorm

from envs.logs import Run

_LEAST_NOISE = 1e-6
_KEPT = 0.75  # share of squared differences that tell of noise, the smallest ones
_OF_KEPT = float(truncnorm.var(*norm.interval(_KEPT)))  # their mean square where the variance is one
_STALE = 3.0  # a repetition is stale where the joint moved by more than this many quanta meanwhile
_HELD = 0.25  # share of the rows of a fast joint that repeat another, from which on a bit does not count
_STEADY = 0.6  # least ratio of the speeds of a joint that moves on


def noise(values: np.ndarray) -> np.ndarray:
    """Estimates the standard deviation of white noise in every column, from differences of the third and sixth order.

        sqrt(mean square of the smallest three quarters / their share of a normal variance / (2n over n))

    Smooth motion drops out of them, in slow rows only out of the sixth; so the smaller estimate counts. Steps and
    outliers are in the last quarter. A median would be a whole count where rounding is as coarse as the noise. The
    estimate is never below the noise of the column's rounding, quantum / sqrt(12), and never zero.

    Args:
      values: [rows, columns] or [rows].

    Returns:
      [columns], or one number.
    """
    found = []
    for order in (order for order in (3, 6) if len(values) > order):
        squares = np.sort(np.diff(values, n=order, axis=0) ** 2, axis=0)
        kept = squares[: max(1, int(_KEPT * len(squares)))].mean(axis=0)
        found.append(np.sqrt(kept / _OF_KEPT / comb(2 * order, order)))
    white = np.min(found, axis=0) if found else np.zeros(values.shape[1:])
    return np.maximum(np.maximum(white, quantum_of(values) / np.sqrt(12.0)), _LEAST_NOISE)


def quantum_of(values: np.ndarray) -> np.ndarray:
    """Finds the step of rounding of every column: an encoder's count, or the last digit of a file.

    Args:
      values: [rows, columns] or [rows].

    Returns:
      [columns], or one number: the smallest step between consecutive rows if the other steps are multiples of it; zero
      where a column is not rounded.
    """
    return np.reshape([_quantum(column) for column in values.reshape(len(values), -1).T], values.shape[1:])


def _quantum(column: np.ndarray) -> float:
    steps = np.unique(np.round(np.abs(np.diff(column)), 9))
    steps = steps[steps > 1e-7]
    if not len(steps):
        return 0.0
    # A file's digits make the smallest step inexact, so it is fitted to its own small multiples.
    few = steps[steps < 10.5 * steps[0]]
    times = np.round(few / steps[0])
    quantum = (few @ times) / (times @ times)
    # Where values are rounded, their steps are multiples of the smallest.
    share = steps[: max(3, len(steps) // 2)] / quantum
    return float(quantum) if np.abs(share - np.round(share)).max() < 0.05 else 0.0


def noise_of(run: Run, signal: str) -> np.ndarray:
    """Returns the noise of a signal's columns, [columns]: what is known of it, else what fresh readings show.

    Args:
      run: with the signal.
      signal: its name.
    """
    known = run.fact(signal, "noise_sd")
    if np.isfinite(known).all():
        return np.maximum(known, _LEAST_NOISE)
    estimate = np.array([noise(values) for _, values in fresh(run, signal)])
    return np.maximum(np.where(np.isfinite(known), known, estimate), _LEAST_NOISE)


def rounding_of(run: Run, signal: str) -> np.ndarray:
    """Returns the step of rounding of a signal's columns, [columns]: what is known of it, else what is found.

    Args:
      run: with the signal.
      signal: its name.
    """
    known = run.fact(signal, "quantum")
    return known if np.isfinite(known).all() else np.where(np.isfinite(known), known, quantum_of(run.signals[signal]))


def with_noise(runs: Sequence[Run], seen: Sequence[Run]) -> tuple[Run, ...]:
    """Fills in the noise and the rounding of measured signals, where they are not known, by one estimate for all runs.

    A joint that stands still in a run shows neither there; and simulated logs are to have those of the measured one.

    Args:
      runs: of one robot.
      seen: those that may be looked at; without sealed ones.

    Returns:
      The runs; what is known of their signals has `noise_sd` and `quantum`.
    """
    known: dict[str, dict[str, np.ndarray]] = {}
    for name in ("q", "dq", "tau", "abs_tau", "gravity"):
        of = [run for run in seen if name in run.signals]
        if of:
            quanta = np.array([rounding_of(run, name) for run in of])
            quantum = np.min(np.where(quanta > 0, quanta, np.inf), axis=0)
            quantum = np.where(np.isfinite(quantum), quantum, 0.0)
            sds = np.ma.masked_less_equal([noise_of(run, name) for run in of], _LEAST_NOISE)
            sd = np.ma.median(sds, axis=0).filled(_LEAST_NOISE)
            known[name] = {"noise_sd": np.maximum(sd, quantum / np.sqrt(12.0)), "quantum": quantum}
    return tuple(replace(run, known={**run.known, **_filled(run, known)}) for run in runs)


def _filled(run: Run, estimates: dict) -> dict:
    """What is known of a run's signals, filled up by estimates."""
    return {
        name: {
            **run.known.get(name, {}),
            **{
                fact: np.where(np.isfinite(run.fact(name, fact)), run.fact(name, fact), values)
                for fact, values in facts.items()
            },
        }
        for name, facts in estimates.items()
        if name in run.signals
    }


def read_later(run: Run, signal: str) -> np.ndarray:
    """Returns by how much later than the rows' time stamps a signal's columns show the robot, [columns] s.

    It is the known offset, less the delay of a known filter, 1 / (2 pi filter_hz).

    Args:
      run: with the signal.
      signal: its name.
    """
    delay = 1.0 / (2.0 * np.pi * run.fact(signal, "filter_hz"))
    return np.nan_to_num(run.fact(signal, "offset_s")) - np.nan_to_num(delay)


def _new(values: np.ndarray, within: float) -> np.ndarray:
    """Rows whose value differs from the last new one, the first row among them."""
    if within == 0.0:
        return np.flatnonzero(np.append(True, np.diff(values) != 0))
    rows, last = [0], values[0]
    for row, value in enumerate(values.tolist()):
        if abs(value - last) > within:
            rows.append(row)
            last = value
    return np.array(rows)


def stale(run: Run, signal: str) -> np.ndarray:
    """Finds readings that only repeat the last one, because the bus or the sensor was slower than the log.

    A repetition is stale where the next new value makes up for it: as if the joint had gone on at the speed before and
    after, over all the rows that say otherwise, and by more than three steps of rounding. One of both speeds is enough
    for a repetition that is no longer than another one. A joint that stands still for a while and goes on, or moves
    slowly, repeats itself too, but has nothing to make up for.

    Args:
      run: with the signal.
      signal: its name.

    Returns:
      [rows, columns], true where a reading is stale.
    """
    found = np.zeros(run.signals[signal].shape, bool)
    for column, quantum in enumerate(rounding_of(run, signal)):
        values = run.signals[signal][:, column]
        exact, about = (_stale(run.time, values, quantum, within) for within in (0.0, 1.01 * quantum))
        # Noise flips the last bit of a value that is held. That counts only where values are held again and again as
        # the joint moves: a joint at rest flips bits too, before it jumps.
        fast = np.zeros(len(values), bool)
        fast[2:-2] = np.abs(values[4:] - values[:-4]) > 4 * _STALE * quantum
        found[:, column] = about if about[fast].sum() > max(_HELD * fast.sum(), exact[fast].sum()) else exact
    return found


def _stale(time: np.ndarray, values: np.ndarray, quantum: float, within: float) -> np.ndarray:
    """Finds stale readings [rows] of a column, in which a value repeats the last new one if it is as near as this."""
    found, new = np.zeros(len(values), bool), _new(values, within)
    if len(new) < 3:
        return found
    # From the first row of every new value to the next one.
    motion, rows = np.diff(values[new]), np.diff(new)
    speed = motion / np.diff(time[new])
    on = np.minimum(speed[1:] / speed[:-1], speed[:-1] / speed[1:]) > _STEADY
    before, after = np.append(False, on), np.append(on, False)
    far = np.abs(motion) * (rows - 1) / rows > _STALE * quantum
    # A joint that stuck and then jumps may well pass for one that had gone on at the slow speed before. Where it starts
    # or turns, one side is enough, but a bus does not take longer there than elsewhere.
    usual = rows[before & after & far].max(initial=0)
    mine = (before | after) & far & (rows <= usual)
    for first, count in zip(new[:-1][mine], rows[mine], strict=True):
        found[first + 1 : first + count] = True
    return found


def fresh(run: Run, signal: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns the readings of every column that are not stale, and the times at which they show the robot.

    Args:
      run: with the signal.
      signal: its name.

    Returns:
      Times [readings] s and values [readings], one pair for every column.
    """
    keep, later = ~stale(run, signal), read_later(run, signal)
    return [
        (run.time[keep[:, column]] + later[column], values[keep[:, column]])
        for column, values in enumerate(run.signals[signal].T)
    ]


def aligned(run: Run, signal: str) -> np.ndarray:
    """Returns a signal at the times of the rows, [rows, columns].

    Columns that were read at other times, or have stale readings, are interpolated by cubics through the fresh
    readings; the others are as they were recorded.

    Args:
      run: with the signal.
      signal: its name.
    """
    values, later = run.signals[signal].copy(), read_later(run, signal)
    for column, (time, read) in enumerate(fresh(run, signal)):
        if later[column] or len(time) < len(values):
            values[:, column] = hermite(time, read, np.gradient(read, time), run.time)[0]
    return values


def hermite(time: np.ndarray, values: np.ndarray, slopes: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolates values and slopes at other times by cubics; beyond both ends the values there stay.

    Args:
      time: [n] s, increasing, two or more.
      values: [n, ...].
      slopes: [n, ...], of the values per s.
      at: s, of any shape.

    Returns:
      Values and slopes, [*at.shape, ...] each.
    """
    at = np.clip(at, time[0], time[-1])
    left = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    along = (*at.shape, *(1,) * (values.ndim - 1))
    width = (time[left + 1] - time[left]).reshape(along)
    s = (at - time[left]).reshape(along) / width
    (p0, v0), (p1, v1) = ((values[left + i], slopes[left + i]) for i in (0, 1))
    slope = 6 * (p1 - p0) / width * s * (1 - s) + v0 * (1 - s) * (1 - 3 * s) + v1 * s * (3 * s - 2)
    cubic = (
        p0 * (1 + 2 * s) * (1 - s) ** 2
        + p1 * s**2 * (3 - 2 * s)
        + width * (v0 * s * (1 - s) ** 2 - v1 * s**2 * (1 - s))
    )
    return cubic, slope
