"""Gauss-Newton fits of many models at once, with slopes that are learnt from the steps taken.

A fit minimises the loss of `least_squares.Linear`: squared residuals in floor units, plus the prior of every coordinate
that is free. With residuals r(c), slopes J = dr/dc, weight w and prior deviations s, a step solves

    (w J'J + diag(1/s^2)) u = -(w J'r + c/s^2),   low <= c + u <= high.

A simulation is the expensive part, so slopes are secants that are taken where a round of discovery begins and, for the
finalists, where they stand (`polish`). In between, Broyden's update learns them from the steps themselves, and one
iteration costs two simulations. Source: Nocedal and Wright, Numerical Optimization, chapters 10 and 11.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.problem import Hypothesis
from jaxtune.discovery.simulation import Evaluate

_SCALES = (1.0, 0.35)  # shares of the Gauss-Newton step that are tried side by side
_DAMPING = 1e-3
_IDLE = 0.5  # fall of the loss that chance gives: about a half for a squared unit residual
_PATIENCE = 2  # rounds without more than that
_PRIOR_ROUNDS = 6  # a tenth off in the parameters, one step would leave so much that it passed for an engine gap
_SHORTEST = 0.03  # length of a step, in coordinates, below which rounding hides what it could teach


@dataclass(frozen=True)
class Free:
    """The coordinates that a fit may move, and the vector they stand for: `vector = coordinates @ directions`.

    The nominal parameters and the timing (the prior directions) come first; the coordinates of every accepted or tried
    effect follow.
    """

    directions: np.ndarray
    """[coordinates, axes]: a standard deviation of the prior, or a typical size, along each."""
    sd: np.ndarray
    """[coordinates]: standard deviation of the prior, in units of the directions."""
    bounds: np.ndarray
    """[coordinates, 2]: least and largest value."""
    nominal: np.ndarray
    """[coordinates]: True for the prior directions, which are free under every hypothesis."""

    def and_then(self, other: "Free") -> "Free":
        """Joins two sets of coordinates, those of the other one last; a model grows by it when a hypothesis joins."""
        return Free(*(np.concatenate(pair) for pair in zip(self.parts(), other.parts(), strict=True)))

    def only(self, kept: np.ndarray) -> "Free":
        """Keeps the coordinates for which `kept` [coordinates] is True, such as all but an ablated effect's."""
        return Free(*(part[kept] for part in self.parts()))

    def parts(self) -> tuple[np.ndarray, ...]:
        """Lists its arrays in the order of the fields; each has one row for each coordinate."""
        return self.directions, self.sd, self.bounds, self.nominal


@dataclass(frozen=True)
class Fit:
    """A model at one horizon: where its coordinates stand, and residuals and slopes there.

    Fits are values: every function that moves one returns another one.
    """

    free: Free
    coordinates: np.ndarray
    """[coordinates]"""
    residual: np.ndarray
    """[features]: residuals on `train` in floor units; a feature is a (segment, bin, component)."""
    jacobian: np.ndarray
    """[features, coordinates]: secants, or what Broyden's update made of them."""
    weight: float
    """Share of the features that count as independent."""
    finite: bool = True
    """False where every step from here broke the simulation."""

    @property
    def vector(self) -> np.ndarray:
        """The model as the vector [axes] that the simulator is given: `coordinates @ directions`."""
        return self.coordinates @ self.free.directions

    def own(self, hypothesis: Hypothesis) -> np.ndarray:
        """Coordinates [parameters] of the hypothesis that joined last, which are the model's last ones."""
        return self.coordinates[-len(hypothesis.directions) :]

    def along(self, hypothesis: Hypothesis) -> np.ndarray:
        """Finds a hypothesis that is part of the model, whenever it joined, by its directions; a mask [coordinates]."""
        return np.array([any((row == mine).all() for mine in hypothesis.directions) for row in self.free.directions])

    @property
    def linear(self) -> Linear:
        """The linear model of the residuals around this point, with the prior: r(c + u) = r + J u."""
        return Linear(self.residual, self.jacobian, self.coordinates, self.free.sd, self.weight)

    def moved(self, scale: float) -> np.ndarray:
        """Coordinates after a share `scale` of the damped Gauss-Newton step; they never leave the bounds."""
        step = self.linear.step(_DAMPING, self.free.bounds)
        return np.clip(self.coordinates + scale * step, self.free.bounds[:, 0], self.free.bounds[:, 1])

    @property
    def at_bounds(self) -> np.ndarray:
        """Mask [coordinates] of those at a bound, which can make no room for anything else."""
        low, high = self.free.bounds.T
        return (self.coordinates <= low) | (self.coordinates >= high)


def refine(fits: Sequence[Fit], evaluate: Evaluate, rounds: int) -> list[Fit]:
    """Moves every fit towards its least loss, all of them in the same batches of simulations.

    A round tries a whole and a short Gauss-Newton step of every fit and keeps the better one, if it lowers the loss.
    A fit that gained less than chance in two rounds in a row is done. One whose trials are all not finite is returned
    with `finite=False`.
    """
    fits, idle = list(fits), [0] * len(fits)
    for _ in range(rounds):
        active = [index for index, count in enumerate(idle) if count < _PATIENCE]
        if not active:
            break
        # All trials of all fits go into one batch, since a device simulates many as fast as one.
        trials = [[fits[index].moved(scale) for scale in _SCALES] for index in active]
        vectors = [p @ fits[index].free.directions for index, pair in zip(active, trials, strict=True) for p in pair]
        found = evaluate(np.stack(vectors)).reshape(len(active), len(_SCALES), -1)
        for index, points, residuals in zip(active, trials, found, strict=True):
            before, fits[index] = fits[index].linear.loss, _best_trial(fits[index], points, residuals)
            idle[index] = idle[index] + 1 if before - fits[index].linear.loss < _IDLE else 0
    return fits


def polish(fits: Sequence[Fit], evaluate: Evaluate, rounds: int) -> list[Fit]:
    """Takes the slopes of all coordinates anew where fits stand, and refines from there.

    It costs one simulation for each coordinate. With no rounds it only renews the slopes.
    """
    steps = [_secant_step(fit) for fit in fits]
    found = evaluate_groups(
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


def fit_prior(prior: Free, evaluate: Evaluate, slopes: np.ndarray, weight: float) -> Fit:
    """Fits the prior directions alone to a log, from the nominal model on.

    Args:
      prior: the directions that are free under every hypothesis.
      evaluate: residuals of vectors on the log.
      slopes: [segments, bins, components, directions] at the nominal model, in floor units. They may be another log's
        of the same motion: a fit corrects them as it goes.
      weight: share of the features that count as independent.
    """
    zero = np.zeros(len(prior.sd))
    residual = evaluate((zero @ prior.directions)[None])[0]
    return refine([Fit(prior, zero, residual, slopes.reshape(-1, len(zero)), weight)], evaluate, _PRIOR_ROUNDS)[0]


def fit_at(free: Free, coordinates: np.ndarray, weight: float, evaluate: Evaluate) -> Fit:
    """Makes a fit of which only the coordinates are known: simulates its residuals and takes its slopes.

    Args:
      free: what the coordinates are.
      coordinates: [coordinates] where the fit stands.
      weight: share of the features that count as independent.
      evaluate: residuals of vectors.
    """
    residual = evaluate((coordinates @ free.directions)[None])[0]
    # Polishing with no rounds fills them in.
    slopes = np.zeros((len(residual), len(coordinates)))
    return polish([Fit(free, coordinates, residual, slopes, weight)], evaluate, 0)[0]


def evaluate_groups(evaluate: Evaluate, groups: Sequence[Sequence[np.ndarray]]) -> list[np.ndarray]:
    """Evaluates the vectors of all groups in one batch; returns residuals [vectors of the group, features] by group."""
    found = evaluate(np.stack([vector for group in groups for vector in group]))
    return np.split(found, np.cumsum([len(group) for group in groups])[:-1])


def probing_step(hypothesis: Hypothesis, point: np.ndarray) -> np.ndarray:
    """Says how far to go from a point for a hypothesis' first secants, [parameters], inwards from an upper bound."""
    size = 0.2 * np.abs(point) + 0.2 * hypothesis.probes.max(axis=0) + 0.02 * (hypothesis.probes == 0).all(axis=0)
    return np.where(point + size > hypothesis.bounds[:, 1], -size, size)


def best_point(fit: Fit, residuals: np.ndarray) -> int:
    """Chooses, among residuals [points, features], the point with the least misfit that a step of `fit` would leave."""
    misfits = []
    for residual in residuals:
        linear = replace(fit, residual=residual).linear
        misfits.append(np.sum((residual + linear.jacobian @ linear.step(_DAMPING)) ** 2))
    return int(np.argmin(np.where(np.isfinite(misfits), misfits, np.inf)))


def taken_over(free: Free, hypothesis: Hypothesis) -> np.ndarray:
    """Mask [coordinates] of the nominal parameters that a hypothesis takes over, prior and all.

    A hypothesis about a link's mass replaces the mass that is free from the start: it has wider bounds and its own
    prior, and beside it the old coordinate would be the same direction twice.
    """
    return np.any([_taken_by_single(free, part) for part in hypothesis.singles], axis=0)


def hand_over(fit: Fit, own: np.ndarray, hypothesis: Hypothesis) -> tuple[Fit, np.ndarray]:
    """Takes the coordinates `own` [coordinates] out of a fit, on behalf of a hypothesis.

    Returns:
      The fit without them, and where they stood in the hypothesis' coordinates, [parameters].
    """
    stood, start = np.zeros(len(hypothesis.directions)), 0
    # The first coordinate of a part is the one that a nominal parameter stands for.
    for part in hypothesis.singles:
        mine, direction = own & _taken_by_single(fit.free, part), part.directions[0]
        vector = fit.coordinates[mine] @ fit.free.directions[mine]
        stood[start] = (vector[direction != 0] / direction[direction != 0]).mean()
        start += len(part.directions)
    kept = replace(fit, free=fit.free.only(~own), coordinates=fit.coordinates[~own], jacobian=fit.jacobian[:, ~own])
    return kept, stood


def _taken_by_single(free: Free, hypothesis: Hypothesis) -> np.ndarray:
    """As `taken_over`, of a hypothesis that is no pair; only one with a single parameter can be a nominal one."""
    if len(hypothesis.directions) > 1:
        return np.zeros(len(free.sd), bool)
    mine = hypothesis.directions[0] != 0
    within = np.array([not (direction[~mine] != 0).any() for direction in free.directions])
    return within & free.nominal


def _secant_step(fit: Fit) -> np.ndarray:
    """How far to go for a secant along each coordinate, [coordinates], inwards from an upper bound."""
    # Nominal parameters stay within a deviation or so; an effect's prior is wide, and its own size says more.
    size = np.maximum(0.3 * fit.free.sd * np.where(fit.free.nominal, 1.0, 0.1), 0.1 * np.abs(fit.coordinates))
    return np.where(fit.coordinates + size > fit.free.bounds[:, 1], -size, size)


def _best_trial(fit: Fit, points: Sequence[np.ndarray], residuals: np.ndarray) -> Fit:
    """The best of the trials, if one is better than the fit; in any case with the slopes that all of them taught."""
    best, learnt = None, fit
    for point, residual in zip(points, residuals, strict=True):
        # A trial may break the simulation, as a mass that goes negative does; the shorter step may not.
        if not np.isfinite(residual).all():
            continue
        learnt = _broyden(learnt, point, residual)
        moved = replace(fit, coordinates=point, residual=residual)
        if moved.linear.loss < (best or fit).linear.loss:
            best = moved
    if learnt is fit and not np.isfinite(residuals).all():
        return replace(fit, finite=False)
    return replace(best or fit, jacobian=learnt.jacobian)


def _broyden(fit: Fit, point: np.ndarray, residual: np.ndarray) -> Fit:
    """Broyden's update of the slopes J after a step u that found residuals r+: J + (r+ - r - J u) u' / (u'u)."""
    step = point - fit.coordinates
    length = step @ step
    # A short step teaches nothing but the rounding of single precision.
    if length < _SHORTEST**2:
        return fit
    surprise = residual - fit.residual - fit.jacobian @ step
    return replace(fit, jacobian=fit.jacobian + np.outer(surprise, step) / length)
