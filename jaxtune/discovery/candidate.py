"""A fitted model, and what it costs: how far its simulation is off on `train` and `select` (validation) together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from jaxtune.discovery.fit import Fit
from jaxtune.discovery.noise_floor import Floor
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.resample import units

_FAR = 1e9  # sum of squares

Measure = Callable[[np.ndarray], np.ndarray]
"""Mean squares [components] from those of all segments, [segments, components]."""


@dataclass(frozen=True)
class Candidate:
    """A model with some effects in it, fitted on `train` and simulated on `select`, both at the main horizon."""

    hypotheses: tuple[Hypothesis, ...]
    """Its effects; none in the null."""
    fit: Fit
    select: np.ndarray
    """[features]: residuals on `select` in floor units."""

    @property
    def key(self) -> str:
        """The keys of its effects in one word, such as `coulomb@elbow + payload@forearm`; `null` without any."""
        return key_of(self.hypotheses)

    @property
    def effects(self) -> tuple[Hypothesis, ...]:
        """Its effects without their forms."""
        return tuple(hypothesis for hypothesis in self.hypotheses if not hypothesis.form)

    def forms_of(self, effect: Hypothesis) -> tuple[Hypothesis, ...]:
        """Its forms of one of its effects."""
        return tuple(hypothesis for hypothesis in self.hypotheses if hypothesis.shapes(effect))

    def price(self, of_effect: float) -> float:
        """Returns what its hypotheses cost; a form or a further size costs half, as there are few to choose from."""
        return of_effect * sum(hypothesis.worth for hypothesis in self.hypotheses)


def of_further_sizes(hypotheses: Sequence[Hypothesis], price: float) -> float:
    """What sizes cost that hypotheses have beyond their first, with a price for every effect."""
    return price * sum(hypothesis.further for hypothesis in hypotheses)


def cheapest_of_each(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Of fitted models with the same effects the one that costs less on `train`, in the order in which they came."""
    found = {}
    for one in candidates:
        if one.key not in found or one.fit.cost < found[one.key].fit.cost:
            found[one.key] = one
    return tuple(found.values())


def key_of(hypotheses: Sequence[Hypothesis]) -> str:
    """The key of a model with these effects."""
    return " + ".join(sorted(hypothesis.key for hypothesis in hypotheses)) or "null"


def squares(at: Floor, candidate: Candidate) -> np.ndarray:
    """Sums the squares of a candidate's residuals over bins: [segments, components], of `train`, then of `select`."""
    both = np.concatenate([candidate.fit.residual, candidate.select])
    return (at.unflatten(both) ** 2).sum(axis=1)


def measures(at: Floor) -> tuple[Measure, Measure]:
    """How far off a model is in all segments but a few (`Counts.usual`), and in typical ones (`Counts.variances`)."""
    return at.counts.usual, at.counts.variances


def total_cost(at: Floor, candidate: Candidate, price: float) -> float:
    """Returns the cost of a candidate on `train` and `select`, with its prior and a price for every effect."""
    of_segments = squares(at, candidate)
    return cost(at, of_segments) + candidate.fit.penalty + candidate.price(price)


def finite(of_segments: np.ndarray) -> np.ndarray:
    """Lets a segment whose simulation broke count as one that is far off."""
    return np.nan_to_num(of_segments, nan=_FAR, posinf=_FAR)


def cost(at: Floor, of_segments: np.ndarray) -> float:
    """Cost of sums of squares [segments, components], without a prior."""
    return float(at.counts.cost(of_segments / at.counts.bins).sum()) if np.isfinite(of_segments).all() else np.inf


def units_of(problem: Problem, at: Floor, of_segments: np.ndarray) -> np.ndarray:
    """Groups the segments of `train` and `select` into units that are drawn together, [segments]."""
    select = problem.data["select"][at.horizon].run
    return units(runs_of(problem, at), of_segments, len(np.unique(select)))


def runs_of(problem: Problem, at: Floor) -> np.ndarray:
    """The run of every segment of `train` and `select`, [segments]."""
    return np.concatenate([problem.data[split][at.horizon].run for split in ("train", "select")])
