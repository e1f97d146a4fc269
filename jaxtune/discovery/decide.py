"""Whether a hypothesis is accepted, and under which name (step 7)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.resample import blocks, in_blocks, standard_error

_REFITS = 200
_TIE = 0.03  # of what is left: less is nobody's victory, however significant


@dataclass(frozen=True)
class Evidence:
    """What speaks for a hypothesis against the model without it."""

    gain: float
    """Fall of the loss of the fit, on `train`."""
    t: float
    """On `select`: mean fall of what a segment counts for over its standard error."""
    confirmed: float
    """Fall of the loss on `select`, where it was not fitted, the block of segments that gains most left out; in units
    of what is left."""
    floors: float
    """Root of the largest fall of a single component's mean square, in floor units."""
    interval: tuple[float, float]
    """95 % interval of the coordinate that is clearest of zero; of two effects, of the one that is less clear."""
    inside: bool
    """Whether the coordinates are inside their bounds."""
    horizons: int
    """At how many horizons it is best, or within a standard error of it."""
    chosen: float
    """How often it, or one that cannot be told from it, is best when it is fitted to segments that are drawn again."""


@dataclass(frozen=True)
class Thresholds:
    """What it takes."""

    t: float
    """Over all hypotheses that are compared on `select`, at once."""
    gain: float
    """What the best hypothesis gains on healthy logs, 95th percentile; of two effects, twice that."""
    floors: float = 1.0
    horizons: int = 2
    chosen: float = 0.7


def passes(evidence: Evidence, thresholds: Thresholds) -> dict[str, bool]:
    """Every test by name."""
    low, high = evidence.interval
    return {
        # What shows in few segments alone has a large standard error however clear it is in those: it is enough if it
        # gains more where it was not fitted than anything gains on healthy logs where it was.
        "significant": evidence.t > thresholds.t or evidence.confirmed > thresholds.gain,
        "beyond_healthy": evidence.gain > thresholds.gain,
        "floor_unit": evidence.floors >= thresholds.floors,
        "inside_bounds": evidence.inside,
        "clear_of_zero": low > 0 or high < 0,
        "horizons": evidence.horizons >= thresholds.horizons,
        "bagged": evidence.chosen >= thresholds.chosen,
    }


def paired(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How much better every segment is, [segments], of residuals [segments, bins, components]."""
    return losses(before) - losses(after)


def losses(residual: np.ndarray) -> np.ndarray:
    """What a segment's residuals [segments, bins, components] count for: their root mean square, [segments].

    Squares would let the few segments in which everything is far off drown the others; logarithms would hide what an
    effect explains where another one is missing too.
    """
    return np.sqrt((residual**2).mean(axis=(1, 2)))


def confirmed(before: np.ndarray, after: np.ndarray, run: np.ndarray, weight: float) -> float:
    """Fall of the loss of residuals [segments, bins, components], the block of segments that gains most left out.

    In units of what is left, where that is more than the floor: among large residuals chance is large too.
    """
    gains = in_blocks(weight * (before**2 - after**2).sum(axis=(1, 2)), run)
    return float((gains.sum() - max(gains.max(), 0.0)) / max((after**2).mean(), 1.0))


def t_statistic(gains: np.ndarray, run: np.ndarray) -> float:
    """Mean over standard error of [segments]."""
    return float(gains.mean() / standard_error(gains, run))


def max_t(gains: Mapping[str, np.ndarray], run: np.ndarray, level: float) -> float:
    """The t that the best of hypotheses without an effect exceeds with probability `level`.

    Bootstrap of gains [segments] with their means taken off, the same draws for every hypothesis. These are all that
    are looked at on `select` this time; which of the library they are was settled on `train`.
    """
    draws, found = blocks(run), []
    for values in gains.values():
        found.append((values[draws].mean(axis=1) - values.mean()) / standard_error(values, run))
    return float(np.quantile(np.max(found, axis=0), 1.0 - level))


def alike(lost: Mapping[str, np.ndarray], run: np.ndarray, errors: float) -> list[str]:
    """Those that cannot be told from the best, best first.

    Args:
      lost: what every segment counts for, [segments] by hypothesis.
      run: [segments] index of each segment's run.
      errors: how many standard errors of the paired difference count as a difference.
    """
    order = sorted(lost, key=lambda key: lost[key].mean())
    worse = {key: lost[key] - lost[order[0]] for key in order}
    tie = _TIE * lost[order[0]].mean()
    return [key for key in order if worse[key].mean() <= max(errors * standard_error(worse[key], run), tie)]


def bagged(fits: Mapping[str, Linear], run: np.ndarray) -> dict[str, float]:
    """How often each is best where it was not fitted, when segments are drawn with repetition and it is fitted again.

    Near its fit a hypothesis is linear; so a draw costs the solution of one small system, and no simulation. A fit is
    taken to be the best for all segments: a draw moves it by how it differs from them, not by what the slopes promise
    of places where it has been and found it otherwise.

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
        lost.append(np.where(times == 0, np.sqrt(np.maximum(there, 0.0)), 0.0).sum(axis=1))
    winners = np.argmin(lost, axis=0)
    return {key: float((winners == index).mean()) for index, key in enumerate(fits)}


def sandwich(residual: np.ndarray, jacobian: np.ndarray, weight: float, sd: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Standard errors [coordinates] that allow for residuals that go together within a block of segments.

    Args:
      residual: [segments, features].
      jacobian: [segments, features, coordinates].
      weight: share of the features that count as independent.
      sd: [coordinates] of the prior.
      run: [segments] index of each segment's run.
    """
    normal = weight * np.einsum("sfi,sfj->ij", jacobian, jacobian) + np.diag(1.0 / sd**2)
    inverse = np.linalg.pinv(normal, hermitian=True)
    pull = weight * np.einsum("sfi,sf->si", jacobian, residual)
    pull = in_blocks(pull, run)
    return np.sqrt(np.diag(inverse @ (pull.T @ pull + np.diag(1.0 / sd**2)) @ inverse))
