"""The driver of a discovery: it loops over steps, reports progress and saves after every one.

    noise floor -> null -> step, until no model costs less -> conclude -> prove

The null is the nominal model with its nominal parameters and other unknowns fitted, and no effect added.
`step` draws what a step does. The sealed segments are simulated by `prove` alone, once.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from jaxtune.discovery import noise_floor, state
from jaxtune.discovery.conclude import conclude
from jaxtune.discovery.noise_floor import Say
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.prove import prove
from jaxtune.discovery.result import DEFAULTS, Result, Settings
from jaxtune.discovery.step import step

Save = Callable[[dict[str, Any]], None]
"""Given the state after every step, as numbers, texts, lists and dictionaries of them."""


# Share of a discovery's time that is over when a stage begins: six joints, six runs of 3 s, one effect.
_STAGES = {
    "noise floor": 0.0,
    "null": 0.34,
    "screen": 0.41,
    "answers of": 0.58,
    "fit": 0.63,
    "evidence": 0.89,
    "learned torque": 0.93,
    "proof": 0.96,
}
_REPEATED = ("screen", "answers of", "fit")


def share_done(said: Sequence[str]) -> float:
    """Estimates how much of a discovery is over, from what it said; a foretold time that is left needs it.

    Args:
      said: all lines that `Say` received so far.

    Returns:
      Share of the whole time, from 0 to 1; it never falls. Every further effect repeats the stages from `screen` to
      `fit`. How often is not known before, so each time takes half of the share that is left for them.
    """
    stages = [stage for stage in (_stage(line) for line in said) if stage]
    if not stages:
        return 0.0
    steps = stages[:-1].count("fit")
    if stages[-1] not in _REPEATED or not steps:
        return _STAGES[stages[-1]]
    return _STAGES["evidence"] - (_STAGES["evidence"] - _STAGES["fit"]) * 0.5**steps


def _stage(line: str) -> str | None:
    """The stage that a line begins; None for any other line."""
    return next((stage for stage in _STAGES if line.startswith(stage)), None)


def discover(
    problem: Problem,
    settings: Settings = DEFAULTS,
    *,
    saved: Mapping[str, Any] | None = None,
    save: Save = lambda saved: None,
    say: Say = lambda text: None,
) -> Result:
    """Finds what a simulator lacks, or says that nothing is missing, or that something without a name is.

    Args:
      problem: the simulator, the hypotheses and the measured segments.
      settings: how much is tried, and how much evidence is asked for.
      saved: what an interrupted run saved last: this one goes on from there.
      save: called with the state after every step.
      say: receives a line of text about progress.

    Raises:
      ValueError: the model cannot be simulated on these logs.
    """
    floor = noise_floor.measure(problem, say)
    say("null")
    floor, begun = state.begin(problem, floor)
    found = state.from_json(problem, floor, begun, saved) if saved else begun
    restored = found.candidates if saved else ()
    while not found.finished:
        found, info = step(settings, problem, floor, found, say)
        for line in info.lines():
            say(line)
        saved = state.to_json(found)
        save(saved)
        # What is new is simulated again, so that an interrupted run, which has nothing else, finds the same numbers.
        kept = replace(begun, library=found.library, ablated=found.ablated)
        found = state.from_json(problem, floor, kept, saved, restored)
        restored = found.candidates
    conclusion = conclude(settings, problem, floor, found, say)
    say("proof on the sealed runs")
    return prove(problem, floor, found, conclusion)
