"""The driver of a discovery: it loops over steps, reports progress and saves after every accepted effect.

    noise floor -> null -> step (at most `Settings.most` acceptances) -> conclude -> prove

The null is the nominal model with its nominal parameters and the controller's timing fitted, and no effect added.
`step` draws what a step does. The sealed segments are simulated by `prove` alone, once.
"""

from collections.abc import Callable, Mapping
from typing import Any

from jaxtune.discovery import noise_floor, state
from jaxtune.discovery.evaluate import fit_null
from jaxtune.discovery.localise import null_penalty, torque_slopes
from jaxtune.discovery.noise_floor import Calibration, Say
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.prove import conclude, prove
from jaxtune.discovery.result import DEFAULTS, Result, Settings
from jaxtune.discovery.screen import chance_gain, scores, secant_columns
from jaxtune.discovery.step import step

Save = Callable[[dict[str, Any]], None]
"""Given the state after every accepted effect, as numbers, texts, lists and dictionaries of them."""


def discover(
    problem: Problem,
    settings: Settings = DEFAULTS,
    *,
    calibration: Calibration | None = None,
    saved: Mapping[str, Any] | None = None,
    save: Save = lambda saved: None,
    say: Say = lambda text: None,
) -> Result:
    """Finds what a simulator lacks, or says that nothing is missing, or that something without a name is.

    Args:
      problem: the simulator, the hypotheses and the measured segments.
      settings: how much is tried, and how much evidence is asked for.
      calibration: the noise floor and the thresholds that `calibrate` measured for the same robot, motion and noise.
        Without it they are measured on the null logs of the problem.
      saved: what an interrupted run saved last: this one goes on from there.
      save: called with the state after every accepted effect.
      say: receives a line of text about progress.

    Raises:
      ValueError: the model cannot be simulated on these logs.
    """
    floor = noise_floor.measure(problem, calibration, say)
    say("null")
    found = state.from_json(problem, floor, saved) if saved else state.begin(problem, floor, calibration)
    while not found.finished:
        found, info = step(settings, problem, floor, found, say)
        for line in info.lines():
            say(line)
        if info.accepted:
            save(state.to_json(problem, found))
    conclusion = conclude(settings, problem, floor, found, say)
    say("proof on the sealed runs")
    return prove(settings, problem, floor, found, conclusion)


def calibrate(problem: Problem, settings: Settings = DEFAULTS, say: Say = lambda text: None) -> Calibration:
    """Measures what simulated null logs teach, to be used for other logs of the same robot, motion and noise.

    Nothing is decided about the measured log of the problem, but its motion gives the slopes.

    Args:
      problem: its null logs are simulated and screened.
      settings: the level of the threshold on the gain.
      say: receives a line of text about progress.

    Raises:
      ValueError: the nominal model cannot be simulated on these logs.
    """
    floor = noise_floor.measure(problem, None, say)
    at = floor[problem.main_horizon]
    null = fit_null(at)
    columns = secant_columns(at, null, problem.hypotheses, say)
    penalty = null_penalty(at.null_fits, torque_slopes(problem, at, null.vector)) if problem.push else 0.0
    return Calibration(
        floors={horizon: (one.scale, one.weight) for horizon, one in floor.items()},
        gain=chance_gain(scores(null, columns, problem.hypotheses, at.null_fits), settings.level),
        penalty=penalty,
    )
