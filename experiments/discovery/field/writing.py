"""Writes the logs of the field benchmark as users would, and the truth beside them."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np

from envs.logs import Controller, Log, Run, write
from experiments.common.files import write_json
from experiments.discovery.field import motions, readings, robots
from experiments.discovery.field.cases import FieldCase
from experiments.discovery.field.forms import Form
from experiments.discovery.field.outside import OUTSIDE
from experiments.discovery.field.plants import PLANTS
from experiments.discovery.field.playing import Hidden, Script, Trace, script, whole
from experiments.discovery.field.readings import stamped_late
from experiments.discovery.field.severity import Generator, Meter, search
from experiments.discovery.field.sizes import FAMILY, ON_BODY, bounds
from experiments.discovery.target_runs import TargetRun

_TRIES = 8  # robots that are drawn until one can show what is wanted
_SEVERITY_RATIO = 1.3  # between wanted and reached severity, at most
_FARTHEST_RAD = 2.7  # that a joint may go, within the ranges that a model may give
_LATE_S = (2e-5, 3e-4)  # mean delays of the stamps of late loggers, least and largest
_WANDERING = 0.2  # standard deviation of the logarithms of frictions and dampings from run to run


@dataclass(frozen=True)
class Placed:
    """An effect with the joints or bodies that have it, and its size."""

    effect: str
    places: tuple[int, ...]
    size: float = float("nan")
    severity: float = 0.0


def forms(generator: str) -> Mapping[str, Form]:
    """Returns the effects of a generator, those outside the library included, by name."""
    return {**import_module(f"experiments.discovery.field.forms_{generator}").FORMS, **OUTSIDE}


class Scene:
    """One drawn robot with its motions and sensors, in one generator.

    Args:
      case: what it is drawn for.
      error: relative error of its nominal parameters.
      rng: random numbers.
    """

    def __init__(self, case: FieldCase, error: float, rng: np.random.Generator):
        module = import_module(f"experiments.discovery.field.forms_{case.generator}")
        self.topology = robots.TOPOLOGIES[case.topology]
        self.forms = forms(case.generator)
        self.generator = Generator(plant=PLANTS[case.generator], friction=module.Friction)
        self.nominal = robots.rounded(robots.draw(self.topology, rng))
        self.real = robots.mistaken(self.nominal, error, rng)
        self.motions = motions.draw(self.topology, rng)
        self.sensors = readings.draw(len(self.topology.joints), rng)
        self.script: Script = script(
            self.motions, self.generator.plant.dt, self.topology.control_hz, case.kind == "linear", rng
        )
        self.meter = Meter(self.generator, self.real, self.script, self.sensors, int(rng.integers(2**31)))
        wandering = self.motions if case.kind == "wandering" else ()
        self.wandered = [robots.wandered(self.real, _WANDERING, rng) for _ in wandering]

    def with_effects(self, placed: Sequence[Placed], sizes: np.ndarray | None, runs: int):
        """Returns robots and `Hidden` effects for lanes ordered by robot, each with a number of runs.

        Args:
          placed: effects; where `sizes` is None, each with its own size.
          sizes: of the only effect, one for each robot.
          runs: lanes of each robot.
        """
        real, hidden = [self.real] * (1 if sizes is None else len(sizes)), []
        for one in placed:
            form, each = self.forms[one.effect], np.array([one.size]) if sizes is None else sizes
            if form.stage == "numbers":
                for place in one.places:
                    real = [form.make(robot, place, float(size)) for robot, size in zip(real, each, strict=True)]
            else:
                hidden.append(Hidden(form=form, columns=one.places, size=np.repeat(each, runs)))
        return real, hidden

    def sized(self, placed: Placed, wanted: float) -> Placed:
        """Searches the size at which an effect alone has a severity."""
        low, high = bounds(placed.effect, self.real, placed.places[0], self.meter.scales(placed.places[0]))

        def severities(sizes: np.ndarray) -> np.ndarray:
            real, hidden = self.with_effects([placed], sizes, self.meter.lanes_a_robot)
            return self.meter.severities(self.meter.play(real, hidden))

        return Placed(placed.effect, placed.places, *search(severities, low, high, wanted))

    def play(self, placed: Sequence[Placed]) -> Trace:
        """Plays all runs with effects."""
        runs = len(self.motions)
        real, hidden = self.with_effects(placed, None, runs)
        lanes = whole(1, self.script, range(runs))
        if self.wandered:
            real, lanes = self.wandered, replace(lanes, robot=np.arange(runs))
        return self.generator.play(real, self.script, lanes, hidden)

    def log(self, trace: Trace, rng: np.random.Generator, late_s: float = 0.0) -> Log:
        """Makes the log that a user would have recorded.

        Half of the users say how targets go on between rows, and half of those whose speeds are filtered say how.

        Args:
          trace: what happened.
          rng: random numbers.
          late_s: by how much rows are stamped late, in the mean.
        """
        nominal, row_s = self.nominal, self.meter.row_s
        runs, tells_targets, tells_filter = [], rng.uniform() < 0.5, rng.uniform() < 0.5
        between = ("linear" if self.script.linear else "hold") if tells_targets else "unknown"
        filters = np.full(len(nominal.joints), self.sensors.filter_hz)
        known = {"dq": {"filter_hz": filters}} if tells_filter and self.sensors.speed == "filtered" else {}
        for motion, q, v in zip(self.motions, trace.q, trace.v, strict=True):
            signals = {"q": self.sensors.positions(q, rng), "target": motion.target}
            speed = self.sensors.speeds(v, row_s, rng)
            signals |= {} if speed is None else {"dq": speed}
            signals |= {} if motion.enabled.all() else {"enabled": motion.enabled}
            time = stamped_late(motion.time, late_s, rng) if late_s else motion.time
            runs.append(self._run(motion, time, between, signals, known))
        return Log(
            robot="robot.xml",
            base="fixed",
            rate_hz=self.topology.row_hz,
            joints=nominal.joints,
            policy=None,
            runs=tuple(runs),
        )

    def _run(self, motion: TargetRun, time: np.ndarray, between: str, signals: dict, known: dict) -> Run:
        nominal, rate = self.nominal, self.topology.control_hz
        gains = {"kp": nominal.kp * motion.gain, "kd": nominal.kd * motion.gain, "torque_limit_nm": nominal.limit}
        return Run(
            name=motion.name,
            condition=motion.condition,
            split=motion.split or None,
            controller=Controller(kind="pd", rate_hz=rate, gains=gains, between_rows=between),
            time=time,
            signals=signals,
            known=known,
        )


def draw_places(case: FieldCase, scene: Scene, rng: np.random.Generator) -> list[tuple[int, ...]]:
    """Draws the places of a case's effects: one joint or body mostly, now and then a left and right pair or all.

    Several effects sit at different joints.
    """
    names, count = scene.topology.joints, len(scene.topology.joints)
    if len(case.effects) > 1:
        return [(int(place),) for place in rng.permutation(count)[: len(case.effects)]]
    if case.effects[0] == "loose_foot":
        return [(count - 1,)]
    first, draw = int(rng.integers(count)), rng.uniform()
    if case.kind == "outside" or case.effects[0] in ON_BODY or draw > 0.4:
        return [(first,)]
    if draw < 0.1:
        return [tuple(range(count))]
    left = names[first].replace("right", "left")
    right = left.replace("left", "right")
    return [(first,)] if left == right else [(names.index(left), names.index(right))]


def prepared(case: FieldCase, error: float, seed: int) -> tuple[Scene, list[Placed], Trace]:
    """Draws robots until one shows a case's effects with the severities that are wanted; the nearest if none does.

    Args:
      case: what is wanted.
      error: relative error of the nominal parameters.
      seed: of the benchmark.
    """
    nearest = None
    for attempt in range(_TRIES):
        rng = np.random.default_rng((seed, case.number, attempt))
        scene = Scene(case, error, rng)
        places = draw_places(case, scene, rng) if case.effects else []
        placed = [
            scene.sized(Placed(effect, place), wanted)
            for effect, place, wanted in zip(case.effects, places, case.severities, strict=True)
        ]
        trace = scene.play(placed)
        if not np.isfinite(trace.q).all() or np.abs(trace.q).max() > _FARTHEST_RAD:
            continue
        ratios = [one.severity / asked for one, asked in zip(placed, case.severities, strict=True)]
        off = max((abs(np.log(ratio)) for ratio in ratios), default=0.0)
        if nearest is None or off < nearest[0]:
            nearest = (off, (scene, placed, trace))
        if off < np.log(_SEVERITY_RATIO):
            break
    if nearest is None:
        raise ValueError(f"case {case.number}: no robot of {_TRIES} kept within {_FARTHEST_RAD} rad")
    return nearest[1]


def write_case(case: FieldCase, error: float, seed: int, out: Path) -> Path:
    """Writes a case's log to `logs`, and its truth to `sealed`, unless they exist.

    Args:
      case: to write.
      error: relative error of the nominal parameters.
      seed: of the benchmark.
      out: folder of the benchmark.

    Returns:
      Folder of the log.
    """
    name = f"case_{case.number:03d}"
    folder, sealed = out / "logs" / name / "log", out / "sealed" / f"{name}.json"
    if sealed.exists() and folder.exists():
        return folder
    scene, placed, trace = prepared(case, error, seed)
    rng = np.random.default_rng((seed, case.number, 99))
    shutil.rmtree(folder.parent, ignore_errors=True)
    folder.parent.mkdir(parents=True)
    late_s = float(np.exp(rng.uniform(*np.log(_LATE_S)))) if case.late_stamps else 0.0
    write(scene.log(trace, rng, late_s), folder, ".csv" if rng.uniform() < 0.2 else ".npz")
    (folder / "robot.xml").write_text(robots.mjcf(scene.nominal))
    sealed.parent.mkdir(parents=True, exist_ok=True)
    write_json(sealed, _truth(case, scene, placed))
    return folder


_NOMINAL = {"coulomb": "friction", "viscous": "damping", "armature": "armature"}
_NOMINAL_RATIO = {"gain_error": "kp", "link_mass": "mass"}


def _value(placed: Placed, scene: Scene) -> float:
    """Returns what discovery should report of an effect's first parameter, which is relative to the nominal model."""
    at = list(placed.places)

    def of(robot: robots.Robot, field: str) -> np.ndarray:
        return getattr(robot, field)[at]

    # Where the nominal number is of the same kind as the effect, its error is part of what is missing.
    if placed.effect in _NOMINAL:
        field = _NOMINAL[placed.effect]
        return float(placed.size + (of(scene.real, field) - of(scene.nominal, field)).mean())
    if placed.effect in _NOMINAL_RATIO:
        field = _NOMINAL_RATIO[placed.effect]
        return float(placed.size * (of(scene.real, field) / of(scene.nominal, field)).mean())
    return placed.size


def _truth(case: FieldCase, scene: Scene, placed: Sequence[Placed]) -> dict:
    effects = []
    for one, asked in zip(placed, case.severities, strict=True):
        names = scene.topology.bodies if one.effect in ON_BODY else scene.topology.joints
        form = scene.forms[one.effect]
        effects.append(
            {
                "name": one.effect,
                "family": FAMILY.get(one.effect),
                "places": [names[place] for place in one.places],
                "size": one.size,
                "value": _value(one, scene) if form.scalar else None,
                "asked": asked,
                "severity": one.severity,
            }
        )
    return {
        "kind": case.kind,
        "topology": case.topology,
        "generator": case.generator,
        "effects": effects,
        "speed": scene.sensors.speed,
        "gains": sorted({motion.gain for motion in scene.motions}),
        "floor_rad": scene.meter.floor_rad.tolist(),
    }
