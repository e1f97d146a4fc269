"""Counts how often discovery is right, in a blind test: `python -m experiments.discovery_bench --size smoke --out DIR`.

For every case it hides an effect in a robot that another engine simulates, and writes a log as a user would. The truth
goes into a folder that only the scorer reads. Discovery gets the log and the nominal model, and its answer is scored.
Every case is a file of its own, so the same command continues where it stopped. `--piece 0/2` and `--piece 1/2` share
the work between two processes.
"""

from dataclasses import dataclass
from pathlib import Path

import jax
from rich.table import Table

from experiments.common import checkpoint, compiler
from experiments.common.cli import bars, console, run
from experiments.discovery.blind_bench import Bench
from experiments.discovery.blind_cases import SIZES
from experiments.discovery.field.bench import FieldBench
from experiments.discovery.field.cases import FIELD_SIZES
from experiments.discovery.scores import shown

_KEPT = 16  # cases after which compiled programs are dropped: those of 90 robots need more memory maps than Linux gives


@dataclass(frozen=True, kw_only=True)
class Args:
    """Hides effects in simulated robots, lets discovery look for them, and counts how often it is right."""

    out: Path = Path("runs/discovery_bench")
    """Folder of the cases and the scores."""
    size: str = "smoke"
    """Cases: smoke (6 two-joint arms, to see that it works), arm (75 arms, an hour), standard (98 BITenos, a night on a
    CPU) or full (BITenos with longer logs, for a GPU or a few nights). In field (184 cases, 6 hours on two cores) every
    case is another robot, in one of three engines; field_smoke is six of them. In field_wandering (24 cases) nothing is
    missing, but frictions differ from run to run. In field_late (24 cases) rows are stamped late."""
    seed: int = 0
    """Random seed of the cases, their places, sizes and wrong parameters."""
    nominal_error: float = 0.1
    """Relative error of the nominal parameters. Each is wrong by 0.5 to 1.5 times this, up or down; gains by a third of
    that."""
    write_only: bool = False
    """Write the logs of the cases, and answer none."""
    limit: int = 0
    """Number of cases to work on, the first ones of the seed; 0 for all."""
    piece: str = "0/1"
    """Share of the cases to work on, as NUMBER/COUNT: 0/2 and 1/2 in two processes make all."""


def main(args: Args) -> None:
    """Lets discovery answer the cases of this piece, and scores all cases that are answered.

    Raises:
      ValueError: an option is wrong, or the folder holds another benchmark.
    """
    compiler.set_up(compiler.for_simulation())
    if args.size not in (*SIZES, *FIELD_SIZES):
        raise ValueError(f"size: got '{args.size}', expected one of {', '.join((*SIZES, *FIELD_SIZES))}")
    number, _, pieces = args.piece.partition("/")
    if not (number.isdigit() and pieces.isdigit() and int(number) < int(pieces)):
        raise ValueError(f"piece: got '{args.piece}', expected '0/1', '0/2', '1/2', ...")
    identity = {"size": args.size, "seed": args.seed, "nominal_error": args.nominal_error}
    checkpoint.open_run(args.out, identity)
    made = FieldBench if args.size in FIELD_SIZES else Bench
    bench = made(args.out, args.size, args.seed, args.nominal_error)
    cases = bench.cases[: args.limit or None][int(number) :: int(pieces)]
    # Those of an earlier call take no time, and would spoil the pace by which time is foretold.
    cases = [case for case in cases if args.write_only or bench.answered(case) is None]
    with bars() as progress:
        for done, case in enumerate(progress.track(cases, description="cases"), start=1):
            if args.write_only:
                console.print(f"{done}/{len(cases)} {bench.write(case)}", markup=False)
                continue
            answer = bench.answer(case)
            names = ", ".join(effect["name"] for effect in [*answer["effects"], *answer["parameter_changes"]])
            console.print(
                f"{done}/{len(cases)} case {case.number}: {answer['verdict']} {names} ({answer['seconds']:.0f} s)"
            )
            bench.report(identity)
            if done % _KEPT == 0:
                jax.clear_caches()
    if args.write_only:
        return
    table = Table("measure", "value", "95 % interval", "cases", "to reach")
    for cells in shown(bench.report(identity)):
        table.add_row(*cells)
    console.print(table)


if __name__ == "__main__":
    run(main, Args)
