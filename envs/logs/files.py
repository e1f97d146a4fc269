"""Reads and writes logs, folders of `meta.yaml` and runs, and checks them.

A damaged log is refused with the file, the row and the column; it is never repaired in silence.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from envs.logs.bags import SUFFIXES, is_bag, read_bag
from envs.logs.containment import check_inside
from envs.logs.format import (
    FACTS,
    JOINT_SIGNALS,
    MEASURED,
    OBSERVATION,
    SCALAR_SIGNALS,
    VECTOR_SIGNALS,
    Controller,
    Log,
    Run,
    column_names,
    is_observation,
)
from envs.logs.meta import Meta
from envs.logs.tables import READERS, WRITERS, check_time, check_values, refuse_first
from envs.models import BUILT_IN, one_file

_MODELS = (".xml", ".mjcf", ".urdf")  # suffixes
_UNIT_NORM = 0.05  # tolerance of the length of unit vectors
_COARSE_S = 1e-9  # resolution of time stamps that are taken as they are
_RATE_RATIO = 2.0  # largest ratio of nominal to recorded rate, or the reverse


def read(folder: Path, measured: bool = True, model: Path | None = None) -> Log:
    """Reads a log and checks everything about it before anything is computed.

    Args:
      folder: with `meta.yaml` and the runs.
      measured: True for a measured log, which needs positions. False for targets that a robot is still to play.
      model: path of an MJCF, which may be anywhere, or name of a built-in robot, in the place of the log's own `robot`.
        A log's own model, and all that it refers to, must be in its folder.

    Returns:
      The log in the model's names, units and signs.

    Raises:
      ValueError: names the file, the row (of data, from 1) or the key, what was found and what was expected.
    """
    folder = Path(folder)
    meta = Meta(folder, {name: joints for name, (_, joints) in BUILT_IN.items()}, model)
    return _read(folder, meta, "q" if measured else "target")


def read_observed(folder: Path) -> Log:
    """Reads a log of what a policy observed and did, of any robot: `t`, `obs.*` and `action.*` are enough.

    `robot` may be any name, `joints` names the components of the action, and `base` and `controller` may be missing.

    Raises:
      ValueError: as `read`.
    """
    folder = Path(folder)
    return _read(folder, Meta(folder, None), OBSERVATION)


def _read(folder: Path, meta: Meta, needed: str) -> Log:
    paths = sorted(folder.glob("run_*"))
    for path in paths:
        check_inside(folder, path, "runs")
        if not (path.suffix in READERS and path.is_file()) and not is_bag(path):
            raise ValueError(
                f"{path}: expected a file that ends in one of {', '.join((*READERS, *SUFFIXES))}, or a bag's folder"
            )
    stems = [path.stem for path in paths]
    if not paths:
        raise ValueError(f"{folder}: no runs; expected run_*.csv, .npz, .parquet or a bag")
    for stem in stems:
        if stems.count(stem) > 1:
            raise ValueError(f"{folder}: run '{stem}' is there twice, expected one file for each run")
    for name in meta.runs:
        if name not in stems:
            raise ValueError(f"{meta.path}: runs.{name}: there is no such run; found {', '.join(stems)}")
    read = [_run(path, meta, needed) for path in paths]
    return Log(
        robot=meta.robot,
        base=meta.base,
        rate_hz=meta.rate_hz,
        joints=meta.joints,
        policy=meta.policy,
        runs=tuple(run for run, _ in read),
        convention=meta.convention,
        notes=tuple(note for _, notes in read for note in notes),
    )


def write(log: Log, folder: Path, suffix: str = ".csv") -> None:
    """Writes a log in the model's names and its own units and signs (`Log.convention`); `read` returns the same log.

    `meta.yaml` is written last, and in one step, so that another program which waits for it finds all runs complete. A
    robot that is the path of an MJCF is written too, as one file, so that the folder can be moved as a whole.

    Args:
      log: to write.
      folder: to write to; new or empty.
      suffix: of the runs' files: .csv, .npz or .parquet.

    Raises:
      ValueError: the folder is not empty, the suffix is unknown, a run's name does not begin with `run_`, or the
        robot's model cannot be read.
    """
    folder = Path(folder)
    if suffix not in WRITERS:
        raise ValueError(f"suffix: got '{suffix}', expected one of {', '.join(WRITERS)}")
    for run in log.runs:
        if not run.name.startswith("run_"):
            raise ValueError(f"runs: got '{run.name}', expected a name that begins with 'run_'")
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder}: expected an empty folder")
    by_path = log.robot not in BUILT_IN and Path(log.robot).suffix in _MODELS and Path(log.robot).is_file()
    model = one_file(log.robot) if by_path else None
    folder.mkdir(parents=True, exist_ok=True)
    if model is not None:
        (folder / Path(log.robot).name).write_text(model, encoding="utf-8")
    meta = {
        "robot": log.robot if model is None else Path(log.robot).name,
        "base": log.base,
        "rate_hz": log.rate_hz,
        "joints": list(log.joints),
        **_as_meta(log.runs[0].controller),
        "runs": {},
    }
    for key in ("units", "sign"):
        if said := dict(getattr(log.convention, key)):
            meta[key] = said
    if known := _facts_as_meta(log):
        meta["signals"] = known
    if log.policy is not None:
        meta["policy"] = dict(log.policy)
    for run in log.runs:
        entry = {"condition": run.condition, **_as_meta(run.controller)}
        meta["runs"][run.name] = entry | ({"split": run.split} if run.split else {})
        columns = {"t": run.time} | dict(run.other)
        for signal, values in run.signals.items():
            values = values.reshape(len(run.time), -1) / log.convention.factors.get(signal, 1.0)
            numbered = [f"{OBSERVATION}.{number}" for number in range(values.shape[1])]
            names = numbered if signal == OBSERVATION else column_names(signal, log.joints)
            columns |= dict(zip(names, values.T, strict=True))
        WRITERS[suffix](folder / f"{run.name}{suffix}", columns)
    # Renaming makes it appear complete, and after all runs.
    draft = folder / "meta.yaml.partial"
    draft.write_text(yaml.safe_dump(meta, sort_keys=False))
    draft.rename(folder / "meta.yaml")


def _as_meta(controller: Controller | None) -> dict:
    if controller is None:
        return {}
    # No limit is an infinite one, which `meta.yaml` expresses by leaving it out.
    gains = {name: values.tolist() for name, values in controller.gains.items() if np.isfinite(values).all()}
    own = {"type": controller.kind, "rate_hz": controller.rate_hz, "target_between_rows": controller.between_rows}
    return {"controller": own | gains}


def _facts_as_meta(log: Log) -> dict:
    """Writes what is known of every column that the first run has; all runs must know the same."""
    first, found = log.runs[0], {}
    for run in log.runs:
        for signal, fact in ((signal, fact) for signal in MEASURED if signal in run.signals for fact in FACTS):
            values = run.fact(signal, fact)
            same = signal in first.signals and np.array_equal(values, first.fact(signal, fact), equal_nan=True)
            if not same and np.isfinite(values).any():
                raise ValueError(f"{run.name}: {signal}: got another {fact} than in {first.name}, expected one")
            own = _scaled({fact: values}, 1.0 / log.convention.factors.get(signal, 1.0))[fact]
            for column, value in zip(column_names(signal, log.joints), own, strict=True):
                if np.isfinite(value):
                    found.setdefault(column, {})[fact] = float(value)
    return found


def _run(path: Path, meta: Meta, needed: str) -> tuple[Run, list[str]]:
    """Reads a run, and notes about what was made of it."""
    columns, notes = read_bag(path, meta.columns) if is_bag(path) else (READERS[path.suffix](path, meta.uses), [])
    for name in [name for name in columns if not meta.uses(name)]:
        if columns[name] is None or not np.isfinite(columns[name]).all():
            del columns[name]
            notes.append(f"{path.stem}: column '{name}' was left out: it is not known, and not one finite number a row")
    for name, values in columns.items():
        refuse_first(path, name, values, ~np.isfinite(values), "a finite number")
    columns = _rename(path, columns, meta)
    time = columns.pop("t")
    if len(time) < 2:
        raise ValueError(f"{path}: got {len(time)} row(s), expected 2 or more")
    check_time(path, meta.columns.get("t", "t"), time)
    if np.spacing(time[-1]) > _COARSE_S:
        # Of a wall clock: what is computed with seconds since 1970 would be rounded again and again.
        time = time - time[0]
    rate = 1.0 / np.median(np.diff(time))
    if not 1 / _RATE_RATIO <= rate / meta.rate_hz <= _RATE_RATIO:
        raise ValueError(f"{path}, column 't': got {rate:.6g} rows a second, expected rate_hz, {meta.rate_hz:g}")
    signals = _signals(path, columns, meta)
    entry = meta.runs.get(path.stem, {"controller": meta.controller})
    known = {signal: facts for signal, facts in meta.facts.items() if signal in signals}
    _convert(path, signals, known, meta, entry["controller"])
    if needed == OBSERVATION:
        for name, column in ((OBSERVATION, "obs.0"), ("action", column_names("action", meta.joints)[0])):
            if name not in signals:
                raise ValueError(f"{path}, column '{column}': is missing, which a log of what a policy did needs")
    elif needed not in signals:
        raise ValueError(f"{path}, column '{column_names(needed, meta.joints)[0]}': is missing")
    elif not {"target", "tau"} & set(signals):
        raise ValueError(f"{path}: there is neither '{column_names('target', meta.joints)[0]}' nor 'tau' or 'current'")
    if entry["controller"] is not None and entry["controller"].kind == "unknown" and needed != OBSERVATION:
        notes += _keep_measured(path, signals, meta)
    run = Run(
        name=path.stem,
        condition=entry.get("condition", path.stem),
        split=entry.get("split"),
        controller=entry["controller"],
        time=time,
        signals=signals,
        other=columns,
        known=known,
    )
    return run, notes


def _keep_measured(path: Path, signals: dict[str, np.ndarray], meta: Meta) -> list[str]:
    """Takes out what an unknown controller was told, which says nothing of its torques, and returns a note of it."""
    if "tau" not in signals:
        raise ValueError(
            f"{path}, column '{column_names('tau', meta.joints)[0]}': is missing, which a log of an unknown controller "
            "needs: torques that were measured, with their signs"
        )
    left = [name for name in ("target", "enabled") if signals.pop(name, None) is not None]
    return [f"{path.stem}: not used, since the controller is unknown: {', '.join(left)}"] if left else []


def _signals(path: Path, columns: dict[str, np.ndarray], meta: Meta) -> dict[str, np.ndarray]:
    """Takes the signals out of the columns and checks them."""
    signals = {}
    for signal in (*JOINT_SIGNALS, *VECTOR_SIGNALS, *SCALAR_SIGNALS):
        names = column_names(signal, meta.joints)
        there = [name for name in names if name in columns]
        if not there:
            continue
        for name in names:
            if name not in columns:
                raise ValueError(f"{path}, column '{name}': is missing, although '{there[0]}' is there")
        values = [columns.pop(name) for name in names]
        for name, one in zip(names, values, strict=True):
            check_values(path, signal, meta.columns.get(name, name), one)
        signals[signal] = np.stack(values, axis=1) if len(names) > 1 or "." in names[0] else values[0]
    numbered = [name for name in columns if is_observation(name)]
    for name in columns:
        if name.startswith(f"{OBSERVATION}.") and name not in numbered:
            raise ValueError(f"{path}, column '{name}': expected {OBSERVATION}.0, {OBSERVATION}.1, ...")
    for number in range(len(numbered)):
        if f"{OBSERVATION}.{number}" not in columns:
            raise ValueError(
                f"{path}, column '{OBSERVATION}.{number}': is missing, although '{max(numbered)}' is there"
            )
    if numbered:
        values = [columns.pop(f"{OBSERVATION}.{number}") for number in range(len(numbered))]
        signals[OBSERVATION] = np.stack(values, axis=1)
    for signal in ("gravity", "quat"):
        if signal in signals:
            norm = np.linalg.norm(signals[signal], axis=1)
            refuse_first(path, f"{signal}.*", norm, abs(norm - 1) > _UNIT_NORM, "a vector of length one")
    return signals


def _convert(path: Path, signals: dict, known: dict, meta: Meta, controller: Controller | None) -> None:
    """Converts signals, and what is known of them, to the model's units and signs, and currents to torques."""
    for signal, factor in meta.convention.factors.items():
        if signal in signals:
            signals[signal] = signals[signal] * factor
        if signal in known:
            known[signal] = _scaled(known[signal], factor)
    if "current" in signals and "tau" not in signals:
        if controller is None or "kt" not in controller.gains:
            name = column_names("current", meta.joints)[0]
            raise ValueError(f"{path}, column '{name}': {meta.path}: controller.kt: is missing, in Nm/A at the joint")
        signals["tau"] = controller.gains["kt"] * signals.pop("current")
        if "current" in known:
            known["tau"] = _scaled(known.pop("current"), controller.gains["kt"])


def _scaled(facts: Mapping[str, np.ndarray], factor: np.ndarray | float) -> dict[str, np.ndarray]:
    """Converts what is known of a signal; noise and rounding have its unit, and no sign."""
    sized = ("noise_sd", "quantum")
    return {name: value * np.abs(factor) if name in sized else value for name, value in facts.items()}


def _rename(path: Path, columns: dict[str, np.ndarray], meta: Meta) -> dict[str, np.ndarray]:
    """Renames foreign columns to the format's names."""
    for ours, theirs in meta.columns.items():
        if theirs not in columns:
            raise ValueError(f"{path}, column '{theirs}': is missing, which {meta.path} maps to '{ours}'")
        if ours in columns and ours not in meta.columns.values():
            raise ValueError(f"{path}, column '{ours}': is there, although {meta.path} maps '{theirs}' to that name")
    foreign = {theirs: ours for ours, theirs in meta.columns.items()}
    columns = {foreign.get(name, name): values for name, values in columns.items()}
    if "t" not in columns:
        raise ValueError(f"{path}, column 't': is missing")
    # A misspelt joint is an error, not a column that the format does not know.
    for name in columns:
        prefix = name.partition(".")[0]
        ours = prefix in (*JOINT_SIGNALS, *VECTOR_SIGNALS) and "." in name
        if ours and name not in meta.known:
            expected = ", ".join(column_names(prefix, meta.joints))
            raise ValueError(f"{path}, column '{name}': is not known; expected {expected}")
    return columns
