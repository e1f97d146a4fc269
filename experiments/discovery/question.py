"""Turns a measured log and a nominal model into the problem that discovery works on."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from envs import readings, segments
from envs.axes import SERVO_RATIOS
from envs.effects import LEARNED, LIBRARY
from envs.effects.learned import PARTS
from envs.following import OF_SENSORS, followed, follower, tells
from envs.logs import Log, Run, splits, with_splits
from envs.null_logs import simulate_null_logs
from envs.regimes import REGIMES
from envs.rig import Rig
from envs.scales import measure_scales
from experiments.discovery.cutting import BIN_S, cut_log, fitting_horizons, told_alike
from experiments.discovery.hypotheses import forms, hypotheses, learned_torque, unknown_directions
from experiments.discovery.measured import (
    check_simulatable,
    drop_useless,
    on_read_times,
    stale_notes,
    velocity_filter_s,
    without_sealed,
)
from jaxtune.discovery.problem import Problem


@dataclass(frozen=True)
class Question:
    """A discovery problem together with the robot and the runs that its numbers refer to."""

    problem: Problem
    """What `jaxtune.discovery` works on; it knows numbers, but no robot."""
    spec: mujoco.MjSpec
    """The nominal model."""
    rig: Rig
    """The simulator with every effect built in, which gives coordinates their names and units."""
    log: Log
    """What is compared: without signals that were filtered, and with a controller that follows an unknown one's motion
    (`envs.following`)."""
    sensed: np.ndarray
    """[axes] True where a coordinate stands for an error of a torque sensor, and not for what the robot does."""
    splits: Mapping[str, tuple[str, ...]]
    """Names of the runs by split: train, select (validation) and sealed (held-out test)."""
    notes: tuple[str, ...]
    """Sentences about what was made of the log: signals that are not used, and why, and how it was split."""

    @property
    def of_whole_runs(self) -> str:
        """The signal by which whole runs are judged: positions, or torques where motion is followed in any case."""
        return "tau" if self.problem.simulate.follows else "q"


@dataclass(frozen=True)
class _Simulator:
    """Simulates some signals of a rig. Two of equal layout and signals are equal, so they share compiled programs."""

    rig: Rig = field(compare=False)
    layout: Hashable
    signals: tuple[str, ...]
    follows: bool = False
    """Whether the controller follows measured motion (`envs.following`): `tau` is then what it asks for, and what a
    motor makes of that is between the measured torque and the joint."""

    def __call__(self, system, values, inputs, steps):
        read = self.rig.on(system).simulate(self.rig.tree(values), inputs, steps)
        tau = read["command" if self.follows else "tau"]
        read = read | {"tau": tau, "abs_tau": jnp.abs(tau)}
        return {name: read[name] for name in self.signals}


def build_question(
    log: Log,
    spec: mujoco.MjSpec,
    horizons: Sequence[float] | None = None,
    null_logs: int = 20,
    seed: int = 0,
    plain: Rig | None = None,
) -> Question:
    """Turns a log and a nominal model into a problem: hypotheses, measured segments and simulated null logs.

    It checks that the log can be simulated, before anything is compiled.

    Args:
      log: what was measured.
      spec: the nominal model.
      horizons: lengths of the segments in s; None takes those that fit the rows (`fitting_horizons`).
      null_logs: number of simulated null logs, which set the noise floor and the thresholds.
      seed: of the null logs.
      plain: a rig of the same robot and controller rate, from an earlier question, to reuse its compiled programs.

    Returns:
      The question.

    Raises:
      ValueError: the runs cannot be split, are too short for a horizon, or lack what discovery needs.
    """
    horizons = fitting_horizons(log, horizons)
    rate = check_simulatable(log, spec, horizons)
    log, moved = on_read_times(with_splits(log))
    filter_s = velocity_filter_s(log)
    log, notes = drop_useless(log)
    log = replace(log, runs=readings.with_noise(log.runs, without_sealed(log).runs))
    controller, ours = log.runs[0].controller.kind, follower(without_sealed(log), spec)
    log = followed(log, ours)
    unsealed = without_sealed(log).runs
    plain = plain or Rig(spec, log.joints, rate)
    plain.check_matches(log.joints, rate)
    rig = plain.scaled(measure_scales(plain, unsealed))
    signals, partly = _compared(log, plain.mj_model)
    follows = ours is not None
    sensed = np.array([follows and axis.effect in OF_SENSORS for axis in rig.axes])
    pushes = {axis.place: number for number, axis in enumerate(rig.axes) if axis.effect == "constant_push"}
    bin_rows = segments.rows_together(1.0 / log.rate_hz, BIN_S)
    measured = cut_log(log, rig.dt, signals, horizons)
    simulated = [followed(one, ours) for one in simulate_null_logs(log, spec, null_logs, seed)]
    nulls = [told_alike(cut_log(one, rig.dt, signals, horizons), measured, follows) for one in simulated]
    problem = Problem(
        simulate=_Simulator(plain, plain.layout, signals, follows),
        system=plain.system,
        values=rig.inner,
        axes=len(rig.axes),
        **_free_or_asked(rig, signals, controller, sensed, filter_s),
        trees=rig.trees,
        axis_trees=np.array([_one_tree(rig.trees[list(axis.joints)]) for axis in rig.axes]),
        data=measured,
        null_logs=nulls,
        bin_rows=bin_rows,
        regimes=REGIMES,
        components={name: tuple("xyz") if name == "gravity" else rig.joints for name in signals},
        least_floor=_least_floor(unsealed[0], signals, bin_rows),
        push=pushes,
        residual=learned_torque(rig.axes, LEARNED),
        residual_parts=tuple((a.place, PARTS[a.parameter]) for a in rig.axes if a.effect == LEARNED.name),
    )
    names = {split: tuple(run.name for run in runs) for split, runs in splits(log).items()}
    return Question(
        problem, spec, rig, log, sensed, names, (*log.notes, *moved, *notes, *partly, *stale_notes(unsealed))
    )


def _free_or_asked(
    rig: Rig, signals: Sequence[str], controller: str, sensed: np.ndarray, filter_s: float
) -> dict[str, Any]:
    """What is free under every hypothesis, and what the hypotheses and their forms are: fields of the problem."""
    follows, constants = controller == "unknown", SERVO_RATIOS if controller == "servo" else {}
    told = {name: row for name, row in rig.effects.items() if not follows or tells(row)}
    asked = {name: row for name, row in told.items() if name in LIBRARY}
    every = hypotheses(rig.axes, rig.places, asked, rig.slides)
    unknowns, bounds = unknown_directions(rig.axes, rig.control_hz, signals, follows, rig.loose_centres(), filter_s)
    shapes = forms(rig.axes, rig.effects, every)
    return {
        "hypotheses": every,
        # An error of a torque sensor is free, and no form of friction.
        "forms": tuple(form for form in shapes if not (form.directions[:, sensed] != 0).any()),
        "prior": np.array([constants.get(a.effect, a.prior_sd) if a.effect in told else 0.0 for a in rig.axes]),
        "unknowns": unknowns,
        "unknown_bounds": bounds,
    }


def _compared(log: Log, model: mujoco.MjModel) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the signals that are compared, and a note for each that is not.

    Some runs may lack it, or an IMU be on a first link that moves: that of a rig is on a base at rest.
    """
    counts = {name: sum(name in run.signals for run in log.runs) for name in (*sorted(segments.COMPARED), "target")}
    # Segments of all runs share one layout.
    everywhere = [name for name, count in counts.items() if count == len(log.runs)]
    partly = [name for name in segments.COMPARED if 0 < counts[name] < len(log.runs)]
    # Without targets the torque is what was sent, not measured.
    left_out = {"target"} if "target" in everywhere else {"target", "tau"}
    notes = tuple(f"{name} is not in all runs, and is not used" for name in partly)
    if "gravity" in everywhere and model.body_jntnum[1]:
        left_out, notes = {*left_out, "gravity"}, (*notes, "gravity is of a link that moves, and is not used")
    return tuple(name for name in everywhere if name not in left_out), notes


def _least_floor(run: Run, signals: Sequence[str], bin_rows: int) -> np.ndarray:
    """What the noise of the readings leaves in the mean of a bin, [cells] in the order of `Problem.cells`."""
    # One estimate for all runs (`readings.with_noise`).
    return np.concatenate([readings.noise_of(run, name) for name in sorted(signals)]) / np.sqrt(bin_rows)


def _one_tree(trees: np.ndarray) -> int:
    """The kinematic tree of some joints, or -1 where they are of several or none are given."""
    return int(trees[0]) if len(set(trees.tolist())) == 1 else -1
