"""Summaries, closing tables and pages."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import jinja2
import numpy as np
from rich.console import Console
from rich.table import Table

from envs import domain
from jaxtune import dist as dists
from jaxtune.tuner import Info
from jaxtune.types import ParamDist, Verdict


def render(name: str, **values) -> str:
    """A page of a template of this folder; text that comes from a log is escaped."""
    folder = jinja2.FileSystemLoader(Path(__file__).parent)
    pages = jinja2.Environment(loader=folder, autoescape=True, undefined=jinja2.StrictUndefined)
    return pages.get_template(name).render(**values)


def tuning(info: Info) -> dict:
    """What happened in a tuning, for JSON: every call of the gate, and the update by parameter, in radii."""
    calls = int(info.calls)
    order = dists.names(info.dist)
    gate = {name: np.asarray(value)[:calls] for name, value in info.gate.items()}
    update = {
        name: dict(zip(order, np.asarray(info.update[name]).tolist(), strict=True))
        for name in ("step", "interval", "identifiable")
    }
    return {
        "verdicts": [Verdict(int(verdict)).name.lower() for verdict in info.verdicts[:calls]],
        "radius": np.asarray(info.radius)[:calls],
        **gate,
        **update,
        "spm_loss": float(info.update.loss),
        "measured_falls": int(info.measured_falls),
        "not_finite": int(info.not_finite),
        "training": {name: float(np.mean(value)) for name, value in info.train.items()},
    }


def moved(entries: Mapping[str, domain.Entry], before: ParamDist, after: ParamDist, info: Info) -> dict[str, dict]:
    """What a tuning did to every parameter, in physical values by name.

    `low` and `high` are ends of the interval that held-out sets have calibrated; nan where nothing was accepted, and
    where it reaches past what was simulated, of which they say nothing.
    """
    update = info.update
    low, high = dists.normalised_box(info.dist)
    inside = (update.step - update.interval >= low) & (update.step + update.interval <= high)
    half = dists.ravel(info.dist.radius) * jnp.where(inside, update.interval, jnp.nan)
    half = dists.unravel(dists.names(after), half)
    ends = {
        "before": before.centre,
        "after": after.centre,
        "low": {name: centre - half[name] for name, centre in after.centre.items()},
        "high": {name: centre + half[name] for name, centre in after.centre.items()},
    }
    found = {end: domain.from_coordinates(entries, values) for end, values in ends.items()}
    return {name: {end: float(values[name]) for end, values in found.items()} for name in after.centre}


def sim2sim(args, results: dict[str, list[dict]], off: Sequence[str]) -> dict:
    """The summary of a run; `falls_in_target` counts falls in the closing evaluation, `measured_falls` while
    measuring."""
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
            "real_episodes": [run["measured_episodes"] for run in runs],
            "falls_in_target": [line["falls"] for line in last],
            "measured_falls": [sum(line["measured_falls"] for line in lines) for lines in calls],
            "not_finite": [sum(line["not_finite"] for line in lines) for lines in calls],
        }
        seconds[name] = [line["seconds"] for line in last]
    return {
        "case": args.case,
        "start": args.start,
        "preset": args.preset,
        "seeds": args.seeds,
        "off": list(off),
        "methods": methods,
        "seconds": seconds,
    }


def print_sim2sim(console: Console, summary: dict, results: dict[str, list[dict]]) -> None:
    """Two tables: the methods side by side, and what became of each parameter."""
    start = f", start {summary['start']:g}X" if summary["off"] else ""
    table = Table(title=f"case {summary['case']}{start}, mean over {summary['seeds']} seed(s)")
    for column in (
        "method",
        "return in target",
        "falls",
        "parameter error",
        "gate calls",
        "target episodes",
        "s",
    ):
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
    console.print(table)

    table = Table(title="|estimate / truth - 1| at the end (not identifiable in the last tuning: ~)")
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
    table.caption = "* off at the start" if summary["off"] else "truth is nominal; what is off is not among them"
    console.print(table)
