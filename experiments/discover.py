"""Names what a model lacks, from measured logs: `python -m experiments.discover --logs LOG [LOG ...] --out DIR`.

It finds where simulation and measurement disagree, names the missing effect and adds it to the model. Then it measures
on held-out runs how much smaller the error has become. It may also answer that nothing is missing, or that something is
missing that it cannot name.
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
    """Finds which effect a robot's model lacks, from measured logs of the robot, suspended or clamped."""

    logs: tuple[Path, ...]
    """Folders of logs of one robot. A folder with the JSON files of the XL330 pendulum (github.com/Rhoban/bam) is read
    too."""
    out: Path = Path("runs/discover")
    """Folder of the results. The same command with the same folder continues after the last accepted effect."""
    horizons: tuple[float, ...] = HORIZONS_S
    """Three increasing lengths in s. Runs are cut into segments of each length, which are simulated from their measured
    first state."""
    healthy: int = 20
    """Number of null logs: simulated logs in which no effect is missing. They set the noise floor and the
    thresholds."""
    seed: int = 0
    """Random seed of the null logs."""


def main(args: Args) -> None:
    """Reads the logs, runs the discovery, prints its verdict, and writes summary, details, model and report.

    Raises:
      ValueError: an option is wrong, a log cannot be used, or the folder holds another run.
    """
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
        raise ValueError(f"horizons: got {args.horizons}, expected three increasing lengths in s, all above zero")
    if args.healthy < 2:
        raise ValueError(f"healthy: got {args.healthy}, expected 2 or more")


if __name__ == "__main__":
    run(main, Args)
