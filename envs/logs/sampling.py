"""What was recorded at some times, at other times."""

import numpy as np

SAID = ("action", "target", "phase")
"""What a policy says in a tick."""
ASKED = (*SAID, "enabled", "cmd")
"""Signals that stay until they change."""
HELD = (*ASKED, "contact", "quat")
"""These, and what means nothing between two rows: never filtered, never mixed."""

_FASTER = 1.25  # than it is asked for, from which on a signal is filtered


def held(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The last of values [rows, ...] at other times [...]; the first one before any."""
    return values[np.maximum(np.searchsorted(time, at, side="right") - 1, 0)]


def sampled(time: np.ndarray, values: np.ndarray, at: np.ndarray, period_s: float) -> np.ndarray:
    """Measured values [rows, ...] at other times [times], `period_s` apart.

    On the line between two rows; where rows come faster than they are asked for, the mean of that line over a period,
    or what is too fast to be seen would look slow.
    """
    left = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    if np.median(np.diff(time)) * _FASTER >= period_s:
        share = (at - time[left]) / (time[left + 1] - time[left])
        return values[left] + _along(np.clip(share, 0.0, 1.0), values) * (values[left + 1] - values[left])
    low, high = (np.clip(at + side * 0.5 * period_s, time[0], time[-1]) for side in (-1, 1))
    return (_integral(time, values, high) - _integral(time, values, low)) / _along(high - low, values)


def _integral(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of the line through the rows, from the first one on."""
    width = np.diff(time)
    left = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    ahead = _along(at - time[left], values)
    slope = np.diff(values, axis=0) / _along(width, values)
    area = np.cumsum(0.5 * (values[1:] + values[:-1]) * _along(width, values), axis=0)
    area = np.concatenate([np.zeros_like(area[:1]), area])
    return area[left] + values[left] * ahead + 0.5 * slope[left] * ahead**2


def _along(factor: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A factor for every row, for values of as many dimensions."""
    return factor.reshape(-1, *[1] * (values.ndim - 1))
