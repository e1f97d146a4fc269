"""Whether a hypothesis is accepted, and under which name (step 7)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

_DRAWS = 1000


@dataclass(frozen=True)
class Evidence:
    """What speaks for a hypothesis against the model without it."""

    gain: float
    """Fall of the loss of the fit, on `train`."""
    t: float
    """On `select`: mean fall of a segment's mean square over its standard error."""
    floors: float
    """Root of the largest fall of a single component's mean square, in floor units."""
    interval: tuple[float, float]
    """95 % interval of the coordinate that is clearest of zero."""
    inside: bool
    """Whether the coordinates are inside their bounds."""
    horizons: int
    """At how many horizons it is best, or within a standard error of it."""
    chosen: float
    """How often it, or one that cannot be told from it, is best when segments are drawn again."""


@dataclass(frozen=True)
class Thresholds:
    """What it takes."""

    t: float
    """Over all hypotheses that were fitted, at once."""
    gain: float
    """What the best hypothesis gains on healthy logs, 95th percentile."""
    floors: float = 1.0
    horizons: int = 2
    chosen: float = 0.7


def passes(evidence: Evidence, thresholds: Thresholds) -> dict[str, bool]:
    """Every test by name."""
    low, high = evidence.interval
    return {
        "significant": evidence.t > thresholds.t,
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


def t_statistic(gains: np.ndarray) -> float:
    """Mean over standard error of [segments]."""
    return float(gains.mean() / max(_standard_error(gains), 1e-12))


def max_t(gains: Mapping[str, np.ndarray], level: float, seed: int = 0) -> float:
    """The t that the best of hypotheses without an effect exceeds with probability `level`.

    Bootstrap over segments of gains [segments] with their means taken off, the same draws for every hypothesis.
    """
    values = np.stack(list(gains.values()))
    centred = values - values.mean(axis=1, keepdims=True)
    count = values.shape[1]
    draws = np.random.default_rng(seed).integers(count, size=(_DRAWS, count))
    drawn = centred[:, draws]
    error = drawn.std(axis=2, ddof=1) / np.sqrt(count)
    return float(np.quantile((drawn.mean(axis=2) / np.maximum(error, 1e-12)).max(axis=0), 1.0 - level))


def alike(lost: Mapping[str, np.ndarray], errors: float) -> list[str]:
    """Those that cannot be told from the best, best first.

    Args:
      lost: what every segment counts for, [segments] by hypothesis.
      errors: how many standard errors of the paired difference count as a difference.
    """
    order = sorted(lost, key=lambda key: lost[key].mean())
    worse = {key: lost[key] - lost[order[0]] for key in order}
    return [key for key in order if worse[key].mean() <= errors * _standard_error(worse[key])]


def bagged(lost: Mapping[str, np.ndarray], seed: int = 0) -> dict[str, float]:
    """How often each is best when segments are drawn with repetition."""
    values = np.stack(list(lost.values()))
    count = values.shape[1]
    draws = np.random.default_rng(seed).integers(count, size=(_DRAWS, count))
    winners = values[:, draws].mean(axis=2).argmin(axis=0)
    return {key: float((winners == index).mean()) for index, key in enumerate(lost)}


def simplest(keys: Sequence[str], complexity: Mapping[str, int]) -> str:
    """The first of the least complex."""
    return min(keys, key=lambda key: complexity[key])


def _standard_error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def sandwich(residual: np.ndarray, jacobian: np.ndarray, weight: float, sd: np.ndarray) -> np.ndarray:
    """Standard errors [coordinates] that allow for residuals that go together within a segment.

    Args:
      residual: [segments, features].
      jacobian: [segments, features, coordinates].
      weight: share of the features that count as independent.
      sd: [coordinates] of the prior.
    """
    normal = weight * np.einsum("sfi,sfj->ij", jacobian, jacobian) + np.diag(1.0 / sd**2)
    inverse = np.linalg.pinv(normal, hermitian=True)
    pull = weight * np.einsum("sfi,sf->si", jacobian, residual)
    return np.sqrt(np.diag(inverse @ (pull.T @ pull + np.diag(1.0 / sd**2)) @ inverse))
