"""The blind benchmark of one robot: writes its logs with a hidden effect, and the truth beside them.

The truth goes into a folder of its own, `sealed`, which only `Benchmark.scored` opens. Every case is a file, so an
interrupted benchmark continues where it stopped, and several processes may share its cases.
"""

import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from envs import models
from envs.effects import LIBRARY
from envs.logs import Controller, Log, write
from experiments.common.files import write_json
from experiments.discovery.benchmark import Benchmark
from experiments.discovery.blind_cases import SIZE_BOUNDS, SIZES, Case
from experiments.discovery.blind_drive import Truth
from experiments.discovery.blind_robots import record
from experiments.discovery.cutting import HORIZONS_S
from experiments.discovery.excitation import excitation
from experiments.discovery.question import Question, build_question
from experiments.discovery.target_runs import TargetRun
from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.noise_floor import Floor, measure
from jaxtune.discovery.simulation import residuals

_HALVINGS = 6  # of the interval in which an effect's size is searched; the severity is then right to about a tenth


class Bench(Benchmark):
    """The cases of a benchmark of one robot.

    Args:
      out: folder of the benchmark.
      size: one of `blind_cases.SIZES`.
      seed: of everything random. Use a new one for a measurement: after somebody has looked at the cases of a seed and
        improved discovery with them, they are no test any more.
      nominal_error: relative error of the nominal parameters.
    """

    def __init__(self, out: Path, size: str, seed: int, nominal_error: float):
        super().__init__(out)
        self._seed, self._nominal_error = seed, nominal_error
        self.size = SIZES[size]
        self.spec = models.spec(self.size.model)
        names = ("kp", "kd", "torque_limit_nm")
        gains = {name: np.array(values) for name, values in zip(names, self.size.gains, strict=True)}
        self.controller = Controller(kind="pd", rate_hz=1000.0, gains=gains)
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

    @cached_property
    def floor(self) -> Floor:
        """The noise floor of a robot without any effect at the main horizon, by which sizes are chosen."""
        question = self._question(self.record(Truth(None), 10_000), self.size.null_logs)
        return measure(question.problem, lambda text: None)[question.problem.main_horizon]

    def _question(self, log: Log, null_logs: int = 0) -> Question:
        return build_question(log, self.spec, HORIZONS_S, null_logs)

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
        floor, seed = self.floor, self.seed(case)
        scale, main, prior = floor.scale["train"], floor.horizon, floor.prior
        problem = self._question(self.record(Truth(None), seed, noise=False)).problem
        vectors = np.concatenate([np.zeros((1, problem.axes)), prior.directions])
        plain, *shifted = residuals(problem, vectors, problem.data["train"][main])
        slopes = np.stack([(one - plain) / scale for one in shifted], axis=-1)
        positions = slice(-len(self.size.joints), None)  # the last columns of a residual are q

        def severity(size: float) -> float:
            log = self.record(Truth(case.effect, places, size), seed, noise=False)
            segments = self._question(log).problem.data["train"][main]
            moved = (residuals(problem, vectors[0], segments)[0] - plain) / scale
            # A robot whose simulation diverges is more severe than any wanted severity.
            if not np.isfinite(moved).all():
                return np.inf
            count, weight = slopes.shape[-1], np.full(moved.size, floor.counts.independent)
            linear = Linear(moved.ravel(), slopes.reshape(-1, count), np.zeros(count), prior.sd, weight)
            left = moved + slopes @ linear.step(0.0, prior.bounds)
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
        sealed = self.truth_path(case)
        folder = self.out / "logs" / sealed.stem
        if not (sealed.exists() and (folder / "log").exists()):
            truth, severity = self.truth(case)
            log = self.record(truth, self.seed(case))
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            name = log.robot if log.robot in models.BUILT_IN else Path(log.robot).name
            write(replace(log, robot=name), folder / "log", ".npz")
            if log.robot not in models.BUILT_IN:
                shutil.copy(log.robot, folder / "log" / name)
            sealed.parent.mkdir(parents=True, exist_ok=True)
            write_json(sealed, sealed_truth(case, truth, severity))
        return folder / "log"


def sealed_truth(case: Case, truth: Truth, severity: float) -> dict:
    """Returns what `scores.score` takes of a hidden effect.

    Args:
      case: that hides it.
      truth: with place and size.
      severity: that was reached.
    """
    if case.effect is None:
        return {"kind": "empty", "effects": []}
    inside = case.effect in LIBRARY
    kind = "outside" if not inside else "weak" if case.severity < 5.0 else "single"
    effect = asdict(truth) | {"name": case.effect, "family": LIBRARY[case.effect].family if inside else None}
    # The formulas differ from the library's, so its parameter has no true value.
    return {"kind": kind, "effects": [effect | {"value": None, "asked": case.severity, "severity": severity}]}
