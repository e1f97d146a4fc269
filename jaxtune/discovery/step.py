"""One step of the search: fit what the screen proposes beside the best model so far, and look which costs least.

    slopes -> localise -> screen -> fit -> polish -> compare

The first step starts from the nominal model, not from the null: nominal parameters that were fitted alone have moved to
imitate what is missing, and a search from there would have to lead them back. Only the other unknowns are where the
null first had them, since nobody believes that these are zero. It tries pairs as well, since the gap of one effect may
hide another. Where nothing joins the best model any more, each of its effects is replaced in turn.
"""

from dataclasses import dataclass, replace

from jaxtune.discovery.candidate import Candidate, key_of, total_cost
from jaxtune.discovery.curves import groups_of, simulate_library
from jaxtune.discovery.evaluate import usual
from jaxtune.discovery.evidence import ablate, or_known
from jaxtune.discovery.finalists import fit_leads
from jaxtune.discovery.fit import polish, taken_over
from jaxtune.discovery.leads import beside, shaped, shaped_after, shortlist, stuck, without_own
from jaxtune.discovery.localise import localise
from jaxtune.discovery.noise_floor import Floor, NoiseFloor, Say
from jaxtune.discovery.problem import Hypothesis, Problem, are_distinct
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import screen, screened_again, seen
from jaxtune.discovery.state import State


@dataclass(frozen=True)
class Info:
    """What a step found: nothing that the next step needs, but what a progress bar or a report shows."""

    fitted: tuple[tuple[str, float], ...] = ()
    """Models that were fitted, by key, with their cost; least first."""
    improved: bool = False
    """True if one of them costs less than the best model before."""

    def lines(self) -> list[str]:
        """Says in a line each which models cost least."""
        return [f"{cost:.1f} {key}" for key, cost in self.fitted]


def step(
    settings: Settings, problem: Problem, floor: NoiseFloor, state: State, say: Say = lambda text: None
) -> tuple[State, Info]:
    """Looks for a model that costs less; the state is finished where there is none, or where nothing is left.

    The function is pure but for what it says.

    Args:
      settings: how much is tried.
      problem: the simulator, the hypotheses and the segments.
      floor: the noise floor.
      state: from `state.begin`, from the last step, or loaded.
      say: receives a line of text about progress.

    Returns:
      The next state, and what was tried.
    """
    at = floor[problem.main_horizon]
    base, state = _next_base(at, state)
    if base is None:
        return replace(state, finished=True), Info()
    free, swapping = _free(settings, problem, at, base, state), base is not state.best
    state = replace(state, tried=(*state.tried, base.key))
    if not free:
        return state, Info()
    (fit,) = polish([base.fit], at.residuals["train"], 0 if state.screened else settings.rounds)
    fresh = replace(base, fit=fit)
    if not swapping:
        state = localise(problem, at, state.replaced(base, fresh), fit)
    # Nominal parameters of the null have moved to imitate what is missing.
    base, best = fresh if state.screened else replace(fresh, fit=state.nominal), state.best
    every = groups_of(problem.hypotheses, problem.forms)
    library = state.library or simulate_library(at, state.nominal, every, say)
    state = replace(state, library=library)
    # A form may be another one of an effect that is there.
    forms = beside(problem.forms, base.hypotheses)
    if state.screened:
        again = screened_again(settings, at, base.fit, free, forms, library, state.price)
        found = screen(at, base.fit, again, price=state.price, pairs=0, say=say)
    else:
        state = state.with_seen(settings, problem, *seen(at, state.nominal, every, library))
        groups, pairs = groups_of(free, forms), settings.firsts
        found = screen(at, base.fit, groups, price=state.price, fitted=fit, pairs=pairs, library=library, say=say)
    leads = shortlist(settings, found, state.price)
    shapes = beside(_unfree(problem, at), base.hypotheses)
    if swapping:
        leads = leads[: settings.swaps]
    else:
        leads += shaped(shapes, free, leads, settings.shaped)
    if base.fit is state.nominal:
        leads = leads + stuck(state.null.fit, [h for h in free if problem.is_nominal(h)], leads)
        leads += without_own(base.fit, free, state.null.fit.cost)
    say(f"fit {len(leads)}")
    fitted = fit_leads(settings, at, base.fit, base.hypotheses, leads, state.price)
    if not swapping:
        more = shaped_after(base.fit, base.hypotheses, shapes, free, fitted, settings.shaped)
        leads, fitted = leads + more, fitted + fit_leads(settings, at, base.fit, base.hypotheses, more, state.price)
    broken = {key_of((*base.hypotheses, *lead.hypotheses)) for lead in leads} - {one.key for one in fitted}
    state = replace(state.with_candidates(fitted), not_finite=(*state.not_finite, *sorted(broken)))
    cost = {one.key: total_cost(at, one, state.price) for one in (*fitted, best)}
    least = min(state.candidates, key=lambda one: total_cost(at, one, state.price))
    ranked = tuple(sorted(((one.key, cost[one.key]) for one in fitted), key=lambda pair: pair[1]))
    ranked = (*ranked[:5], ("before", total_cost(at, best, state.price)), ("price", state.price))
    state = replace(state, best=least, ablated=state.ablated if least is best else ())
    return state, Info(ranked, least.key != best.key)


def _next_base(at: Floor, state: State) -> tuple[Candidate | None, State]:
    """The model beside which to look next; None where all that make sense were tried.

    It is the best one. Where nothing joins that, it is the best one without one of its effects, the weakest first:
    another may stand in its place better.
    """
    best = state.best
    if best.key not in state.tried:
        return best, state
    if len(best.effects) < 2:
        return None, state
    if not state.ablated:
        (fit,) = polish([best.fit], at.residuals["train"], 0)
        ablated = tuple(ablate(at, replace(best, fit=fit), effect) for effect in best.effects)
        state = replace(state, ablated=ablated)
    fitted = {one.key: one for one in state.candidates}
    without = [or_known(one, fitted) for one in state.ablated]
    without = [one for one in without if one.key not in state.tried]
    return min(without, key=lambda one: total_cost(at, one, state.price), default=None), state


def _free(settings: Settings, problem: Problem, at: Floor, base: Candidate, state: State) -> list[Hypothesis]:
    """Lists what may join a model: forms of its effects, and other effects unless it is at the floor or full."""
    full = state.screened and (len(base.effects) >= settings.most or usual(at, base).max() <= settings.at_floor)
    forms = [form for form in _unfree(problem, at) if any(form.shapes(h) for h in base.effects)]
    left_out = {h.key for h in state.best.hypotheses} - {h.key for h in base.hypotheses}
    return [
        h
        for h in (*forms, *(() if full else problem.hypotheses))
        if h.key not in left_out and all(are_distinct(h, other) for other in base.hypotheses)
    ]


def _unfree(problem: Problem, at: Floor) -> list[Hypothesis]:
    """Lists the forms that are not free under every hypothesis."""
    return [form for form in problem.forms if not taken_over(at.prior, form).any()]
