"""What a round tells a person: a page with its picture in it, and a table."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from experiments import plots, report
from experiments.expected import surprise, verdict
from experiments.rounds import Terms

VERDICTS = {
    "accept": "The simulator covers what was measured.",
    "unexplained": "The simulator does not cover what was measured, and a wider distribution brings it no closer: "
    "physics is missing in the model.",
    "radius_exhausted": "The simulator does not cover what was measured, and its distribution can grow no wider.",
    "not_finite": "Nothing could be compared: no walk lasted as long as a window, or a number is not finite.",
    None: "Nobody asked whether the simulator covers what was measured.",
}
_QUANTITIES = {"return": "return", "fall_rate": "share of walks that end in a fall", "power_w": "mechanical power, W"}


def write(path: Path, history: Sequence[dict], terms: Terms) -> None:
    """Writes the page of the last round; whatever came from the log is escaped."""
    line = history[-1]
    page = report.render(
        "sim2real_report.html",
        line=line,
        verdict=verdict(line),
        meaning=VERDICTS[verdict(line)],
        quantities=_QUANTITIES,
        unknown=unknown(line),
        surprise=surprise(line),
        safe=line["expected_falls"] <= terms.max_fall_rate,
        terms=terms,
        episodes=sum(one["measured"]["episodes"] for one in history),
        falls=sum(round(one["measured"]["episodes"] * one["measured"]["fall_rate"]) for one in history),
        picture=plots.embedded(plots.rounds(history)),
    )
    path.write_text(page)


def unknown(line: dict) -> list[str]:
    """Parameters of which an accepted log says no more than was known before."""
    tuning = line["tuning"]
    return [name for name, known in tuning["identifiable"].items() if not known] if verdict(line) == "accept" else []


def show(console: Console, history: Sequence[dict]) -> None:
    """Prints what the last round measured, what moved, and what is expected of the next."""
    line = history[-1]
    console.print(f"[bold]round {line['round']}: {verdict(line) or 'not asked'}[/bold]: {VERDICTS[verdict(line)]}")
    table = Table("", "predicted", "measured", "same policy, tuned simulator", "predicted of the next")
    columns = line["predicted"], line["measured"], line["tuning"]["explained"], line["next"]
    for name, label in _QUANTITIES.items():
        table.add_row(label, *(f"{column[name]:.2f}" for column in columns))
    console.print(table)
    table = Table("parameter", "before", "after", "90 % interval")
    for name, ends in line["tuning"]["moved"].items():
        interval = "-" if ends["low"] is None else f"{ends['low']:.3f} to {ends['high']:.3f}"
        note = " (not identifiable from this log)" if name in unknown(line) else ""
        table.add_row(name + note, f"{ends['before']:.3f}", f"{ends['after']:.3f}", interval)
    console.print(table)
    for one in line["measured"]["suspected"]:
        console.print(f"doctor: {one['sentence']} ({', '.join(one['runs'])})", highlight=False, markup=False)
    console.print(f"{line['expected_falls']:.0%} of the next walks are expected to end in a fall")
    if verdict(line) == "unexplained":
        console.print("hang the robot, record the log that experiments.excite writes targets for, and ask discover")
