"""What discovery tells a person: a page with its pictures in it, and two tables."""

from pathlib import Path

from rich.console import Console
from rich.table import Table

from envs.logs import Log
from experiments import plots, report
from experiments.question import Question
from jaxtune.discovery.result import Result

VERDICTS = {
    "named": "Something is missing in the model, and it has a name.",
    "parameter_change": "Nothing is missing, but a parameter is another one.",
    "no_missing_effect": "The model explains these logs down to the floor.",
    "unnamed": "Something is missing that no effect of the library explains.",
}


def write(path: Path, log: Log, question: Question, result: Result, summary: dict, free: dict) -> None:
    """Writes the page; whatever came from the log is escaped."""
    pictures = {"where": plots.heat_map(result.where), "traces": plots.traces(free["runs"], log.joints)}
    if result.terms:
        pictures["ladder"] = plots.ladder(result.terms)
    effects = [*summary["effects"], *summary["parameter_changes"]]
    page = report.render(
        "discovery_report.html",
        robot=log.robot,
        runs=len(log.runs),
        meaning=VERDICTS[summary["verdict"]],
        summary=summary,
        effects=[effect | {"sentence": question.rig.effects[effect["name"]].sentence} for effect in effects],
        notes=question.notes,
        not_testable=[
            (name, question.rig.effects[name].excited_by if name in question.rig.effects else "a free base")
            for name in summary["not_testable"]
        ],
        proof=result.proof,
        rungs=result.terms,
        rejected=result.rejected,
        free=free,
        pictures={name: plots.embedded(figure) for name, figure in pictures.items()},
    )
    path.write_text(page)


def show(console: Console, summary: dict, result: Result, free: dict) -> None:
    """Prints the verdict."""
    console.print(f"[bold]{summary['verdict']}[/bold]: {VERDICTS[summary['verdict']]}")
    table = Table("effect", "place", "value (95 % interval)", "cannot be told from", "split by")
    for effect in [*summary["effects"], *summary["parameter_changes"]]:
        values = ", ".join(
            f"{name} {value['value']:.4g} ({value['low']:.4g} to {value['high']:.4g})"
            for name, value in effect["parameters"].items()
        )
        others = ", ".join(effect["confusable_with"]) or "-"
        table.add_row(effect["name"], ", ".join(effect["places"]), values, others, effect["split_by"])
    if table.row_count:
        console.print(table)
    table = Table("sealed runs", "before", "null", "after")
    gap, error = summary["gap"], free["error_rad"]["sealed"]
    table.add_row("gap, floor units", *(f"{gap[name]:.2f}" for name in ("before", "null", "after")))
    table.add_row("error of whole runs, rad", *(f"{error[name]:.4f}" for name in ("before", "null", "after")))
    console.print(table)
    if summary["not_testable"]:
        console.print(f"these logs cannot show: {', '.join(summary['not_testable'])}")
