"""Intervals of rates."""

import numpy as np

from jaxtune.selftest import Rate


def interval(rate: Rate) -> tuple[float, float]:
    """Returns the 95 % interval of a self-test's rate, in which robots of gates that differ count for fewer."""
    return wilson(rate.share * rate.independent, rate.independent)


def wilson(hits: float, count: float, z: float = 1.96) -> tuple[float, float]:
    """Returns the 95 % score interval of a rate (Wilson, 1927), which stays within [0, 1] and works at 0 and 1.

    Args:
      hits: number of successes.
      count: number of cases; without any the interval is all of [0, 1].
      z: quantile of the normal distribution.
    """
    if not count:
        return 0.0, 1.0
    rate, z2 = hits / count, z * z
    middle = (rate + z2 / (2 * count)) / (1 + z2 / count)
    half = z * np.sqrt(rate * (1 - rate) / count + z2 / (4 * count**2)) / (1 + z2 / count)
    return float(max(middle - half, 0.0)), float(min(middle + half, 1.0))
