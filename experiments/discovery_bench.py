"""Measures blind how often discovery is right: `python -m experiments.discovery_bench --size smoke --out DIR`.

It hides an effect in a robot that another engine moves, writes a log as a user would and the truth into a folder that
only the scorer reads, has discovery work on the log and the nominal model, and scores what it says. Every case is a
file of its own: the same command goes on where it stopped, and `--piece 0/2` and `--piece 1/2` share the work between
two processes.
"""

from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from experiments.common import checkpoint
from experiments.common.cli import console, run
from experiments.discovery.blind_bench import Bench
from experiments.discovery.blind_cases import SIZES
from experiments.discovery.scores import shown


@dataclass(frozen=True, kw_only=True)
class Args:
    """Hides effects in simulated robots, has discovery look for them, and counts how often it is right."""

    out: Path = Path("runs/discovery_bench")
    """Folder of the cases and the scores."""
    size: str = "smoke"
    """smoke, arm, standard or full."""
    seed: int = 0
    """Seed of everything random."""
    nominal_error: float = 0.1
    """By how much nominal parameters are wrong: half of it to one and a half times it; gains by a third of that."""
    piece: str = "0/1"
    """Which share of the cases to work on."""


def main(args: Args) -> None:
    """Answers this piece's cases, and scores all that are answered."""
    checkpoint.set_up_compiler(checkpoint.a_device_a_core())
    if args.size not in SIZES:
        raise ValueError(f"size: got '{args.size}', expected one of {', '.join(SIZES)}")
    number, _, pieces = args.piece.partition("/")
    if not (number.isdigit() and pieces.isdigit() and int(number) < int(pieces)):
        raise ValueError(f"piece: got '{args.piece}', expected '0/1', '0/2', '1/2', ...")
    identity = {"size": args.size, "seed": args.seed, "nominal_error": args.nominal_error}
    checkpoint.open_run(args.out, identity)
    bench = Bench(args.out, args.size, args.seed, args.nominal_error)
    cases = bench.cases[int(number) :: int(pieces)]
    for done, case in enumerate(cases, start=1):
        answer = bench.answer(case)
        names = ", ".join(effect["name"] for effect in [*answer["effects"], *answer["parameter_changes"]])
        console.print(
            f"{done}/{len(cases)} case {case.number}: {answer['verdict']} {names} ({answer['seconds']:.0f} s)"
        )
        bench.report(identity)
    table = Table("measure", "value", "95 % interval", "cases", "to reach")
    for cells in shown(bench.report(identity)):
        table.add_row(*cells)
    console.print(table)


if __name__ == "__main__":
    run(main, Args)
