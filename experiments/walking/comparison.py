"""Compares the tuning methods of the paper's section IV-B: sets them up, summarises their runs, prints tables."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from envs.targets.protocol import Target
from experiments.walking.learner import Learner, Policy
from jaxtune import baselines, conformal
from jaxtune.baselines import Untuned
from jaxtune.mjx import parameters
from jaxtune.settings import UNEXPLAINED
from jaxtune.tuner import Tuner
from jaxtune.types import ParamDist

METHODS = ("ours", "spm", "dr", "oracle")
"""`ours` (gate and posterior update), `spm` (the paper's update without the gate), `dr` (wide domain randomisation,
never tuned) and `oracle` (trained with the target's own parameters)."""

UPDATES: dict[str, Callable[[Tuner], Tuner]] = {"posterior": lambda machine: machine, "vote": baselines.voting}
"""What makes a tuner move the distribution in a way, by the name that `--update` takes."""


@dataclass(frozen=True)
class Contender:
    """One method of a comparison, ready to run.

    All methods are the same tuner. They differ in its functions, the policy that they start with, or the distribution.
    """

    tuner: Tuner | Untuned
    policy: Policy
    dist: ParamDist
    sets: int
    """Measured sets that the method uses up in a tuning: one, or zero if it is never tuned."""


def contenders(
    learner: Learner, target: Target, policy: Policy, *, radius: float, dr_radius: float, update: str
) -> dict[str, Contender]:
    """Makes the four methods over one learner and one target.

    Args:
      learner: BITeno's side of the tuner.
      target: what is tuned to. Only `oracle` uses its parameters; the others see episodes.
      policy: what every method starts with.
      radius: first radius of `ours` and `spm`, in coordinates.
      dr_radius: radius of domain randomisation, in coordinates.
      update: one of `UPDATES`, for `ours`.

    Returns:
      Contenders by the names in `METHODS`.
    """
    nominal = parameters.nominal(learner.entries)
    machine = learner.tuner(target)
    untuned = Untuned(tuner=machine)
    start = learner.dist(nominal, radius)
    truth = {name: target.params[name] for name in nominal}
    # Domain randomisation trains on all of its distribution, while the other policies train on a narrow part of theirs.
    wide = policy.replace(radius=jnp.full_like(policy.radius, dr_radius))
    # Values that nobody tunes (a weak motor) are part of the truth too.
    knowing = policy.replace(
        hidden={name: jnp.full_like(value, target.params[name]) for name, value in policy.hidden.items()}
    )
    return {
        "ours": Contender(UPDATES[update](machine), policy, start, 1),
        "spm": Contender(baselines.spm(machine), policy, start, 1),
        "dr": Contender(untuned, wide, learner.dist(nominal, dr_radius), 0),
        "oracle": Contender(untuned, knowing, learner.dist(truth, learner.preset.policy_radius), 0),
    }


def summarise(settings: Mapping[str, object], results: dict[str, list[dict]], off: Sequence[str]) -> dict:
    """Summarises a run for `summary.json`.

    `falls_in_target` counts falls in the evaluation after the last tuning. `measured_falls` counts those in the
    measured episodes: with a real robot they would be the price of tuning.

    Args:
      settings: `case`, `start`, `preset` and `seeds` of the run.
      results: what `experiments.sim2sim.Runner` returned, by method and seed.
      off: names of the tuned parameters whose true value is not nominal.

    Returns:
      Lists over seeds by method, `seconds` by method, and the settings.
    """
    methods, seconds = {}, {}
    for name, runs in results.items():
        first, last = ([run["lines"][end] for run in runs] for end in (0, -1))
        names = list(first[0]["param_error"])
        calls = [[line for line in run["lines"] if "verdicts" in line] for run in runs]
        methods[name] = {
            "return_start": [line["return"] for line in first],
            "return_end": [line["return"] for line in last],
            "param_names": names,
            "param_error_start": [[line["param_error"][p] for p in names] for line in first],
            "param_error_end": [[line["param_error"][p] for p in names] for line in last],
            **{
                field: [[value for line in lines for value in line[field]] for lines in calls]
                for field in ("radius", "novelty", "threshold", "p_value", "verdicts")
            },
            # Of all sets of a run together. Files have None for nan, which becomes nan again.
            "misfit_p_value": [
                float(conformal.together(np.array([line.get("misfit_p_value") for line in lines], float)))
                for lines in calls
            ],
            "real_episodes": [run["measured_episodes"] for run in runs],
            "falls_in_target": [line["falls"] for line in last],
            "measured_falls": [sum(line["measured_falls"] for line in lines) for lines in calls],
            "not_finite": [sum(line["not_finite"] for line in lines) for lines in calls],
        }
        seconds[name] = [line["seconds"] for line in last]
    return {**settings, "off": list(off), "methods": methods, "seconds": seconds}


def show(console: Console, summary: dict, results: dict[str, list[dict]]) -> None:
    """Prints two tables, the methods side by side and the error of every parameter after the last tuning.

    Where the sets of a run fit badly together, it says so.

    Args:
      console: where they are printed.
      summary: of `summarise`.
      results: what `summary` was made of.
    """
    console.print(_methods_table(summary))
    console.print(_parameters_table(summary, results))
    for name, method in summary["methods"].items():
        for seed, p_value in zip(summary["seeds"], method["misfit_p_value"], strict=True):
            if p_value <= UNEXPLAINED:
                console.print(
                    f"{name}, seed {seed}: the sets of all tunings together fit worse than simulated ones "
                    f"(p {p_value:.1g}): something differs that is not tuned, and estimates make up for it",
                    highlight=False,
                )


def _methods_table(summary: dict) -> Table:
    start = f", start {summary['start']:g}X" if summary["off"] else ""
    what = f"truth {', '.join(summary['truth'])}" if summary["truth"] else f"case {summary['case']}{start}"
    table = Table(title=f"{what}, mean over {len(summary['seeds'])} seed(s)")
    columns = "method", "return in target", "falls", "parameter error", "gate calls", "target episodes", "seconds"
    for column in columns:
        table.add_column(column, justify="left" if column == "method" else "right")
    for name, method in summary["methods"].items():
        columns = [method["param_names"].index(p) for p in summary["off"] or method["param_names"]]
        error = [np.array(method[f"param_error_{end}"])[:, columns].mean() for end in ("start", "end")]
        verdicts = [verdict for seed in method["verdicts"] for verdict in seed]
        table.add_row(
            name,
            f"{np.mean(method['return_start']):.1f} -> {np.mean(method['return_end']):.1f}",
            f"{np.mean(method['falls_in_target']):.1f}",
            f"{error[0]:.3f} -> {error[1]:.3f}",
            ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(verdicts)) or "-",
            f"{np.mean(method['real_episodes']):.0f}",
            f"{np.mean(summary['seconds'][name]):.0f}",
        )
    return table


def _parameters_table(summary: dict, results: dict[str, list[dict]]) -> Table:
    table = Table(title="relative error after the last tuning (~: not identifiable in it)")
    table.add_column("parameter")
    for name in summary["methods"]:
        table.add_column(name, justify="right")
    first = next(iter(summary["methods"].values()))
    for column, parameter in enumerate(first["param_names"]):
        cells = []
        for name, method in summary["methods"].items():
            lines = [run["lines"][-1] for run in results[name]]
            unknown = any(line.get("verdicts") and not line["identifiable"][parameter] for line in lines)
            mean = np.array(method["param_error_end"])[:, column].mean()
            cells.append(f"{'~ ' if unknown else ''}{mean:.3f}")
        table.add_row(f"{parameter}{' *' if parameter in summary['off'] else ''}", *cells)
    same = "target and simulator agree in all of these: they differ in something that is not tuned"
    table.caption = "* differs from the target at the start" if summary["off"] else same
    return table
