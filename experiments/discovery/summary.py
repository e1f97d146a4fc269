"""What a discovery found, in the form of `summary.json` and `details.json`, and whole runs simulated before and
after."""

import jax
import numpy as np

from envs import segments
from envs.effects import LIBRARY
from envs.logs import Log
from experiments.discovery.setup import Question
from jaxtune.discovery.fit import Fit
from jaxtune.discovery.problem import Hypothesis
from jaxtune.discovery.result import Result

_SHOWN = 12  # cells in the summary


def summarise(question: Question, result: Result) -> dict:
    """What `summary.json` says; times and versions apart."""
    effects, changes = [], []
    for rung in result.rungs:
        nominal = question.problem.is_nominal(rung.hypothesis)
        (changes if nominal else effects).append(
            _effect(question, rung.hypothesis, result.fit, result.errors, rung.alike)
        )
    singles = {h.key: h for h in question.problem.hypotheses if len(h.places) == 1 and len(h.directions) == 1}
    for axis in result.changed:
        named = question.rig.axes[axis]
        hypothesis = singles[f"{named.effect}@{named.place}"]
        if not any(change["name"] == named.effect and named.place in change["places"] for change in changes):
            alike = tuple(name for name in result.changed_alike[axis] if name != named.effect)
            changes.append(_effect(question, hypothesis, result.fit, result.errors, alike))
    not_there = [name for name in LIBRARY if name not in question.rig.effects]
    return {
        "verdict": result.verdict,
        "effects": effects,
        "parameter_changes": changes,
        "not_testable": [*result.not_testable, *not_there],
        "where": [
            {name: cell[name] for name in ("joint", "signal", "regime", "excess_floor_units")}
            for cell in result.where[:_SHOWN]
            if cell["low"] > 0
        ],
        "gap": {"unit": "floor", **result.gap, "split": "sealed"},
    }


def _effect(question: Question, hypothesis: Hypothesis, fit: Fit, errors: np.ndarray, alike) -> dict:
    rig = question.rig
    row = rig.effects[hypothesis.name]
    place = rig.places[row.on].index(hypothesis.places[0])
    parameters = {}
    for number, parameter in enumerate(row.parameters):
        direction = hypothesis.directions[number]
        mine = [i for i, free in enumerate(fit.free.directions) if ((free != 0) & (direction != 0)).any()]
        axis = int(np.flatnonzero(direction)[0])
        value = fit.vector[axis]
        error = 1.96 * float(np.sqrt(sum((errors[i] * fit.free.directions[i][axis]) ** 2 for i in mine)))
        scale = float(rig.scale(row, parameter)[place])
        # A limit or a stiffness that may as well not be there has no upper end.
        least = max(value - error, 1e-12) if parameter.form == "reciprocal" else value - error
        ends = sorted(float(parameter.value(end, scale)) for end in (least, value + error))
        parameters[parameter.name] = {"value": float(parameter.value(value, scale)), "low": ends[0], "high": ends[1]}
    return {
        "name": hypothesis.name,
        "family": hypothesis.family,
        "places": list(hypothesis.places),
        "parameters": parameters,
        "confusable_with": list(alike),
        "split_by": f"{row.excited_by} on {', '.join(hypothesis.places)}",
    }


def free_runs(log: Log, question: Question, result: Result) -> dict:
    """Every run simulated from its first state to its end, before and after: errors in rad, and the traces."""
    rig = question.rig
    cut = segments.whole(log.runs, rig.dt)
    play = jax.jit(jax.vmap(lambda value, inputs: rig.simulate(rig.tree(value), inputs)["q"], (None, 0)))
    vectors = {
        "before": np.zeros(len(rig.axes)),
        "null": result.null.vector,
        "after": (result.residual or result.fit).vector,
    }
    values = np.asarray(rig.inner(np.stack(list(vectors.values()))), np.float32)
    found = {name: np.asarray(play(value, cut.segments)) for name, value in zip(vectors, values, strict=True)}
    splits = {name: split for split, names in question.splits.items() for name in names}
    runs = []
    for piece, recorded in enumerate(log.runs):
        rows = np.unique(cut.row[piece])
        runs.append(
            {
                "run": recorded.name,
                "split": splits[recorded.name],
                "time": recorded.time[rows] - recorded.time[rows[0]],
                "measured": recorded.signals["q"][rows],
                **{name: values[piece][: len(rows)] for name, values in found.items()},
                "error_rad": {
                    name: float(np.abs(values[piece][: len(rows)] - recorded.signals["q"][rows]).mean())
                    for name, values in found.items()
                },
            }
        )
    return {
        "runs": runs,
        "error_rad": {
            split: {
                name: float(np.mean([run["error_rad"][name] for run in runs if run["split"] == split]))
                for name in found
            }
            for split in ("train", "select", "sealed")
        },
    }


def details(question: Question, result: Result, free: dict) -> dict:
    """What a reader of the summary may want to know more of."""
    return {
        "notes": question.notes,
        "ladder": [
            {
                "hypothesis": rung.hypothesis.key,
                "evidence": rung.evidence,
                "thresholds": rung.thresholds,
                "confusable_with": rung.alike,
            }
            for rung in result.rungs
        ],
        "rejected": result.rejected,
        "where": result.where,
        "needs_torque": result.needs_torque,
        "not_finite": result.not_finite,
        "proof": result.proof,
        "free_run_error_rad": free["error_rad"],
        "free_runs": [{name: run[name] for name in ("run", "split", "error_rad")} for run in free["runs"]],
    }
