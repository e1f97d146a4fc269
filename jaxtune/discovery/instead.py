"""What may as well be there in the place of a changed parameter: a drag of the first link looks like damping.

A nominal parameter costs less than an effect, so it goes first, and beside it the effect gains nothing. Here it is held
at its nominal value, and effects are asked what they explain without it.
"""

from dataclasses import replace

from jaxtune.discovery.candidate import Candidate, total_cost
from jaxtune.discovery.curves import groups_of, simulate_library
from jaxtune.discovery.finalists import fit_leads
from jaxtune.discovery.fit import fit_at, refine
from jaxtune.discovery.leads import beside, shortlist
from jaxtune.discovery.noise_floor import Floor
from jaxtune.discovery.problem import Problem, are_distinct
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import screen, screened_again
from jaxtune.discovery.state import State


def instead(
    settings: Settings, problem: Problem, at: Floor, state: State, best: Candidate, axis: int
) -> tuple[str, ...]:
    """Names the effects that explain most of what a changed nominal parameter does, while it keeps its value.

    Args:
      settings: how many are fitted, and the share from which on a name counts.
      problem: the hypotheses.
      at: the floor at the main horizon.
      state: of the search.
      best: the model that is reported.
      axis: of the parameter.

    Returns:
      Names, the one that explains most first.
    """
    evaluate = at.residuals["train"]
    kept = (best.fit.free.directions[:, axis] == 0) | ~best.fit.free.nominal
    held = fit_at(best.fit.free.only(kept), best.fit.coordinates[kept], at.counts, evaluate)
    (held,) = refine([held], evaluate, settings.rounds)
    without = replace(best, fit=held, select=at.residuals["select"](held.vector[None])[0])
    every = groups_of(problem.hypotheses, problem.forms)
    library = state.library or simulate_library(at, state.nominal, every, lambda text: None)
    free = [
        h
        for h in problem.hypotheses
        if not h.each
        and not (h.directions[:, axis] != 0).any()
        and all(are_distinct(h, other) for other in best.hypotheses)
    ]
    forms = beside(problem.forms, best.hypotheses)
    groups = screened_again(settings, at, held, free, forms, library, state.price)
    leads = shortlist(settings, screen(at, held, groups, price=state.price, pairs=0), state.price)
    most, least = total_cost(at, without, 0.0), total_cost(at, best, 0.0)
    known, found = {h.key for h in best.hypotheses}, {}
    for one in fit_leads(settings, at, held, best.hypotheses, leads, state.price):
        name = next(h.name for h in one.effects if h.key not in known)
        explained = (most - total_cost(at, one, 0.0)) / max(most - least, 1e-9)
        found[name] = max(found.get(name, 0.0), explained)
    ranked = sorted((name for name, share in found.items() if share > settings.same), key=lambda name: -found[name])
    return tuple(ranked[: settings.rivals])
