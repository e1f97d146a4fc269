"""Names what a model lacks, from measured logs: `python -m experiments.discover --logs LOG [LOG ...] --out DIR`.

It finds where simulation and measurement disagree, names the missing effect, adds it to the model, and shows on runs
that nothing was fitted to what that is worth. Or it says that nothing is missing, or something without a name.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path

from envs import corrected
from experiments.common import checkpoint
from experiments.common.checkpoint import write_json
from experiments.common.cli import bars, console, run
from experiments.discovery import report
from experiments.discovery.setup import HORIZONS_S, build_question, read_logs
from experiments.discovery.summary import details, free_runs, summarise
from jaxtune.discovery import workflow


@dataclass(frozen=True, kw_only=True)
class Args:
    """Finds what a model lacks, from measured logs of the robot, suspended or clamped."""

    logs: tuple[Path, ...]
    """Folders of logs of one robot; a folder of the XL330 pendulum's JSON files will do as well."""
    out: Path = Path("runs/discover")
    """Folder of the results; the same command with the same folder goes on after the last accepted effect."""
    horizons: tuple[float, ...] = HORIZONS_S
    """Lengths in s of the segments that are simulated: three, rising."""
    healthy: int = 20
    """Number of simulated null logs, in which nothing is missing. They set the noise floor and the thresholds."""
    seed: int = 0
    """Seed of everything random."""


def main(args: Args) -> None:
    """Builds the question, discovers, and writes summary, details, model and page."""
    checkpoint.set_up_compiler(checkpoint.a_device_a_core())
    began = time.monotonic()
    _check(args)
    log, spec = read_logs(args.logs)
    identity = {"logs": [str(path) for path in args.logs], "horizons": args.horizons, "healthy": args.healthy}
    checkpoint.open_run(args.out, identity | {"seed": args.seed})
    saved = args.out / "state.json"
    with bars() as progress:
        task = progress.add_task("simulating null logs", total=None)
        question = build_question(log, spec, args.horizons, args.healthy, args.seed)
        result = workflow.discover(
            question.problem,
            saved=json.loads(saved.read_text()) if saved.exists() else None,
            save=lambda state: write_json(saved, state),
            say=lambda text: progress.update(task, description=text[:100]),
        )
    summary, free = summarise(question, result), free_runs(log, question, result)
    evidence = details(question, result, free)
    seconds = {"seconds": time.monotonic() - began, "versions": checkpoint.versions()}
    write_json(args.out / "summary.json", summary | seconds)
    write_json(args.out / "details.json", evidence)
    corrected.save(args.out / "model", spec, question.rig, (result.residual or result.fit).vector)
    report.show(console, question, summary, free)
    report.write(args.out / "report.html", log, question, result, summary, free)


def _check(args: Args) -> None:
    if len(args.horizons) != 3 or sorted(set(args.horizons)) != list(args.horizons) or args.horizons[0] <= 0:
        raise ValueError(f"horizons: got {args.horizons}, expected three lengths that rise")
    if args.healthy < 2:
        raise ValueError(f"healthy: got {args.healthy}, expected 2 or more")


if __name__ == "__main__":
    run(main, Args)
