"""Gauss-Newton fits of many models at once, with slopes that are learnt from the steps taken.

A fit minimises the cost of `least_squares`: what the residuals say, and the prior of every coordinate that is free. A
simulation is the expensive part, so slopes are secants that are taken once and, for the finalists, where they stand
(`polish`). In between, Broyden's update learns them from the steps themselves, and one iteration costs two simulations.
Sources: Nocedal and Wright, Numerical Optimization, chapters 10 and 11; Marquardt (1963) for the damping.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from jaxtune.discovery.least_squares import Counts, Linear, of_size
from jaxtune.discovery.problem import Hypothesis
from jaxtune.discovery.simulation import Evaluate

_SHORT = 0.35  # share of the step that is tried beside the whole one
_DAMPING, _LEAST, _MOST, _FACTOR = 1e-3, 1e-6, 1.0, 30.0  # first damping, its range, and how fast it changes
_IDLE = 0.5  # fall of the cost that chance gives: about a half for a squared unit residual
_PATIENCE = 2  # rounds without more than that
_SECANT, _SHORTEST_SECANT, _FIRST_SECANT = 0.03, 0.001, 0.3  # of a deviation; the last one from zero
_SHORTEST = 0.03  # length of a step, in coordinates, below which rounding hides what it could teach


@dataclass(frozen=True)
class Free:
    """The coordinates that a fit may move, and the vector they stand for: `vector = coordinates @ directions`.

    The nominal parameters and other unknowns (the prior directions) come first; the coordinates of every accepted or
    tried effect follow.
    """

    directions: np.ndarray
    """[coordinates, axes]: a standard deviation of the prior, or a typical size, along each."""
    sd: np.ndarray
    """[coordinates]: scale s of the prior (`least_squares`), in units of the directions."""
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

    def penalty(self, coordinates: np.ndarray) -> float:
        """What the prior says against coordinates [coordinates] (`least_squares`)."""
        z = coordinates / self.sd
        return float(np.where(self.nominal, z**2, of_size(z)).sum())

    def deviations(self, coordinates: np.ndarray) -> np.ndarray:
        """Deviations [coordinates] of the Gaussian that stands for the prior around coordinates [coordinates].

        It pulls as the prior does there and is nowhere below it, so a step that lowers it lowers the cost.
        """
        return self.sd * np.where(self.nominal, 1.0, np.sqrt(1.0 + (coordinates / self.sd) ** 2))

    def parts(self) -> tuple[np.ndarray, ...]:
        """Lists its arrays in the order of the fields; each has one row for each coordinate."""
        return self.directions, self.sd, self.bounds, self.nominal


@dataclass(frozen=True)
class Fit:
    """A model at the main horizon: where its coordinates stand, and residuals and slopes there.

    Fits are values: every function that moves one returns another one.
    """

    free: Free
    coordinates: np.ndarray
    """[coordinates]"""
    residual: np.ndarray
    """[features]: residuals on `train` in floor units; a feature is a (segment, bin, component)."""
    jacobian: np.ndarray
    """[features, coordinates]: secants, or what Broyden's update made of them."""
    counts: Counts
    """How many independent numbers the residuals are worth."""
    finite: bool = True
    """False where every step from here broke the simulation."""

    @property
    def vector(self) -> np.ndarray:
        """The model as the vector [axes] that the simulator is given: `coordinates @ directions`."""
        return self.coordinates @ self.free.directions

    @property
    def penalty(self) -> float:
        """What the prior says against the coordinates."""
        return self.free.penalty(self.coordinates)

    @cached_property
    def cost(self) -> float:
        """The cost of the model on `train`, prior included (`least_squares`); infinite where it is not finite."""
        if not np.isfinite(self.residual).all():
            return np.inf
        return float(self.counts.cost(self.counts.mean_squares(self.residual)).sum()) + self.penalty

    def along(self, hypothesis: Hypothesis) -> np.ndarray:
        """Finds a hypothesis that is part of the model by its directions; a mask [coordinates]."""
        rows = self.free.directions
        return (
            np.array([any((row == mine).all() for mine in hypothesis.directions) for row in rows]) & ~self.free.nominal
        )

    @property
    def linear(self) -> Linear:
        """The linear model of the residuals around this point, with the prior: r(c + u) = r + J u."""
        weight = self.counts.weights(self.residual)
        sd = self.free.deviations(self.coordinates)
        return Linear(self.residual, self.jacobian, self.coordinates, sd, weight)

    def moved(self, scale: float, damping: float) -> np.ndarray:
        """Coordinates after a share `scale` of the damped Gauss-Newton step; they never leave the bounds."""
        step = self.linear.step(damping, self.free.bounds)
        return np.clip(self.coordinates + scale * step, self.free.bounds[:, 0], self.free.bounds[:, 1])


def refine(fits: Sequence[Fit], evaluate: Evaluate, rounds: int) -> list[Fit]:
    """Moves every fit towards its least cost, all of them in the same batches of simulations.

    A round tries a whole and a short Gauss-Newton step of every fit and keeps the better one, if it lowers the cost.
    The whole one is damped less: with thousands of residuals, parameters that make up for one another would creep along
    their valley at any fixed damping. A fit that gained less than chance in two rounds in a row is done. One whose
    trials are all not finite is returned with `finite=False`.
    """
    fits, idle, damping = list(fits), [0] * len(fits), [_DAMPING] * len(fits)
    for _ in range(rounds):
        active = [index for index, count in enumerate(idle) if count < _PATIENCE and fits[index].finite]
        if not active:
            break
        # All trials of all fits go into one batch, since a device simulates many as fast as one.
        less = [max(damping[index] / _FACTOR, _LEAST) for index in active]
        trials = [
            (fits[index].moved(1.0, light), fits[index].moved(_SHORT, damping[index]))
            for index, light in zip(active, less, strict=True)
        ]
        vectors = [p @ fits[index].free.directions for index, pair in zip(active, trials, strict=True) for p in pair]
        found = evaluate(np.stack(vectors)).reshape(len(active), len(trials[0]), -1)
        for index, light, points, residuals in zip(active, less, trials, found, strict=True):
            before, fits[index] = fits[index], _best_trial(fits[index], points, residuals)
            if (fits[index].coordinates == points[0]).all():
                damping[index] = light
            elif fits[index].cost == before.cost:
                damping[index] = min(damping[index] * _FACTOR, _MOST)
            idle[index] = idle[index] + 1 if before.cost - fits[index].cost < _IDLE else 0
    return fits


def polish(fits: Sequence[Fit], evaluate: Evaluate, rounds: int) -> list[Fit]:
    """Takes the slopes of all coordinates anew where fits stand, and refines from there.

    It costs one simulation for each coordinate. With no rounds it only renews the slopes.
    """
    return refine(with_slopes(fits, [np.ones(len(fit.coordinates), bool) for fit in fits], evaluate), evaluate, rounds)


def with_slopes(fits: Sequence[Fit], which: Sequence[np.ndarray], evaluate: Evaluate) -> list[Fit]:
    """Takes the slopes of some coordinates, `which` [coordinates] of every fit, as secants where the fits stand."""
    steps = [_secant_step(fit) for fit in fits]
    moves = [step[mine, None] * fit.free.directions[mine] for fit, mine, step in zip(fits, which, steps, strict=True)]
    found = evaluate.changes([fit.vector for fit in fits], [fit.residual for fit in fits], moves)
    fresh = []
    for fit, mine, step, changes in zip(fits, which, steps, found, strict=True):
        jacobian = fit.jacobian.copy()
        jacobian[:, mine] = (changes / step[mine, None]).T
        fresh.append(replace(fit, jacobian=jacobian))
    return fresh


def fit_at(free: Free, coordinates: np.ndarray, counts: Counts, evaluate: Evaluate) -> Fit:
    """Makes a fit of which only the coordinates are known: simulates its residuals and takes its slopes.

    Args:
      free: what the coordinates are.
      coordinates: [coordinates] where the fit stands.
      counts: how many independent numbers residuals are worth.
      evaluate: residuals of vectors.
    """
    residual = evaluate((coordinates @ free.directions)[None])[0]
    return polish([Fit(free, coordinates, residual, np.zeros((len(residual), len(coordinates))), counts)], evaluate, 0)[
        0
    ]


def begin(
    base: Fit,
    hypotheses: Sequence[Sequence[Hypothesis]],
    points: Sequence[np.ndarray],
    starts: Sequence[np.ndarray],
    evaluate: Evaluate,
) -> list[Fit]:
    """Adds hypotheses to a model, each group of them to a model of its own, with secants along their coordinates.

    Args:
      base: the model without them.
      hypotheses: what is added, a group for every fit.
      points: [parameters] coordinates of each group, one hypothesis behind the other.
      starts: [coordinates of the base] for each group: where what was free already begins.
      evaluate: residuals of vectors.

    Returns:
      A fit for every group. Its last coordinates are the group's own.
    """
    fits = []
    for group, point, start in zip(hypotheses, points, starts, strict=True):
        keeps = ~np.any([taken_over(base.free, hypothesis) for hypothesis in group], axis=0)
        free = base.free.only(keeps)
        for hypothesis in group:
            free = free.and_then(own_coordinates(hypothesis))
        # The Jacobian of the base serves as a first one; own slopes follow below.
        none = np.zeros((len(base.residual), len(point)))
        jacobian = np.concatenate([base.jacobian[:, keeps], none], axis=1)
        coordinates = np.clip(np.concatenate([start[keeps], point]), *free.bounds.T)
        fits.append(replace(base, free=free, coordinates=coordinates, jacobian=jacobian))
    found = evaluate(np.stack([fit.vector for fit in fits]))
    fits = [
        replace(fit, residual=residual, finite=bool(np.isfinite(residual).all()))
        for fit, residual in zip(fits, found, strict=True)
    ]
    own = [
        np.arange(len(fit.coordinates)) >= len(fit.coordinates) - len(p) for fit, p in zip(fits, points, strict=True)
    ]
    return with_slopes(fits, own, evaluate)


def without(fit: Fit, hypothesis: Hypothesis, prior: Free, slopes: np.ndarray) -> Fit:
    """Takes an effect out of a model; nominal parameters that it had taken over are free again, and stand where it had
    them or at their bounds.

    Residuals are still those of the model with it.

    Args:
      fit: the model.
      hypothesis: part of it.
      prior: the directions that are free under every hypothesis.
      slopes: [features, directions] along them.
    """
    own = fit.along(hypothesis)
    kept = fit.free.only(~own)
    mine = taken_over(prior, hypothesis)
    back, moved = prior.only(mine), fit.coordinates[own] @ fit.free.directions[own]
    at = np.clip(back.directions @ moved / (back.directions**2).sum(axis=1), *back.bounds.T)
    return replace(
        fit,
        free=back.and_then(kept),
        coordinates=np.concatenate([at, fit.coordinates[~own]]),
        jacobian=np.concatenate([slopes[:, mine], fit.jacobian[:, ~own]], axis=1),
    )


def own_coordinates(hypothesis: Hypothesis) -> Free:
    """The coordinates that a hypothesis adds to a model."""
    return Free(hypothesis.directions, hypothesis.prior, hypothesis.bounds, np.zeros(len(hypothesis.prior), bool))


def taken_over(free: Free, hypothesis: Hypothesis) -> np.ndarray:
    """Mask [coordinates] of the nominal parameters that a hypothesis takes over, prior and all.

    A hypothesis about a link's mass replaces the mass that is free from the start: it has wider bounds and its own
    prior, and beside it the old coordinate would be the same direction twice. So does one about where a link's centre
    of mass is.
    """
    mine = hypothesis.directions.any(axis=0)
    within = np.array([not (direction[~mine] != 0).any() for direction in free.directions])
    return within & free.nominal


def _secant_step(fit: Fit) -> np.ndarray:
    """How far to go for a secant along each coordinate, [coordinates], inwards from an upper bound."""
    sd, at, nominal = fit.free.sd, np.abs(fit.coordinates), fit.free.nominal
    # Logs may say a hundred times more than the prior does, so slopes must not bend over a secant. Nominal parameters
    # stay within a deviation or so; an effect's prior is wide, and its own size says more.
    size = np.maximum(_SECANT * sd * np.where(nominal, 1.0, 0.1), _SECANT / 3.0 * at)
    # What cannot be negative may matter by its ratio, as a short travel of bristles does, and not at once.
    grows = nominal & (fit.free.bounds[:, 0] == 0)
    size = np.where(grows, np.clip(_SECANT * at, _SHORTEST_SECANT * sd, size), size)
    size = np.where(grows & (at == 0), _FIRST_SECANT * sd, size)
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
        if moved.cost < (best or fit).cost:
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
