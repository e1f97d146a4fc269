"""Estimates the states behind the positions and velocities that a run recorded."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from math import factorial

import numpy as np
from scipy.stats import chi2

from envs.logs import Run
from envs.readings import aligned, fresh, noise_of

_PARABOLA_S, _CUBIC_S = 0.012, 0.03  # half widths of the local fits
_BENT_S, _BENT_EVERY_S = (0.012, 0.02, 0.03, 0.045), 0.005  # half widths of those that give slopes, and their spacing
_WIDEST_S = 0.018  # half width from which on a parabola no longer follows the motion
_MIN_HALF_ROWS = 2  # a parabola needs three rows
_CLEARER = 0.9  # share of a misfit that is left by a lag that is there
_TELLS = 3.0  # how much worse the worst shift is than the best, of a joint that moves enough to tell
_SAME_RATE = 0.02
_CHANCE = 0.01  # share of windows in which noise alone misses a polynomial by so much that it seems not to agree


def smoothed(run: Run) -> np.ndarray:
    """Estimates positions and velocities at every row by local parabolas.

    A parabola is fitted by least squares to the positions within 12 ms (two at least) on both sides, and to the
    velocities where they were recorded, each weighted by its noise and at the time when it was read:

        q(t + s) = q + dq s + ddq s^2 / 2,   dq(t + s) = dq + ddq s

    Where the rows are so slow (100 Hz and less) that two of them span more than 18 ms, it is a cubic over 30 ms on both
    sides. Where a polynomial misses the readings by more than their noise, as after a step of the target, the window is
    narrower. Stale readings (`envs.readings.stale`) are left out.

    Args:
      run: with `q` and perhaps `dq`.

    Returns:
      [rows, 2, joints] rad, rad/s.
    """

    def windows(time):
        widest, order, period = _window(time)
        least = min(1 if "dq" in run.signals else _MIN_HALF_ROWS, widest)
        return {least, max(least, widest // 2), widest}, order, period

    return _fit(run, run.time, windows)[:, :2]


def slopes(run: Run) -> np.ndarray:
    """Estimates velocities and accelerations at every row, by cubics over 12 to 45 ms on both sides.

    Those of the parabolas that give states have several times the noise. What a filter hides of a motion are its slopes
    times the filter's time.

    Args:
      run: with `q` and perhaps `dq`.

    Returns:
      [rows, 2, joints] rad/s, rad/s^2.
    """

    def windows(time):
        period = _window(time)[2]
        return {max(_MIN_HALF_ROWS, round(half / period)) for half in _BENT_S}, 3, period

    # They change little over 5 ms, and windows of a fast log hold many rows.
    some = run.time[:: max(1, int(_BENT_EVERY_S / _spacing(run)))]
    found = _fit(run, some, windows)[:, 1:]
    return np.apply_along_axis(lambda one: np.interp(run.time, some, one), 0, found)


def _fit(run: Run, time: np.ndarray, windows: Callable[[np.ndarray], tuple[Collection[int], int, float]]) -> np.ndarray:
    """Fits polynomials around every time to positions, and to velocities: [times, 3, joints], with accelerations.

    Every time has the widest window in which the polynomial agrees with the readings, or the narrowest one.

    Args:
      run: with `q` and perhaps `dq`.
      time: s, some or all of the run's.
      windows: of a joint's times of readings: how many a window has on each side, of all windows that are tried; the
        order of the polynomials; and the time between readings.
    """
    parts, every = [(fresh(run, name), noise_of(run, name)) for name in ("q", "dq") if name in run.signals], []
    for joint in range(run.signals["q"].shape[1]):
        mine, found = [(*readings[joint], sd[joint]) for readings, sd in parts], None
        halves, order, period = windows(mine[0][0])
        for half in sorted(halves):
            fit, agrees = _fit_window(time, mine, half, order, half * period)
            found = fit if found is None else np.where(agrees[:, None], fit, found)
        every.append(found)
    return np.stack(every, axis=-1)


def _fit_window(
    time: np.ndarray, parts: Sequence[tuple[np.ndarray, np.ndarray, float]], half: int, order: int, width: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fits polynomials in windows of one width: motion [rows, 3], and whether it agrees with the readings [rows]."""
    designs, values = [], []
    for derivative, (at, read, sd) in enumerate(parts):
        near = _nearest(at, time, half)
        # In units of the width; otherwise the normal equations would be badly conditioned.
        share = (at[near] - time[:, None]) / width
        terms = [
            factorial(power) / factorial(power - derivative) * share ** (power - derivative)
            if power >= derivative
            else np.zeros_like(share)
            for power in range(order + 1)
        ]
        designs.append(np.stack(terms, axis=-1) / width**derivative / sd)
        values.append(read[near] / sd)
    design, value = np.concatenate(designs, axis=1), np.concatenate(values, axis=1)
    across = np.swapaxes(design, 1, 2)
    fit = np.linalg.solve(across @ design + 1e-9 * np.eye(order + 1), across @ value[..., None])
    left = value - (design @ fit)[..., 0]
    agrees = (left**2).sum(axis=1) < chi2.isf(_CHANCE, max(value.shape[1] - order - 1, 1))
    return fit[:, :3, 0] * [1.0, 1.0 / width, 2.0 / width**2], agrees


def _window(time: np.ndarray) -> tuple[int, int, float]:
    """Returns how many readings a fit takes on each side at most, its order, and the time between them."""
    period = float(np.median(np.diff(time))) if len(time) > 1 else _PARABOLA_S
    half, order = max(_MIN_HALF_ROWS, round(_PARABOLA_S / period)), 2
    if half * period > _WIDEST_S:
        half, order = max(_MIN_HALF_ROWS, round(_CUBIC_S / period)), 3
    return half, order, period


def _nearest(at: np.ndarray, time: np.ndarray, half: int) -> np.ndarray:
    """Finds the readings nearest to each time, [times, 2 half + 1]; at both ends the window stays inside."""
    right = np.clip(np.searchsorted(at, time), 1, max(len(at) - 1, 1))
    closest = np.where(time - at[right - 1] <= at[np.minimum(right, len(at) - 1)] - time, right - 1, right)
    middle = np.clip(closest, half, max(len(at) - 1 - half, half))
    return np.clip(middle[:, None] + np.arange(-half, half + 1), 0, len(at) - 1)


def lateness(runs: Sequence[Run]) -> np.ndarray:
    """Estimates by how many seconds recorded velocities lag behind the slopes of recorded positions, [joints].

    A lag means that the robot filtered its velocities before they were logged, a negative one that it filtered its
    positions. Of shifts by whole rows, from about -10 to 50 ms, the one with the least mean square of all runs counts,
    and between rows the vertex of a parabola through its neighbours. Shifts by a part of a row would average noise
    away, and seem right for that. A joint has no lag where none lowers the mean square by a tenth, or where the worst
    shift is hardly worse than the best: one that rests or moves slowly, whose velocities are mostly noise.

    Args:
      runs: with `q` and `dq`. Of runs at several rates those at the first one's count.
    """
    period = _spacing(runs[0])
    least, most = max(1, round(0.01 / period)), max(2, round(0.05 / period))
    rows, misfit = np.arange(-least, most + 1), 0.0
    for run in (one for one in runs if abs(_spacing(one) / period - 1.0) < _SAME_RATE):
        # Slopes of the positions alone: with `dq` among the signals the fit would follow it.
        own, read = smoothed(replace(run, signals={"q": run.signals["q"]}))[:, 1], aligned(run, "dq")
        inner = np.arange(most, len(own) - least)
        misfit = misfit + np.stack([((own[inner - row] - read[inner]) ** 2).sum(axis=0) for row in rows])
    middle, joint = np.clip(misfit.argmin(axis=0), 1, len(rows) - 2), np.arange(misfit.shape[1])
    before, here, after = (misfit[middle + step, joint] for step in (-1, 0, 1))
    bend = np.maximum(before - 2.0 * here + after, 1e-12)
    vertex = np.clip(0.5 * (before - after) / bend, -1.0, 1.0)
    lowest = here - 0.5 * bend * vertex**2
    clear = (lowest < _CLEARER * misfit[rows == 0][0]) & (misfit.max(axis=0) > _TELLS * lowest)
    return np.where(clear, period * (rows[middle] + vertex), 0.0)


def _spacing(run: Run) -> float:
    """Mean time between rows in s; stamps may come in bursts."""
    return max(float(run.time[-1] - run.time[0]) / max(len(run.time) - 1, 1), 1e-5)
