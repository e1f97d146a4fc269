"""Names what a model lacks, from measured logs: `python -m experiments.discover --logs LOG [LOG ...] --out DIR`.

The log doctor looks at the logs first. Discovery finds where simulation and measurement disagree, names the missing
effect and adds it to the model. Then it measures on held-out runs how much smaller the error has become. It may also
answer that nothing is missing, or that something is missing that it cannot name.
"""

from dataclasses import dataclass
from pathlib import Path

from experiments.common import checkpoint, compiler
from experiments.common.cli import bars, console, run
from experiments.discovery import gate, report
from experiments.discovery.investigate import investigate
from experiments.discovery.measured import digest, read_logs
from jaxtune.discovery.workflow import share_done


@dataclass(frozen=True, kw_only=True)
class Args:
    """Finds which effect a robot's model lacks, from measured logs of the robot, suspended or clamped."""

    logs: tuple[Path, ...]
    """Folders of logs of one robot. A folder with the JSON files of the XL330 pendulum (github.com/Rhoban/bam) is read
    too."""
    robot: Path | None = None
    """MJCF of the robot, in the place of the logs' own models. It may be anywhere; a log's own must be in its
    folder."""
    out: Path = Path("runs/discover")
    """Folder of the results. The same command with the same folder continues after the last accepted effect."""
    horizons: tuple[float, ...] | None = None
    """Three increasing lengths in s. Runs are cut into segments of each length, which are simulated from their measured
    first state. Lengths that fit the rate of the rows if not given."""
    healthy: int = 20
    """Number of null logs: simulated logs in which no effect is missing. They set the noise floor and the
    thresholds."""
    seed: int = 0
    """Random seed of the null logs."""
    trust_log: bool = False
    """Go on although the log doctor suspects an error of the log that would make the answer wrong."""
    clear_flags: bool = False
    """Clear flags of the model that switch physics off; without this option such a model is refused."""
    swap_halves: bool = False
    """Fit the runs of select and sealed, and test on those of train: a second opinion from the other half of the
    log."""


def main(args: Args) -> None:
    """Reads the logs, runs the discovery, prints its verdict, and writes summary, details, model and report.

    Raises:
      ValueError: an option is wrong, a log cannot be used, or the folder holds another run or belongs to a process that
        still works there.
    """
    compiler.set_up(compiler.for_simulation())
    _check(args)
    # Says what is wrong with the logs before the folder is made and anything is compiled.
    log, spec = read_logs(args.logs, args.clear_flags, args.swap_halves, args.robot)
    with console.status(f"looking for errors in {len(log.runs)} runs"):
        notes = gate.check(log, spec, args.horizons, trust=args.trust_log)
    for note in notes:
        console.print(f"note: {note}", highlight=False, markup=False, soft_wrap=True)
    identity = {name: value for name, value in vars(args).items() if name not in ("out", "trust_log")}
    # What was read may change behind the same names, as when a sign or a gain is corrected.
    identity |= {"logs": [str(path) for path in args.logs], "read_sha256": digest(log, spec)}
    checkpoint.open_run(args.out, identity)
    with checkpoint.lock(args.out / "summary.json"), bars() as progress:
        task, said = progress.add_task("simulating null logs", total=100), []

        def follow(line: str) -> None:
            said.append(line)
            progress.update(task, description=line[:100], completed=round(100 * share_done(said)))

        answer = investigate(
            args.logs,
            args.out,
            horizons=args.horizons,
            null_logs=args.healthy,
            seed=args.seed,
            clear_flags=args.clear_flags,
            swap_halves=args.swap_halves,
            robot=args.robot,
            say=follow,
        )
        progress.update(task, completed=100)
    report.show(console, answer.question, answer.summary, answer.free)
    report.write(args.out / "report.html", answer.log, answer.question, answer.result, answer.summary, answer.free)


def _check(args: Args) -> None:
    lengths = args.horizons
    if lengths is not None and (len(lengths) != 3 or sorted(set(lengths)) != list(lengths) or lengths[0] <= 0):
        raise ValueError(f"horizons: got {lengths}, expected three increasing lengths in s, all above zero")
    if args.healthy < 2:
        raise ValueError(f"healthy: got {args.healthy}, expected 2 or more")


if __name__ == "__main__":
    run(main, Args)
