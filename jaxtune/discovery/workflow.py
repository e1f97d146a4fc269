"""The driver of a discovery: it loops over steps, reports progress and saves after every accepted effect.

    noise floor -> null -> step (at most `Settings.most` acceptances) -> conclude -> prove

`step` draws what a step does. The sealed segments are simulated by `prove` alone, once.
"""

from collections.abc import Callable, Mapping
from typing import Any

from jaxtune.discovery import noise_floor, state
from jaxtune.discovery.evaluate import fit_null
from jaxtune.discovery.localise import null_penalty, torque_slopes
from jaxtune.discovery.noise_floor import Calibration, Say
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.prove import Conclusion, Proof, conclude, prove
from jaxtune.discovery.result import DEFAULTS, Result, Settings
from jaxtune.discovery.screen import chance_gain, scores, secant_columns
from jaxtune.discovery.state import State
from jaxtune.discovery.step import Info, begin, step

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
      calibration: what null logs of the same robot and motion taught; see `calibrate`. Without it they are taken from
        the problem.
      saved: what an interrupted run saved last: this one goes on from there.
      save: called with the state after every accepted effect.
      say: told about progress.

    Raises:
      ValueError: the model cannot be simulated on these logs.
    """
    floor = noise_floor.measure(problem, calibration, say)
    say("null")
    found = state.from_json(problem, floor, saved) if saved else begin(problem, floor, calibration)
    while not found.finished:
        found, info = step(settings, problem, floor, found, say)
        _report(info, say)
        if info.accepted:
            save(state.to_json(problem, found))
    conclusion = conclude(settings, problem, floor, found, say)
    say("proof on the sealed runs")
    return _result(problem, found, conclusion, prove(settings, problem, floor, found, conclusion))


def calibrate(problem: Problem, settings: Settings = DEFAULTS, say: Say = lambda text: None) -> Calibration:
    """Measures what simulated null logs teach, to be used for other logs of the same robot, motion and noise.

    Nothing is decided about the measured log of the problem, but its motion gives the slopes.

    Args:
      problem: its null logs are simulated and screened.
      settings: the level of the threshold on the gain.
      say: told about progress.

    Raises:
      ValueError: the nominal model cannot be simulated on these logs.
    """
    floor = noise_floor.measure(problem, None, say)
    null, null_fits = fit_null(problem, floor), floor[problem.main_horizon].null_fits
    columns = secant_columns(problem, floor, null, problem.hypotheses, say)
    penalty = null_penalty(null_fits, torque_slopes(problem, floor, null.vector)) if problem.push else 0.0
    return Calibration(
        floors={horizon: (at.scale, at.weight) for horizon, at in floor.items()},
        gain=chance_gain(scores(null, columns, problem.hypotheses, null_fits), settings.level),
        penalty=penalty,
    )


def _report(info: Info, say: Say) -> None:
    """Says what a step decided and why."""
    for decision in info.decisions:
        failed = [name for name, passed in decision.tests.items() if not passed]
        verdict = f"rejected, fails {', '.join(failed)}" if failed else "accepted"
        say(f"{decision.hypothesis.key} {verdict}: {decision.evidence} {decision.thresholds}")
    for key in info.dropped:
        say(f"{key} dropped: it no longer pays")


def _result(problem: Problem, found: State, conclusion: Conclusion, proof: Proof) -> Result:
    """Puts together what the steps, the verdict and the proof have found."""
    # What was accepted was shown, whatever the screen had thought of it at the smallest size.
    named = {term.hypothesis.name for term in found.terms}
    return Result(
        verdict=conclusion.verdict,
        terms=found.terms,
        fit=found.fits[problem.main_horizon],
        errors=conclusion.errors,
        null=found.null,
        where=found.where,
        needs_torque=found.needs_torque,
        not_testable=tuple(name for name in found.not_testable if name not in named),
        not_finite=found.not_finite,
        dropped=found.dropped,
        rejected=found.rejected,
        changed=conclusion.changed,
        changed_alike=conclusion.changed_alike,
        residual=conclusion.residual,
        gap=proof.gap,
        proof=proof.proof,
    )
