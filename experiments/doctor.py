"""Finds probable errors in a log before anything is learnt from it: `python -m experiments.doctor --log LOG`.

It reports suspicions, never certainties: which change of order, sign, unit, offset or delay would make the log agree
much better with itself and with the robot's model. `envs.diagnosis` holds the tests.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from envs.diagnosis import diagnose_log, shared_findings
from envs.logs import read_any
from experiments.common import checkpoint, files, plots
from experiments.common.cli import console, run


@dataclass(frozen=True, kw_only=True)
class Args:
    """Looks in a log for swapped joints, flipped signs, degrees in the place of radians, offsets, delays and clock
    errors."""

    log: Annotated[Path, tyro.conf.arg(aliases=["--logs"])]
    """Folder of the log, with its meta.yaml; or of the JSON files of the XL330 pendulum."""
    robot: Path | None = None
    """MJCF of the robot, in the place of the log's own model. It may be anywhere; a log's own must be in its folder."""
    out: Path | None = None
    """Folder of doctor.json and doctor.png; runs/doctor/NAME_OF_THE_LOG if not given."""


def main(args: Args) -> None:
    """Reads the log, prints what is suspected, and writes doctor.json and a plot of the run with most suspicions.

    Raises:
      ValueError: the log is damaged and cannot be read.
    """
    log = read_any(args.log, args.robot)
    out = args.out or Path("runs/doctor") / args.log.resolve().name
    checkpoint.check_writable(out)
    with console.status(f"looking for errors in {len(log.runs)} runs"):
        found = diagnose_log(log)
    said = shared_findings(found)
    files.write_json(
        out / "doctor.json",
        {"log": args.log, "runs": {name: [asdict(one) for one in findings] for name, findings in found.items()}},
    )
    worst = max(log.runs, key=lambda one: len(found[one.name]))
    plots.suspicions(out / "doctor.png", worst, log.joints, [one.sentence for one in found[worst.name]])
    for note in log.notes:
        console.print(note, highlight=False, markup=False)
    if not said:
        console.print(f"nothing is suspected in {len(log.runs)} run(s); plot in {out}", markup=False)
        return
    table = Table("what is suspected", "runs", title=escape(str(args.log)))
    for finding, names in said:
        table.add_row(escape(finding.sentence), f"{len(names)} of {len(log.runs)}: {escape(', '.join(names[:3]))}")
    console.print(table)
    console.print(f"plot of {worst.name} in {out}", markup=False)


if __name__ == "__main__":
    run(main, Args)
