"""Fits of several hypotheses at once, the nominal parameters free in each (steps 3 and 6).

Gauss and Newton with secants. Slopes are found where a round of discovery begins and, of the finalists, where they
stand (`polish`); in between they are learnt from the steps taken (Broyden): a round of a fit costs two simulations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.problem import Hypothesis

Evaluate = Callable[[np.ndarray], np.ndarray]
"""`evaluate(vectors [n, axes]) -> residuals [n, features]` in floor units."""

ROUNDS_MORE = 2  # of a fit that starts from another one
_SCALES = (1.0, 0.35)
_DAMPING = 1e-3
_IDLE = 0.5  # of a loss, in which chance counts one
_PATIENCE = 2  # rounds
_SHORTEST = 0.03  # of a step that slopes are learnt from


@dataclass(frozen=True)
class Free:
    """What may move: `vector = coordinates @ directions`."""

    directions: np.ndarray
    """[coordinates, axes] a standard deviation, or a typical size, along each."""
    sd: np.ndarray
    """[coordinates] of the prior, in units of the directions."""
    bounds: np.ndarray
    """[coordinates, 2]"""
    nominal: np.ndarray
    """[coordinates] True for what is free under every hypothesis."""

    def and_then(self, other: "Free") -> "Free":
        """Both together."""
        return Free(*(np.concatenate(pair) for pair in zip(self.parts(), other.parts(), strict=True)))

    def parts(self) -> tuple[np.ndarray, ...]:
        """Its fields."""
        return self.directions, self.sd, self.bounds, self.nominal


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

    def own(self, hypothesis: Hypothesis) -> np.ndarray:
        """Coordinates [parameters] of the hypothesis that it was begun for."""
        return self.coordinates[-len(hypothesis.directions) :]

    def along(self, hypothesis: Hypothesis) -> np.ndarray:
        """Which coordinates [coordinates] are those of a hypothesis that is in it."""
        return np.array([any((row == mine).all() for mine in hypothesis.directions) for row in self.free.directions])

    @property
    def linear(self) -> Linear:
        """Residuals near the point."""
        return Linear(self.residual, self.jacobian, self.coordinates, self.free.sd, self.weight)

    def moved(self, scale: float) -> np.ndarray:
        """Coordinates a share of the best step away, within the bounds."""
        step = self.linear.step(_DAMPING, self.free.bounds)
        return np.clip(self.coordinates + scale * step, self.free.bounds[:, 0], self.free.bounds[:, 1])

    @property
    def at_bounds(self) -> np.ndarray:
        """Which coordinates [coordinates] are where they may not go on."""
        low, high = self.free.bounds.T
        return (self.coordinates <= low) | (self.coordinates >= high)


def refine(fits: Sequence[Fit], evaluate: Evaluate, rounds: int) -> list[Fit]:
    """Moves every fit towards its least loss; one that meets nothing but numbers that are not finite says so.

    One that twice in a row has not gained what chance would is done.
    """
    fits, idle = list(fits), [0] * len(fits)
    for _ in range(rounds):
        active = [index for index, count in enumerate(idle) if count < _PATIENCE]
        if not active:
            break
        trials = [[fits[index].moved(scale) for scale in _SCALES] for index in active]
        vectors = [p @ fits[index].free.directions for index, pair in zip(active, trials, strict=True) for p in pair]
        found = evaluate(np.stack(vectors)).reshape(len(active), len(_SCALES), -1)
        for index, points, residuals in zip(active, trials, found, strict=True):
            before, fits[index] = fits[index].linear.loss, _best(fits[index], points, residuals)
            idle[index] = idle[index] + 1 if before - fits[index].linear.loss < _IDLE else 0
    return fits


def anew(free: Free, coordinates: np.ndarray, weight: float, evaluate: Evaluate) -> Fit:
    """A fit of which no more is known than where it stands."""
    residual = evaluate((coordinates @ free.directions)[None])[0]
    slopes = np.zeros((len(residual), len(coordinates)))
    return polish([Fit(free, coordinates, residual, slopes, weight)], evaluate, 0)[0]


def polish(fits: Sequence[Fit], evaluate: Evaluate, rounds: int) -> list[Fit]:
    """Finds all slopes anew where fits stand, one simulation for each, and goes on from there."""
    steps = [_own_step(fit) for fit in fits]
    found = _dealt(
        evaluate,
        [
            [(fit.coordinates + step) @ fit.free.directions for step in np.diag(size)]
            for fit, size in zip(fits, steps, strict=True)
        ],
    )
    fresh = [
        replace(fit, jacobian=np.where(np.isfinite(moved), (moved - fit.residual) / size[:, None], 0.0).T)
        for fit, size, moved in zip(fits, steps, found, strict=True)
    ]
    return refine(fresh, evaluate, rounds)


def _own_step(fit: Fit) -> np.ndarray:
    """How far to go for slopes, [coordinates], inwards from a bound."""
    size = np.maximum(0.3 * fit.free.sd * np.where(fit.free.nominal, 1.0, 0.1), 0.1 * np.abs(fit.coordinates))
    return np.where(fit.coordinates + size > fit.free.bounds[:, 1], -size, size)


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
    # A short step teaches nothing but the rounding of single precision.
    if length < _SHORTEST**2:
        return fit
    surprise = residual - fit.residual - fit.jacobian @ step
    return replace(fit, jacobian=fit.jacobian + np.outer(surprise, step) / length)


def begin(
    base: Fit,
    hypotheses: Sequence[Hypothesis],
    tried: Sequence[Sequence[np.ndarray]],
    evaluate: Evaluate,
    absolute: bool = False,
    like: Sequence[Fit] | None = None,
) -> list[Fit]:
    """Fits that are about to start: each hypothesis beside what is free in `base`, at the best of its points.

    Args:
      base: the model without them.
      hypotheses: one for every fit.
      tried: points [parameters] for every hypothesis, seen from where the base has what the hypothesis takes over.
      evaluate: residuals of vectors.
      absolute: points are seen from the nominal model instead.
      like: fits of the same hypotheses to other segments, where everything else starts.
    """
    kept, points = [], []
    for number, (hypothesis, group) in enumerate(zip(hypotheses, tried, strict=True)):
        fit, stood = without(base, given_up(base.free, hypothesis), hypothesis)
        if like:
            fit = replace(fit, coordinates=like[number].coordinates[: len(fit.coordinates)])
        kept.append(fit)
        points.append([np.clip(point if absolute else stood + point, *hypothesis.bounds.T) for point in group])
    places = list(zip(kept, hypotheses, points, strict=True))
    found = _dealt(evaluate, [[fit.vector + p @ h.directions for p in group] for fit, h, group in places])
    best = [_best_start(fit, residuals) for fit, residuals in zip(kept, found, strict=True)]
    at = [(group[index], residuals[index]) for group, residuals, index in zip(points, found, best, strict=True)]
    steps = [_probing_step(hypothesis, point) for hypothesis, (point, _) in zip(hypotheses, at, strict=True)]
    moved = _dealt(
        evaluate,
        [
            [fit.vector + (point + step) @ h.directions for step in np.diag(size)]
            for fit, h, (point, _), size in zip(kept, hypotheses, at, steps, strict=True)
        ],
    )
    return [
        replace(
            fit,
            free=fit.free.and_then(Free(h.directions, h.prior, h.bounds, np.zeros(len(h.prior), bool))),
            coordinates=np.concatenate([fit.coordinates, point]),
            residual=residual,
            jacobian=np.concatenate([fit.jacobian, np.nan_to_num((shifted - residual) / size[:, None]).T], axis=1),
            finite=bool(np.isfinite(residual).all() and np.isfinite(shifted).all()),
        )
        for fit, h, (point, residual), size, shifted in zip(kept, hypotheses, at, steps, moved, strict=True)
    ]


def given_up(free: Free, hypothesis: Hypothesis) -> np.ndarray:
    """Which coordinates [coordinates] are the hypothesis' own: nominal parameters at its places, prior and all."""
    return np.any([_own(free, part) for part in hypothesis.parts or (hypothesis,)], axis=0)


def _own(free: Free, hypothesis: Hypothesis) -> np.ndarray:
    if len(hypothesis.directions) > 1:
        return np.zeros(len(free.sd), bool)
    mine = hypothesis.directions[0] != 0
    within = np.array([not (direction[~mine] != 0).any() for direction in free.directions])
    return within & free.nominal


def without(fit: Fit, own: np.ndarray, hypothesis: Hypothesis) -> tuple[Fit, np.ndarray]:
    """A fit without some of its coordinates, and where those stood in the hypothesis' [parameters]."""
    stood, start = np.zeros(len(hypothesis.directions)), 0
    for part in hypothesis.parts or (hypothesis,):
        mine, direction = own & _own(fit.free, part), part.directions[0]
        vector = fit.coordinates[mine] @ fit.free.directions[mine]
        stood[start] = (vector[direction != 0] / direction[direction != 0]).mean()
        start += len(part.directions)
    free = Free(*(part[~own] for part in fit.free.parts()))
    return replace(fit, free=free, coordinates=fit.coordinates[~own], jacobian=fit.jacobian[:, ~own]), stood


def _probing_step(hypothesis: Hypothesis, point: np.ndarray) -> np.ndarray:
    """How far to go for slopes, [parameters], inwards from a bound."""
    size = 0.2 * np.abs(point) + 0.2 * hypothesis.probes.max(axis=0) + 0.02 * (hypothesis.probes == 0).all(axis=0)
    return np.where(point + size > hypothesis.bounds[:, 1], -size, size)


def _best_start(fit: Fit, residuals: np.ndarray) -> int:
    """The point with the least misfit once the nominal parameters have answered."""
    misfits = []
    for residual in residuals:
        linear = replace(fit, residual=residual).linear
        misfits.append(np.sum((residual + linear.jacobian @ linear.step(_DAMPING)) ** 2))
    return int(np.argmin(np.where(np.isfinite(misfits), misfits, np.inf)))


def _dealt(evaluate: Evaluate, groups: Sequence[Sequence[np.ndarray]]) -> list[np.ndarray]:
    """Evaluates all vectors of all groups at once; what was found, by group."""
    found = evaluate(np.stack([vector for group in groups for vector in group]))
    return np.split(found, np.cumsum([len(group) for group in groups])[:-1])
