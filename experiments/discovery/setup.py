"""Turns measured logs and a nominal model into the problem that discovery works on."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from envs import models, segments
from envs.effects import LEARNED, LIBRARY
from envs.logs import Log, read, read_xl330, splits
from envs.null_logs import simulate_null_log
from envs.regimes import REGIMES
from envs.rig import Rig
from envs.scales import measure_scales
from experiments.discovery.cutting import BIN_S, cut_log
from experiments.discovery.hypotheses import hypotheses, learned_torque, timing_directions
from jaxtune.discovery.problem import Problem

HORIZONS_S = (0.05, 0.15, 0.45)
"""Default lengths in s of the segments that are simulated. Short ones stay close to the measurement; long ones show
biases and delays."""

_LATE_S = 0.004  # a velocity that lags its position by more was filtered, and would be mistaken for a sensor's lag


@dataclass(frozen=True)
class Question:
    """A discovery problem together with the robot and the runs that its numbers refer to."""

    problem: Problem
    """What `jaxtune.discovery` works on; it knows numbers, but no robot."""
    rig: Rig
    """The simulator with every effect built in, which gives coordinates their names and units."""
    splits: Mapping[str, tuple[str, ...]]
    """Names of the runs by split: train, select (validation) and sealed (held-out test)."""
    notes: tuple[str, ...]
    """Sentences about signals that are not used, and why."""


@dataclass(frozen=True)
class _Simulator:
    """Simulates some signals of a rig. Two of equal layout and signals are equal, so they share compiled programs."""

    rig: Rig = field(compare=False)
    layout: Hashable
    signals: tuple[str, ...]

    def __call__(self, system, values, inputs, steps):
        read = self.rig.on(system).simulate(self.rig.tree(values), inputs, steps)
        return {name: read[name] for name in self.signals}


def read_logs(folders: Sequence[Path]) -> tuple[Log, mujoco.MjSpec]:
    """Reads the logs of one robot as a single log, and the robot's nominal model.

    Args:
      folders: of logs, or of the XL330 pendulum's JSON files.

    Returns:
      A log with the runs of all folders (of several, a run's name ends in the number of its folder), and the model.

    Raises:
      ValueError: a log cannot be read, the logs are not of one robot, or its base is free.
    """
    logs = [
        read(folder) if (folder / "meta.yaml").exists() or not any(folder.glob("*.json")) else read_xl330(folder)
        for folder in folders
    ]
    if not logs:
        raise ValueError("logs: got none, expected one or more")
    first = logs[0]
    model = models.spec(first.robot).to_xml()
    for folder, log in zip(folders, logs, strict=True):
        if log.base != "fixed":
            raise ValueError(f"{folder}: base: got '{log.base}', expected 'fixed': suspend or clamp the robot")
        if log.joints != first.joints:
            raise ValueError(f"{folder}: joints: got {log.joints}, expected {first.joints}")
        if models.spec(log.robot).to_xml() != model:
            raise ValueError(f"{folder}: robot: got {log.robot}, expected the same model as {first.robot}")
    # Loaded anew, because writing a specification compiles it, and a compiled one is saved with other geom masses.
    spec = models.spec(first.robot)
    if len(logs) == 1:
        return first, spec
    runs = tuple(replace(run, name=f"{run.name}_{number}") for number, log in enumerate(logs) for run in log.runs)
    return replace(first, runs=runs), spec


def build_question(
    log: Log,
    spec: mujoco.MjSpec,
    horizons: Sequence[float] = HORIZONS_S,
    null_logs: int = 20,
    seed: int = 0,
    plain: Rig | None = None,
) -> Question:
    """Turns a log and a nominal model into a problem: hypotheses, measured segments and simulated null logs.

    It checks that the log can be simulated, before anything is compiled.

    Args:
      log: what was measured.
      spec: the nominal model.
      horizons: lengths of the segments in s.
      null_logs: number of simulated null logs, which set the noise floor and the thresholds.
      seed: of the null logs.
      plain: a rig of the same robot and controller rate, from an earlier question, to reuse its compiled programs.

    Returns:
      The question.

    Raises:
      ValueError: the runs cannot be split, are too short for a horizon, or lack what discovery needs.
    """
    rate = _checked_rate(log, segments.HISTORY_S + min(horizons))
    log, notes = drop_filtered(log)
    unsealed = without_sealed(log).runs
    plain = plain or Rig(spec, log.joints, rate)
    plain.check_matches(log.joints, rate)
    rig = plain.scaled(measure_scales(plain, unsealed))
    # A signal that some runs lack is not compared, since segments of all runs share one layout.
    signals = tuple(name for name in ("dq", "gravity", "q") if all(name in run.signals for run in log.runs))
    axes = {(axis.effect, axis.place): number for number, axis in enumerate(rig.axes)}
    library = {name: row for name, row in rig.effects.items() if name in LIBRARY}
    every = hypotheses(rig.axes, rig.places, library)
    timing, timing_bounds = timing_directions(rig.axes, rig.control_hz)
    simulated = [simulate_null_log(log, spec, seed + number) for number in range(null_logs)]
    measured, *nulls = (cut_log(one, rig.dt, signals, horizons) for one in (log, *simulated))
    problem = Problem(
        simulate=_Simulator(plain, plain.layout, signals),
        system=plain.system,
        values=rig.inner,
        axes=len(rig.axes),
        hypotheses=every,
        prior=np.array([axis.prior_sd for axis in rig.axes]),
        timing=timing,
        timing_bounds=timing_bounds,
        trees=rig.trees,
        data=measured,
        null_logs=nulls,
        bin_rows=segments.rows_together(1.0 / log.rate_hz, BIN_S),
        regimes=REGIMES,
        components={name: tuple("xyz") if name == "gravity" else rig.joints for name in signals},
        push={joint: axes["constant_push", joint] for joint in rig.joints},
        residual=learned_torque(rig.axes, LEARNED),
    )
    names = {split: tuple(run.name for run in runs) for split, runs in splits(log).items()}
    return Question(problem, rig, names, notes)


def _checked_rate(log: Log, least_s: float) -> float:
    """Returns the controller's rate in Hz, which all runs share, after checking that the runs can be simulated."""
    rate = log.runs[0].controller.rate_hz
    for run in log.runs:
        if run.controller.rate_hz != rate:
            raise ValueError(
                f"{run.name}: controller.rate_hz: got {run.controller.rate_hz:g}, expected {rate:g} for all"
            )
        if run.controller.kind == "servo" and "target" in run.signals and "volts" not in run.signals:
            raise ValueError(f"{run.name}: column 'volts' is missing, and the controller is a servo")
        if run.time[-1] - run.time[0] < least_s:
            raise ValueError(f"{run.name}: got {run.time[-1] - run.time[0]:.3g} s, expected {least_s:.3g} s or more")
    return rate


def without_sealed(log: Log) -> Log:
    """Returns the log without its sealed runs (the held-out test), which only the final proof may use.

    Whatever is estimated from a log, scales and filters included, must be estimated from this.
    """
    parts = splits(log)
    return replace(log, runs=(*parts["train"], *parts["select"]))


def drop_filtered(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Leaves out joint velocities that were filtered, because their lag would be mistaken for a sensor's.

    A velocity counts as filtered if it lags the derivative of the position by more than 4 ms in the median run.

    Args:
      log: as it was read.

    Returns:
      The log, with the row rate of its time stamps in the place of the declared one, and a note for every signal that
      was left out.
    """
    notes = []
    # Sealed runs are left out here too: nothing may be decided by them.
    late = [segments.velocity_lag(run) for run in without_sealed(log).runs if "dq" in run.signals]
    if late and np.median(late) > _LATE_S:
        notes.append(f"dq lags q by {1e3 * np.median(late):.0f} ms, so it was filtered and is not used")
        runs = [replace(run, signals={k: v for k, v in run.signals.items() if k != "dq"}) for run in log.runs]
        log = replace(log, runs=tuple(runs))
    rate = 1.0 / float(np.median([np.median(np.diff(run.time)) for run in log.runs]))
    return replace(log, rate_hz=rate), tuple(notes)
