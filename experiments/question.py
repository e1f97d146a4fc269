"""From a log and a model to the question that discovery is asked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import mujoco
import numpy as np

from envs import regimes, segments
from envs.effects import LIBRARY, RESIDUAL
from envs.healthy import healthy
from envs.logs import Log, splits
from envs.rig import Rig
from jaxtune.discovery.problem import Hypothesis, Problem, Segments
from jaxtune.types import Effect

HORIZONS_S = (0.05, 0.15, 0.45)
_BIN_S = 0.01
_LEAST_SEGMENTS = 3
_LATE_S = 0.004  # a velocity that lags its position by more is a filter's, not a measurement


@dataclass(frozen=True)
class Question:
    """A problem, and what its numbers are about."""

    problem: Problem
    rig: Rig
    splits: Mapping[str, tuple[str, ...]]
    """Names of the runs by split."""
    notes: tuple[str, ...]
    """What the gate left out, and why."""


@dataclass(frozen=True)
class _Simulator:
    """What a rig reads of some signals; equal where the rig is the same."""

    rig: Rig
    signals: tuple[str, ...]

    def __call__(self, values, inputs):
        read = self.rig.simulate(self.rig.tree(values), inputs)
        return {name: read[name] for name in self.signals}


def ask(
    log: Log,
    spec: mujoco.MjSpec,
    horizons: Sequence[float] = HORIZONS_S,
    healthy_logs: int = 20,
    seed: int = 0,
    plain: Rig | None = None,
) -> Question:
    """Builds the question.

    Args:
      log: what was measured.
      spec: the nominal model.
      horizons: lengths of the segments in s.
      healthy_logs: simulated logs in which nothing is missing.
      seed: of those.
      plain: the same robot and controller rate on the rig, if it was asked about before: programs are shared.

    Raises:
      ValueError: the runs cannot be split, or are too short for a horizon.
    """
    log, notes = gate(log)
    rate = _checked(log, segments.HISTORY_S + min(horizons))
    plain = plain or Rig(spec, log.joints, rate)
    if (plain.joints, plain.control_hz) != (tuple(log.joints), rate):
        raise ValueError(f"plain: got {plain.joints} at {plain.control_hz:g} Hz, expected {log.joints} at {rate:g} Hz")
    if plain.others:
        raise ValueError(f"joints: {', '.join(plain.others)} may move too, and the log does not have them")
    rig = plain.scaled(measure_scales(plain, unsealed(log)))
    signals = tuple(name for name in ("dq", "gravity", "q") if all(name in run.signals for run in log.runs))
    nominal = rig.nominal()
    index = {(axis.effect, axis.place): number for number, axis in enumerate(rig.axes)}
    problem = Problem(
        simulate=_Simulator(plain, signals),
        values=rig.inner,
        axes=len(rig.axes),
        hypotheses=hypotheses(rig, {name: row for name, row in rig.effects.items() if name in LIBRARY}),
        prior=np.array([nominal.get(axis, 0.0) for axis in rig.axes]),
        timing=_timing(rig),
        data=_cut(log, rig, signals, horizons),
        null_logs=[_cut(healthy(log, spec, seed + number), rig, signals, horizons) for number in range(healthy_logs)],
        bin_rows=segments.rows_together(1.0 / log.rate_hz, _BIN_S),
        regimes=regimes.REGIMES,
        components={name: tuple("xyz") if name == "gravity" else rig.joints for name in signals},
        push={joint: index["constant_push", joint] for joint in rig.joints},
        residual={h.places[0]: h for h in hypotheses(rig, {RESIDUAL.name: RESIDUAL}) if len(h.places) == 1},
    )
    names = {split: tuple(run.name for run in runs) for split, runs in splits(log).items()}
    return Question(problem, rig, names, notes)


def _checked(log: Log, least_s: float) -> float:
    """The controller's rate in Hz, the same in all runs, which have what discovery needs."""
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


def unsealed(log: Log) -> Log:
    """The log without its sealed runs."""
    parts = splits(log)
    return replace(log, runs=(*parts["train"], *parts["select"]))


def gate(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Takes out what is no measurement, and says so."""
    notes = []
    late = [segments.velocity_lag(run) for run in unsealed(log).runs if "dq" in run.signals]
    if late and np.median(late) > _LATE_S:
        notes.append(f"dq lags q by {1e3 * np.median(late):.0f} ms: it is filtered, and not used")
        runs = [replace(run, signals={k: v for k, v in run.signals.items() if k != "dq"}) for run in log.runs]
        log = replace(log, runs=tuple(runs))
    # The recorded rate; time stamps win.
    rate = 1.0 / float(np.median([np.median(np.diff(run.time)) for run in log.runs]))
    return replace(log, rate_hz=rate), tuple(notes)


def measure_scales(rig: Rig, log: Log) -> dict[str, np.ndarray]:
    """What one unit of a coordinate stands for at every place: what the robot did in this log."""
    torque, speed, limit, pose = [], [], [], []
    for run in log.runs:
        position, velocity = np.moveaxis(segments.smoothed(run), 1, 0)
        asked, most = regimes.control_torque(run, position, velocity)
        torque.append(asked)
        speed.append(velocity)
        limit.append(np.where(np.isfinite(most), most, 0.0))
        pose.append(position)
    mass, inertia = rig.inertias(np.concatenate(pose).mean(axis=0))
    return {
        "torque": _rms(torque),
        "damping": _rms(torque) / _rms(speed),
        "stiffness": _rms(torque) / 0.02,
        "inertia": inertia,
        "mass": mass,
        "drag": mass * 9.81,  # N s/m that weigh as much as the link at 1 m/s
        "speed": _rms(speed),
        "slow": 0.1 * _rms(speed),
        "motor": np.maximum(np.concatenate(limit).max(axis=0), 1e-6) / _rms(speed),
    }


def _rms(values: Sequence[np.ndarray]) -> np.ndarray:
    return np.sqrt((np.concatenate(values) ** 2).mean(axis=0)) + 1e-6


def hypotheses(rig: Rig, rows: Mapping[str, Effect]) -> tuple[Hypothesis, ...]:
    """Every effect at every place alone, at left/right pairs, and at all of them."""
    index = {(axis.effect, axis.parameter, axis.place): number for number, axis in enumerate(rig.axes)}
    found = []
    for name, row in rows.items():
        free = [number for number, parameter in enumerate(row.parameters) if not parameter.shape]
        sizes = np.zeros((len(free) if len(free) > 1 else len(row.sizes), len(row.parameters)))
        if len(free) > 1:
            sizes[np.arange(len(free)), free] = row.sizes[0]
        else:
            sizes[:, free[0]] = row.sizes
        for places in place_sets(rig.places[row.on]):
            directions = np.zeros((len(row.parameters), len(rig.axes)))
            for number, parameter in enumerate(row.parameters):
                scale = dict(zip(rig.places[row.on], rig.scale(row, parameter), strict=True))
                for place in places:
                    # The same physical size everywhere, whatever a coordinate stands for there.
                    ratio = scale[places[0]] / scale[place]
                    factor = 1.0 / ratio if parameter.form == "reciprocal" else ratio
                    shared = parameter.form == "ratio"
                    directions[number, index[name, parameter.name, place]] = 1.0 if shared else factor
            found.append(
                Hypothesis(
                    name=name,
                    family=row.family,
                    places=places,
                    directions=directions,
                    probes=sizes,
                    bounds=_bounds(rig, row, places),
                    prior=np.array([parameter.prior for parameter in row.parameters]),
                    joints=tuple(sorted({joint for place in places for joint in rig.moves(row.on, place)})),
                )
            )
    return tuple(found)


def _bounds(rig: Rig, row: Effect, places: Sequence[str]) -> np.ndarray:
    """Least and largest coordinates, [parameters, 2]; no less is taken from a model's field than there is."""
    bounds = np.array([parameter.bounds for parameter in row.parameters], float)
    for number, parameter in enumerate(row.parameters):
        if parameter.form == "added" and row.on == "joint" and parameter.fields:
            at = [rig.joints.index(place) for place in places]
            there = getattr(rig.mj_model, parameter.fields[0])[rig.dof[at]] / rig.scale(row, parameter)[at]
            bounds[number, 0] = max(bounds[number, 0], -0.9 * there.min())
    return bounds


def _timing(rig: Rig) -> np.ndarray:
    """Half a period of the controller, as the delay of all readings and as that of all targets, [2, axes]."""
    late = [[axis.effect == effect for axis in rig.axes] for effect in ("sensor_delay", "command_delay")]
    return np.array(late, float) * 0.5 / rig.control_hz


def place_sets(places: Sequence[str]) -> list[tuple[str, ...]]:
    """Each alone, left and right together, all."""
    pairs = [(one, one.replace("left", "right")) for one in places if "left" in one]
    sets = [(place,) for place in places] + [pair for pair in pairs if pair[1] in places]
    return sets if len(places) < 2 or tuple(places) in sets else [*sets, tuple(places)]


def _cut(log: Log, rig: Rig, signals, horizons) -> dict[str, dict[float, Any]]:
    names = {split: {run.name for run in runs} for split, runs in splits(log).items()}
    labels = [regimes.regimes(run) for run in log.runs]
    data: dict[str, dict[float, Any]] = {split: {} for split in names}
    for horizon in horizons:
        # All runs at once: segments of equal shape compile once.
        cut = segments.cut(log.runs, horizon, rig.dt, _BIN_S)
        label = np.stack([labels[run][rows] for run, rows in zip(cut.run, cut.row, strict=True)])
        for split in names:
            mine = np.array([log.runs[run].name in names[split] for run in cut.run])
            if mine.sum() < _LEAST_SEGMENTS:
                raise ValueError(
                    f"runs: '{split}' has {mine.sum()} segment(s) of {horizon:g} s, expected {_LEAST_SEGMENTS} or "
                    "more: record longer runs, more of them, or ask for shorter horizons"
                )
            data[split][horizon] = Segments(
                inputs=jax.tree.map(lambda leaf, mine=mine: leaf[mine], cut.segments),
                signals={name: cut.signals[name][mine] for name in signals},
                run=cut.run[mine],
                regimes=label[mine],
            )
    return data
