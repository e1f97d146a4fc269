"""Measures a GPU with the commands that its user would give: `python -m experiments.gpu_bench --out DIR`.

Each part is one command in a process of its own, so that each begins with an empty device. A part that is finished is
not run again, and an interrupted one goes on where its own command does.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from experiments.common import checkpoint
from experiments.common.cli import console, run
from experiments.common.config import preset
from experiments.common.files import read_json, write_json

GOALS = {"environment steps per second": 500e3, "walking policy, s": 300.0, "five tunings, s": 480.0}
"""What a data-centre GPU should reach, compilation apart."""

_PYTHON = [sys.executable, "-m"]


@dataclass(frozen=True, kw_only=True)
class Args:
    """Measures speeds on this machine's GPU: training, a walking policy, five tunings, a sweep of 64 runs."""

    out: Path = Path("runs/gpu_bench")
    """Folder of the parts and of summary.json. The same command with the same folder goes on after the last part."""
    preset: str = "gpu"
    """Size of the run: gpu, or smoke (minutes, to see that it works on any machine) or cpu."""
    parts: tuple[str, ...] = ("speed", "policy", "walk", "tunings", "tunings_cached", "sweep", "profile")
    """Parts that are run now, in this order: speed (environment steps per second of training), policy (training from
    scratch), walk (how that policy walks), tunings (the main command), tunings_cached (the same again, with programs
    that are compiled already), sweep (64 runs in one program), profile (where the time of a tuning goes)."""


def commands(sizes: str, out: Path) -> dict[str, list[str]]:
    """Lists the command of every part.

    Args:
      sizes: name of the preset.
      out: folder of the whole benchmark.

    Returns:
      Module and options by part.
    """
    small = sizes == "smoke"
    envs = ["16", "32"] if small else ["4096", "8192", "16384"]
    settings = ["0.5", "1.0"] if small else ["0.25", "0.5", "1.0", "2.0"]
    tune = ["experiments.sim2sim", "--preset", sizes, "--methods", "ours"]
    return {
        "speed": [
            *["experiments.bench", "speed", "--preset", sizes, "--physics", "exact", "--envs", *envs],
            *["--out", str(out / "bench")],
        ],
        "policy": ["experiments.train", "--preset", sizes, "--out", str(out / "policy")],
        "walk": [
            *["experiments.evaluate", "--preset", sizes, "--policy", str(out / "policy"), "--out", str(out / "walk")],
            *(["--episodes", "2"] if small else []),
        ],
        "tunings": [*tune, "--out", str(out / "tunings")],
        "tunings_cached": [*tune, "--out", str(out / "tunings_cached")],
        "sweep": [
            *["experiments.sweep", "--preset", sizes, "--step-sizes", *settings, "--out", str(out / "sweep")],
            *(["--widen-factors", "2.0", "--radii", "0.2", "--levels", "0.9", "--seeds", "0"] if small else []),
        ],
        "profile": ["experiments.bench", "profile", "--preset", sizes, "--out", str(out / "bench")],
    }


def _speed(out: Path) -> dict[str, float]:
    rows = read_json(out / "bench" / "speed.json", "rows")["rows"]
    return {name: row["steps_per_second"] for name, row in rows.items()}


def _fastest(rows: Mapping[str, float]) -> float:
    """The speed with exact physics, which is that of the policy and of the tunings."""
    return max(speed for name, speed in rows.items() if name.startswith("exact"))


def _training(out: Path) -> dict[str, float]:
    curve = read_json(out / "policy" / "curve.json", "curve")["curve"]
    last = curve[-1]
    each = np.diff([0.0, *(line["seconds"] for line in curve)])
    # All lines are of equal work. The first holds the compilation, as does the one after an interruption.
    return {
        "steps": last["steps"],
        "with_compilation_s": last["seconds"],
        "without_s": float(np.median(each)) * len(each),
    }


def _tunings(place: str) -> Callable[[Path], dict[str, float]]:
    def read(out: Path) -> dict[str, float]:
        lines = [json.loads(line) for line in (out / place / "metrics.jsonl").read_text().splitlines()]
        first, last = lines[0], lines[-1]
        found = {"tunings": last["tuning"], "seconds": last["seconds"], "before_the_first_s": first["seconds"]}
        return found | {"return_start": first["return"], "return_end": last["return"]}

    return read


RESULTS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "speed": _speed,
    "policy": _training,
    "walk": lambda out: read_json(out / "walk" / "evaluation.json", "rows")["rows"],
    "tunings": _tunings("tunings"),
    "tunings_cached": _tunings("tunings_cached"),
    "sweep": lambda out: {name: read_json(out / "sweep" / "summary.json")[name] for name in ("lanes", "seconds")},
    "profile": lambda out: read_json(out / "bench" / "profile.json", "rows")["rows"],
}
"""Reads what a part has found, by part."""


def main(args: Args) -> None:
    """Runs the parts that are missing, writes summary.json, and prints what they found beside the goals.

    Raises:
      ValueError: a part has no such name, the folder holds another run, or a command has failed.
    """
    preset(args.preset)
    todo = commands(args.preset, args.out)
    for part in args.parts:
        if part not in todo:
            raise ValueError(f"parts: got '{part}', expected some of {', '.join(todo)}")
    environment = dict(os.environ)
    # This process asks for the device's name alone, and must leave its memory to the parts.
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    checkpoint.open_run(args.out, {"preset": args.preset})
    for part in args.parts:
        kept = args.out / f"{part}.json"
        if kept.exists():
            continue
        console.rule(part)
        begin = time.monotonic()
        done = subprocess.run([*_PYTHON, *todo[part]], env=environment, check=False)
        if done.returncode:
            raise ValueError(
                f"parts: '{part}' ended with code {done.returncode}; to go on, give the same command again"
            )
        write_json(kept, {"command": todo[part], "wall_s": time.monotonic() - begin, "found": RESULTS[part](args.out)})
    found = {part: read_json(args.out / f"{part}.json") for part in todo if (args.out / f"{part}.json").exists()}
    write_json(args.out / "summary.json", {"parts": found, "goals": GOALS, "versions": checkpoint.versions()})
    console.print(_table(found))


def _table(found: Mapping[str, dict]) -> Table:
    table = Table(title="what was reached")
    for column in ("", "goal", "found"):
        table.add_column(column, justify="right" if column else "left")
    reached = {
        "environment steps per second": ("speed", _fastest),
        "walking policy, s": ("policy", lambda row: row["without_s"]),
        "five tunings, s": ("tunings_cached", lambda row: row["seconds"]),
    }
    for name, (part, value) in reached.items():
        table.add_row(name, f"{GOALS[name]:,.0f}", f"{value(found[part]['found']):,.0f}" if part in found else "-")
    return table


if __name__ == "__main__":
    run(main, Args)
