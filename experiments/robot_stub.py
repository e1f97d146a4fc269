"""Plays a simulated robot that answers through files: `python -m experiments.robot_stub --folder RUN`.

It stands in for a real robot, so that `sim2real` can be tried without one; `experiments.robot.surrogate` describes
BITeno's body. Another robot (`--robot`) is its own simulation with parameters that are hidden. For every
`RUN/**/round_*/request.json` beside an exported policy it walks with that policy and writes `round_*/log`. For targets
of `experiments.excite` in `RUN/**/hung/targets` BITeno plays them suspended and writes `hung/log`. The learner sees
nothing of it but these files.
"""

import json
import math
import os
import shutil
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from envs.biteno import constants
from envs.logs import Log, read, write
from experiments.common.cli import console, run
from experiments.robot.simulated import SimulatedRobot
from experiments.robot.surrogate import Body, Robot
from experiments.walking.robots import BITENO, kind


@dataclass(frozen=True, kw_only=True)
class Args:
    """Plays a simulated robot: walks with the policies in a folder, plays targets while suspended, and writes logs."""

    robot: str = "biteno"
    """Robot and task: biteno, go2, playground:NAME (an environment of MuJoCo Playground) or playground-warp:NAME (the
    same by MuJoCo Warp), or path/to/file.py:function, which returns a jaxtune.mjx.Simulator or an environment."""
    folder: Path
    """Folder that is searched, at any depth, for requests to walk (`round_*/request.json` beside `round_*/policy`) and
    for targets to play while suspended (`hung/targets`)."""
    body: Body = field(default_factory=Body)
    """Properties of biteno's body; masses, friction and torque are multiples of the nominal model's. Other robots take
    --truth."""
    truth: tuple[str, ...] = ()
    """True values of another robot's parameters, name=value; those that are left out are nominal."""
    idle_s: float = 3600.0
    """The program ends after this many seconds without a request."""
    parent: int | None = None
    """Id of the process that started it, with which it ends."""
    seed: int = 0
    """Random seed of its noise and, together with the request's own seed, of its commands."""


def answer(place: Path, robot: Robot | SimulatedRobot, seed: int) -> Sequence[bool]:
    """Answers a request: walks as often and as long as it says, and writes the log.

    Args:
      place: folder of the request and the policy.
      robot: a robot that stands on the ground.
      seed: of its noise.

    Returns:
      Whether each walk ended in a fall.

    Raises:
      ValueError: request or policy cannot be read.
    """
    request = _request(place / "request.json")
    exported = place / "policy" / "policy.npz"
    try:
        policy = robot.load(exported)
    except (KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{exported}: {error!r}, expected what experiments.export writes") from error
    # A generator for every walk, so that a walk does not depend on how long the one before it lasted.
    rngs = [np.random.default_rng((seed, request["seed"], index)) for index in range(request["episodes"])]
    walked = [robot.walk(f"run_{index:03d}", policy, request["seconds"], rng) for index, rng in enumerate(rngs)]
    _put(robot.log(policy.meta, tuple(run for run, _ in walked)), place)
    return [fell for _, fell in walked]


def _request(path: Path) -> dict:
    request = json.loads(path.read_text())
    checks = {
        "episodes": ("a positive integer", lambda value: isinstance(value, int) and value > 0),
        "seconds": ("a positive number", lambda value: isinstance(value, int | float) and 0 < value < math.inf),
        "seed": ("an integer that is not negative", lambda value: isinstance(value, int) and value >= 0),
    }
    for name, (expected, fits) in checks.items():
        value = request.get(name) if isinstance(request, dict) else None
        if not fits(value):
            raise ValueError(f"{path}: {name}: got {value!r}, expected {expected}")
    return request


def play_targets(place: Path, robot: Robot, seed: int) -> None:
    """Plays the targets of a folder on the suspended robot, and writes the log that discovery reads.

    Args:
      place: folder that holds `targets`; `log` is written beside it.
      robot: a robot that is suspended.
      seed: of its noise.

    Raises:
      ValueError: the targets are for other joints or a free base, or cannot be played.
    """
    targets = read(place / "targets", measured=False)
    for name, expected in {"joints": constants.JOINTS, "base": "fixed"}.items():
        if getattr(targets, name) != expected:
            raise ValueError(f"{place / 'targets'}: {name}: got {getattr(targets, name)}, expected {expected}")
    rngs = [np.random.default_rng((seed, index)) for index in range(len(targets.runs))]
    runs = tuple(robot.play(run, rng) for run, rng in zip(targets.runs, rngs, strict=True))
    _put(replace(targets, runs=runs), place)


def _put(log: Log, place: Path) -> None:
    """Writes the log whole or not at all, because another process may be waiting to read it."""
    draft = place / f"log.{os.getpid()}.partial"
    shutil.rmtree(draft, ignore_errors=True)
    write(log, draft, ".parquet")
    draft.rename(place / "log")


def stand_in(args: Args) -> tuple[Robot | SimulatedRobot, Robot | None]:
    """Makes the robot that walks, and the same robot suspended if it can be.

    Raises:
      ValueError: there is no such robot, a true value is not in its table, or the robot does not take the option.
    """
    return _STAND_INS.get(args.robot, _simulated)(args)


def _embodied(args: Args) -> tuple[Robot, Robot]:
    if args.truth:
        raise ValueError(
            f"truth: got {' '.join(args.truth)}, but {args.robot} has a body of its own; expected --body.*"
        )
    return Robot(args.body), Robot(args.body, suspended=True)


def _simulated(args: Args) -> tuple[SimulatedRobot, None]:
    if args.body != Body():
        raise ValueError(f"body: got {args.body}, but {args.robot} is its own simulation; expected --truth name=value")
    return SimulatedRobot(kind(args.robot), args.truth), None


_STAND_INS = {BITENO.name: _embodied}
"""Robots that have a body of their own, `Body`."""


def main(args: Args) -> None:
    """Answers requests until none has come for `idle_s`, or until its parent is gone; why it refuses: `refused.txt`."""
    standing, suspended = stand_in(args)
    last = time.monotonic()
    while time.monotonic() - last < args.idle_s and args.parent in (None, os.getppid()):
        jobs = [(path.parent, answer, standing) for path in args.folder.glob("**/round_*/request.json")]
        hung = args.folder.glob("**/hung/targets/meta.yaml") if suspended else ()
        jobs += [(path.parent.parent, play_targets, suspended) for path in hung]
        for place, does, robot in sorted(jobs, key=lambda job: job[0]):
            if (place / "log").exists() or (place / "refused.txt").exists() or args.parent not in (None, os.getppid()):
                continue
            try:
                does(place, robot, args.seed)
                console.print(f"{place}: answered")
            except (ValueError, OSError) as error:
                if (place / "log").exists():  # another process was faster
                    continue
                # Whole or not at all, because the learner reads the file as soon as it exists.
                draft = place / f"refused.{os.getpid()}.partial"
                draft.write_text(f"{error}\n")
                draft.rename(place / "refused.txt")
                console.print(f"{place}: refused: {error}", highlight=False, markup=False)
            last = time.monotonic()
        time.sleep(0.5)


if __name__ == "__main__":
    run(main, Args)
