"""Statistics of segments that are not independent, from segments drawn again in blocks.

Segments that follow on each other share a posture, a speed and an error of the smoothed state. So they are drawn
together: a circular block bootstrap (Politis and Romano, 1992) within every run.
"""

from collections.abc import Mapping

import numpy as np

from jaxtune.discovery.fit import Fit
from jaxtune.discovery.least_squares import Linear

LENGTH = 3
"""Segments of a block."""
_REFITS = 200
_TIE = 0.03  # of what is left: less is nobody's victory, however significant


def blocks(run: np.ndarray, draws: int = 1000, seed: int = 0) -> np.ndarray:
    """Draws segments with repetition, in blocks that stay within a run.

    A block begins anywhere and goes on at the run's first segment after its last, so that every segment is drawn as
    often as any other. The same arguments give the same draws: differences between hypotheses are paired.

    Args:
      run: [segments] index of each segment's run; those of a run follow on each other.
      draws: how often as many segments as there are, are drawn.
      seed: of the draws.

    Returns:
      Indices of segments, [draws, segments].

    Raises:
      ValueError: the segments of a run do not follow on each other.
    """
    count = len(run)
    if len(np.unique(run)) != 1 + np.count_nonzero(np.diff(run)):
        raise ValueError("run: got segments of a run apart from each other, expected them to follow on each other")
    _, first, length = np.unique(run, return_index=True, return_counts=True)
    # For every segment, where its run begins and how long it is.
    which = np.searchsorted(np.sort(first), np.arange(count), side="right") - 1
    first, length = (values[np.argsort(first)][which] for values in (first, length))
    start = np.random.default_rng(seed).integers(count, size=(draws, -(-count // LENGTH)))[..., None]
    ahead = start - first[start] + np.arange(LENGTH)
    return (first[start] + ahead % length[start]).reshape(draws, -1)[:, :count]


def standard_error(values: np.ndarray, draws: np.ndarray) -> float:
    """Estimates the standard error of the mean of values [segments], from draws [draws, segments] of `blocks`."""
    return float(max(values[draws].mean(axis=1).std(), 1e-12))


def in_blocks(values: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Sums values [segments, ...] over consecutive blocks that do not overlap, for sums that must be independent.

    Returns [blocks, ...].
    """
    # A block ends where its run does.
    first = np.flatnonzero(np.diff(run, prepend=run[0] - 1))
    starts = [np.arange(a, b, LENGTH) for a, b in zip(first, [*first[1:], len(run)], strict=True)]
    return np.add.reduceat(values, np.concatenate(starts), axis=0)


def losses(residual: np.ndarray) -> np.ndarray:
    """Returns what a segment's residuals [segments, bins, components] count for: their root mean square, [segments].

    Squares would let the few segments in which everything is far off drown the others; logarithms would hide what an
    effect explains where another one is missing too.
    """
    return np.sqrt((residual**2).mean(axis=(1, 2)))


def paired(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Returns how much better every segment [segments] is, from two residuals [segments, bins, components]."""
    return losses(before) - losses(after)


def t_statistic(gains: np.ndarray, run: np.ndarray) -> float:
    """Returns the mean of gains [segments] over its standard error, which is bootstrapped in blocks."""
    return float(gains.mean() / standard_error(gains, blocks(run)))


def max_t(gains: Mapping[str, np.ndarray], run: np.ndarray, level: float) -> float:
    """Finds the t that the best of several hypotheses exceeds with probability `level` if none has an effect.

    Max-t bootstrap (Westfall and Young, 1993): gains have their means taken off, the same draws serve all hypotheses,
    and the quantile 1 - level of max_h (mean*_h - mean_h) / se_h is the threshold. These are all hypotheses that are
    looked at on `select` this time; which of the library they are was settled on `train`.

    Args:
      gains: [segments] by hypothesis.
      run: [segments] index of each segment's run.
      level: probability of a false alarm.
    """
    draws, found = blocks(run), []
    for values in gains.values():
        found.append((values[draws].mean(axis=1) - values.mean()) / standard_error(values, draws))
    return float(np.quantile(np.max(found, axis=0), 1.0 - level))


def confirmed(before: np.ndarray, after: np.ndarray, run: np.ndarray, weight: float) -> float:
    """Returns the fall of the loss where nothing was fitted, without the block of segments that gains most.

    It is in units of what is left, where that is more than the floor: among large residuals chance is large too.

    Args:
      before: [segments, bins, components] residuals without the hypothesis.
      after: the same with it.
      run: [segments] index of each segment's run.
      weight: share of the bins that count as independent.
    """
    gains = in_blocks(weight * (before**2 - after**2).sum(axis=(1, 2)), run)
    return float((gains.sum() - max(gains.max(), 0.0)) / max((after**2).mean(), 1.0))


def alike(lost: Mapping[str, np.ndarray], draws: np.ndarray, errors: float) -> list[str]:
    """Lists the hypotheses that are not distinguishable from the best, best first.

    Args:
      lost: what every segment counts for, [segments] by hypothesis.
      draws: [draws, segments] of `resample.blocks`.
      errors: how many standard errors of the paired difference count as a difference.
    """
    order = sorted(lost, key=lambda key: lost[key].mean())
    worse = {key: lost[key] - lost[order[0]] for key in order}
    tie = _TIE * lost[order[0]].mean()
    return [key for key in order if worse[key].mean() <= max(errors * standard_error(worse[key], draws), tie)]


def bagged(fits: Mapping[str, Linear], run: np.ndarray) -> dict[str, float]:
    """Says how often each hypothesis is best where it was not fitted, when it is fitted to segments drawn again.

    Near its fit a hypothesis is linear; so a draw costs the solution of one small system, and no simulation. With
    n_s the times that segment s was drawn, the step solves

        (w sum_s n_s J_s'J_s + diag(1/sd^2)) u = -w sum_s (n_s - 1) J_s'r_s,

    and the segments with n_s = 0 decide which is best. The right-hand side has n_s - 1: a fit is taken to be the best
    for all segments, and a draw moves it by how it differs from them, not by what the slopes promise of places where it
    has been and found it otherwise.

    Args:
      fits: residuals and slopes of all segments, flat, at each hypothesis' fit.
      run: [segments] index of each segment's run.
    """
    draws = blocks(run, _REFITS)
    times = np.stack([np.bincount(draw, minlength=len(run)) for draw in draws])
    lost = []
    for fit in fits.values():
        residual = fit.residual.reshape(len(run), -1)
        slope = fit.jacobian.reshape(*residual.shape, -1)
        # |r + J u|^2 of every segment, as a quadratic in u.
        square = np.einsum("sf,sf->s", residual, residual)
        pull = np.einsum("sfi,sf->si", slope, residual)
        normal = np.einsum("sfi,sfj->sij", slope, slope, optimize=True)
        prior = np.diag(1.0 / fit.sd**2)
        steps = -np.linalg.solve(
            fit.weight * np.einsum("ds,sij->dij", times, normal, optimize=True) + prior + 1e-9 * np.eye(len(prior)),
            (fit.weight * (times - 1) @ pull)[..., None],
        )[..., 0]
        there = square + 2 * steps @ pull.T + np.einsum("di,sij,dj->ds", steps, normal, steps, optimize=True)
        # Only segments that were not drawn count: the others were fitted.
        lost.append(np.where(times == 0, np.sqrt(np.maximum(there, 0.0)), 0.0).sum(axis=1))
    winners = np.argmin(lost, axis=0)
    return {key: float((winners == index).mean()) for index, key in enumerate(fits)}


def standard_errors(fit: Fit, run: np.ndarray) -> np.ndarray:
    """Computes standard errors [coordinates] that allow for residuals that go together within a block of segments.

    The sandwich covariance (White, 1980; clustered by block): with N = w sum J'J + diag(1/sd^2), the inverse of the
    loss' curvature, and g_b = w sum_(s in b) J_s'r_s,

        Cov = N^-1 (sum_b g_b g_b' + diag(1/sd^2)) N^-1.

    Args:
      fit: residuals and slopes on `train`.
      run: [segments] index of each segment's run.
    """
    residual = fit.residual.reshape(len(run), -1)
    jacobian = fit.jacobian.reshape(*residual.shape, -1)
    prior = np.diag(1.0 / fit.free.sd**2)
    inverse = np.linalg.pinv(fit.weight * np.einsum("sfi,sfj->ij", jacobian, jacobian) + prior, hermitian=True)
    pull = in_blocks(fit.weight * np.einsum("sfi,sf->si", jacobian, residual), run)
    return np.sqrt(np.diag(inverse @ (pull.T @ pull + prior) @ inverse))
