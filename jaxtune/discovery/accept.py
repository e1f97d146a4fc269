"""Whether the best finalist becomes part of the model, and whether what was accepted before still pays (steps 7, 8).

`select` (validation) decides: nothing was fitted there. `decide` holds the statistics; this module applies them to a
contest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery import decide
from jaxtune.discovery.compete import Contest
from jaxtune.discovery.evaluate import ablate, residuals_on, standard_errors
from jaxtune.discovery.fit import Fit
from jaxtune.discovery.noise_floor import NoiseFloor
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.result import Settings
from jaxtune.discovery.state import AcceptedTerm, State

_EQUAL = 2.0  # standard errors within which two hypotheses are not distinguishable
_ABOUT_BEST = 1.0  # standard errors within which the simplest is taken
_PAYS = 1.0  # t of an effect accepted earlier, below which it may go


@dataclass(frozen=True)
class Comparison:
    """Finalists side by side, on segments that they were not fitted to."""

    before: Mapping[float, np.ndarray]
    """[segments, bins, components] by horizon: residuals on `select` of the model without them."""
    after: Mapping[float, Mapping[str, np.ndarray]]
    """The same with each of them, by horizon and key."""
    lost: Mapping[str, np.ndarray]
    """[segments of train and select] by key: what every segment counts for at the main horizon."""
    gain: Mapping[str, float]
    """Fall of the fit's loss on `train`, by key."""
    runs: Mapping[float, np.ndarray]
    """[segments] of `select` by horizon: index of each segment's run."""
    runs_of_lost: np.ndarray
    """[segments of train and select]: index of each segment's run."""


@dataclass(frozen=True)
class Decision:
    """What became of the best finalist, for reports."""

    hypothesis: Hypothesis
    evidence: decide.Evidence
    thresholds: decide.Thresholds
    tests: Mapping[str, bool]
    """Whether it passed, by test; see `decide.passes`."""
    equal: tuple[str, ...]
    """Keys of finalists that fit as well as the best."""
    nearly: tuple[str, ...]
    """Keys of the others that explain nearly as much as the best."""

    @property
    def accepted(self) -> bool:
        """True if it passed every test."""
        return all(self.tests.values())


def accept(
    settings: Settings, problem: Problem, floor: NoiseFloor, state: State, contest: Contest
) -> tuple[State, Decision]:
    """Compares the finalists on `select` and adds the best one to the model, if it passes every test.

    Args:
      settings: levels and shares of the tests.
      problem: the simulator and the segments.
      floor: the noise floor.
      state: `state.fits` is the model without them, at every horizon.
      contest: the finalists, at least one.

    Returns:
      The state with the effect (both, of a pair) in the model, or with it as `rejected`; and the decision.
    """
    comparison = compare(problem, floor, state, contest)
    chosen = choose(contest, comparison, problem.main_horizon)
    equal, nearly = close_to_best(settings, comparison)
    evidence = weigh_evidence(problem, floor, state, contest, comparison, chosen, equal)
    thresholds = set_thresholds(settings, problem, state, comparison, chosen)
    tests = decide.passes(evidence, thresholds)
    decision = Decision(chosen, evidence, thresholds, tests, tuple(equal), tuple(nearly))
    if not decision.accepted:
        rejected = {"hypothesis": chosen.key, "tests": tests, "evidence": evidence}
        return replace(state, rejected=rejected), decision
    return extend(state, contest, decision), decision


def compare(problem: Problem, floor: NoiseFloor, state: State, contest: Contest) -> Comparison:
    """Simulates the model and every finalist on `select`, at all horizons.

    Args:
      problem: the simulator and the segments.
      floor: the noise floor.
      state: the model without the finalists.
      contest: the finalists' fits.
    """
    main, before, after = problem.main_horizon, {}, {}
    for horizon, fits in contest.fits.items():
        vectors = np.stack([state.fits[horizon].vector, *(fits[h.key].vector for h in contest.hypotheses)])
        found = residuals_on(problem, floor, horizon, "select")(vectors)
        before[horizon], *others = (floor[horizon].unflatten(one) for one in found)
        after[horizon] = {h.key: one for h, one in zip(contest.hypotheses, others, strict=True)}
    lost = {}
    for key, fit in contest.fits[main].items():
        on_train = decide.losses(floor[main].unflatten(fit.residual))
        lost[key] = np.concatenate([on_train, decide.losses(after[main][key])])
    loss = state.fits[main].linear.loss
    runs = {horizon: problem.data["select"][horizon].run for horizon in contest.fits}
    return Comparison(
        before=before,
        after=after,
        lost=lost,
        gain={key: loss - fit.linear.loss for key, fit in contest.fits[main].items()},
        runs=runs,
        runs_of_lost=np.concatenate([problem.data["train"][main].run, runs[main]]),
    )


def choose(contest: Contest, comparison: Comparison, horizon: float) -> Hypothesis:
    """Chooses the simplest hypothesis within one standard error of the best, and the best fit among the simplest."""
    best = decide.alike(comparison.lost, comparison.runs_of_lost, _ABOUT_BEST)
    about_best = [h for h in contest.hypotheses if h.key in best]
    return min(about_best, key=lambda h: (len(h.directions), contest.fits[horizon][h.key].linear.loss))


def close_to_best(settings: Settings, comparison: Comparison) -> tuple[list[str], list[str]]:
    """Finds the hypotheses that may be right as well as the best.

    Returns:
      Keys of those that fit equally well (the best among them), and of others that explain nearly as much.
    """
    equal = decide.alike(comparison.lost, comparison.runs_of_lost, _EQUAL)
    enough = settings.same * max(comparison.gain.values())
    return equal, [key for key, gain in comparison.gain.items() if key not in equal and gain > enough]


def weigh_evidence(
    problem: Problem,
    floor: NoiseFloor,
    state: State,
    contest: Contest,
    comparison: Comparison,
    chosen: Hypothesis,
    equal: Sequence[str],
) -> decide.Evidence:
    """Collects what speaks for the chosen hypothesis against the model without it.

    Args:
      problem: the segments.
      floor: the noise floor.
      state: the model without it.
      contest: the finalists' fits.
      comparison: the finalists on `select`.
      chosen: the hypothesis.
      equal: keys of those that fit as well as the best; a bagged refit that chooses one of them counts for it.
    """
    main = problem.main_horizon
    before, after, run = comparison.before[main], comparison.after[main][chosen.key], comparison.runs[main]
    fit, base = contest.fits[main][chosen.key], state.fits[main]
    low, high = chosen.bounds.T
    own = fit.own(chosen)
    linear = {key: fit.linear for key, fit in contest.fits[main].items()}
    share = decide.bagged(linear, problem.data["train"][main].run)
    return decide.Evidence(
        gain=comparison.gain[chosen.key],
        t=decide.t_statistic(decide.paired(before, after), run),
        confirmed=decide.confirmed(before, after, run, base.weight),
        floors=_largest_fall(before, after),
        interval=_interval(chosen, own, standard_errors(problem, floor, fit)[-len(own) :]),
        inside=bool(((low < own) & (own < high)).all()),
        horizons=sum(_is_about_best(comparison, horizon, chosen) for horizon in comparison.after),
        chosen=sum(share[h.key] for h in contest.hypotheses if h.key in equal or _same_name_nearby(h, chosen)),
    )


def set_thresholds(
    settings: Settings, problem: Problem, state: State, comparison: Comparison, chosen: Hypothesis
) -> decide.Thresholds:
    """Computes what the evidence has to exceed.

    The t must beat the best of all finalists under no effect (max-t), and the gain that of chance, for each part of a
    pair.

    Args:
      settings: the level.
      problem: names the main horizon.
      state: the gain that chance gives.
      comparison: the finalists on `select`.
      chosen: the hypothesis that is tested.
    """
    main = problem.main_horizon
    gains = {key: decide.paired(comparison.before[main], after) for key, after in comparison.after[main].items()}
    return decide.Thresholds(
        t=decide.max_t(gains, comparison.runs[main], settings.level), gain=len(chosen.singles) * state.least_gain
    )


def extend(state: State, contest: Contest, decision: Decision) -> State:
    """Adds an accepted hypothesis to the model; the finalist's fits become the model's."""
    chosen = decision.hypothesis
    others = confusable_names(contest, decision)
    terms = [AcceptedTerm(part, decision.evidence, decision.thresholds, others) for part in chosen.singles]
    fits = {horizon: fits[chosen.key] for horizon, fits in contest.fits.items()}
    return state.with_model(fits, terms=(*state.terms, *terms))


def confusable_names(contest: Contest, decision: Decision) -> tuple[str, ...]:
    """Names the effects, other than the accepted ones, that these logs cannot distinguish from it."""
    mine = {part.name for part in decision.hypothesis.singles}
    close = {*decision.equal, *decision.nearly}
    names = [part.name for h in contest.hypotheses if h.key in close for part in h.singles]
    return tuple(dict.fromkeys(name for name in names if name not in mine))


def drop_unpaid(problem: Problem, floor: NoiseFloor, state: State) -> State:
    """Takes out earlier effects that no longer pay beside what was accepted last.

    A wrong effect that stood in for a right one is found out when the right one joins: without it nothing gets worse.

    Args:
      problem: the simulator and the segments.
      floor: the noise floor.
      state: right after an acceptance.
    """
    newest = state.terms[-1].evidence
    for term in [term for term in state.terms if term.evidence is not newest]:
        without = {
            horizon: ablate(problem, floor, horizon, fit, term.hypothesis) for horizon, fit in state.fits.items()
        }
        if not _still_pays(problem, floor, state, without[problem.main_horizon]):
            kept = tuple(other for other in state.terms if other is not term)
            state = state.with_model(without, terms=kept, dropped=(*state.dropped, term.hypothesis.key))
    return state


def _still_pays(problem: Problem, floor: NoiseFloor, state: State, without: Fit) -> bool:
    """Whether the model is better on `select` than the same one without an effect."""
    main, run = problem.main_horizon, problem.data["select"][problem.main_horizon].run
    vectors = np.stack([without.vector, state.fits[main].vector])
    found = residuals_on(problem, floor, main, "select")(vectors)
    pair = [floor[main].unflatten(one) for one in found]
    confirmed = decide.confirmed(*pair, run, floor[main].weight) > state.least_gain
    return decide.t_statistic(decide.paired(*pair), run) >= _PAYS or confirmed


def _is_about_best(comparison: Comparison, horizon: float, chosen: Hypothesis) -> bool:
    """Whether a hypothesis is best on `select` at a horizon, or within a standard error of the best."""
    lost = {key: decide.losses(residual) for key, residual in comparison.after[horizon].items()}
    return chosen.key in decide.alike(lost, comparison.runs[horizon], _ABOUT_BEST)


def _largest_fall(before: np.ndarray, after: np.ndarray) -> float:
    """Root of the largest fall of a component's mean square, in floor units."""
    fall = (before**2).mean(axis=(0, 1)) - (after**2).mean(axis=(0, 1))
    return float(np.sqrt(max(fall.max(), 0.0)))


def _same_name_nearby(one: Hypothesis, chosen: Hypothesis) -> bool:
    """Whether a hypothesis has the same name at some of the same places: for bagging it is the same answer."""
    return one.name == chosen.name and bool(set(one.places) & set(chosen.places))


def _interval(hypothesis: Hypothesis, values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """95 % interval of the coordinate that tells whether all parts of a hypothesis are there.

    Of several parameters of one part, one must be clear of zero: the clearest counts. A parameter without a probe has
    no meaning alone and cannot be the one. Of two parts the one that is less clear counts.
    """
    clear, start = [], 0
    for part in hypothesis.singles:
        mine = slice(start, start := start + len(part.directions))
        distance = np.where((part.probes != 0).any(axis=0), np.abs(values[mine]) / errors[mine], 0.0)
        clear.append((distance.max(), mine.start + int(distance.argmax())))
    _, index = min(clear)
    return float(values[index] - 1.96 * errors[index]), float(values[index] + 1.96 * errors[index])
