"""The fits of leads: all on some segments, the best of them with fresh slopes on all."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxtune.discovery.candidate import Candidate, cheapest_of_each, key_of, of_further_sizes
from jaxtune.discovery.curves import on_segments, spread_segments
from jaxtune.discovery.fit import Fit, begin, polish, refine
from jaxtune.discovery.noise_floor import Floor
from jaxtune.discovery.problem import Hypothesis
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import Lead

_REACH = 0.5  # share of the best fit's gain that another one needs for fresh slopes


def fit_leads(
    settings: Settings, at: Floor, base: Fit, present: Sequence[Hypothesis], leads: Sequence[Lead], price: float
) -> list[Candidate]:
    """Fits leads beside a model: all of them on the screened segments, the best on the whole of `train`.

    Args:
      settings: rounds, and how many are finalists.
      at: the floor at the main horizon.
      base: the model without them.
      present: the effects that the model has.
      leads: what joins it.
      price: of an effect.

    Returns:
      Models that could be simulated, on `train` and `select`; of the finalists with fresh slopes.
    """
    if not leads:
        return []
    chosen = spread_segments(at, base)
    some, evaluate = on_segments(at, base, chosen), at.on_some(chosen)
    groups, points, starts = zip(*((lead.hypotheses, lead.point, lead.start) for lead in leads), strict=True)
    fits = refine(begin(some, groups, points, starts, evaluate), evaluate, settings.rounds)
    order = [index for index in np.argsort([fit.cost for fit in fits]) if np.isfinite(fits[index].cost)]
    if not order:
        return []
    whole = _on_all(at, [fits[index] for index in order])
    costs = [fit.cost + of_further_sizes(groups[order[index]], price) for index, fit in whole]
    cheapest = np.argsort(costs, kind="stable")
    whole, costs = [whole[index] for index in cheapest], [costs[index] for index in cheapest]
    every = [fit for _, fit in whole]
    chosen = _finalists(settings, base.cost, [groups[order[index]] for index, _ in whole], costs)
    # A further round costs little beside the slopes.
    for number, fit in zip(
        chosen, polish([every[n] for n in chosen], at.residuals["train"], 3 * settings.rounds), strict=True
    ):
        every[number] = fit
    select = at.residuals["select"](np.stack([fit.vector for fit in every]))
    found = [
        Candidate((*present, *groups[order[index]]), fit, residual)
        for (index, _), fit, residual in zip(whole, every, select, strict=True)
    ]
    # Of several starts of one model the best stays.
    return [*cheapest_of_each(found)]


def _finalists(
    settings: Settings, before: float, groups: Sequence[Sequence[Hypothesis]], costs: Sequence[float]
) -> list[int]:
    """Picks the fits that get fresh slopes, of those that gain enough: the best single effects and half as many pairs.

    Pairs have a list of their own, since a pair costs less than its better half for want of rounds alone. Starts of one
    model count once: a few rounds do not tell which of them ends lowest.

    Args:
      settings: how many.
      before: cost without any of them.
      groups: what each fit adds, in the order of their costs.
      costs: of the fits, rising.

    Returns:
      Indices of the fits.
    """
    near = [index for index, cost in enumerate(costs) if before - cost >= _REACH * (before - costs[0])]
    effects = [sum(not hypothesis.form for hypothesis in groups[index]) for index in near]
    chosen = []
    for alone, most in ((True, settings.finalists), (False, settings.finalists // 2)):
        mine = [index for index, count in zip(near, effects, strict=True) if (count < 2) == alone]
        best = [*dict.fromkeys(key_of(groups[index]) for index in mine)][:most]
        chosen += [index for index in mine if key_of(groups[index]) in best]
    return chosen


def _on_all(at: Floor, fits: Sequence[Fit]) -> list[tuple[int, Fit]]:
    """The same models with their residuals on the whole of `train`, and without slopes; numbered."""
    found = at.residuals["train"](np.stack([fit.vector for fit in fits]))
    return [
        (index, replace(fit, residual=residual, jacobian=np.zeros((len(residual), len(fit.coordinates)))))
        for index, (fit, residual) in enumerate(zip(fits, found, strict=True))
    ]
