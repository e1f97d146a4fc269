"""The verdict, from open segments: which effects stay, how far each is believed, and what they explain (step 9)."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxtune.discovery.belief import believed, families, posterior, rivals
from jaxtune.discovery.candidate import Candidate, cost, key_of, measures, squares, total_cost, units_of
from jaxtune.discovery.evaluate import is_worse, position_gap, rms
from jaxtune.discovery.evidence import Thresholds, ablate, passes, weigh_evidence
from jaxtune.discovery.finalists import fit_leads
from jaxtune.discovery.fit import Fit, begin, polish, refine
from jaxtune.discovery.instead import instead
from jaxtune.discovery.leads import at_some_places, beside, known_in_forms, taken_for
from jaxtune.discovery.naming import at_fewest_places, clear_places, moved_forms, renamed, with_refinements
from jaxtune.discovery.noise_floor import Floor, NoiseFloor, Say
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.resample import standard_errors
from jaxtune.discovery.result import AcceptedTerm, Change, DroppedTerm, Settings, Suspect
from jaxtune.discovery.screen import Lead
from jaxtune.discovery.shares import energy, enough, explained, explained_shares, lost_without, open_gaps, speak
from jaxtune.discovery.state import State

_SUSPECTS = 8
_BELIEVED = 0.01  # probability from which on effects are worth an experiment
_BOUND = 1e-6  # of the width of the bounds: how near to one a coordinate is at it


@dataclass(frozen=True)
class Conclusion:
    """The verdict and what it stands on, before any sealed segment was looked at; the fields are those of `Result`."""

    verdict: str
    best: Candidate
    terms: tuple[AcceptedTerm, ...]
    ablated: Mapping[str, np.ndarray]
    """The model [axes] without each of the terms, by key."""
    errors: np.ndarray
    suspects: tuple[Suspect, ...]
    families: Mapping[tuple[str, tuple[str, ...]], float]
    rivals: tuple[tuple[str, np.ndarray], ...]
    explained_share: float
    explainable_share: float
    learned_parts: Mapping[Hashable, float]
    models: Mapping[str, np.ndarray]
    """Vectors [axes] that may become the corrected model, by what they are; the chosen one is first."""
    changed: Mapping[int, Change]
    dropped: tuple[DroppedTerm, ...]
    details: Mapping[str, Any]


def conclude(settings: Settings, problem: Problem, floor: NoiseFloor, state: State, say: Say) -> Conclusion:
    """Reaches the verdict from `train` and `select` together.

    Args:
      settings: what counts as explained.
      problem: the hypotheses, and the torque that stands in where none fits.
      floor: the noise floor.
      state: after the last step.
      say: receives a line of text about progress.
    """
    at = floor[problem.main_horizon]
    say("evidence")
    state = _where_it_shows(problem, at, _with_one_name(problem, at, state))
    best, terms, ablated, dropped = _proved(settings, problem, floor, state)
    state = _with_what_passes(settings, problem, at, replace(state, best=best))
    state = _by_whole_runs(settings, problem, at, state)
    if state.best is not best:
        best, terms, ablated, later = _proved(settings, problem, floor, state)
        dropped += later
    unit = units_of(problem, at, squares(at, best))[: len(problem.data["train"][at.horizon].run)]
    errors = standard_errors(best.fit, unit)
    terms = tuple(replace(term, clear=clear_places(best.fit, errors, term.hypothesis)) for term in terms)
    candidates, probabilities = _compared(problem, at, replace(state, best=best))
    terms = tuple(
        replace(term, confusable_with=rivals(at, candidates, probabilities, best, term, settings))
        for term in with_refinements(terms, settings.own)
    )
    say("learned torque")
    learned = learn(settings, problem, at, best)
    models = _by_select(problem, at, state, best, learned)
    usual, share, whole = _shares(settings, problem, at, (state.null, best, learned))
    named = sum(term.refines is None for term in terms)
    explains = enough(settings, usual[1].max(), share if terms else 0.0, whole, named)
    changed = _at_bounds(problem, best.fit, state.price) if explains else {}
    explains = explains and (len(changed) < settings.strained or usual[1].max() < settings.much)
    verdict = _verdict(problem, terms, changed) if explains else "unnamed"
    if verdict != "unnamed":
        changed = {
            axis: replace(change, confusable_with=instead(settings, problem, at, state, best, axis))
            for axis, change in changed.items()
        }
    terms = tuple(
        replace(term, forms=(*term.forms, *moved_forms(problem, best.fit, errors, term.hypothesis))) for term in terms
    )
    for part in (part for term in terms for part in (term.hypothesis, *term.forms)):
        errors = np.hypot(errors, settings.inexact * best.fit.coordinates * best.fit.along(part))
    return Conclusion(
        verdict=verdict,
        best=best,
        terms=terms,
        ablated=ablated,
        errors=errors,
        suspects=tuple(believed(candidates, probabilities)[:_SUSPECTS]),
        families=dict(list(families(candidates, probabilities).items())[:_SUSPECTS]),
        rivals=_rivals(candidates, probabilities),
        explained_share=share,
        explainable_share=explained(energy(usual[0]), energy(usual[2]), 0.0),
        learned_parts=_parts(problem, learned),
        models=models if verdict == "unnamed" else {"effects" if terms else "null": best.fit.vector} | models,
        changed=changed,
        dropped=dropped,
        details={
            one.key: {"cost": total_cost(at, one, state.price), "probability": float(probability)}
            for one, probability in zip(candidates, probabilities, strict=True)
        },
    )


def _shares(
    settings: Settings, problem: Problem, at: Floor, compared: Sequence[Candidate]
) -> tuple[list[np.ndarray], float, float]:
    """Gaps of the null, the best model and that with a learned torque, and which shares of them effects explain.

    Returns:
      Gaps [positions] of each, and `explained_shares` of those gaps that speak for the effects most.
    """
    costs = [total_cost(at, one, 0.0) for one in compared]
    usual, typical = ([open_gaps(problem, at, one, measure) for one in compared] for measure in measures(at))
    speaking = speak(usual, typical, settings.at_floor)
    return usual, *max(explained_shares([energy(one) for one in gaps], costs) for gaps in speaking)


def _verdict(problem: Problem, terms: Sequence[AcceptedTerm], changed: Mapping[int, Change]) -> str:
    """The verdict of a model that explains what there is."""
    if any(not problem.is_change(term.hypothesis, term.forms) for term in terms if term.refines is None):
        # A term about a nominal parameter is a change, however large: the model has the parameter.
        return "named"
    return "parameter_change" if changed or terms else "no_missing_effect"


def _rivals(candidates: Sequence[Candidate], probabilities: np.ndarray) -> tuple[tuple[str, np.ndarray], ...]:
    """The two sets of effects that are most believed, best first, each by its best model; none that hardly is."""
    models: dict[str, np.ndarray] = {}
    belief: dict[str, float] = {}
    for index in np.argsort(-probabilities, kind="stable"):
        candidate = candidates[index]
        if candidate.effects:
            key = key_of(candidate.effects)
            models.setdefault(key, candidate.fit.vector)
            belief[key] = belief.get(key, 0.0) + float(probabilities[index])
    best = sorted((key for key in models if belief[key] >= _BELIEVED), key=lambda key: -belief[key])
    return tuple((key, models[key]) for key in best[:2])


def _with_one_name(problem: Problem, at: Floor, state: State) -> State:
    """Makes one of models that were found in two forms, each with the name of the other's form: the cheapest."""
    named = [renamed(problem, one) for one in state.candidates]
    named.sort(key=lambda one: total_cost(at, one, state.price), reverse=True)
    return replace(state, best=renamed(problem, state.best), candidates=tuple({one.key: one for one in named}.values()))


def _where_it_shows(problem: Problem, at: Floor, state: State) -> State:
    """Claims effects only of the joints at which logs show them."""
    if all(len(effect.places) == 1 for effect in state.best.effects):
        return state
    return replace(state, best=at_fewest_places(state.best, *_compared(problem, at, state)))


def _by_whole_runs(settings: Settings, problem: Problem, at: Floor, state: State) -> State:
    """Takes, of models that are believed about as much as the best one, one that predicts whole runs much better.

    Of a servo two models of its losses were as good on segments, which start at measured states, and one of them
    predicted whole runs that were fitted with more than twice the error of the other.
    """
    if problem.whole_runs is None or not state.best.hypotheses:
        return state
    candidates, probabilities = _compared(problem, at, state)
    mine = next(n for n, one in enumerate(candidates) if one.key == state.best.key)
    near = np.flatnonzero(probabilities >= settings.as_likely * probabilities[mine])
    near = np.append(near[near != mine][: settings.rivals], mine)
    if len(near) < 2:
        return state
    errors = problem.whole_runs(np.stack([candidates[n].fit.vector for n in near]))
    errors = np.where(np.isfinite(errors), errors, np.inf)
    least = int(np.argmin(errors))
    return replace(state, best=candidates[near[least]]) if errors[least] < settings.share_whole * errors[-1] else state


def _with_what_passes(settings: Settings, problem: Problem, at: Floor, state: State) -> State:
    """Adds models that have, instead of an effect of the best one, a similar effect or the same one at fewer places.

    The search may have come to the best model by taking effects away, and never have looked there, or from too far
    off. Of the same effect at more places or fewer, `_where_it_shows` chooses last.
    """
    found, known = [], {one.key for one in state.candidates}
    costs = [(one, total_cost(at, one, state.price)) for one in state.candidates]
    for effect in state.best.effects:
        mine = effect, *state.best.forms_of(effect)
        keys = {part.key for part in mine}
        others = [one for one in state.best.hypotheses if one.key not in keys]
        forms, free = (beside(some, others) for some in (problem.forms, problem.hypotheses))
        points = [state.best.fit.coordinates[state.best.fit.along(one)] for one in mine]
        alone = Lead((effect,), points[0], state.null.fit.coordinates, state.null.fit.cost)
        whole = replace(alone, hypotheses=mine, point=np.concatenate(points))
        leads = taken_for(alone, forms, free)
        untried = (*at_some_places(whole, forms, free), *known_in_forms(effect, costs, forms, free))
        leads += [one for one in untried if key_of((*others, *one.hypotheses)) not in known]
        if leads:
            base = ablate(at, state.best, effect)
            (fit,) = polish([base.fit], at.residuals["train"], 0)
            leads = [replace(one, start=fit.coordinates) for one in leads]
            found += fit_leads(settings, at, fit, base.hypotheses, leads, state.price)
    cheapest = min((state.best, *found), key=lambda one: total_cost(at, one, state.price))
    return _where_it_shows(problem, at, replace(state.with_candidates(found), best=cheapest))


def _compared(problem: Problem, at: Floor, state: State) -> tuple[list[Candidate], np.ndarray]:
    """All models, the cheapest first, and how far each is believed, [models]."""
    models = {one.key: one for one in (*state.candidates, state.best)}.values()
    ranked = sorted(models, key=lambda one: total_cost(at, one, state.price))
    return ranked, posterior(problem, at, ranked, state.price)


def learn(settings: Settings, problem: Problem, at: Floor, best: Candidate) -> Candidate:
    """Fits a learned torque at all joints beside a model: a bound of what is explainable, and a fallback without name.

    Args:
      settings: rounds of the fit.
      problem: has the learned torque, or None.
      at: the floor at the main horizon.
      best: the model.

    Returns:
      The model with the torque, or the model itself where there is none.
    """
    if problem.residual is None:
        return best
    evaluate, point = at.residuals["train"], np.zeros(len(problem.residual.directions))
    (begun,) = begin(best.fit, [(problem.residual,)], [point], [best.fit.coordinates], evaluate)
    (fit,) = refine([begun], evaluate, 2 * settings.rounds)
    return Candidate(best.hypotheses, fit, at.residuals["select"](fit.vector[None])[0])


def _parts(problem: Problem, learned: Candidate) -> dict[Hashable, float]:
    """What is lost without each part of the learned torque; nothing where nobody says what its parts are."""
    if problem.residual is None or not problem.residual_parts:
        return {}
    return lost_without(learned.fit, problem.residual, problem.residual_parts)


def _proved(
    settings: Settings, problem: Problem, floor: NoiseFloor, state: State
) -> tuple[Candidate, tuple[AcceptedTerm, ...], dict[str, np.ndarray], tuple[DroppedTerm, ...]]:
    """The cheapest model without the effects that do not pass, which are taken out one by one, the weakest first."""
    at, dropped = floor[problem.main_horizon], []

    def of_effect(effect: Hypothesis) -> Thresholds:
        return Thresholds(state.price * effect.worth)

    (fit,) = polish([state.best.fit], at.residuals["train"], 0)
    best = replace(state.best, fit=fit)
    # Much of what forms are about ends at its bounds: friction can be all at the motor, a limit as soft as it gets.
    of_form = Thresholds(0.5 * state.price, floors=0.0, of_left=0.0, inside=False, horizons=1, size=0.0)
    fitted = {one.key: one for one in state.candidates}
    while True:
        weighed = {h.key: (h, *weigh_evidence(problem, floor, best, h, fitted)) for h in best.hypotheses}
        failed = {
            key: tuple(n for n, passed in passes(evidence, of_form if h.form else of_effect(h)).items() if not passed)
            for key, (h, evidence, _) in weighed.items()
        }
        wrong = [key for key, tests in failed.items() if tests]
        if not wrong:
            break
        weakest = min(wrong, key=lambda key: weighed[key][1].gain)
        hypothesis, evidence, best = weighed[weakest]
        dropped.append(DroppedTerm(hypothesis, evidence, failed[weakest]))
        (fit,) = polish([best.fit], at.residuals["train"], 1)
        best = renamed(problem, replace(best, fit=fit, select=at.residuals["select"](fit.vector[None])[0]))
    if not best.hypotheses:
        best = state.null
        (fit,) = polish([best.fit], at.residuals["train"], 0)
        best = replace(best, fit=fit)
    # What explains most is named first.
    ranked = sorted((row for row in weighed.values() if not row[0].form), key=lambda row: -row[1].gain)
    terms = tuple(AcceptedTerm(h, evidence, of_effect(h), forms=best.forms_of(h)) for h, evidence, _ in ranked)
    return best, terms, {h.key: ablated.fit.vector for h, _, ablated in ranked}, tuple(dropped)


def _by_select(problem: Problem, at: Floor, state: State, best: Candidate, learned: Candidate) -> dict[str, np.ndarray]:
    """Models by what they are, the one that costs least on `select` first; last those that would be withdrawn there.

    The worst signal alone may be a few segments' that nothing explains. And the cost counts a segment by the logarithm
    of its misfit, so it hardly minds one that breaks.
    """
    fits = {"null": state.null, "effects": best, "learned": learned}
    models = {"nominal": np.zeros_like(best.fit.vector)} | {name: one.fit.vector for name, one in fits.items()}
    residuals = {name: one.select for name, one in fits.items()}
    residuals["nominal"] = at.residuals["select"](models["nominal"][None])[0]
    gaps = {name: position_gap(problem, rms(at, one)) for name, one in residuals.items()}

    def rank(name: str) -> tuple[bool, float]:
        worse = is_worse({"before": gaps["nominal"], "null": gaps["null"], "after": gaps[name]})
        return worse, cost(at, (at.unflatten(residuals[name]) ** 2).sum(axis=1))

    return {name: models[name] for name in sorted(models, key=rank)}


def _at_bounds(problem: Problem, fit: Fit, price: float) -> dict[int, Change]:
    """Nominal axes that went as far as they may.

    Those are left out without which, at their nominal value, the model would cost hardly more.
    """
    low, high = fit.free.bounds.T
    edge = np.minimum(fit.coordinates - low, high - fit.coordinates) < _BOUND * (high - low)
    ends = np.flatnonzero(edge)
    worth = fit.linear.without([np.arange(len(edge)) == number for number in ends], ~edge)
    found = {}
    for number, more in zip(ends, worth, strict=True):
        row = fit.free.directions[number]
        for axis in np.flatnonzero(row):
            if problem.prior[axis] > 0 and problem.prior[axis] == row[axis] and more > price:
                found[int(axis)] = Change(float(fit.coordinates[number]))
    return found
