"""Adds the best finalist to the model, if it passes, and takes out what no longer pays (steps 7 and 8).

`select` (validation) decides: nothing was fitted there. This module simulates it and changes the model accordingly;
`decide` has the statistics.
"""

from dataclasses import replace

import numpy as np

from jaxtune.discovery.compete import Contest
from jaxtune.discovery.decide import Comparison, Decision, decide, no_longer_pays
from jaxtune.discovery.evaluate import ablate
from jaxtune.discovery.noise_floor import NoiseFloor
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.result import Settings
from jaxtune.discovery.state import AcceptedTerm, State


def accept(
    settings: Settings, problem: Problem, floor: NoiseFloor, state: State, contest: Contest
) -> tuple[State, tuple[Decision, ...]]:
    """Compares the finalists on `select` and adds the best one to the model, if it passes every test.

    Args:
      settings: level and shares of the tests.
      problem: the runs of the segments.
      floor: the noise floor.
      state: `state.fits` is the model without them, at every horizon.
      contest: the finalists.

    Returns:
      The state with the effect (both, of a pair) in the model, or with it as `rejected`; and the decision, if there was
      a finalist.
    """
    state = replace(state, not_finite=(*state.not_finite, *contest.not_finite))
    # All of the shortlist may have broken the simulation.
    if not contest.hypotheses:
        return state, ()
    comparison = compare(problem, floor, state, contest)
    decision = decide(comparison, state.least_gain, settings.level, settings.same)
    if decision.accepted:
        return extend(state, contest, decision), (decision,)
    rejected = {"hypothesis": decision.hypothesis.key, "tests": decision.tests, "evidence": decision.evidence}
    return replace(state, rejected=rejected), (decision,)


def compare(problem: Problem, floor: NoiseFloor, state: State, contest: Contest) -> Comparison:
    """Simulates the model and every finalist on `select`, at all horizons.

    Args:
      problem: the runs of the segments.
      floor: the noise floor.
      state: the model without the finalists.
      contest: the finalists' fits.
    """
    main, before, after = problem.main_horizon, {}, {}
    for horizon, fits in contest.fits.items():
        # The model and all finalists in one batch: a program is compiled for any number of vectors.
        vectors = np.stack([state.fits[horizon].vector, *(fits[h.key].vector for h in contest.hypotheses)])
        found = floor[horizon].residuals["select"](vectors)
        before[horizon], *others = (floor[horizon].unflatten(one) for one in found)
        after[horizon] = {h.key: one for h, one in zip(contest.hypotheses, others, strict=True)}
    return Comparison(
        hypotheses=contest.hypotheses,
        base=state.fits[main],
        fits=contest.fits[main],
        before=before,
        after=after,
        runs={horizon: problem.data["select"][horizon].run for horizon in contest.fits},
        run_of_train=problem.data["train"][main].run,
        main=main,
    )


def extend(state: State, contest: Contest, decision: Decision) -> State:
    """Adds an accepted hypothesis to the model: the finalist's fits, at all horizons, become the model's.

    Of a pair each part is a term of its own, so that each can be ablated and dropped alone.
    """
    terms = [
        AcceptedTerm(part, decision.evidence, decision.thresholds, decision.confusable_with)
        for part in decision.hypothesis.singles
    ]
    fits = {horizon: fits[decision.hypothesis.key] for horizon, fits in contest.fits.items()}
    return state.with_model(fits, terms=(*state.terms, *terms))


def drop_unpaid(problem: Problem, floor: NoiseFloor, state: State) -> State:
    """Takes out earlier effects that no longer pay beside what was accepted last.

    A wrong effect that stood in for a right one is found out when the right one joins: without it nothing gets worse.

    Args:
      problem: the runs of the segments.
      floor: the noise floor.
      state: right after an acceptance.
    """
    at, run = floor[problem.main_horizon], problem.data["select"][problem.main_horizon].run
    # The parts of a pair were accepted by the same evidence, and neither is older than the other.
    newest = state.terms[-1].evidence
    for term in [term for term in state.terms if term.evidence is not newest]:
        without = {horizon: ablate(floor[horizon], fit, term.hypothesis) for horizon, fit in state.fits.items()}
        models = np.stack([fits[problem.main_horizon].vector for fits in (without, state.fits)])
        before, now = (at.unflatten(one) for one in at.residuals["select"](models))
        if no_longer_pays(before, now, run, at.weight, state.least_gain):
            kept = tuple(other for other in state.terms if other is not term)
            state = state.with_model(without, terms=kept, dropped=(*state.dropped, term.hypothesis.key))
    return state
