"""The blind benchmark: `python -m experiments.discovery_bench --size smoke --out DIR`.

Hides an effect in a robot that another engine moves (`experiments.hidden`), writes a log as a user would and the truth
into a folder that only the scorer reads, has discovery work on the log and the nominal model, and scores what it says.
Every case is a file of its own: the same command goes on where it stopped, and `--piece 0/2` and `--piece 1/2` share
the work between two processes.
"""

import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from rich.table import Table

from envs import models
from envs.biteno import constants
from envs.effects import LIBRARY
from envs.logs import Controller, Log, read, write
from envs.rig import Rig
from experiments import checkpoint, plots
from experiments.checkpoint import write_json
from experiments.discover import summarise
from experiments.discovery_scores import SEVERITIES, page, score, shown, tally
from experiments.excite import Motion, excitation
from experiments.hidden import OUTSIDE, Truth, record
from experiments.question import HORIZONS_S, Question, ask
from experiments.train import console, run
from jaxtune.discovery import workflow
from jaxtune.discovery.noise_floor import Calibration, left_by_prior, prior_slopes
from jaxtune.discovery.simulation import residuals

ARM = Path(__file__).parent / "arm.xml"

_HALVINGS = 6

_BOUNDS = {
    "coulomb": (0.01, 10.0),
    "viscous": (0.01, 20.0),
    "stribeck": (0.01, 20.0),
    "load_friction": (0.01, 0.8),
    "command_delay": (0.001, 0.04),
    "target_slew": (20.0, 0.3),
    "gain_error": (0.98, 0.3),
    "deadband": (0.001, 0.15),
    "torque_speed": (0.1, 20.0),
    "torque_limit": (60.0, 0.5),
    "torque_lag": (0.001, 0.06),
    "torque_scale": (0.98, 0.3),
    "backlash": (0.001, 0.15),
    "compliance": (5000.0, 10.0),
    "armature": (0.001, 0.5),
    "link_mass": (1.02, 3.0),
    "com_offset": (0.001, 0.12),
    "payload": (0.01, 4.0),
    "encoder_bias": (0.0005, 0.2),
    "sensor_delay": (0.001, 0.04),
    "sensor_lag": (0.001, 0.06),
    "drag": (0.1, 100.0),
    "constant_push": (0.01, 15.0),
    "cogging": (0.02, 15.0),
    "temperature_fade": (0.02, 0.9),
    "cable_stiffness": (0.1, 500.0),
    "loose_foot": (0.01, 1.5),
}
"""Sizes between which a severity is looked for, the harmless one first."""


@dataclass(frozen=True)
class Case:
    """One robot."""

    number: int
    effect: str | None
    severity: float
    """In floor units, of what is hidden alone."""


@dataclass(frozen=True)
class Size:
    """How much is tried, on which robot."""

    model: str
    """Name or path."""
    joints: tuple[str, ...]
    gains: tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
    """kp, kd and torque limit, one for every joint."""
    runs: int
    seconds: float
    hidden: tuple[tuple[str, float], ...]
    """Effects and severities."""
    empty: int
    outside: tuple[tuple[str, float], ...]
    healthy: int


def _spread(names: Sequence[str], count: int) -> tuple[tuple[str, float], ...]:
    """Effects in turn, severities in turn."""
    return tuple((names[i % len(names)], SEVERITIES[i % len(SEVERITIES)]) for i in range(count))


_HIDDEN = tuple(name for name, row in LIBRARY.items() if not row.needs)
_ARM = (str(ARM), ("shoulder", "elbow"), ((40.0, 20.0), (2.0, 0.8), (15.0, 15.0)))
_BITENO = ("biteno", constants.JOINTS, ((60.0,) * 6, (2.0,) * 6, (60.0,) * 6))
SIZES = {
    "smoke": Size(
        *_ARM, 6, 2.0, (("coulomb", 15.0), ("command_delay", 15.0), ("payload", 15.0), ("torque_scale", 15.0)), 2, (), 6
    ),
    "arm": Size(*_ARM, 6, 3.0, _spread(_HIDDEN, 46), 20, _spread(OUTSIDE[:3], 9), 20),
    "standard": Size(*_BITENO, 6, 3.0, _spread(_HIDDEN, 48), 40, _spread(OUTSIDE, 10), 20),
    "full": Size(
        *_BITENO,
        12,
        5.0,
        tuple((name, severity) for name in _HIDDEN for severity in SEVERITIES for _ in range(5)),
        100,
        _spread(OUTSIDE, 24),
        40,
    ),
}
"""`smoke` for CI, `arm` for an hour, `standard` for a night on a CPU, `full` for a GPU or a few nights."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Hides effects, has them found, and counts."""

    out: Path = Path("runs/discovery_bench")
    """Folder of the cases and the scores."""
    size: str = "smoke"
    """smoke, arm, standard or full."""
    seed: int = 0
    """Seed of everything random."""
    nominal_error: float = 0.1
    """By how much nominal parameters are wrong, half of it to one and a half times; gains by a third of that."""
    piece: str = "0/1"
    """Which share of the cases to work on."""


class Bench:
    """The robots of one size."""

    def __init__(self, args: Args):
        self.args, self.size = args, SIZES[args.size]
        self.spec = models.spec(self.size.model)
        names = ("kp", "kd", "torque_limit_nm")
        gains = {name: np.array(values) for name, values in zip(names, self.size.gains, strict=True)}
        self.controller = Controller(kind="pd", rate_hz=1000.0, gains=gains)
        self.rig = Rig(self.spec, self.size.joints, self.controller.rate_hz)
        self.motions: list[Motion] = excitation(
            self.spec, self.size.joints, self.size.runs, self.size.seconds, 500.0, args.seed
        )

    @property
    def cases(self) -> list[Case]:
        """All of them, the harmless ones mixed in."""
        listed = [*self.size.hidden, *self.size.outside, *[(None, 0.0)] * self.size.empty]
        order = np.random.default_rng(self.args.seed).permutation(len(listed))
        return [Case(number, *listed[index]) for number, index in enumerate(order)]

    def record(self, truth: Truth, seed: int, noise: bool = True) -> Log:
        """Plays the motions on a robot with something in it."""
        log = record(
            self.spec, self.size.joints, self.motions, self.controller, truth, self.args.nominal_error, seed, noise
        )
        return replace(log, robot=self.size.model)

    def ask(self, log: Log, horizons: Sequence[float] = HORIZONS_S, healthy_logs: int = 0) -> Question:
        """The question to discovery, about the nominal model."""
        return ask(log, self.spec, horizons, healthy_logs, plain=self.rig)

    @cached_property
    def calibration(self) -> Calibration:
        """What healthy logs of this robot and motion say: found once, and kept."""
        path = self.args.out / "calibration.npz"
        if not path.exists():
            question = self.ask(self.record(Truth(None), 10_000), healthy_logs=self.size.healthy)
            found = workflow.calibrate(question.problem)
            arrays = {
                f"floor {horizon} {split}": floor
                for horizon, (floors, _) in found.floors.items()
                for split, floor in floors.items()
            }
            arrays |= {f"weight {horizon}": weight for horizon, (_, weight) in found.floors.items()}
            partial = path.with_suffix(f".{os.getpid()}.npz")
            np.savez(partial, gain=found.gain, penalty=found.penalty, **arrays)
            partial.replace(path)
        with np.load(path) as saved:
            floors = {}
            for name in saved.files:
                kind, *place = name.split()
                if kind == "floor":
                    horizon, split = place
                    of_splits, _ = floors.setdefault(float(horizon), ({}, float(saved[f"weight {horizon}"])))
                    of_splits[split] = saved[name]
            return Calibration(floors, float(saved["gain"]), float(saved["penalty"]))

    def truth(self, case: Case) -> tuple[Truth, float]:
        """Where it hides and how large it is, and its severity in floor units."""
        if case.effect is None:
            return Truth(None), 0.0
        rng = np.random.default_rng((self.args.seed, case.number))
        on = LIBRARY[case.effect].on if case.effect in LIBRARY else "joint"
        bodies = [self.spec.joint(name).parent.name for name in self.size.joints]
        places = tuple(bodies if on == "body" else self.size.joints)
        place = str(rng.choice(places))
        if case.effect == "loose_foot":
            place = str(rng.choice([name for name in self.size.joints if "knee" in name or "elbow" in name]))
        pair = place.replace("left", "right")
        chosen = (place, pair) if pair != place and rng.uniform() < 0.2 else (place,)
        severity = self.severity_of(case, chosen)
        low, high = np.log(_BOUNDS[case.effect])
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if severity(float(np.exp(middle))) > case.severity else (middle, high)
        size = float(np.exp(0.5 * (low + high)))
        return Truth(case.effect, chosen, size), severity(size)

    def severity_of(self, case: Case, places: tuple[str, ...]) -> Callable[[float], float]:
        """How far an effect of a size moves the worst joint's positions, in floor units, noise apart.

        What nominal parameters can make up for within their priors does not count: nobody could see it.
        """
        main = sorted(self.calibration.floors)[len(self.calibration.floors) // 2]
        (floors, weight), seed = self.calibration.floors[main], self.seed(case)
        floor = floors["train"]
        problem = self.ask(self.record(Truth(None), seed, noise=False), (main,)).problem
        zero = np.zeros(problem.axes)
        slope = prior_slopes(problem, main) / floor[..., None]
        plain = residuals(problem, zero, problem.data["train"][main])[0]
        positions = slice(-len(self.size.joints), None)

        def severity(size: float) -> float:
            log = self.record(Truth(case.effect, places, size), seed, noise=False)
            segments = self.ask(log, (main,)).problem.data["train"][main]
            moved = (residuals(problem, zero, segments)[0] - plain) / floor
            if not np.isfinite(moved).all():
                return np.inf
            left = left_by_prior(moved, slope, weight)
            return float(np.sqrt((left[..., positions] ** 2).mean(axis=(0, 1))).max())

        return severity

    def seed(self, case: Case) -> int:
        """Of the robot."""
        return 1000 * (self.args.seed + 1) + case.number

    def write(self, case: Case) -> Path:
        """Writes a case's log, and its truth where only the scorer looks."""
        folder, sealed = self.args.out / "logs" / f"case_{case.number:03d}", self._sealed(case)
        if not sealed.exists():
            truth, severity = self.truth(case)
            log = self.record(truth, self.seed(case))
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            name = log.robot if log.robot in models.BUILT_IN else Path(log.robot).name
            write(replace(log, robot=name), folder / "log", ".npz")
            if log.robot not in models.BUILT_IN:
                shutil.copy(log.robot, folder / "log" / name)
            sealed.parent.mkdir(parents=True, exist_ok=True)
            write_json(sealed, {"effect": case.effect, "asked": case.severity, "severity": severity, "truth": truth})
        return folder / "log"

    def _sealed(self, case: Case) -> Path:
        return self.args.out / "sealed" / f"case_{case.number:03d}.json"

    def answer(self, case: Case) -> dict:
        """What discovery says of a case's log; it sees the log, the nominal model and the calibration."""
        path = self.args.out / "answers" / f"case_{case.number:03d}.json"
        if not path.exists():
            folder = self.write(case)
            began = time.monotonic()
            log = read(folder)
            question = self.ask(log)
            result = workflow.discover(question.problem, calibration=self.calibration)
            path.parent.mkdir(parents=True, exist_ok=True)
            answer = summarise(question, result) | {"seconds": time.monotonic() - began, "rejected": result.rejected}
            write_json(path, checkpoint.as_json(answer))
        return json.loads(path.read_text())

    def scored(self) -> list[dict]:
        """Truth and answer of every case that is done; the one place that opens the truth."""
        rows = []
        for case in self.cases:
            path = self.args.out / "answers" / f"case_{case.number:03d}.json"
            if path.exists():
                truth = json.loads(self._sealed(case).read_text())
                rows.append(score(truth, json.loads(path.read_text())) | {"case": case.number})
        return rows

    def report(self, identity: Mapping[str, object]) -> list[dict]:
        """Writes down how the cases that are done were answered; the table of rates."""
        rows, out = self.scored(), self.args.out
        lines = tally(rows)
        write_json(out / "scores.json", {"cases": rows, "table": lines, "versions": checkpoint.versions()})
        plots.confusion(out / "confusion.png", rows)
        (out / "README.md").write_text(page(identity, len(rows), len(self.cases), lines))
        return lines


def main(args: Args) -> None:
    """Works off this piece's cases and scores all that are done."""
    checkpoint.set_up_compiler(checkpoint.a_device_a_core())
    if args.size not in SIZES:
        raise ValueError(f"size: got '{args.size}', expected one of {', '.join(SIZES)}")
    number, _, pieces = args.piece.partition("/")
    if not (number.isdigit() and pieces.isdigit() and int(number) < int(pieces)):
        raise ValueError(f"piece: got '{args.piece}', expected '0/1', '0/2', '1/2', ...")
    identity = {"size": args.size, "seed": args.seed, "nominal_error": args.nominal_error}
    checkpoint.open_run(args.out, identity)
    bench = Bench(args)
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
