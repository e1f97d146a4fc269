"""Which effects deserve a fit (step 5): every effect at every place and size, answered by the nominal parameters.

A fit of the whole library would cost thousands of simulations. The screen has each effect simulated at each single
place at a few sizes (`curves`), while the nominal parameters stand where they are believed to be. `profile` then says
what every hypothesis would cost, at every size, if the nominal parameters answered it within their bounds and their
prior. So all hypotheses are compared by what counts in the end, and a pair costs no more simulations than its parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from jaxtune.discovery.candidate import of_further_sizes
from jaxtune.discovery.curves import Curves, Group, Library, groups_of, on_segments, probes_of, simulate_library
from jaxtune.discovery.fit import Fit, Free, taken_over
from jaxtune.discovery.least_squares import of_size
from jaxtune.discovery.noise_floor import Floor, Say
from jaxtune.discovery.problem import Hypothesis, are_distinct
from jaxtune.discovery.profile import Changes, Profile, profile_of
from jaxtune.discovery.result import Settings

_BETWEEN = (0.0, 0.25, 0.5, 0.75)  # of the way from a size to the next, where costs are computed
_VISIBLE = 4.0  # standard deviations
_PARTNERS = 4  # of a hypothesis that are kept
_ROUGH = 2  # reweighted solutions with which partners are sorted out


@dataclass(frozen=True)
class Lead:
    """One or two hypotheses that may explain the logs, some with a form, and the point where their fit begins."""

    hypotheses: tuple[Hypothesis, ...]
    point: np.ndarray
    """[parameters] of the hypotheses, one behind the other."""
    start: np.ndarray
    """[coordinates] at which what is free in the model answers them."""
    cost: float
    """What the model with them would cost on the screened segments, with half a price for every further size."""


@dataclass(frozen=True)
class Screen:
    """What the screen of a model found."""

    leads: tuple[Lead, ...]
    """The best lead of every hypothesis, best first."""
    pairs: tuple[Lead, ...]
    """The best pairs, best first; empty unless they were asked for."""
    cost: float
    """What the model costs as it is, on the screened segments."""


def promising(
    at: Floor, base: Fit, groups: Sequence[Group], library: Library, price: float, count: int
) -> list[Hypothesis]:
    """Picks the hypotheses that would lower the cost of a model most, if it changed as the nominal model does.

    Args:
      at: the floor at the main horizon.
      base: the model, with slopes of all that is free in it.
      groups: of which to pick.
      library: of the nominal model.
      price: of an effect.
      count: how many.
    """
    some = on_segments(at, base, library.segments)
    profile = profile_of(some, library.curves.changes, _shares(at, base, library.segments))
    leads = _once([_best(profile, group, library.curves, price) for group in groups])
    return [lead.hypotheses[0] for lead in leads[:count]]


def screened_again(
    settings: Settings,
    at: Floor,
    base: Fit,
    free: Sequence[Hypothesis],
    forms: Sequence[Hypothesis],
    library: Library,
    price: float,
) -> list[Group]:
    """Picks what is screened beside a model that is not the nominal one.

    Args:
      settings: how much is screened.
      at: the floor at the main horizon.
      base: the model, with slopes of all that is free in it.
      free: what may join it. Forms of its own effects are all picked, and of other effects the most `promising`.
      forms: that these effects may have.
      library: of the nominal model.
      price: of an effect.
    """
    own, effects = ([h for h in free if bool(h.form) == shaping] for shaping in (True, False))
    more = promising(at, base, groups_of(effects, forms), library, price, settings.again) if effects else []
    return groups_of([*own, *more], forms)


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
        changed = curves.at(group, probes_of(group)).of(curves.changes)
        pull = share * (some.jacobian[:, free].T @ changed.T)
        answer = np.linalg.solve(normal[free][:, free], pull)
        length = np.sqrt(np.maximum(share * (changed**2).sum(axis=1) - (pull * answer).sum(axis=0), 0.0))
        # A form may change what friction the nominal model has, which says nothing about more of it.
        if len(group) == 1 and length[_smallest(hypothesis.probes, length > 0)].max() >= _VISIBLE:
            names.add(hypothesis.name)
        falls = (share * changed @ null_residuals - answer.T @ of_slopes[free]) / np.maximum(length, 1e-3)[:, None]
        chance = np.maximum(chance, (np.minimum(falls, 0.0) ** 2).max(axis=0))
    return frozenset(names), chance


def _smallest(probes: np.ndarray, moving: np.ndarray) -> list[int]:
    """Finds the probes [probes, parameters] of the smallest size of interest, one for every parameter that has some.

    What can be subtracted may be less: a joint loses no more damping than the model gives it. A size that changes
    nothing, as a torque limit beyond the declared one, is none of interest.

    Args:
      probes: sizes.
      moving: [probes] True where the simulation changes.
    """
    found = []
    for column in probes.T:
        added = np.flatnonzero((column > 0) & moving)
        if added.size:
            found.append(int(added[column[added].argmin()]))
    return found or [int(np.abs(probes).max(axis=1).argmin())]


def screen(
    at: Floor,
    base: Fit,
    groups: Sequence[Group],
    *,
    price: float,
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
      price: of an effect, which further sizes of one cost half of.
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
    firsts = _once([_best(profile, group, curves, price) for group in groups])
    # Partners come in the form in which they alone are best.
    partners = [lead.hypotheses for lead in firsts]
    couples = [pair for lead in firsts[:pairs] for pair in _pairs_with(profile, lead, partners, curves, price)]
    firsts, couples = (tuple(_freed(base.free, lead) for lead in leads) for leads in (firsts, _once(couples)))
    return Screen(firsts, couples, _cost_now(profile))


def _shares(at: Floor, fit: Fit, chosen: np.ndarray) -> np.ndarray:
    """How far each of the chosen segments counts under a fit, [segments, components]."""
    return fit.counts.shares(at.unflatten(fit.residual)[chosen].ravel())


def _tempered(at: Floor) -> np.ndarray:
    """Residuals [logs, features] of the null logs, weighed as in the cost."""
    return np.stack([log * np.sqrt(at.counts.weights(log) / at.counts.independent) for log in at.null_residuals])


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
    profile: Profile,
    group: Group,
    curves: Curves,
    price: float,
    points: np.ndarray | None = None,
    reweighted: int = 4,
) -> Lead:
    """The point, of some or of all that are worth a look, at which a group costs least beside a model."""
    points = _points(profile, group, curves) if points is None else points
    costs, starts = profile.costs(curves.at(group, points), reweighted)
    costs = costs + _of_sizes(points, group, price)
    best = int(np.argmin(costs))
    return Lead(group, points[best], starts[best], float(costs[best]))


def _of_sizes(points: np.ndarray, group: Group, price: float) -> np.ndarray:
    """What the prior says against points [..., parameters] of a group and the price of its further sizes, [...]."""
    return of_size(points / np.concatenate([one.prior for one in group])).sum(axis=-1) + of_further_sizes(group, price)


def _points(profile: Profile, group: Group, curves: Curves) -> np.ndarray:
    """Points [n, parameters] at which a group is answered: between its sizes, or where its slopes lead to."""
    (hypothesis, *forms), probes = group, probes_of(group)
    several = np.count_nonzero((hypothesis.probes != 0).any(axis=0)) > 1
    if several:
        own, none = hypothesis.probes, probes.copy()
        none[:, : own.shape[1]] = 0.0
        # A form may change what the nominal model has of it.
        changes, alone = curves.at(group, probes), curves.at(group, none)
        sizes = np.abs(own).max(axis=1)[:, None]
        directions = replace(changes, weights=(changes.weights - alone.weights) / sizes)
        nothing = Changes(np.zeros(0, int), np.zeros((1, 0)))
        beside = profile.moved(replace(alone, weights=alone.weights[:1]))
        _, at = beside.with_directions(directions).costs(nothing)
        wanted = np.clip(at[:, len(profile.offset) :] @ (own / sizes), *hypothesis.bounds.T)
        return np.concatenate([wanted, *(form.probes[:1] for form in forms)], axis=1)
    sizes = np.array(sorted([0.0, *probes[:, 0]]))
    between = [a + share * (b - a) for a, b in pairwise(sizes) for share in _BETWEEN]
    points = np.tile(probes[0], (len(between), 1))
    points[:, 0] = between
    return points[points[:, 0] != 0]


def _pairs_with(profile: Profile, lead: Lead, groups: Sequence[Group], curves: Curves, price: float) -> list[Lead]:
    """The best partners of a lead, whose size may still change a little."""
    first = lead.hypotheses
    change, further = curves.at(first, lead.point[None]), curves.at(first, 1.1 * lead.point[None])
    beside = profile.moved(change)
    if (further.weights != change.weights).any():
        beside = beside.with_directions(replace(further, weights=further.weights - change.weights))
    others = [other for other in groups if all(are_distinct(one, two) for one in first for two in other)]
    rough = sorted(others, key=lambda other: _best(beside, other, curves, price, probes_of(other), _ROUGH).cost)
    found = []
    for best in (_best(beside, other, curves, price) for other in rough[: 3 * _PARTNERS]):
        point, start = np.concatenate([lead.point, best.point]), best.start[: len(profile.offset)]
        cost = best.cost + float(_of_sizes(lead.point, first, price))
        found.append(Lead((*first, *best.hypotheses), point, start, cost))
    return _once(found)[:_PARTNERS]
