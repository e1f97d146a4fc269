"""Which effects deserve a fit (step 5): every effect at every place and size, answered by the nominal parameters.

A fit of the whole library would cost thousands of simulations. The screen simulates each effect at each single place at
a few sizes, while the nominal parameters stand where they are believed to be, on a part of the segments. Limits, delays
and play have no slope at zero, and their best size is found among these. Between sizes residuals are interpolated, and
effects at several places are sums of those at each. `profile` then says what every hypothesis would cost, at every
size, if the nominal parameters answered it within their bounds and their prior. So all hypotheses are compared by what
counts in the end, and a pair costs no more simulations than its parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from jaxtune.discovery.fit import Fit, taken_over
from jaxtune.discovery.noise_floor import Floor, Say
from jaxtune.discovery.problem import Hypothesis, are_distinct
from jaxtune.discovery.profile import Changes, Profile, profile_of

_SEGMENTS = 40  # that are simulated: half of them spread over all, half with the largest residuals
_BETWEEN = (0.0, 0.25, 0.5, 0.75)  # of the way from a size to the next, where costs are computed
_VISIBLE = 4.0  # standard deviations
_PARTNERS = 4  # of a hypothesis that are kept
_ROUGH = 2  # reweighted solutions with which partners are sorted out


@dataclass(frozen=True)
class Curves:
    """How the residuals change with each axis alone."""

    sizes: dict[int, np.ndarray]
    """By axis: sizes [nodes], rising and with zero."""
    first: dict[int, int]
    """By axis: number of its first node in `changes`; the others follow."""
    changes: np.ndarray
    """[nodes of all axes, features]"""

    def at(self, hypothesis: Hypothesis, points: np.ndarray) -> Changes:
        """Interpolates between nodes: how a hypothesis changes the residuals at points [n, parameters]."""
        coordinates = points @ hypothesis.directions
        which, weights = [], []
        # Shape parameters have no curve: they mean nothing without a size.
        for axis in (int(one) for one in np.flatnonzero((hypothesis.directions != 0).any(axis=0))):
            if axis not in self.sizes:
                continue
            sizes = self.sizes[axis]
            which.append(self.first[axis] + np.arange(len(sizes)))
            weights.append(np.stack([np.interp(coordinates[:, axis], sizes, unit) for unit in np.eye(len(sizes))], 1))
        return Changes(np.concatenate(which), np.concatenate(weights, axis=1))


@dataclass(frozen=True)
class Lead:
    """One or two hypotheses that may explain the logs, with the point where their fit begins."""

    hypotheses: tuple[Hypothesis, ...]
    point: np.ndarray
    """[parameters] of the hypotheses, one behind the other."""
    start: np.ndarray
    """[coordinates] at which what is free in the model answers them."""
    cost: float
    """What the model with them would cost on the screened segments."""


@dataclass(frozen=True)
class Screen:
    """What the screen of a model found."""

    leads: tuple[Lead, ...]
    """The best lead of every hypothesis, best first."""
    pairs: tuple[Lead, ...]
    """The best pairs, best first; empty unless they were asked for."""
    cost: float
    """What the model costs as it is, on the screened segments."""
    testable: frozenset[str]
    """Names of effects that these logs could show at the smallest size of interest."""
    chance: np.ndarray
    """[logs]: fall of the cost that the best hypothesis reaches on each null log."""


@dataclass(frozen=True)
class Library:
    """How the nominal model changes with every axis, from the first screen."""

    segments: np.ndarray
    """Indices of those of `train` that were simulated."""
    curves: Curves


def simulate_library(at: Floor, nominal: Fit, hypotheses: Sequence[Hypothesis], say: Say) -> Library:
    """Simulates every axis of the hypotheses alone, from the nominal model.

    Args:
      at: the floor at the main horizon.
      nominal: the nominal model.
      hypotheses: all of them.
      say: receives a line of text about progress.
    """
    chosen = spread_segments(at, nominal)
    return Library(chosen, simulate_curves(at, on_segments(at, nominal, chosen), chosen, hypotheses, say))


def promising(at: Floor, base: Fit, hypotheses: Sequence[Hypothesis], library: Library, count: int) -> list[Hypothesis]:
    """Picks the hypotheses that would lower the cost of a model most, if it changed as the nominal model does.

    Args:
      at: the floor at the main horizon.
      base: the model, with slopes of all that is free in it.
      hypotheses: of which to pick.
      library: of the nominal model.
      count: how many.
    """
    profile = profile_of(on_segments(at, base, library.segments), library.curves.changes)
    return sorted(hypotheses, key=lambda one: _best(profile, one, library.curves).cost)[:count]


def screen(
    at: Floor,
    base: Fit,
    hypotheses: Sequence[Hypothesis],
    *,
    pairs: int,
    library: Library | None = None,
    say: Say = lambda text: None,
) -> Screen:
    """Screens hypotheses beside a model.

    Args:
      at: the floor at the main horizon.
      base: the model, fitted or nominal, with slopes of all that is free in it.
      hypotheses: what may join it.
      pairs: how many of the best hypotheses are tried with every other one.
      library: how the axes change this very model, where that is known.
      say: receives a line of text about progress.
    """
    library = library or simulate_library(at, base, hypotheses, say)
    chosen, curves = library.segments, library.curves
    some = on_segments(at, base, chosen)
    say("answers of the nominal parameters")
    profile = profile_of(some, curves.changes)
    firsts = sorted((_best(profile, hypothesis, curves) for hypothesis in hypotheses), key=lambda lead: lead.cost)
    couples = [pair for lead in firsts[:pairs] for pair in _pairs_with(profile, lead, hypotheses, curves)]
    testable, chance = _seen(some, profile, hypotheses, curves, at, chosen)
    return Screen(tuple(firsts), _best_pairs(couples), _cost_now(profile), testable, chance)


def _tempered(at: Floor) -> np.ndarray:
    """Residuals [logs, features] of the null logs, weighed as in the cost."""
    return np.stack([log * np.sqrt(at.counts.weights(log) / at.counts.independent) for log in at.null_residuals])


def spread_segments(at: Floor, base: Fit) -> np.ndarray:
    """Chooses segments of `train`, rising: half of them evenly spread, half of them where the model is worst."""
    energy = (at.unflatten(base.residual) ** 2).sum(axis=(1, 2))
    half = min(_SEGMENTS, len(energy)) // 2
    even = np.linspace(0, len(energy) - 1, half).round().astype(int)
    worst = [index for index in np.argsort(-energy) if index not in set(even.tolist())]
    return np.sort(np.concatenate([even, worst[: min(_SEGMENTS, len(energy)) - half]]).astype(int))


def on_segments(at: Floor, fit: Fit, chosen: np.ndarray) -> Fit:
    """Restricts residuals and slopes of a fit to some segments of `train`."""
    residual = at.unflatten(fit.residual)[chosen].ravel()
    jacobian = at.unflatten(fit.jacobian)[chosen].reshape(len(residual), -1)
    return replace(fit, residual=residual, jacobian=jacobian)


def simulate_curves(at: Floor, some: Fit, chosen: np.ndarray, hypotheses: Sequence[Hypothesis], say: Say) -> Curves:
    """Simulates every axis of the hypotheses alone, at a few sizes.

    Args:
      at: the floor at the main horizon.
      some: the model, on the chosen segments.
      chosen: indices of the segments of `train`.
      hypotheses: whose axes are simulated.
      say: receives a line of text about progress.

    Returns:
      Curves; zero where a simulation is not finite.
    """
    nodes = {axis: np.array(sorted([0.0, *values])) for axis, values in _sizes(hypotheses).items()}
    keys = [(axis, size) for axis, values in nodes.items() for size in values]
    moves = np.zeros((len(keys), len(some.vector)))
    for move, (axis, size) in zip(moves, keys, strict=True):
        move[axis] = size
    moved, changes = (moves != 0).any(axis=1), np.zeros((len(keys), len(some.residual)), np.float32)
    (changes[moved],) = at.on_some(chosen).changes(
        [some.vector], [some.residual], [moves[moved]], lambda done, count: say(f"screen {done}/{count}")
    )
    firsts = np.cumsum([0, *(len(values) for values in nodes.values())]).tolist()
    return Curves(nodes, dict(zip(nodes, firsts, strict=False)), changes)


def _cost_now(profile: Profile) -> float:
    """What the model costs as it is, answered by nothing but its own coordinates."""
    return float(profile.costs(Changes(np.zeros(0, int), np.zeros((1, 0))))[0][0])


def _best(
    profile: Profile, hypothesis: Hypothesis, curves: Curves, points: np.ndarray | None = None, reweighted: int = 4
) -> Lead:
    """The point, of some or of all that are worth a look, at which a hypothesis costs least beside a model."""
    points = _points(profile, hypothesis, curves) if points is None else points
    costs, starts = profile.costs(curves.at(hypothesis, points), reweighted)
    costs = costs + ((points / hypothesis.prior) ** 2).sum(axis=1)
    best = int(np.argmin(costs))
    return Lead((hypothesis,), points[best], starts[best], float(costs[best]))


def _points(profile: Profile, hypothesis: Hypothesis, curves: Curves) -> np.ndarray:
    """Points [n, parameters] at which a hypothesis is answered: between its sizes, or where its slopes lead to."""
    probes = hypothesis.probes
    several = np.count_nonzero((probes != 0).any(axis=0)) > 1
    if several:
        sizes, changes = np.abs(probes).max(axis=1)[:, None], curves.at(hypothesis, probes)
        directions = replace(changes, weights=changes.weights / sizes)
        nothing = Changes(np.zeros(0, int), np.zeros((1, 0)))
        _, at = profile.with_directions(directions).costs(nothing)
        wanted = at[:, len(profile.offset) :] @ (probes / sizes)
        return np.clip(wanted, *hypothesis.bounds.T)
    sizes = np.array(sorted([0.0, *probes[:, 0]]))
    between = [a + share * (b - a) for a, b in pairwise(sizes) for share in _BETWEEN]
    points = np.zeros((len(between), probes.shape[1]))
    points[:, 0] = between
    return points[points[:, 0] != 0]


def _pairs_with(profile: Profile, lead: Lead, hypotheses: Sequence[Hypothesis], curves: Curves) -> list[Lead]:
    """The best partners of a lead, whose size may still change a little."""
    (first,) = lead.hypotheses
    change, further = curves.at(first, lead.point[None]), curves.at(first, 1.1 * lead.point[None])
    beside = profile.moved(change)
    if (further.weights != change.weights).any():
        beside = beside.with_directions(replace(further, weights=further.weights - change.weights))
    others = [other for other in hypotheses if are_distinct(first, other)]
    rough = sorted(others, key=lambda other: _best(beside, other, curves, other.probes, _ROUGH).cost)
    found = []
    for best in (_best(beside, other, curves) for other in rough[: 3 * _PARTNERS]):
        point, start = np.concatenate([lead.point, best.point]), best.start[: len(profile.offset)]
        cost = best.cost + ((lead.point / first.prior) ** 2).sum()
        found.append(Lead((first, *best.hypotheses), point, start, cost))
    return sorted(found, key=lambda pair: pair.cost)[:_PARTNERS]


def _best_pairs(pairs: Sequence[Lead]) -> tuple[Lead, ...]:
    """Every pair once, best first."""
    best: dict[frozenset[str], Lead] = {}
    for pair in sorted(pairs, key=lambda pair: pair.cost):
        best.setdefault(frozenset(h.key for h in pair.hypotheses), pair)
    return tuple(best.values())


def _seen(
    some: Fit, profile: Profile, hypotheses: Sequence[Hypothesis], curves: Curves, at: Floor, chosen: np.ndarray
) -> tuple[frozenset[str], np.ndarray]:
    """Names of the effects that these logs could show, and the largest gain [logs] that each null log gives any.

    Both are seen at the weights of the noise floor, after what is free has answered.
    """
    share = some.counts.independent
    null_residuals = at.unflatten(_tempered(at).T)[chosen].reshape(len(some.residual), -1)
    # Nominal parameters that were fitted pull against their prior as hard as the residuals do.
    # Beside a model with effects nobody asks what chance gains.
    alike = at.null_coordinates.shape[1] == len(profile.offset)
    pulls = at.null_coordinates.T * profile.precision[:, None] if alike else 0.0
    of_logs, of_slopes = share * (curves.changes @ null_residuals), share * (some.jacobian.T @ null_residuals) + pulls
    gram, mixed = share * profile.gram.sum(axis=0), share * profile.of_slopes.sum(axis=0)
    normal = share * profile.normal.sum(axis=0) + np.diag(profile.precision)
    seen, chance = set(), np.zeros(null_residuals.shape[1])
    for hypothesis in hypotheses:
        free = ~taken_over(some.free, hypothesis)
        changes = curves.at(hypothesis, hypothesis.probes)
        which, weights = changes.which, changes.weights
        pull = mixed[free][:, which] @ weights.T
        answer = np.linalg.solve(normal[free][:, free], pull)
        left = np.einsum("ns,st,nt->n", weights, gram[which[:, None], which], weights) - (pull * answer).sum(axis=0)
        length = np.sqrt(np.maximum(left, 0.0))
        sizes = np.abs(hypothesis.probes).max(axis=1)
        if length[np.argmin(sizes)] >= _VISIBLE:
            seen.add(hypothesis.name)
        falls = (weights @ of_logs[which] - answer.T @ of_slopes[free]) / np.maximum(length, 1e-3)[:, None]
        chance = np.maximum(chance, (np.minimum(falls, 0.0) ** 2).max(axis=0))
    return frozenset(seen), chance


def _sizes(hypotheses: Sequence[Hypothesis]) -> dict[int, list[float]]:
    """The sizes at which every axis is simulated: those of the hypothesis at its place alone, if there is one."""
    found: dict[int, set[float]] = {}
    for hypothesis in sorted(hypotheses, key=lambda h: len(h.places)):
        mine: dict[int, set[float]] = {}
        for row in hypothesis.probes @ hypothesis.directions:
            for axis in np.flatnonzero(row):
                mine.setdefault(int(axis), set()).add(float(row[axis]))
        for axis, sizes in mine.items():
            found.setdefault(axis, sizes)
    return {axis: sorted(sizes) for axis, sizes in found.items()}
