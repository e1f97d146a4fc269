"""The blind benchmark: writes the log of a robot with a hidden effect, lets discovery answer, and scores the answer.

The truth goes into a folder of its own, `sealed`, which only `Bench.scored` opens. Every case is a file, so an
interrupted benchmark continues where it stopped, and several processes may share its cases.
"""

import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from envs import models
from envs.effects import LIBRARY
from envs.logs import Controller, Log, read, write
from envs.rig import Rig
from experiments.common import checkpoint, plots
from experiments.common.checkpoint import write_json
from experiments.discovery.blind_cases import SIZE_BOUNDS, SIZES, Case
from experiments.discovery.blind_robots import Truth, record
from experiments.discovery.excitation import TargetRun, excitation
from experiments.discovery.scores import page, score, tally
from experiments.discovery.setup import HORIZONS_S, Question, build_question
from experiments.discovery.summary import summarise
from jaxtune.discovery import workflow
from jaxtune.discovery.noise_floor import Calibration, left_by_prior, prior_slopes
from jaxtune.discovery.simulation import residuals

_HALVINGS = 6  # of the interval in which an effect's size is searched; the severity is then right to about a tenth


class Bench:
    """The cases of a benchmark: their logs, truths, answers and scores, each in a file.

    Call `answer` for every case in `cases`, then `report`.

    Args:
      out: folder of the benchmark.
      size: one of `blind_cases.SIZES`.
      seed: of everything random. Use a new one for a measurement: after somebody has looked at the cases of a seed and
        improved discovery with them, they are no test any more.
      nominal_error: relative error of the nominal parameters.
    """

    def __init__(self, out: Path, size: str, seed: int, nominal_error: float):
        self._out, self._seed, self._nominal_error = out, seed, nominal_error
        self.size = SIZES[size]
        self.spec = models.spec(self.size.model)
        names = ("kp", "kd", "torque_limit_nm")
        gains = {name: np.array(values) for name, values in zip(names, self.size.gains, strict=True)}
        self.controller = Controller(kind="pd", rate_hz=1000.0, gains=gains)
        self.rig = Rig(self.spec, self.size.joints, self.controller.rate_hz)
        self.motions: list[TargetRun] = excitation(
            self.spec, self.size.joints, self.size.runs, self.size.seconds, 500.0, seed
        )

    @property
    def cases(self) -> list[Case]:
        """All cases, in an order that the seed draws, so that a case's number says nothing about what it hides."""
        listed = [*self.size.hidden, *self.size.outside, *[(None, 0.0)] * self.size.empty]
        order = np.random.default_rng(self._seed).permutation(len(listed))
        return [Case(number, *listed[index]) for number, index in enumerate(order)]

    def record(self, truth: Truth, seed: int, noise: bool = True) -> Log:
        """Records the log of a robot with a hidden effect, or with none, and with its own wrong nominal parameters.

        Args:
          truth: what is hidden.
          seed: of the robot's parameters and of noise.
          noise: False leaves readings exact, to measure the effect alone.
        """
        log = record(
            self.spec, self.size.joints, self.motions, self.controller, truth, self._nominal_error, seed, noise
        )
        return replace(log, robot=self.size.model)

    def build_question(self, log: Log, horizons: Sequence[float] = HORIZONS_S, null_logs: int = 0) -> Question:
        """Builds the question for discovery from a log and the nominal model; all cases share compiled programs.

        Args:
          log: of a case.
          horizons: lengths of the segments in s.
          null_logs: number of simulated null logs; zero if `calibration` takes their place.
        """
        return build_question(log, self.spec, horizons, null_logs, plain=self.rig)

    @cached_property
    def calibration(self) -> Calibration:
        """Noise floor and thresholds for this robot and these motions, from simulated null logs.

        They are computed once and kept in `calibration.npz`, because computing them takes as long as a discovery and
        all cases share robot, motions and noise.
        """
        path = self._out / "calibration.npz"
        if not path.exists():
            question = self.build_question(self.record(Truth(None), 10_000), null_logs=self.size.null_logs)
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
        """Draws the place of a case's effect, and searches the size at which it has the severity of the case.

        Returns:
          The hidden effect with place and size, and the severity that was reached, in floor units. It may be less than
          that of the case, because sizes are bounded.
        """
        if case.effect is None:
            return Truth(None), 0.0
        rng = np.random.default_rng((self._seed, case.number))
        on = LIBRARY[case.effect].on if case.effect in LIBRARY else "joint"
        bodies = [self.spec.joint(name).parent.name for name in self.size.joints]
        places = tuple(bodies if on == "body" else self.size.joints)
        place = str(rng.choice(places))
        # A loose mass hangs below a shank or a forearm.
        if case.effect == "loose_foot":
            place = str(rng.choice([name for name in self.size.joints if "knee" in name or "elbow" in name]))
        pair = place.replace("left", "right")
        chosen = (place, pair) if pair != place and rng.uniform() < 0.2 else (place,)
        # Bisection of the logarithm, since sizes span orders of magnitude.
        severity = self.severity_of(case, chosen)
        low, high = np.log(SIZE_BOUNDS[case.effect])
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if severity(float(np.exp(middle))) > case.severity else (middle, high)
        size = float(np.exp(0.5 * (low + high)))
        return Truth(case.effect, chosen, size), severity(size)

    def severity_of(self, case: Case, places: tuple[str, ...]) -> Callable[[float], float]:
        """Makes the function from an effect's size to its severity at these places.

        Severity is the rms by which the effect changes the positions of the most affected joint, in floor units. It is
        measured without noise and after the nominal parameters were fitted again: what they can imitate within their
        priors no method can distinguish from wrong parameters.

        Args:
          case: its effect and seed.
          places: joints or bodies that have the effect.
        """
        main = sorted(self.calibration.floors)[len(self.calibration.floors) // 2]
        (floors, weight), seed = self.calibration.floors[main], self.seed(case)
        floor = floors["train"]
        problem = self.build_question(self.record(Truth(None), seed, noise=False), (main,)).problem
        zero = np.zeros(problem.axes)
        slope = prior_slopes(problem, main) / floor[..., None]
        plain = residuals(problem, zero, problem.data["train"][main])[0]
        positions = slice(-len(self.size.joints), None)  # the last columns of a residual are q

        def severity(size: float) -> float:
            log = self.record(Truth(case.effect, places, size), seed, noise=False)
            segments = self.build_question(log, (main,)).problem.data["train"][main]
            moved = (residuals(problem, zero, segments)[0] - plain) / floor
            # A robot whose simulation diverges is more severe than any wanted severity.
            if not np.isfinite(moved).all():
                return np.inf
            left = left_by_prior(moved, slope, weight)
            return float(np.sqrt((left[..., positions] ** 2).mean(axis=(0, 1))).max())

        return severity

    def seed(self, case: Case) -> int:
        """Returns the seed of a case's robot, which no other case and no benchmark with another seed has."""
        return 1000 * (self._seed + 1) + case.number

    def write(self, case: Case) -> Path:
        """Writes a case's log, and its truth into the folder that only `scored` reads, unless they exist.

        Returns:
          Folder of the log.
        """
        folder, sealed = self._out / "logs" / f"case_{case.number:03d}", self._sealed(case)
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
        return self._out / "sealed" / f"case_{case.number:03d}.json"

    def answer(self, case: Case) -> dict:
        """Lets discovery answer a case, or reads an earlier answer.

        Discovery gets the log, the nominal model and the calibration, and nothing of the truth.

        Returns:
          Content of `summary.json`, and the best hypothesis that was rejected.
        """
        path = self._out / "answers" / f"case_{case.number:03d}.json"
        if not path.exists():
            folder = self.write(case)
            began = time.monotonic()
            log = read(folder)
            question = self.build_question(log)
            result = workflow.discover(question.problem, calibration=self.calibration)
            path.parent.mkdir(parents=True, exist_ok=True)
            answer = summarise(question, result) | {"seconds": time.monotonic() - began, "rejected": result.rejected}
            write_json(path, answer)
        return json.loads(path.read_text())

    def scored(self) -> list[dict]:
        """Scores every case that is answered. No other function opens the truth.

        Returns:
          Rows of `experiments.discovery.scores.score`, with the number of the `case`.
        """
        rows = []
        for case in self.cases:
            path = self._out / "answers" / f"case_{case.number:03d}.json"
            if path.exists():
                truth = json.loads(self._sealed(case).read_text())
                rows.append(score(truth, json.loads(path.read_text())) | {"case": case.number})
        return rows

    def report(self, identity: Mapping[str, object]) -> list[dict]:
        """Writes scores, confusion matrix and page of the cases that are answered so far.

        Args:
          identity: options of the benchmark, for the page.

        Returns:
          The table of rates (`experiments.discovery.scores.tally`).
        """
        rows, out = self.scored(), self._out
        lines = tally(rows)
        write_json(out / "scores.json", {"cases": rows, "table": lines, "versions": checkpoint.versions()})
        plots.confusion(out / "confusion.png", rows)
        (out / "README.md").write_text(page(identity, len(rows), len(self.cases), lines))
        return lines
