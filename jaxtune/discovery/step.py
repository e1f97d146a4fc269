"""One step of forward selection: look for one more effect, and add it to the model if it passes.

    refit -> localise -> screen -> compete -> accept (alone, else in pairs) -> drop

Each arrow is a pure function from a state to the next. The screen is taken anew in every step, since an effect may show
only once another one is in the model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtune.discovery.accept import Decision, accept, drop_unpaid
from jaxtune.discovery.compete import Contest, Start, compete, starts_of_pairs, starts_of_singles
from jaxtune.discovery.evaluate import fit_null, refit, refit_others, worst
from jaxtune.discovery.localise import localise
from jaxtune.discovery.noise_floor import Calibration, NoiseFloor, Say
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import candidates, screen
from jaxtune.discovery.state import State


@dataclass(frozen=True)
class Info:
    """What a step decided, for progress and reports."""

    decisions: tuple[Decision, ...] = ()
    """About the best single hypothesis and, where that failed, about the best pair."""
    dropped: tuple[str, ...] = ()
    """Keys of earlier effects that were taken out, since they no longer paid."""

    @property
    def accepted(self) -> bool:
        """True if the model has an effect that it had not before."""
        return any(decision.accepted for decision in self.decisions)


def begin(problem: Problem, floor: NoiseFloor, calibration: Calibration | None) -> State:
    """Makes the first state: the null is fitted, and nothing was accepted yet.

    Raises:
      ValueError: the nominal model cannot be simulated on these logs.
    """
    null = fit_null(problem, floor)
    state = State(fits={problem.main_horizon: null}, null=null)
    if calibration is None:
        return state
    return replace(state, least_gain=calibration.gain, penalty=calibration.penalty)


def step(
    settings: Settings, problem: Problem, floor: NoiseFloor, state: State, say: Say = lambda text: None
) -> tuple[State, Info]:
    """Looks for one more effect; the state is finished where the model is at the floor or nothing passes.

    The function is pure but for what it says. In the finished state the model is fitted with fresh slopes, whatever
    ended the search.

    Args:
      settings: how much is tried, and how much evidence is asked for.
      problem: the simulator, the hypotheses and the segments.
      floor: the noise floor.
      state: from `begin`, from the last step, or loaded.
      say: told about progress.

    Returns:
      The next state, and what was decided.
    """
    state = _refitted(settings, problem, floor, state)
    at_floor = worst(problem, floor, state.fits[problem.main_horizon].vector) <= settings.at_floor
    # The first look is taken in any case: it says what these logs could show.
    if len(state.terms) >= settings.most or (state.screened and at_floor):
        return replace(state, finished=True), Info()
    state = localise(problem, floor, state)
    state, scores = screen(settings, problem, floor, state, say)
    chosen = candidates(settings, problem, state, scores)
    if not chosen:
        return replace(state, finished=True), Info()
    say(f"fit {len(chosen)}")
    before = replace(state, fits=refit_others(problem, floor, state.fits, 2 * settings.rounds))
    state, contest, decisions = _attempt(settings, problem, floor, before, starts_of_singles(chosen, scores))
    if not state.terms and not at_floor:
        pairs = starts_of_pairs(settings, problem, contest)
        say(f"fit {len(pairs)} pairs")
        state, _, more = _attempt(settings, problem, floor, state, pairs)
        decisions += more
    if not any(decision.accepted for decision in decisions):
        return replace(state, finished=True), Info(decisions)
    state = drop_unpaid(problem, floor, state)
    return state, Info(decisions, dropped=state.dropped[len(before.dropped) :])


def _refitted(settings: Settings, problem: Problem, floor: NoiseFloor, state: State) -> State:
    """The state with its model fitted again at the main horizon; before any acceptance that is the null."""
    main = problem.main_horizon
    base = refit(problem, floor, main, state.fits[main], 2 * settings.rounds)
    return state.with_model({**state.fits, main: base}, null=state.null if state.terms else base)


def _attempt(
    settings: Settings, problem: Problem, floor: NoiseFloor, state: State, starts: Sequence[Start]
) -> tuple[State, Contest, tuple[Decision, ...]]:
    """Fits hypotheses, compares the finalists and accepts the best if it passes; a decision if there is a finalist."""
    contest = compete(settings, problem, floor, state.fits, starts)
    state = replace(state, not_finite=(*state.not_finite, *contest.not_finite))
    if not contest.hypotheses:
        return state, contest, ()
    state, decision = accept(settings, problem, floor, state, contest)
    return state, contest, (decision,)
