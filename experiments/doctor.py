"""Says what is wrong with a log before anything is learnt from it: `python -m experiments.doctor --log LOG`."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from envs import models
from envs.diagnosis import Finding, diagnose
from envs.logs import Log, read
from envs.rig import hung
from experiments import checkpoint, plots
from experiments.train import console, run


@dataclass(frozen=True, kw_only=True)
class Args:
    """Looks for swapped joints, turned signs, wrong units, offsets, delays, and a clock that is off."""

    log: Path
    """Folder of the log."""
    out: Path | None = None
    """Folder of doctor.json and doctor.png; the log's own name in runs/doctor where not given."""


def examine(log: Log) -> dict[str, list[Finding]]:
    """What is suspected, by run; a run in which nothing is has an empty list."""
    spec = models.spec(log.robot)
    model = hung(spec) if log.base == "fixed" else spec.compile()
    return {one.name: diagnose(one, log.joints, model, log.base) for one in log.runs}


def summary(found: dict[str, Sequence[Finding]]) -> list[tuple[Finding, list[str]]]:
    """Every suspicion once, in the words of its first finding, and the runs that share it, the most common first."""
    shared: dict[tuple, tuple[Finding, dict[str, int]]] = {}
    for name, findings in found.items():
        for finding in findings:
            times = shared.setdefault((finding.kind, finding.signal, finding.joints), (finding, {}))[1]
            times[name] = times.get(name, 0) + 1
    names = lambda times: [name if count == 1 else f"{name} ({count} times)" for name, count in times.items()]  # noqa: E731
    return [(one, names(times)) for one, times in sorted(shared.values(), key=lambda one: -len(one[1]))]


def main(args: Args) -> None:
    """Reads, examines, prints and draws."""
    log = read(args.log)
    out = args.out or Path("runs/doctor") / args.log.resolve().name
    found = examine(log)
    said = summary(found)
    out.mkdir(parents=True, exist_ok=True)
    checkpoint.write_json(
        out / "doctor.json",
        {"log": args.log, "runs": {name: [asdict(one) for one in findings] for name, findings in found.items()}},
    )
    worst = max(log.runs, key=lambda one: len(found[one.name]))
    plots.suspicions(out / "doctor.png", worst, log.joints, [one.sentence for one in found[worst.name]])
    if not said:
        console.print(f"nothing is suspected in {len(log.runs)} run(s); picture in {out}")
        return
    table = Table("what is suspected", "runs", title=escape(str(args.log)))
    for finding, names in said:
        table.add_row(escape(finding.sentence), f"{len(names)} of {len(log.runs)}: {', '.join(names[:3])}")
    console.print(table)
    console.print(f"picture of {worst.name} in {out}")


if __name__ == "__main__":
    run(main, Args)
