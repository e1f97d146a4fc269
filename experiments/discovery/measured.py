"""The measured log that discovery works on: several folders as one, checked, and without what was filtered."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from operator import itemgetter
from pathlib import Path

import mujoco
import numpy as np

from envs import models, readings, segments
from envs.clock import evened, retimed
from envs.diagnosis.structure import pieces
from envs.diagnosis.stuck import stuck
from envs.held import held_joints, unread_joints
from envs.logs import Log, Run, read_any, splits, with_halves_swapped, with_splits
from experiments.discovery.cutting import row_rate, split_in_time

_LEAST_STALE = 0.02  # share of readings
_RATES = 1.8  # largest ratio of two runs' rates: all segments have one number of rows. A servo's logs differed by 1.5
_LATE_S = 0.001  # where velocity and position are further apart, states would follow neither


def read_logs(
    folders: Sequence[Path], clear_flags: bool = False, swap_halves: bool = False, robot: Path | None = None
) -> tuple[Log, mujoco.MjSpec]:
    """Reads the logs of one robot as a single log that can be split, and the robot's nominal model.

    Args:
      folders: of logs, or of the XL330 pendulum's JSON files.
      clear_flags: whether flags of the model that switch physics off are cleared; else they are refused.
      swap_halves: whether train changes places with select and sealed.
      robot: path of an MJCF in the place of the logs' own models.

    Returns:
      A log with the runs of all folders (of several, a run's name ends in the number of its folder), cut in time where
      its conditions are too few, and the model.

    Raises:
      ValueError: a log cannot be read, a recording is there twice, the logs are not of one robot, its base is free, or
        its model has flags that switch physics off.
    """
    logs = [read_any(folder, robot) for folder in folders]
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
    cleared = models.check_flags(spec, clear_flags)
    notes = (f"flags of the model that disabled {', '.join(cleared)} were cleared",) if cleared else ()
    if still := held_joints(spec, first.joints):
        notes += (f"not logged, so taken to be held where the model puts them: {', '.join(still)}",)
    runs = first.runs
    if len(logs) > 1:
        runs = tuple(_numbered(run, number) for number, log in enumerate(logs) for run in log.runs)
    _check_recorded_once(runs)
    notes += tuple(note for log in logs for note in log.notes)
    # Splits go by what motors do, so they are settled before stamps move.
    log = with_splits(split_in_time(replace(first, runs=runs, notes=notes)))
    log = with_halves_swapped(log) if swap_halves else log
    parts = len(log.runs) // len(runs)
    return _in_pieces(_on_lines(log, [parts * len(one.runs) for one in logs])), spec


def _check_recorded_once(runs: Sequence[Run]) -> None:
    """Refuses a recording that is there twice: it would be fitted, and tested on itself."""
    found: dict[str, str] = {}
    for run in runs:
        signals = hashlib.sha256()
        for _, values in sorted(run.signals.items()):
            signals.update(np.ascontiguousarray(values))
        first = found.setdefault(signals.hexdigest(), run.name)
        if first != run.name:
            raise ValueError(f"runs: got one recording twice, as {first} and as {run.name}; expected each once")


def _on_lines(log: Log, sizes: Sequence[int]) -> Log:
    """The log with time stamps that jitter put on lines (`evened`), each folder judged by its own runs.

    Args:
      log: with splits.
      sizes: numbers of its runs by folder, in their order.
    """
    runs = []
    for size in sizes:
        mine = log.runs[len(runs) : len(runs) + size]
        runs += evened(mine, [run for run in mine if run.split != "sealed"])
    moved = sum(run is not before for run, before in zip(runs, log.runs, strict=True))
    if not moved:
        return log
    note = f"time stamps of {moved} runs jitter and were put on a line: positions are smoother there"
    return replace(log, runs=tuple(runs), notes=(*log.notes, note))


def _in_pieces(log: Log) -> Log:
    """The log with its runs cut where a recorder missed a few rows (`pieces`); a note says where."""
    runs, cut, lost = [], [], 0.0
    taken = {run.name for run in log.runs}
    for run in log.runs:
        found = pieces(run)
        if found[0] is run:
            runs.append(run)
            continue
        cut.append(run.name)
        lost += (1.0 - sum(len(one.time) for one in found) / len(run.time)) * (run.time[-1] - run.time[0])
        names = (name for number in count() if (name := f"{run.name}_{number}") not in taken)
        # Of the same condition, so they stay in one split.
        runs += [replace(one, name=name) for one, name in zip(found, names, strict=False)]
    if not cut:
        return log
    note = (
        f"time stamps jump by up to 20 ms in {', '.join(cut)}, as where rows are missing: cut there into pieces of "
        f"half a second and more, without {lost:.2g} s"
    )
    return replace(log, runs=tuple(runs), notes=(*log.notes, note))


def _numbered(run: Run, number: int) -> Run:
    """A run of one of several folders; one that is a condition of its own stays so."""
    name = f"{run.name}_{number}"
    return replace(run, name=name, condition=name if run.condition == run.name else run.condition)


def digest(log: Log, spec: mujoco.MjSpec) -> str:
    """Computes a SHA-256 of all that a discovery reads: the runs with their controllers, and the model."""
    found = hashlib.sha256(spec.copy().to_xml().encode())
    for run in log.runs:
        told = (run.name, run.condition, run.split, run.controller.kind, run.controller.rate_hz)
        found.update(repr((*told, run.controller.between_rows)).encode())
        facts = {f"{signal}.{name}": value for signal, known in run.known.items() for name, value in known.items()}
        # A gain may have the name of a signal (`volts`).
        numbers = [("t", run.time), *run.controller.gains.items(), *run.signals.items(), *facts.items()]
        for name, values in sorted(numbers, key=itemgetter(0)):
            found.update(name.encode())
            found.update(np.ascontiguousarray(values, float))
    return found.hexdigest()


def check_simulatable(log: Log, spec: mujoco.MjSpec, horizons: Sequence[float]) -> float:
    """Checks that the runs of a log can be simulated, and that it says something of every joint that may move.

    Args:
      log: what was measured.
      spec: the nominal model.
      horizons: lengths of the segments in s.

    Returns:
      The controller's rate in Hz, which all runs share.

    Raises:
      ValueError: names the run or the joints, and what is expected.
    """
    model, least_s = models.suspended(spec, log.joints), segments.HISTORY_S + min(horizons)
    if others := unread_joints(model, log.joints):
        raise ValueError(
            f"joints: got a log without {', '.join(others)}, expected all joints that may move: log these too. If they "
            "are held, take their <joint> out of the MJCF, or give it actuators for them"
        )
    rate = log.runs[0].controller.rate_hz
    rows = [1.0 / np.median(np.diff(run.time)) for run in log.runs]
    for run, own in zip(log.runs, rows, strict=True):
        if not 1.0 / _RATES < own / rows[0] < _RATES:
            raise ValueError(
                f"{run.name}: got {own:.4g} rows a second, expected {rows[0]:.4g} as in {log.runs[0].name}"
            )
        if run.controller.rate_hz != rate:
            raise ValueError(
                f"{run.name}: controller.rate_hz: got {run.controller.rate_hz:g}, expected {rate:g} for all"
            )
        supplied = "volts" in run.signals or "volts" in run.controller.gains
        if run.controller.kind == "servo" and "target" in run.signals and not supplied:
            raise ValueError(f"{run.name}: column 'volts' is missing, and so is controller.volts of the servo")
        if run.time[-1] - run.time[0] < least_s:
            raise ValueError(f"{run.name}: got {run.time[-1] - run.time[0]:.3g} s, expected {least_s:.3g} s or more")
    return rate


def without_sealed(log: Log) -> Log:
    """Returns the log without its sealed runs (the held-out test), which only the final proof may use.

    Whatever is estimated from a log, scales and filters included, must be estimated from this.
    """
    parts = splits(log)
    return replace(log, runs=(*parts["train"], *parts["select"]))


def drop_useless(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Leaves out signals that were filtered, because their lag would be mistaken for a sensor's, or never written.

    A signal counts as filtered if the log says so. Velocities are left out too if those of a joint lag the derivative
    of its position by more than 1 ms, or are as much ahead of it: states are estimated from signals that agree.
    Positions stay: the delay of a filter that the log declares is taken out (`envs.readings`).

    Args:
      log: as it was read.

    Returns:
      The log, with the row rate of its time stamps in the place of the declared one, and a note for every signal that
      was left out.
    """
    log, notes = _drop_declared(log)
    # Sealed runs are left out here too: nothing may be decided by them.
    constant = {
        one.signal for run in without_sealed(log).runs for one in stuck(run, log.joints) if one.kind == "constant"
    }
    for name in sorted(constant):
        notes.append(f"{name} is constant while its joints move, and is not used")
        log = _without(log, name)
    if runs := [run for run in without_sealed(log).runs if "dq" in run.signals]:
        apart = segments.lateness(runs)
        worst = int(np.abs(apart).argmax())
        if abs(apart[worst]) > _LATE_S:
            which = "lags" if apart[worst] > 0 else "is ahead of"
            said = f"dq {which} q by {1e3 * abs(apart[worst]):.0f} ms at {log.joints[worst]}"
            notes.append(f"{said}, so one of them was filtered or read late, and dq is not used")
            log = _without(log, "dq")
    return replace(log, rate_hz=row_rate(log)), tuple(notes)


def on_read_times(log: Log) -> tuple[Log, tuple[str, ...]]:
    """The log with rows where all joints say that they were read (`retimed`), and a note if they moved.

    It is for logs of unknown controllers: what was sent has the time of its stamp. And it comes after the log doctor,
    which looks at stamps as they are.
    """
    if any(run.controller.kind != "unknown" for run in log.runs):
        return log, ()
    runs = retimed(log.runs, without_sealed(log).runs)
    if all(run is before for run, before in zip(runs, log.runs, strict=True)):
        return log, ()
    moves = [run.time - before.time for run, before in zip(runs, log.runs, strict=True)]
    off = 1e3 * np.concatenate([move - np.median(move) for move in moves]).std()
    note = f"time stamps jitter by {off:.2g} ms (rms), as all joints agree: rows were moved to where they were read"
    return replace(log, runs=runs), (note,)


def stale_notes(runs: Sequence[Run]) -> list[str]:
    """Says which signals repeat readings that a slow bus had not renewed."""
    notes = []
    for name in segments.COMPARED:
        found = [readings.stale(run, name).ravel() for run in runs if name in run.signals]
        share = np.concatenate(found).mean() if found else 0.0
        if share > _LEAST_STALE:
            notes.append(f"{share:.0%} of the readings of {name} repeat an older one; they are interpolated")
    return notes


def velocity_filter_s(log: Log) -> float:
    """Time constant in s of the filter that a log says its velocities went through; zero where it says nothing.

    The controller may act on the velocities that were recorded, or on others.
    """
    corners = [corner for run in log.runs if "dq" in run.signals for corner in run.fact("dq", "filter_hz")]
    known = [corner for corner in corners if np.isfinite(corner)]
    return 1.0 / (2.0 * np.pi * min(known)) if known else 0.0


def _drop_declared(log: Log) -> tuple[Log, list[str]]:
    """Leaves out signals of which the log says that they were filtered; notes say which."""
    notes = []
    for name in segments.COMPARED:
        # One column's filter counts for the signal.
        corners = [corner for run in log.runs if name in run.signals for corner in run.fact(name, "filter_hz")]
        silent = name == "tau" and not all("target" in run.signals for run in log.runs)
        needed = name == "q" or (silent and log.runs[0].controller.kind == "unknown")
        # Torques that were sent were not read.
        if (silent and not needed) or not np.isfinite(corners).any():
            continue
        corner = f"{name} was filtered at {np.nanmin(corners):g} Hz, as the log says"
        notes.append(f"{corner}; the delay is taken out" if needed else f"{corner}, and is not used")
        log = log if needed else _without(log, name)
    return log, notes


def _without(log: Log, signal: str) -> Log:
    runs = [replace(run, signals={k: v for k, v in run.signals.items() if k != signal}) for run in log.runs]
    return replace(log, runs=tuple(runs))
