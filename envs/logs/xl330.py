"""Reads recordings of a Dynamixel XL330 that turns a pendulum, in the JSON files of github.com/Rhoban/bam.

They are public measurements of one real motor, at several firmware gains.
"""

import json
from pathlib import Path

import numpy as np

from envs.logs.containment import check_inside
from envs.logs.controller import Controller
from envs.logs.files import read
from envs.logs.format import JOINT_SIGNALS, Log, Run
from envs.logs.tables import check_time, check_values

KT, RESISTANCE_OHM = 0.38, 3.6  # Nm/A and Ohm, of the published Coulomb-viscous fit
SPLIT_OF_GAIN = {100: "train", 800: "train", 200: "select", 400: "sealed"}
"""Split by the firmware's gain. The gains of validation (select) and of the held-out test (sealed) lie between those
that are fitted."""

_MASS_KG, _LENGTH_M = 0.49, 0.1
_COUNTS_PER_RAD = 4096 / (2 * np.pi)
_FIRMWARE_GAIN = 1 / (256 * 885)  # duty per count and unit of gain
_RATE_HZ = 200.0  # 185 to 250 rows a second
_FIRMWARE_HZ = 1000.0
_SIGNALS = {
    "q": "position",
    "dq": "speed",
    "target": "goal_position",
    "enabled": "torque_enable",
    "volts": "input_volts",
}
_OTHER = ("load", "temp")


def read_any(folder: Path, model: Path | None = None) -> Log:
    """Reads the log in a folder, in the project's format or as JSON files of the XL330 pendulum.

    Args:
      folder: of the log.
      model: as in `read`; the pendulum takes none, because it has its own.

    Raises:
      ValueError: it is neither, or has errors.
    """
    foreign = not (folder / "meta.yaml").exists() and any(folder.glob("*.json"))
    if foreign and model is not None:
        raise ValueError(
            f"robot: got {model}, but the logs of the XL330 pendulum in {folder} have a model of their own"
        )
    return read_xl330(folder) if foreign else read(folder, model=model)


def read_xl330(folder: Path) -> Log:
    """Reads a folder of Rhoban's JSON files as a log of the robot `pendulum`.

    A file is a run, a firmware gain is a condition, and gains decide the split (`SPLIT_OF_GAIN`). The controller is a
    servo whose gain follows from the firmware's.

    Args:
      folder: with the *.json files.

    Raises:
      ValueError: names the file, the row and the key that is missing, no number, or other than expected.
    """
    paths = sorted(Path(folder).glob("*.json"))
    if not paths:
        raise ValueError(f"{folder}: no *.json files")
    for path in paths:
        check_inside(Path(folder), path, "runs")
    runs = tuple(map(_run, paths))
    names = [run.name for run in runs]
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise ValueError(f"{path}: '{name}' is there twice")
    return Log(
        robot="pendulum",
        base="fixed",
        rate_hz=_RATE_HZ,
        joints=("hinge",),
        policy=None,
        runs=runs,
    )


def _run(path: Path) -> Run:
    try:
        recording = json.loads(path.read_text(encoding="utf-8"))
        gain, trajectory, entries = (recording[key] for key in ("kp", "trajectory", "entries"))
        for key, expected in {"mass": _MASS_KG, "length": _LENGTH_M}.items():
            if recording[key] != expected:
                raise ValueError(f"{key}: got {recording[key]!r}, expected {expected}")
        for key, kind in {"kp": int, "trajectory": str, "entries": list}.items():
            if type(recording[key]) is not kind:
                raise ValueError(f"{key}: got {recording[key]!r:.40}, expected {kind.__name__}")
        if len(entries) < 2:
            raise ValueError(f"entries: got {len(entries)}, expected 2 or more")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: {type(error).__name__}: {error}") from error
    # Everything is checked before the first value is used.
    columns = {key: _column(path, entries, key) for key in ("timestamp", *_SIGNALS.values(), *_OTHER)}
    check_time(path, "timestamp", columns["timestamp"])
    for ours, theirs in _SIGNALS.items():
        check_values(path, ours, theirs, columns[theirs])
    return Run(
        name=f"run_kp{gain}_{trajectory}",
        condition=f"kp{gain}",
        split=SPLIT_OF_GAIN.get(gain),
        controller=Controller(
            kind="servo",
            rate_hz=_FIRMWARE_HZ,
            gains={
                "gain": np.array([_COUNTS_PER_RAD * _FIRMWARE_GAIN * gain]),
                "kt": np.array([KT]),
                "resistance_ohm": np.array([RESISTANCE_OHM]),
            },
        ),
        time=columns["timestamp"],
        signals={
            ours: columns[theirs][:, None] if ours in JOINT_SIGNALS else columns[theirs]
            for ours, theirs in _SIGNALS.items()
        },
        other={key: columns[key] for key in _OTHER},
    )


def _column(path: Path, entries: list, key: str) -> np.ndarray:
    for row, entry in enumerate(entries, start=1):
        value = entry.get(key) if isinstance(entry, dict) else None
        if not isinstance(value, int | float) or not np.isfinite(value):
            raise ValueError(f"{path}, row {row}, key '{key}': got {value!r}, expected a finite number")
    return np.array([entry[key] for entry in entries], float)
