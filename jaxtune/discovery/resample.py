"""Segments drawn again in blocks (circular block bootstrap; Politis and Romano, 1992).

Segments that follow on each other share a posture, a speed and an error of the smoothed state, so they are drawn
together.
"""

import numpy as np

LENGTH = 3
"""Segments of a block."""


def blocks(run: np.ndarray, draws: int = 1000, seed: int = 0) -> np.ndarray:
    """Segments by draw, [draws, segments]: as many as there are, in blocks that stay within a run.

    Args:
      run: [segments] index of each segment's run; those of a run follow on each other.
      draws: how often.
      seed: of the draws.

    Raises:
      ValueError: segments of a run are apart.
    """
    count = len(run)
    if len(np.unique(run)) != 1 + np.count_nonzero(np.diff(run)):
        raise ValueError("run: the segments of a run must follow on each other")
    _, first, length = np.unique(run, return_index=True, return_counts=True)
    which = np.searchsorted(np.sort(first), np.arange(count), side="right") - 1
    first, length = (values[np.argsort(first)][which] for values in (first, length))
    start = np.random.default_rng(seed).integers(count, size=(draws, -(-count // LENGTH)))[..., None]
    ahead = start - first[start] + np.arange(LENGTH)
    return (first[start] + ahead % length[start]).reshape(draws, -1)[:, :count]


def standard_error(values: np.ndarray, run: np.ndarray) -> float:
    """Of the mean of values [segments]."""
    return float(max(values[blocks(run)].mean(axis=1).std(), 1e-12))


def in_blocks(values: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Sums of values [segments, ...] over blocks that do not overlap, [blocks, ...]."""
    first = np.flatnonzero(np.diff(run, prepend=run[0] - 1))
    starts = [np.arange(a, b, LENGTH) for a, b in zip(first, [*first[1:], len(run)], strict=True)]
    return np.add.reduceat(values, np.concatenate(starts), axis=0)
