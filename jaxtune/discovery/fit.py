"""Fits of several hypotheses at once, the nominal parameters free in each (steps 3 and 6).

Gauss and Newton with secants. The slopes of the nominal parameters are those found at the null; what changes of them,
and of the hypothesis' own, is learnt from the steps taken (Broyden), so that a round costs two simulations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.least_squares import Linear

Evaluate = Callable[[np.ndarray], np.ndarray]
"""`evaluate(vectors [n, axes]) -> residuals [n, features]` in floor units."""

_SCALES = (1.0, 0.35)
_DAMPING = 1e-3


@dataclass(frozen=True)
class Free:
    """What may move: `vector = coordinates @ directions`."""

    directions: np.ndarray
    """[coordinates, axes] a standard deviation, or a typical size, along each."""
    sd: np.ndarray
    """[coordinates] of the prior, infinite where there is none."""
    bounds: np.ndarray
    """[coordinates, 2]"""

    def and_then(self, other: "Free") -> "Free":
        """Both together."""
        return Free(*(np.concatenate(pair) for pair in zip(self.parts(), other.parts(), strict=True)))

    def parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Its fields."""
        return self.directions, self.sd, self.bounds


@dataclass(frozen=True)
class Fit:
    """A point, and what was found there."""

    free: Free
    coordinates: np.ndarray
    """[coordinates]"""
    residual: np.ndarray
    """[features]"""
    jacobian: np.ndarray
    """[features, coordinates]"""
    weight: float
    finite: bool = True

    @property
    def vector(self) -> np.ndarray:
        """[axes]"""
        return self.coordinates @ self.free.directions

    @property
    def linear(self) -> Linear:
        """Residuals near the point."""
        return Linear(self.residual, self.jacobian, self.coordinates, self.free.sd, self.weight)

    def moved(self, scale: float) -> np.ndarray:
        """Coordinates a share of the best step away, within the bounds."""
        step = self.linear.step(_DAMPING)
        return np.clip(self.coordinates + scale * step, self.free.bounds[:, 0], self.free.bounds[:, 1])


def refine(fits: Sequence[Fit], evaluate: Evaluate, rounds: int) -> list[Fit]:
    """Moves every fit towards its least loss; one that meets nothing but numbers that are not finite says so."""
    fits = list(fits)
    for _ in range(rounds):
        trials = [[fit.moved(scale) for scale in _SCALES] for fit in fits]
        vectors = [point @ fit.free.directions for fit, points in zip(fits, trials, strict=True) for point in points]
        found = evaluate(np.stack(vectors)).reshape(len(fits), len(_SCALES), -1)
        fits = [_best(*trio) for trio in zip(fits, trials, found, strict=True)]
    return fits


def _best(fit: Fit, points: Sequence[np.ndarray], residuals: np.ndarray) -> Fit:
    """The better of the trials, if one is better than where it is; what they taught in any case."""
    best, learnt = None, fit
    for point, residual in zip(points, residuals, strict=True):
        if not np.isfinite(residual).all():
            continue
        learnt = _learn(learnt, point, residual)
        moved = replace(fit, coordinates=point, residual=residual)
        if moved.linear.loss < (best or fit).linear.loss:
            best = moved
    if learnt is fit and not np.isfinite(residuals).all():
        return replace(fit, finite=False)
    return replace(best or fit, jacobian=learnt.jacobian)


def _learn(fit: Fit, point: np.ndarray, residual: np.ndarray) -> Fit:
    """Slopes that would have foreseen the residual at a point."""
    step = point - fit.coordinates
    length = step @ step
    if length < 1e-12:
        return fit
    surprise = residual - fit.residual - fit.jacobian @ step
    return replace(fit, jacobian=fit.jacobian + np.outer(surprise, step) / length)
