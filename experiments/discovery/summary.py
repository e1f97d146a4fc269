"""Prepares the result of a discovery for files and pages: `summary.json`, `details.json`, and whole simulated runs."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from envs.effects import LIBRARY
from envs.following import OF_SENSORS
from envs.logs import Log
from experiments.discovery.hypotheses import hypotheses
from experiments.discovery.next_experiment import deciding_experiment
from experiments.discovery.question import Question
from experiments.discovery.whole_runs import simulate_runs
from jaxtune.discovery.fit import Fit
from jaxtune.discovery.problem import Hypothesis, acts_within
from jaxtune.discovery.result import AcceptedTerm, Result

_FAR_OFF = 6.0  # floor units; none of the 194 robots that lacked nothing in the benchmarks reached it (5.2)
_PART = 0.1  # least share of what a learned torque explains at which a part of it is listed
_SHOWN = 12  # places with the largest gap that the summary lists


def summarise(question: Question, log: Log, folder: Path, result: Result) -> dict:
    """Returns the content of `summary.json`, except for times and versions.

    Args:
      question: the problem that discovery worked on.
      log: what was measured.
      folder: of the log.
      result: what was found.

    Returns:
      The verdict; effects and parameter changes with values, intervals and confusable names; what was accepted beside
      them and is not named; what was taken out again; what these logs cannot show; what sensors read of torques; the
      cells with the largest gap; and the gap on sealed runs.
    """
    effects, changes, not_named = [], [], []
    for term in (*result.terms, *_changed(question, result)):
        effect = _effect(question, term, result.fit, result.errors)
        if term.refines is not None or result.verdict == "unnamed":
            not_named.append(effect | {"refines": term.refines})
        elif question.problem.is_change(term.hypothesis, term.forms):
            changes.append(effect)
        else:
            effects.append(effect)
    asked = {hypothesis.name for hypothesis in question.problem.hypotheses}
    not_there = [name for name in LIBRARY if name not in asked]
    return {
        "verdict": result.verdict,
        "effects": effects,
        "parameter_changes": changes,
        "not_named": not_named,
        "dropped": [
            {
                "name": one.hypothesis.name,
                "places": list(one.hypothesis.places),
                "each": one.hypothesis.each,
                "form": one.hypothesis.form or None,
                "failed": list(one.failed),
            }
            for one in result.dropped
        ],
        "not_testable": [*result.not_testable, *not_there],
        "torque_sensors": _torque_sensors(question, result.fit),
        "where": [
            {name: cell[name] for name in ("joint", "signal", "regime", "excess_floor_units")}
            for cell in result.where[:_SHOWN]
            if cell["low"] > 0
        ],
        "far_off": _far_off(result),
        "gap": {"unit": "floor", **result.gap, "split": "sealed"},
        "suspects": [
            {
                "name": one.hypothesis.name,
                "places": list(one.hypothesis.places),
                "each": one.hypothesis.each,
                "form": _names(one.forms),
                "probability": one.probability,
            }
            for one in result.suspects
        ],
        "families": [
            {"family": family, "places": list(places), "probability": probability}
            for (family, places), probability in result.families.items()
        ],
        "next_experiment": deciding_experiment(question, log, folder, result),
        "withdrawn": result.withdrawn,
        "explained_share": result.explained_share,
        "explainable_share": result.explainable_share,
        "model_is": result.model_is,
        "learned_parts": [
            {"place": place, "part": part, "lost_without": share}
            for (place, part), share in result.learned_parts.items()
            if share >= _PART
        ],
    }


def _torque_sensors(question: Question, fit: Fit) -> dict[str, dict[str, float]]:
    """What sensors read of torques, by joint: `ratio` times the robot's, and `offset_nm` where they may have one.

    Empty where no recorded torques are compared.
    """
    rig, follows, found = question.rig, question.sensed.any(), {}
    if not follows and not {"tau", "abs_tau"} & set(question.problem.components):
        return {}
    # With a known controller those of sensors are effects, and not free under every hypothesis.
    free = OF_SENSORS if follows else ("torque_reading",)
    for axis, coordinate in zip(rig.axes, fit.vector, strict=True):
        if axis.effect not in free:
            continue
        parameter = next(one for one in rig.effects[axis.effect].parameters if one.name == axis.parameter)
        found.setdefault(axis.place, {})[parameter.name] = float(parameter.value(coordinate, axis.scale))
    if not follows:
        return found
    # The model's motors turn readings into torques, torque = ratio reading + push.
    return {
        joint: {"ratio": 1.0 / one["ratio"], "offset_nm": 0.0 - one["nm"] / one["ratio"]}
        for joint, one in found.items()
    }


def _far_off(result: Result) -> dict | None:
    """Where the positions of a model that lacks nothing are far off all the same, as in a few motions; None if nowhere.

    Its intervals reach zero, where few segments show it.
    """
    cells = [cell for cell in result.where if cell["signal"] == "q" and cell["excess_floor_units"] >= _FAR_OFF]
    if result.verdict != "no_missing_effect" or not cells:
        return None
    return {name: cells[0][name] for name in ("joint", "regime", "excess_floor_units")}


def _changed(question: Question, result: Result) -> list[AcceptedTerm]:
    """Nominal parameters that went as far as they may. One at the joints of a named effect refines that effect."""
    rig, found = question.rig, []
    for axis, change in ((rig.axes[number], change) for number, change in result.changed.items()):
        if any(term.hypothesis.name == axis.effect and axis.place in term.hypothesis.places for term in result.terms):
            continue
        every = hypotheses(rig.axes, rig.places, {axis.effect: rig.effects[axis.effect]})
        hypothesis = next(one for one in every if one.places == (axis.place,))
        over = [t.hypothesis.key for t in result.terms if t.refines is None and acts_within(hypothesis, t.hypothesis)]
        refines = over[0] if over else None
        found.append(AcceptedTerm(hypothesis, None, None, confusable_with=change.confusable_with, refines=refines))
    return found


def _effect(question: Question, term: AcceptedTerm, fit: Fit, errors: np.ndarray) -> dict:
    """Describes a fitted effect: physical values with 95 % intervals, and what would distinguish it from its rivals."""
    rig, hypothesis, parameters = question.rig, term.hypothesis, {}
    places = hypothesis.places if term.clear is None else term.clear
    rows = [(part.form, row) for part in (hypothesis, *term.forms) for row in part.directions]
    for form, direction in rows:
        mine = [i for i, free in enumerate(fit.free.directions) if ((free != 0) & (direction != 0)).any()]
        number = int(np.flatnonzero(direction)[0])
        axis, value = rig.axes[number], fit.vector[number]
        scale, known = axis.scale, rig.effects[axis.effect].parameters
        parameter = next(one for one in known if one.name == axis.parameter)
        # Standard errors of the directions through this coordinate add up in quadrature; 1.96 makes it a 95 % interval.
        several = [errors[i] * fit.free.directions[i][number] for i in mine]
        if axis.effect == "command_delay":
            # A controller that takes targets once in its period makes whole periods of any delay.
            several.append(1.0 / (rig.control_hz * scale * np.sqrt(12.0)))
        error = 1.96 * float(np.linalg.norm(several))
        low, high = (axis.least if axis.takes else parameter.bounds[0]), parameter.bounds[1]
        # A limit or a stiffness that may as well not be there has no upper end.
        low = max(low, 1e-12) if parameter.form == "reciprocal" else low
        ends = np.clip([value - error, value + error], low, high)
        ends = sorted(float(parameter.value(float(end), scale)) for end in ends)
        name = parameter.name
        if term.clear is not None and not form:
            if axis.place not in term.clear:
                continue
            name = f"{name}.{axis.place}"
        # A delay that is filtered has two times.
        name = f"{form}.{name}" if name in parameters else name
        parameters[name] = {"value": float(parameter.value(value, scale)), "low": ends[0], "high": ends[1]}
    return {
        "name": hypothesis.name,
        "family": hypothesis.family,
        "places": list(places),
        "parameters": parameters,
        "form": _names(term.forms),
        "confusable_with": list(term.confusable_with),
        "split_by": f"{rig.effects[hypothesis.name].excited_by} on {', '.join(places)}",
    }


def _names(forms: Sequence[Hypothesis]) -> str | None:
    """The forms of an effect in one text; None for its first form."""
    return ", ".join(form.form for form in forms) or None


def free_runs(question: Question, result: Result) -> dict:
    """Simulates every run from its first state to its end, with the nominal, the fitted and the corrected model.

    Discovery works on short segments. Whole runs show how well the model predicts a motion without being corrected by
    measured states, which is what a user of the model needs.

    Args:
      question: the problem that discovery worked on, with its log.
      result: what was found.

    Returns:
      `signal`: what is compared (`Question.of_whole_runs`); `runs`: name, split, time in s, values of the signal
      [rows, joints] (`measured`, `before`, `null`, `after`) and their mean absolute errors (`error`), in rad, Nm or
      what slides have; `error`: means of these errors by split and model.
    """
    vectors = {"before": np.zeros(len(question.rig.axes)), "null": result.null.vector, "after": result.proposed}
    rows, simulated = simulate_runs(question, question.log.runs, np.stack(list(vectors.values())))
    splits = {name: split for split, names in question.splits.items() for name in names}
    runs = []
    for recorded, own, played in zip(question.log.runs, rows, simulated, strict=True):
        measured, found = recorded.signals[question.of_whole_runs][own], dict(zip(vectors, played, strict=True))
        runs.append(
            {
                "run": recorded.name,
                "split": splits[recorded.name],
                "time": recorded.time[own] - recorded.time[own[0]],
                "measured": measured,
                **found,
                "error": {name: float(np.abs(values - measured).mean()) for name, values in found.items()},
            }
        )
    return {"signal": question.of_whole_runs, "runs": runs, "error": _mean_errors(runs, list(vectors))}


def _mean_errors(runs: Sequence[Mapping], names: Sequence[str]) -> dict[str, dict[str, float]]:
    return {
        split: {name: float(np.mean([run["error"][name] for run in runs if run["split"] == split])) for name in names}
        for split in ("train", "select", "sealed")
    }


def details(question: Question, result: Result, free: dict) -> dict:
    """Returns the content of `details.json`: evidence, tests and proofs behind the summary.

    Args:
      question: the problem that discovery worked on.
      result: what was found.
      free: whole simulated runs, of `free_runs`.
    """
    unit = {"q": "rad", "tau": "nm"}[free["signal"]]
    return {
        "notes": question.notes,
        "ladder": [
            {
                "hypothesis": term.hypothesis.key,
                "evidence": term.evidence,
                "thresholds": term.thresholds,
                "form": _names(term.forms),
                "confusable_with": term.confusable_with,
                "refines": term.refines,
            }
            for term in result.terms
        ],
        "dropped": [
            {"hypothesis": one.hypothesis.key, "failed": one.failed, "evidence": one.evidence} for one in result.dropped
        ],
        "models": result.details,
        "where": result.where,
        "needs_torque": result.needs_torque,
        "not_finite": result.not_finite,
        "proof": result.proof,
        f"free_run_error_{unit}": free["error"],
        "free_runs": [
            {"run": run["run"], "split": run["split"], f"error_{unit}": run["error"]} for run in free["runs"]
        ],
    }
