"""One step of forward selection: look for one more effect, and add it to the model if it passes.

    refit -> localise -> screen -> shortlist -> compete -> accept (alone, else in pairs) -> drop

Each arrow is a pure function from a state to the next. The screen is taken anew in every step, since an effect may show
only once another one is in the model.
"""

from dataclasses import dataclass, replace

from jaxtune.discovery.accept import accept, drop_unpaid
from jaxtune.discovery.compete import compete, starts_of_pairs, starts_of_singles
from jaxtune.discovery.decide import Decision
from jaxtune.discovery.evaluate import refit, refit_others, worst
from jaxtune.discovery.localise import localise
from jaxtune.discovery.noise_floor import NoiseFloor, Say
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import screen
from jaxtune.discovery.shortlist import candidates
from jaxtune.discovery.state import State


@dataclass(frozen=True)
class Info:
    """What a step decided: nothing that the next step needs, but what a progress bar or a report shows."""

    decisions: tuple[Decision, ...] = ()
    """About the best single hypothesis and, where that failed, about the best pair."""
    dropped: tuple[str, ...] = ()
    """Keys of earlier effects that were taken out, since they no longer paid."""

    @property
    def accepted(self) -> bool:
        """True if the model has an effect that it had not before the step; the driver saves then."""
        return any(decision.accepted for decision in self.decisions)

    def lines(self) -> list[str]:
        """Says in a line each what was decided and with which evidence, and what was dropped."""
        lines = []
        for decision in self.decisions:
            failed = [name for name, passed in decision.tests.items() if not passed]
            verdict = f"rejected, fails {', '.join(failed)}" if failed else "accepted"
            lines.append(f"{decision.hypothesis.key} {verdict}: {decision.evidence} {decision.thresholds}")
        return lines + [f"{key} dropped: it no longer pays" for key in self.dropped]


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
      state: from `state.begin`, from the last step, or loaded.
      say: receives a line of text about progress.

    Returns:
      The next state, and what was decided.
    """
    main = problem.main_horizon
    base = refit(floor[main], state.fits[main], 2 * settings.rounds)
    at_floor = worst(floor[main], base.vector) <= settings.at_floor
    # Before any acceptance the model is the null.
    state = state.with_model({**state.fits, main: base}, null=state.null if state.terms else base)
    # The first look is taken in any case: it says what these logs could show.
    if len(state.terms) >= settings.most or (state.screened and at_floor):
        return replace(state, finished=True), Info()
    state = localise(problem, floor, state)
    state, scores = screen(settings, problem, floor, state, say)
    chosen = candidates(settings, problem, state, scores)
    if not chosen:
        return replace(state, finished=True), Info()
    say(f"fit {len(chosen)}")
    before = replace(state, fits=refit_others(floor, state.fits, main, 2 * settings.rounds))
    singles = starts_of_singles(chosen, scores)
    contest = compete(settings, problem, floor, before.fits, singles)
    state, decisions = accept(settings, problem, floor, before, contest)
    if not state.terms and not at_floor:
        pairs = starts_of_pairs(settings, problem, contest)
        say(f"fit {len(pairs)} pairs")
        contest = compete(settings, problem, floor, before.fits, pairs)
        state, of_pairs = accept(settings, problem, floor, state, contest)
        decisions += of_pairs
    if not any(decision.accepted for decision in decisions):
        return replace(state, finished=True), Info(decisions)
    state = drop_unpaid(problem, floor, state)
    return state, Info(decisions, dropped=state.dropped[len(before.dropped) :])
