"""Which effects deserve a fit (step 5): every effect at every place and size, answered by the nominal parameters.

A fit of the whole library would cost thousands of simulations. The screen simulates each effect at each single place at
a few sizes, while the nominal parameters stand where they are believed to be, on a part of the segments. Limits, delays
and play have no slope at zero, and their best size is found among these. Between sizes residuals are interpolated, and
effects at several places are sums of those at each. An effect that may show in one form alone, such as friction that
sets in over a small travel, is screened in that form too. `profile` then says what every hypothesis would cost, at
every size, if the nominal parameters answered it within their bounds and their prior. So all hypotheses are compared by
what counts in the end, and a pair costs no more simulations than its parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from jaxtune.discovery.fit import Fit, Free, taken_over
from jaxtune.discovery.noise_floor import Floor, Say
from jaxtune.discovery.problem import Hypothesis, are_distinct
from jaxtune.discovery.profile import Changes, Profile, profile_of

_SEGMENTS = 40  # that are simulated: half of them spread over all, half with the largest residuals
_BETWEEN = (0.0, 0.25, 0.5, 0.75)  # of the way from a size to the next, where costs are computed
_VISIBLE = 4.0  # standard deviations
_PARTNERS = 4  # of a hypothesis that are kept
_ROUGH = 2  # reweighted solutions with which partners are sorted out

Group = tuple[Hypothesis, ...]
"""What is screened as one: a hypothesis, alone or with one of its forms at the form's smallest size."""


_Key = tuple[int, ...]
"""An axis, alone or with the axis of a form at the same place."""


@dataclass(frozen=True)
class Curves:
    """How the residuals change with each axis alone."""

    sizes: dict[_Key, np.ndarray]
    """Sizes [nodes], rising and with zero."""
    first: dict[_Key, int]
    """Number of the first node in `changes`; the others follow."""
    changes: np.ndarray
    """[nodes of all axes, features]"""

    def at(self, group: Group, points: np.ndarray) -> Changes:
        """Interpolates between nodes: how a group changes the residuals at points [n, parameters]."""
        (hypothesis, *_), which, weights = group, [], []
        coordinates = points[:, : len(hypothesis.directions)] @ hypothesis.directions
        # Shape parameters have no curve: they mean nothing without a size.
        for key in (one for one in _keys(group) if one in self.sizes):
            sizes = self.sizes[key]
            which.append(self.first[key] + np.arange(len(sizes)))
            weights.append(np.stack([np.interp(coordinates[:, key[0]], sizes, unit) for unit in np.eye(len(sizes))], 1))
        return Changes(np.concatenate(which), np.concatenate(weights, axis=1))


def _keys(group: Group) -> list[_Key]:
    """The keys of the curves of a group."""
    hypothesis, *forms = group
    if not forms:
        return [(int(axis),) for axis in np.flatnonzero((hypothesis.directions != 0).any(axis=0))]
    # Places are in the same order on the axes of every effect.
    return list(zip(*(np.flatnonzero(one.directions[0]).tolist() for one in group), strict=True))


@dataclass(frozen=True)
class Lead:
    """One or two hypotheses that may explain the logs, some with a form, and the point where their fit begins."""

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


@dataclass(frozen=True)
class Library:
    """How the nominal model changes with every axis, from the first screen."""

    segments: np.ndarray
    """Indices of those of `train` that were simulated."""
    curves: Curves


def groups_of(hypotheses: Sequence[Hypothesis], forms: Sequence[Hypothesis]) -> list[Group]:
    """Lists what is screened: every hypothesis alone, and with each of its forms that asks for that."""
    shaped = [(one, form) for one in hypotheses for form in forms if form.screened and form.shapes(one)]
    return [*((one,) for one in hypotheses), *shaped]


def simulate_library(at: Floor, nominal: Fit, groups: Sequence[Group], say: Say) -> Library:
    """Simulates every axis of the hypotheses alone, from the nominal model.

    Args:
      at: the floor at the main horizon.
      nominal: the nominal model.
      groups: of all hypotheses.
      say: receives a line of text about progress.
    """
    chosen = spread_segments(at, nominal)
    return Library(chosen, simulate_curves(at, on_segments(at, nominal, chosen), chosen, groups, say))


def promising(at: Floor, base: Fit, groups: Sequence[Group], library: Library, count: int) -> list[Hypothesis]:
    """Picks the hypotheses that would lower the cost of a model most, if it changed as the nominal model does.

    Args:
      at: the floor at the main horizon.
      base: the model, with slopes of all that is free in it.
      groups: of which to pick.
      library: of the nominal model.
      count: how many.
    """
    some = on_segments(at, base, library.segments)
    profile = profile_of(some, library.curves.changes, _shares(at, base, library.segments))
    leads = _once([_best(profile, group, library.curves) for group in groups])
    return [lead.hypotheses[0] for lead in leads[:count]]


def seen(at: Floor, nominal: Fit, groups: Sequence[Group], library: Library) -> tuple[frozenset[str], np.ndarray]:
    """Finds what these logs could show, and what chance gains, at the weights of the noise floor.

    Args:
      at: the floor at the main horizon.
      nominal: the nominal model, with the slopes of the prior directions.
      groups: of all hypotheses.
      library: of the nominal model.

    Returns:
      Names of the effects that these logs could show at the smallest size of interest, after the nominal parameters
      have answered, and the largest gain [logs] that each null log gives any.
    """
    some, curves = on_segments(at, nominal, library.segments), library.curves
    share, precision = some.counts.independent, some.free.sd**-2.0
    null_residuals = at.unflatten(_tempered(at).T)[library.segments].reshape(len(some.residual), -1)
    # Nominal parameters that were fitted pull against their prior as hard as the residuals do.
    of_slopes = share * (some.jacobian.T @ null_residuals) + at.null_coordinates.T * precision[:, None]
    normal = share * (some.jacobian.T @ some.jacobian) + np.diag(precision)
    names, chance = set(), np.zeros(null_residuals.shape[1])
    for group in groups:
        hypothesis, free = group[0], ~taken_over(some.free, group[0])
        changed = curves.at(group, _probes(group)).of(curves.changes)
        pull = share * (some.jacobian[:, free].T @ changed.T)
        answer = np.linalg.solve(normal[free][:, free], pull)
        length = np.sqrt(np.maximum(share * (changed**2).sum(axis=1) - (pull * answer).sum(axis=0), 0.0))
        # A form may change what friction the nominal model has, which says nothing about more of it.
        if len(group) == 1 and length[np.abs(hypothesis.probes).max(axis=1).argmin()] >= _VISIBLE:
            names.add(hypothesis.name)
        falls = (share * changed @ null_residuals - answer.T @ of_slopes[free]) / np.maximum(length, 1e-3)[:, None]
        chance = np.maximum(chance, (np.minimum(falls, 0.0) ** 2).max(axis=0))
    return frozenset(names), chance


def screen(
    at: Floor,
    base: Fit,
    groups: Sequence[Group],
    *,
    fitted: Fit | None = None,
    pairs: int,
    library: Library | None = None,
    say: Say = lambda text: None,
) -> Screen:
    """Screens hypotheses beside a model.

    Args:
      at: the floor at the main horizon.
      base: the model, fitted or nominal, with slopes of all that is free in it.
      groups: what may join it.
      fitted: the same model fitted, which tells how far each segment counts; None where the model is fitted itself.
      pairs: how many of the best hypotheses are tried with every other one.
      library: how the axes change this very model, where that is known.
      say: receives a line of text about progress.
    """
    library = library or simulate_library(at, base, groups, say)
    chosen, curves = library.segments, library.curves
    some = on_segments(at, base, chosen)
    say("answers of the nominal parameters")
    profile = profile_of(some, curves.changes, _shares(at, fitted or base, chosen))
    firsts = _once([_best(profile, group, curves) for group in groups])
    # Partners come in the form in which they alone are best.
    partners = [lead.hypotheses for lead in firsts]
    couples = [pair for lead in firsts[:pairs] for pair in _pairs_with(profile, lead, partners, curves)]
    firsts, couples = (tuple(_freed(base.free, lead) for lead in leads) for leads in (firsts, _once(couples)))
    return Screen(firsts, couples, _cost_now(profile))


def _shares(at: Floor, fit: Fit, chosen: np.ndarray) -> np.ndarray:
    """How far each of the chosen segments counts under a fit, [segments, components]."""
    return fit.counts.shares(at.unflatten(fit.residual)[chosen].ravel())


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


def simulate_curves(at: Floor, some: Fit, chosen: np.ndarray, groups: Sequence[Group], say: Say) -> Curves:
    """Simulates every axis of the hypotheses alone, at a few sizes.

    Args:
      at: the floor at the main horizon.
      some: the model, on the chosen segments.
      chosen: indices of the segments of `train`.
      groups: whose axes are simulated.
      say: receives a line of text about progress.

    Returns:
      Curves; zero where a simulation is not finite.
    """
    nodes = {key: np.array(sorted([0.0, *values])) for key, values in _sizes(groups).items()}
    keys = [(key, size) for key, values in nodes.items() for size in values]
    # Of a form every node has the smallest size.
    smallest = {
        axis: form.probes[0, 0] * form.directions[0, axis]
        for _, *forms in groups
        for form in forms
        for axis in np.flatnonzero(form.directions[0])
    }
    moves = np.zeros((len(keys), len(some.vector)))
    for move, ((axis, *of_form), size) in zip(moves, keys, strict=True):
        move[axis], move[of_form] = size, [smallest[one] for one in of_form]
    # Curves of one form begin alike, and others where nothing moves.
    moves, which = np.unique(moves, axis=0, return_inverse=True)
    moved, changes = (moves != 0).any(axis=1), np.zeros((len(moves), len(some.residual)), np.float32)
    (changes[moved],) = at.on_some(chosen).changes(
        [some.vector], [some.residual], [moves[moved]], lambda done, count: say(f"screen {done}/{count}")
    )
    firsts = np.cumsum([0, *(len(values) for values in nodes.values())]).tolist()
    return Curves(nodes, dict(zip(nodes, firsts, strict=False)), changes[which.ravel()])


def _cost_now(profile: Profile) -> float:
    """What the model costs as it is, answered by nothing but its own coordinates."""
    return float(profile.costs(Changes(np.zeros(0, int), np.zeros((1, 0))))[0][0])


def _once(leads: Sequence[Lead]) -> list[Lead]:
    """The best lead of the same effects, in whichever form, best first."""
    best: dict[frozenset[str], Lead] = {}
    for lead in sorted(leads, key=lambda lead: lead.cost):
        best.setdefault(frozenset(h.key for h in lead.hypotheses if not h.form), lead)
    return list(best.values())


def _freed(free: Free, lead: Lead) -> Lead:
    """Lets a lead begin with forms that are free anyway, in the place of adding them."""
    ends = np.cumsum([len(one.directions) for one in lead.hypotheses])[:-1]
    kept, start = [], lead.start.copy()
    for hypothesis, point in zip(lead.hypotheses, np.split(lead.point, ends), strict=True):
        mine = taken_over(free, hypothesis) if hypothesis.form else np.zeros(len(start), bool)
        if mine.any():
            (size,), (direction,) = point, hypothesis.directions
            start[mine] += [size * direction[row != 0][0] / row[row != 0][0] for row in free.directions[mine]]
        else:
            kept.append((hypothesis, point))
    return replace(
        lead, hypotheses=tuple(one for one, _ in kept), point=np.concatenate([point for _, point in kept]), start=start
    )


def _best(
    profile: Profile, group: Group, curves: Curves, points: np.ndarray | None = None, reweighted: int = 4
) -> Lead:
    """The point, of some or of all that are worth a look, at which a group costs least beside a model."""
    points = _points(profile, group, curves) if points is None else points
    costs, starts = profile.costs(curves.at(group, points), reweighted)
    costs = costs + ((points / np.concatenate([one.prior for one in group])) ** 2).sum(axis=1)
    best = int(np.argmin(costs))
    return Lead(group, points[best], starts[best], float(costs[best]))


def _probes(group: Group) -> np.ndarray:
    """Points [probes, parameters] of the hypothesis of a group, with the smallest size of its form."""
    hypothesis, *forms = group
    return np.concatenate(
        [hypothesis.probes, *(np.tile(form.probes[0], (len(hypothesis.probes), 1)) for form in forms)], axis=1
    )


def _points(profile: Profile, group: Group, curves: Curves) -> np.ndarray:
    """Points [n, parameters] at which a group is answered: between its sizes, or where its slopes lead to."""
    (hypothesis, *_), probes = group, _probes(group)
    several = np.count_nonzero((hypothesis.probes != 0).any(axis=0)) > 1
    if several:
        sizes, changes = np.abs(probes).max(axis=1)[:, None], curves.at(group, probes)
        directions = replace(changes, weights=changes.weights / sizes)
        nothing = Changes(np.zeros(0, int), np.zeros((1, 0)))
        _, at = profile.with_directions(directions).costs(nothing)
        wanted = at[:, len(profile.offset) :] @ (probes / sizes)
        return np.clip(wanted, *hypothesis.bounds.T)
    sizes = np.array(sorted([0.0, *probes[:, 0]]))
    between = [a + share * (b - a) for a, b in pairwise(sizes) for share in _BETWEEN]
    points = np.tile(probes[0], (len(between), 1))
    points[:, 0] = between
    return points[points[:, 0] != 0]


def _pairs_with(profile: Profile, lead: Lead, groups: Sequence[Group], curves: Curves) -> list[Lead]:
    """The best partners of a lead, whose size may still change a little."""
    first = lead.hypotheses
    change, further = curves.at(first, lead.point[None]), curves.at(first, 1.1 * lead.point[None])
    beside = profile.moved(change)
    if (further.weights != change.weights).any():
        beside = beside.with_directions(replace(further, weights=further.weights - change.weights))
    others = [other for other in groups if all(are_distinct(one, two) for one in first for two in other)]
    rough = sorted(others, key=lambda other: _best(beside, other, curves, _probes(other), _ROUGH).cost)
    found = []
    for best in (_best(beside, other, curves) for other in rough[: 3 * _PARTNERS]):
        point, start = np.concatenate([lead.point, best.point]), best.start[: len(profile.offset)]
        cost = best.cost + ((lead.point / np.concatenate([one.prior for one in first])) ** 2).sum()
        found.append(Lead((*first, *best.hypotheses), point, start, cost))
    return _once(found)[:_PARTNERS]


def _sizes(groups: Sequence[Group]) -> dict[_Key, list[float]]:
    """The sizes at which every axis is simulated: those of the group at its place alone, if there is one."""
    found: dict[_Key, set[float]] = {}
    for group in sorted(groups, key=lambda group: len(group[0].places)):
        mine: dict[_Key, set[float]] = {}
        for row in group[0].probes @ group[0].directions:
            for key in (one for one in _keys(group) if row[one[0]]):
                mine.setdefault(key, set()).add(float(row[key[0]]))
        for key, sizes in mine.items():
            found.setdefault(key, sizes)
    return {key: sorted(sizes) for key, sizes in found.items()}
