"""Statistics of segments that are not independent, from segments drawn again together.

Segments that follow on each other share a posture, a speed and an error of the smoothed state, and what is wrong in one
is wrong in the next. So whole runs are drawn where there are enough of them; else blocks that are longer than the
correlation, within every run: a circular block bootstrap (Politis and Romano, 1992).
"""

import numpy as np

from jaxtune.discovery.fit import Fit

LENGTH = 3
"""Least number of segments of a block."""
_ENOUGH_RUNS = 8  # to draw whole runs
_UNCORRELATED = 0.2  # autocorrelation below which segments count as independent


def units(run: np.ndarray, squares: np.ndarray, runs_of_select: int) -> np.ndarray:
    """Groups segments into the units that are drawn together.

    Args:
      run: [segments] index of each segment's run; those of a run follow on each other.
      squares: [segments, components] what a good model leaves, from which the correlation is measured.
      runs_of_select: number of runs that the validation has.

    Returns:
      [segments] number of each segment's unit.

    Raises:
      ValueError: the segments of a run do not follow on each other.
    """
    if len(np.unique(run)) != 1 + np.count_nonzero(np.diff(run)):
        raise ValueError("run: got segments of a run apart from each other, expected them to follow on each other")
    if runs_of_select >= _ENOUGH_RUNS:
        return np.unique(run, return_inverse=True)[1]
    return np.repeat(*_blocks(run, max(LENGTH, correlation_length(run, squares))))


def correlation_length(run: np.ndarray, squares: np.ndarray) -> int:
    """Counts the segments over which a misfit goes together, from the autocorrelation of its square root.

    Args:
      run: [segments] index of each segment's run.
      squares: [segments, components].

    Returns:
      The first lag at which the mean autocorrelation over components is small; a third of the longest run at most.
    """
    values = np.sqrt(squares)
    values = values - values.mean(axis=0)
    variance = np.maximum((values**2).mean(axis=0), 1e-12)
    longest = max(1, int(np.unique(run, return_counts=True)[1].max()) // 3)
    for lag in range(1, longest):
        same = run[lag:] == run[:-lag]
        if not same.any():
            return lag
        if float(((values[lag:] * values[:-lag])[same].mean(axis=0) / variance).mean()) < _UNCORRELATED:
            return lag
    return longest


def times_drawn(unit: np.ndarray, draws: int = 400, seed: int = 0) -> np.ndarray:
    """Draws as many units as there are, with repetition; says how often that is every segment, [draws, segments].

    The same arguments give the same draws: differences between models are paired.
    """
    count = int(unit.max()) + 1
    drawn = np.random.default_rng(seed).integers(count, size=(draws, count))
    times = np.stack([np.bincount(draw, minlength=count) for draw in drawn])[:, unit].astype(float)
    # Units differ in length; a draw stands for as many segments as there are.
    return times * (len(unit) / np.maximum(times.sum(axis=1, keepdims=True), 1.0))


def in_units(values: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Sums values [segments, ...] over the segments of every unit; returns [units, ...]."""
    return np.stack([values[unit == number].sum(axis=0) for number in range(int(unit.max()) + 1)])


def standard_errors(fit: Fit, unit: np.ndarray) -> np.ndarray:
    """Computes standard errors [coordinates] that allow for residuals that go together within a unit.

    The sandwich covariance (White, 1980; clustered): with N = J'WJ + diag(1/sd^2), the normal matrix of a
    step (`Linear`), and g_b = sum_(s in b) J_s'W r_s,

        Cov = N^-1 (n / (n - 1) sum_b g_b g_b' + diag(1/sd^2)) N^-1,   at least N^-1 itself.

    Args:
      fit: residuals and slopes on `train`.
      unit: [segments] of `train`, from `units`.
    """
    linear = fit.linear
    value, slope = linear.rows()
    prior = np.diag(linear.sd**-2.0)
    inverse = np.linalg.pinv(slope.T @ slope, hermitian=True)
    rows = len(fit.residual)
    pull = (slope[:rows] * value[:rows, None]).reshape(len(unit), -1, slope.shape[1]).sum(axis=1)
    pulls = in_units(pull, unit)
    count = len(pulls)
    middle = count / max(count - 1, 1) * pulls.T @ pulls + prior
    return np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse), np.diag(inverse)))


def _blocks(run: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of consecutive blocks within every run, and their lengths; a short rest joins the block before it."""
    lengths: list[int] = []
    # In the order of the segments, whatever the runs' numbers are.
    ends = np.append(np.flatnonzero(np.diff(run)) + 1, len(run))
    for count in np.diff(ends, prepend=0):
        whole = max(1, int(count) // length)
        lengths += [int(count) // whole + (index < int(count) % whole) for index in range(whole)]
    return np.arange(len(lengths)), np.array(lengths)
