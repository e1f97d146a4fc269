"""Resamples recorded signals at other times: commands are held, measurements are interpolated or averaged.

Bags need it to bring all topics to one clock, and recorded walks to find what a policy observed at its own rate.
"""

import numpy as np

SENT = ("action", "target", "phase", "obs")
"""Signals that a policy sends in one of its steps (a tick)."""
ON_CHANGE = ("enabled", "cmd", "contact")
"""Signals that may be sent only when they change."""
HELD = (*SENT, *ON_CHANGE, "quat")
"""Signals of which the last value counts, because they hold or cannot be interpolated. They are never averaged."""

_FASTER = 1.25  # a signal is averaged if it was recorded at this many times the wanted rate, or faster


def held(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Samples a signal that holds until it changes: the last value at or before each time.

    Args:
      time: [rows] s, increasing.
      values: [rows, ...].
      at: other times; before the first row its value is taken.

    Returns:
      Values at these times, [times, ...].
    """
    return values[np.maximum(np.searchsorted(time, at, side="right") - 1, 0)]


def sampled(time: np.ndarray, values: np.ndarray, at: np.ndarray, period_s: float) -> np.ndarray:
    """Samples a measured signal at other times.

    Values are interpolated linearly between two rows. Where the signal was recorded faster than it is wanted, the line
    is averaged over one period around each time, or else fast motion would be aliased into slow motion.

    Args:
      time: [rows] s, increasing.
      values: [rows, ...].
      at: [times] s.
      period_s: time between two of them.

    Returns:
      Values at these times, [times, ...].
    """
    # The row at or before each time, but never the last: a line needs a row to its right.
    left = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    if np.median(np.diff(time)) * _FASTER >= period_s:
        share = (at - time[left]) / (time[left + 1] - time[left])
        return values[left] + _along(np.clip(share, 0.0, 1.0), values) * (values[left + 1] - values[left])
    low, high = (np.clip(at + side * 0.5 * period_s, time[0], time[-1]) for side in (-1, 1))
    return (_integral(time, values, high) - _integral(time, values, low)) / _along(high - low, values)


def _integral(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Integrates the line through the rows from the first row to other times."""
    width = np.diff(time)
    left = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    ahead = _along(at - time[left], values)
    slope = np.diff(values, axis=0) / _along(width, values)
    area = np.cumsum(0.5 * (values[1:] + values[:-1]) * _along(width, values), axis=0)
    area = np.concatenate([np.zeros_like(area[:1]), area])
    return area[left] + values[left] * ahead + 0.5 * slope[left] * ahead**2


def _along(factor: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Adds axes to a factor for every row, so that it multiplies values of several dimensions."""
    return factor.reshape(-1, *[1] * (values.ndim - 1))
