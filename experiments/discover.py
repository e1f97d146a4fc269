"""Names what a model lacks: `python -m experiments.discover --logs LOG [LOG ...] --out DIR`.

Reads measured logs, finds where simulation and measurement disagree, names the missing effect, adds it to the model and
shows on runs that nothing was fitted to what that is worth; or says that nothing is missing, or something unnamed.
"""

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from envs import corrected, models, segments
from envs.effects import LIBRARY
from envs.logs import Log, read, read_xl330
from experiments import checkpoint, discovery_report
from experiments.checkpoint import as_json, write_json
from experiments.question import HORIZONS_S, Question, ask
from experiments.train import bars, console, run
from jaxtune.discovery import workflow
from jaxtune.discovery.fit import Fit
from jaxtune.discovery.problem import Hypothesis
from jaxtune.discovery.result import Result

_SHOWN = 12  # cells in the summary


@dataclass(frozen=True, kw_only=True)
class Args:
    """Finds what a model lacks, from measured logs of the robot on the rig."""

    logs: tuple[Path, ...]
    """Folders of logs of one robot; a folder of the XL330 pendulum's JSON files will do as well."""
    out: Path = Path("runs/discover")
    """Folder of the results; the same command with the same folder goes on after the last accepted effect."""
    horizons: tuple[float, ...] = HORIZONS_S
    """Lengths in s of the segments that are simulated, three of them."""
    healthy: int = 20
    """Simulated logs in which nothing is missing; they make the floor and the threshold."""
    seed: int = 0
    """Seed of everything random."""


def main(args: Args) -> None:
    """Asks, answers, proves, and writes it down."""
    checkpoint.set_up_compiler(checkpoint.a_device_a_core())
    began = time.monotonic()
    log = gathered(args.logs)
    if len(args.horizons) != 3 or sorted(set(args.horizons)) != list(args.horizons) or args.horizons[0] <= 0:
        raise ValueError(f"horizons: got {args.horizons}, expected three lengths that rise")
    if args.healthy < 2:
        raise ValueError(f"healthy: got {args.healthy}, expected 2 or more")
    identity = {"logs": [str(path) for path in args.logs], "horizons": args.horizons, "healthy": args.healthy}
    checkpoint.open_run(args.out, identity | {"seed": args.seed})
    saved = args.out / "state.json"
    with bars() as progress:
        task = progress.add_task("asking", total=None)
        say = lambda text: progress.update(task, description=text[:100])  # noqa: E731
        question = ask(log, models.spec(log.robot), args.horizons, args.healthy, args.seed)
        state = json.loads(saved.read_text()) if saved.exists() else None
        result = workflow.discover(question.problem, saved=state, save=lambda state: write_json(saved, state), say=say)
    spec = models.spec(log.robot)
    summary = summarise(question, result)
    free = free_runs(log, question, result)
    write_json(
        args.out / "summary.json", summary | {"seconds": time.monotonic() - began, "versions": checkpoint.versions()}
    )
    write_json(args.out / "details.json", as_json(details(question, result, free)))
    corrected.save(args.out / "model", spec, question.rig, (result.residual or result.fit).vector)
    discovery_report.write(args.out / "report.html", log, question, result, summary, free)
    discovery_report.show(console, summary, result, free)


def gathered(folders: tuple[Path, ...]) -> Log:
    """One log of several.

    Raises:
      ValueError: they are not of one robot, or its base is free.
    """
    logs = [
        read(folder) if (folder / "meta.yaml").exists() or not _xl330(folder) else read_xl330(folder)
        for folder in folders
    ]
    if not logs:
        raise ValueError("logs: got none, expected one or more")
    first = logs[0]
    for folder, log in zip(folders, logs, strict=True):
        if log.base != "fixed":
            raise ValueError(f"{folder}: base: got '{log.base}', expected 'fixed': hang or clamp the robot")
        if log.joints != first.joints:
            raise ValueError(f"{folder}: joints: got {log.joints}, expected {first.joints}")
        if models.spec(log.robot).to_xml() != models.spec(first.robot).to_xml():
            raise ValueError(f"{folder}: robot: got {log.robot}, expected the same model as {first.robot}")
    if len(logs) == 1:
        return first
    runs = tuple(replace(run, name=f"{run.name}_{number}") for number, log in enumerate(logs) for run in log.runs)
    return replace(first, runs=runs)


def _xl330(folder: Path) -> bool:
    return any(folder.glob("*.json"))


def summarise(question: Question, result: Result) -> dict:
    """What `summary.json` says; times and versions apart."""
    effects, changes = [], []
    for term in result.terms:
        nominal = question.problem.is_nominal(term.hypothesis)
        (changes if nominal else effects).append(
            _effect(question, term.hypothesis, result.fit, result.errors, term.confusable_with)
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
                "hypothesis": term.hypothesis.key,
                "evidence": term.evidence,
                "thresholds": term.thresholds,
                "confusable_with": term.confusable_with,
            }
            for term in result.terms
        ],
        "rejected": result.rejected,
        "where": result.where,
        "needs_torque": result.needs_torque,
        "not_finite": result.not_finite,
        "proof": result.proof,
        "free_run_error_rad": free["error_rad"],
        "free_runs": [{name: run[name] for name in ("run", "split", "error_rad")} for run in free["runs"]],
    }


if __name__ == "__main__":
    run(main, Args)
