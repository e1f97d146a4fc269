"""Counts how well robots of other projects are tuned: `python -m experiments.robots_bench --out DIR`.

Each robot is tuned to itself with hidden parameters, a few tunings long, with a policy that stays as it is. Hidden
parameters are drawn per seed without regard to the first box, so that some lie outside it.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
from rich.table import Table

from experiments.common import checkpoint, compiler, plots
from experiments.common.cli import bars, console, run
from experiments.common.config import Preset, preset
from experiments.common.files import read_json, write_json
from experiments.walking import foreign
from experiments.walking.cases import check_positive, check_seeds
from jaxtune import dist as dists
from jaxtune import pooling
from jaxtune.mjx import parameters
from jaxtune.tuner import TunerState, knobs
from jaxtune.types import Verdict

FACTORS = (0.6, 1.5)
"""Hidden multipliers are drawn between these, evenly in log space."""
GROUPS = {
    "in_box": "in the first box",
    "in_box_identifiable": "in the first box, and identifiable in some tuning",
    "outside": "outside the first box",
}
"""Groups of parameters that are summarised, with what a table calls them."""
_DELAY_S = 0.02  # largest hidden delay, in s
_UPDATES = 400  # of PPO, for a policy of the sizes `cpu` and `gpu`


@dataclass(frozen=True, kw_only=True)
class Args:
    """Tunes robots of MuJoCo Playground, Brax and Gymnasium to themselves with other parameters."""

    out: Path = Path("runs/robots_bench")
    """Folder of the results. The same command with the same folder continues where it was."""
    robots: tuple[str, ...] = tuple(foreign.PACKAGES)
    """Robots: cheetah (MuJoCo Playground), hopper (Brax), half_cheetah (Gymnasium)."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Random seeds of each robot; hidden parameters, episodes and models depend on them."""
    tunings: int = 3
    """Tunings of each run; each measures new episodes."""
    radius: float = 0.3
    """First radius in log space: 0.3 spans 0.74 to 1.35 times nominal."""
    preset: str = "cpu"
    """Size of the run: smoke (minutes, to see that it works), cpu (two cores) or gpu (one GPU)."""


def draw(world: foreign.World, seed: int) -> dict[str, float]:
    """Draws hidden physical values by name."""
    rng = np.random.default_rng(seed)
    return {
        name: float(np.exp(rng.uniform(*np.log(FACTORS))) if entry.log else rng.uniform(0.0, _DELAY_S))
        for name, entry in world.entries.items()
    }


def errors(world: foreign.World, found: dict[str, float], truth: dict[str, float]) -> dict[str, float]:
    """Computes errors in coordinates by name: of a multiplier, of its logarithm."""
    found, truth = (parameters.to_coords(world.entries, values) for values in (found, truth))
    return {name: abs(float(found[name]) - float(truth[name])) for name in truth}


def tuned(world: foreign.World, args: Args, policy, seed: int) -> dict:
    """Runs the tunings of one seed.

    Returns:
      Hidden values, whether they lie in the first box, and for every tuning its verdict, gate calls, seconds, and by
      name the estimate, error, end points of the box and whether the parameter was identifiable.
    """
    truth = draw(world, seed)
    first = parameters.distribution(world.entries, args.radius, {})
    state = TunerState(policy=policy, dist=first, knobs=knobs(), past=pooling.nothing(first))
    before = errors(world, parameters.nominal(world.entries), truth)
    radius = {name: float(value) for name, value in first.radius.items()}
    lines = []
    for index in range(args.tunings):
        key_measure, key_tune = jax.random.split(jax.random.fold_in(jax.random.PRNGKey(seed), index))
        measured = world.measure(key_measure, policy, truth)
        begin = time.monotonic()
        state, info = jax.block_until_ready(world.tune(key_tune, state, measured))
        seconds = time.monotonic() - begin
        low, high = (parameters.from_coords(world.entries, ends) for ends in dists.box(state.dist))
        estimate = parameters.from_coords(world.entries, state.dist.centre)
        verdict = Verdict(int(info.verdicts[int(info.calls) - 1]))
        told = info.update.identifiable if verdict == Verdict.ACCEPT else np.zeros(len(truth), bool)
        lines.append(
            {
                "verdict": verdict.name.lower(),
                "calls": int(info.calls),
                "seconds": seconds,
                "estimate": estimate,
                "error": errors(world, estimate, truth),
                "low": low,
                "high": high,
                "identifiable": dict(zip(dists.names(state.dist), map(bool, told), strict=True)),
            }
        )
    in_box = {name: before[name] <= radius[name] for name in truth}
    return {"seed": seed, "truth": truth, "in_first_box": in_box, "error_before": before, "tunings": lines}


def summary(results: list[dict]) -> dict:
    """Summarises the seeds of one robot.

    Returns:
      For parameters inside the first box, outside it, and inside and called identifiable by the last update: their
      number, and the median error before and after. Then counts of the verdicts, and seconds of a tuning.
    """

    def group(keep) -> dict:
        pairs = [
            (one["error_before"][name], one["tunings"][-1]["error"][name])
            for one in results
            for name in one["truth"]
            if keep(one, name)
        ]
        before, after = np.median(pairs, axis=0) if pairs else (np.nan, np.nan)
        return {"parameters": len(pairs), "before": float(before), "after": float(after)}

    def excited(one, name):
        return any(line["identifiable"][name] for line in one["tunings"])

    lines = [line for one in results for line in one["tunings"]]
    verdicts = [line["verdict"] for line in lines]
    held = [
        line["low"][name] <= one["truth"][name] <= line["high"][name]
        for one in results
        for line in one["tunings"][-1:]
        for name in one["truth"]
    ]
    return {
        "in_box": group(lambda one, name: one["in_first_box"][name]),
        "in_box_identifiable": group(lambda one, name: one["in_first_box"][name] and excited(one, name)),
        "outside": group(lambda one, name: not one["in_first_box"][name]),
        "truth_in_last_box": float(np.mean(held)),
        "verdicts": {name: verdicts.count(name) for name in sorted(set(verdicts))},
        "gate_calls": [line["calls"] for line in lines],
        "first_tuning_s": results[0]["tunings"][0]["seconds"],
        "later_tuning_s": float(np.median([line["seconds"] / line["calls"] for line in lines[1:]])),
    }


def results_of(args: Args, sizes: Preset, name: str) -> list[dict]:
    """Runs the seeds of one robot, or reads those that an earlier call has run."""
    place = args.out / name
    paths = {seed: place / f"seed_{seed}.json" for seed in args.seeds}
    missing = {seed: path for seed, path in paths.items() if not path.exists()}
    if missing:
        world = foreign.world(name, sizes)
        policy = world.policy(place)
        with bars() as progress:
            for seed, path in progress.track(missing.items(), description=name):
                write_json(path, tuned(world, args, policy, seed))
    return [read_json(path) for path in paths.values()]


def show(summaries: Mapping[str, dict]) -> None:
    """Prints what `summary` found of every robot as two tables: errors, and verdicts with seconds."""
    table = Table("robot", "parameters", "number", "median error before", "after")
    for name, found in summaries.items():
        for group in GROUPS:
            row = found[group]
            table.add_row(name, GROUPS[group], str(row["parameters"]), f"{row['before']:.3f}", f"{row['after']:.3f}")
    console.print(table)
    table = Table(
        "robot", "verdicts", "gate calls a tuning", "first tuning, s", "later gate call, s", "truth in last box"
    )
    for name, found in summaries.items():
        verdicts = ", ".join(f"{verdict} {count}" for verdict, count in found["verdicts"].items())
        numbers = np.mean(found["gate_calls"]), found["first_tuning_s"], found["later_tuning_s"]
        table.add_row(name, verdicts, *[f"{number:.1f}" for number in numbers], f"{found['truth_in_last_box']:.2f}")
    console.print(table)


def main(args: Args) -> None:
    """Runs what is missing in the folder, prints a table, and writes summary.json and errors.png.

    Raises:
      ValueError: an option is wrong, or a robot's package is not installed.
    """
    for name in args.robots:
        foreign.check(name)
    check_seeds(args.seeds)
    check_positive(tunings=args.tunings, radius=args.radius)
    sizes = preset(args.preset)
    sizes = replace(sizes, scratch_updates=min(sizes.scratch_updates, _UPDATES))
    compiler.set_up(sizes.xla_flags)
    checkpoint.open_run(args.out, {"radius": args.radius, "tunings": args.tunings, "preset": args.preset})
    with checkpoint.lock(args.out / "summary.json"):
        results = {name: results_of(args, sizes, name) for name in args.robots}
        summaries = {name: summary(each) for name, each in results.items()}
        write_json(args.out / "summary.json", {"args": args, "robots": summaries, "versions": checkpoint.versions()})
        plots.recovery(args.out / "errors.png", results)
    show(summaries)


if __name__ == "__main__":
    run(main, Args)
