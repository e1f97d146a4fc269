"""Fits a fixed list of parameters with mujoco.sysid, for comparison: `python -m experiments.sysid_baseline --logs LOG`.

It is what a general identification tool makes of the logs that `discover` reads. Runs, splits, first states and errors
are discovery's, so the numbers can stand side by side. It needs the extra `sysid`.
"""

import itertools
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress
from rich.table import Table

from envs.logs import Log, Run, splits
from envs.segments import HISTORY_S
from experiments.common import checkpoint, files
from experiments.common.cli import bars, console, run
from experiments.discovery import playback, sysid_fit, sysid_parameters
from experiments.discovery.measured import read_logs

SEGMENTS_S = (0.15, 0.45)
"""Lengths in s of the segments on which models are compared, beside free runs."""
MEASURES = ("free_run", "segments")
"""What a fit may be chosen by on the validation runs: the error of free runs, or of the longest segments."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Fits parameters of a robot's model with mujoco.sysid and measures errors on held-out runs."""

    logs: tuple[Path, ...]
    """Folders of logs of one robot, as `discover` takes them."""
    robot: Path | None = None
    """MJCF of the robot, in the place of the logs' own models."""
    out: Path = Path("runs/sysid_baseline.json")
    """File of the results."""
    subsets: tuple[str, ...] = ("joints", "actuators", "sensing", "masses")
    """Subsets of parameters to fit (of joints, actuators, sensing, masses, inertia), each starting from the fit of the
    one before. The validation runs choose."""
    horizons: tuple[float, ...] = (0.45, 8.0)
    """Lengths in s of the pieces that are fitted; a longer one than the shortest run is cut to it."""
    weights: tuple[float, ...] = (0.001,)
    """Weights of the distance from the nominal parameters."""
    train_s: float = 60.0
    """Seconds of training data that are fitted, in pieces at even distances."""
    iterations: int = 10
    """Largest number of iterations of a fit."""
    halves: bool = False
    """Whether the chosen fit is repeated on either half of the training runs."""


def main(args: Args) -> None:
    """Reads the logs, fits every candidate, chooses on the validation runs, and writes the errors of all splits.

    Raises:
      ValueError: an option is wrong, a log cannot be used, or `mujoco.sysid` is missing.
    """
    sysid_parameters.package()
    _check(args)
    checkpoint.check_writable(args.out.parent)
    log, spec = read_logs(args.logs, robot=args.robot)
    begin = time.perf_counter()
    bench = Bench(log, sysid_parameters.robot_of(spec, log))
    with bars() as progress:
        tried = _fit_all(args, bench, progress)
    chosen = {}
    for measure in MEASURES:
        best = min(tried, key=lambda one: one.select[measure])
        same = [name for name in chosen if chosen[name]["fit"] == best.name()]
        chosen[measure] = {"as": same[0], "fit": best.name()} if same else _prove(args, bench, best)
    nominal = sysid_parameters.declare(bench.robot, "joints")
    report = {
        "logs": [path.name for path in args.logs],
        "settings": {name: value for name, value in asdict(args).items() if name not in ("logs", "out")},
        "seconds": time.perf_counter() - begin,
        "versions": checkpoint.versions(),
        "nominal": {split: bench.errors(nominal, runs) for split, runs in bench.parts.items()},
        "candidates": [{"fit": one.name(), "seconds": one.seconds, "select": one.select} for one in tried],
        "chosen": chosen,
    }
    files.write_json(args.out, report)
    _show(report)


@dataclass(frozen=True)
class Bench:
    """A log, its runs by split, and the robot that is fitted to them."""

    log: Log
    robot: sysid_parameters.Robot

    @property
    def parts(self) -> dict[str, tuple[Run, ...]]:
        """Runs by split."""
        return splits(self.log)

    def take(self, runs: Sequence[Run], horizon_s: float | None = None) -> playback.Pieces:
        """Cuts runs into pieces (`playback.take`); one longer than the shortest run is cut to it."""
        if horizon_s is not None:
            period = 1.0 / self.log.rate_hz
            longest = min(run.time[-1] - run.time[0] for run in self.log.runs) - HISTORY_S - 5 * period
            horizon_s = min(horizon_s, longest)
        return playback.take(runs, playback.step_s(self.log), horizon_s)

    def errors(self, parameters, runs: Sequence[Run]) -> dict:
        """Measures a model on runs: mean absolute error of free runs, and rms of segments by joint, in rad."""
        whole = self.take(runs)
        found = {"free_run_error_rad": playback.mean_absolute_error(self.robot.play(parameters, whole), whole)}
        for horizon in SEGMENTS_S:
            pieces = self.take(runs, horizon)
            rms = playback.rms_by_joint(self.robot.play(parameters, pieces), pieces)
            found[f"rms_{horizon:g}_s_rad"] = dict(zip(self.robot.joints, rms.tolist(), strict=True))
        return found


@dataclass(frozen=True)
class Candidate:
    """A fit: which parameters, on pieces of which length, how strongly held to the nominal ones, and how good."""

    subset: str
    horizon_s: float
    weight: float
    seconds: float
    parameters: Any
    select: dict[str, float]
    """Errors on the validation runs by the names of `MEASURES`."""

    def name(self) -> str:
        """Says what was fitted, and how."""
        return f"{self.subset}, pieces of {self.horizon_s:g} s, weight {self.weight:g}"


def _fit_all(args: Args, bench: Bench, progress: Progress) -> list[Candidate]:
    found, total = [], len(args.horizons) * len(args.weights) * len(args.subsets)
    task = progress.add_task("fits", total=total)
    for horizon, weight in itertools.product(args.horizons, args.weights):
        before = None
        for subset in args.subsets:
            fitted, seconds = _fit(args, bench, bench.parts["train"], (subset, horizon, weight), before)
            errors, before = bench.errors(fitted, bench.parts["select"]), fitted
            select = {
                "free_run": errors["free_run_error_rad"],
                "segments": float(np.mean(list(errors[f"rms_{SEGMENTS_S[-1]:g}_s_rad"].values()))),
            }
            # A fit that diverges on validation is never chosen.
            select = {name: value if np.isfinite(value) else np.inf for name, value in select.items()}
            found.append(Candidate(subset, horizon, weight, seconds, fitted, select))
            console.print(f"{found[-1].name()}: {seconds:.0f} s, {select}", highlight=False)
            progress.advance(task)
    return found


def _fit(args: Args, bench: Bench, runs: Sequence[Run], how: tuple[str, float, float], before=None) -> tuple:
    """Fits parameters to runs, from those of `before` where both have them; returns them and the seconds it took."""
    begin, (subset, horizon, weight) = time.perf_counter(), how
    start = sysid_parameters.declare(bench.robot, subset)
    for name, parameter in before.items() if before else ():
        if name in start:
            start[name].value = parameter.value.copy()
    # A fit that starts at a bound may stay there, so the package's own remedy is taken.
    start.move_off_bounds()
    pieces = sysid_fit.subsample(bench.take(runs, horizon), args.train_s)
    fitted = sysid_fit.fit(bench.robot, start, pieces, weight, args.iterations)
    return fitted, time.perf_counter() - begin


def _prove(args: Args, bench: Bench, best: Candidate) -> dict:
    """Measures the chosen fit on every split, the held-out runs included, and repeats it on halves of the training."""
    chosen = {
        "fit": best.name(),
        "parameters": sysid_parameters.physical(bench.robot, best.parameters),
        "errors": {split: bench.errors(best.parameters, runs) for split, runs in bench.parts.items()},
    }
    if args.halves:
        chosen["halves"] = []
        for number in (0, 1):
            runs = bench.parts["train"][number::2]
            fitted, _ = _fit(args, bench, runs, (best.subset, best.horizon_s, best.weight))
            chosen["halves"].append(
                {
                    "runs": [run.name for run in runs],
                    "parameters": sysid_parameters.physical(bench.robot, fitted),
                    "sealed": bench.errors(fitted, bench.parts["sealed"]),
                }
            )
    return chosen


def _show(report: dict) -> None:
    table = Table("model", *(f"{split}, rad" for split in report["nominal"]), title="mean absolute error of free runs")
    rows = {"nominal": report["nominal"]} | {
        one["fit"]: one["errors"] for one in report["chosen"].values() if "errors" in one
    }
    for name, errors in rows.items():
        table.add_row(name, *(f"{one['free_run_error_rad']:.4f}" for one in errors.values()))
    console.print(table)


def _check(args: Args) -> None:
    for subset in args.subsets:
        if subset not in sysid_parameters.SUBSETS:
            raise ValueError(f"subsets: got '{subset}', expected some of {', '.join(sysid_parameters.SUBSETS)}")
    for name, least in {"horizons": 0.05, "weights": 0.0}.items():
        values = getattr(args, name)
        if not values or min(values) < least:
            raise ValueError(f"{name}: got {values}, expected one or more numbers, {least:g} or more")
    for name in ("train_s", "iterations"):
        if getattr(args, name) <= 0:
            raise ValueError(f"{name}: got {getattr(args, name)}, expected more than 0")


if __name__ == "__main__":
    run(main, Args)
