"""Estimates the states behind the positions and velocities that a run recorded."""

from collections.abc import Sequence
from dataclasses import replace
from math import factorial

import numpy as np

from envs.logs import Run
from envs.readings import aligned, fresh, noise_of

_SMOOTHING_S = 0.012  # half width of the local fit
_MIN_HALF_ROWS = 2  # a parabola needs three rows
_WIDE = 1.5  # from this many times `_SMOOTHING_S` on, a parabola no longer follows the motion


def smoothed(run: Run) -> np.ndarray:
    """Estimates positions and velocities at every row by local parabolas.

    A parabola is fitted by least squares to the positions within 12 ms (two at least) on both sides, and to the
    velocities where they were recorded, each weighted by its noise and at the time when it was read:

        q(t + s) = q + dq s + ddq s^2 / 2,   dq(t + s) = dq + ddq s

    It is a cubic where the rows are so slow (100 Hz and less) that two of them span more than 18 ms. Stale readings
    (`stale`) are left out.

    Args:
      run: with `q` and perhaps `dq`.

    Returns:
      [rows, 2, joints] rad, rad/s.
    """
    parts = [(fresh(run, name), noise_of(run, name)) for name in ("q", "dq") if name in run.signals]
    return np.stack(
        [
            _fit(run.time, [(*readings[joint], sd[joint]) for readings, sd in parts])
            for joint in range(run.signals["q"].shape[1])
        ],
        axis=-1,
    )


def _fit(time: np.ndarray, parts: Sequence[tuple[np.ndarray, np.ndarray, float]]) -> np.ndarray:
    """Fits polynomials around every row to positions, and to velocities in the second part: [rows, 2]."""
    half, width = _window(parts[0][0])
    order = 2 if width < _WIDE * _SMOOTHING_S else 3
    designs, values = [], []
    for derivative, (at, read, sd) in enumerate(parts):
        near = _nearest(at, time, half if derivative == 0 else _window(at)[0])
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
    normal = np.einsum("rki,rkj->rij", design, design) + 1e-9 * np.eye(order + 1)
    fit = np.linalg.solve(normal, np.einsum("rki,rk->ri", design, value)[..., None])[..., 0]
    return np.stack([fit[:, 0], fit[:, 1] / width], axis=1)


def _window(time: np.ndarray) -> tuple[int, float]:
    """Returns how many readings a fit takes on each side, and the time that they span."""
    period = float(np.median(np.diff(time))) if len(time) > 1 else _SMOOTHING_S
    half = max(_MIN_HALF_ROWS, round(_SMOOTHING_S / period))
    return half, half * period


def _nearest(at: np.ndarray, time: np.ndarray, half: int) -> np.ndarray:
    """Finds the readings nearest to each time, [times, 2 half + 1]; at both ends the window stays inside."""
    right = np.clip(np.searchsorted(at, time), 1, max(len(at) - 1, 1))
    closest = np.where(time - at[right - 1] <= at[np.minimum(right, len(at) - 1)] - time, right - 1, right)
    middle = np.clip(closest, half, max(len(at) - 1 - half, half))
    return np.clip(middle[:, None] + np.arange(-half, half + 1), 0, len(at) - 1)


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
            for mine, theirs in zip(own.T, aligned(run, "dq").T, strict=True)
        )
        for lag in lags
    ]
    return float(lags[int(np.argmin(misfit))])
