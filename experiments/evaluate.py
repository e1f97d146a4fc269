"""Measures how well a policy walks in a target: `python -m experiments.evaluate --out DIR --target mujoco_c`.

It makes three measurements: a grid of commands that are held for 5 s each, episodes of the full time limit under the
task's own commands, and the same with pushes.
"""

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from rich.table import Table

from envs.biteno import constants
from envs.targets.protocol import Commands
from experiments.common import checkpoint, compiler, film, plots
from experiments.common.cli import bars, console, run
from experiments.common.config import PRESETS, named_values, preset
from experiments.common.files import write_json
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from experiments.walking.quality import quality, record_walks
from experiments.walking.robots import BITENO
from experiments.walking.targets import TARGETS
from jaxtune.mjx import parameters

GRID = tuple(itertools.product((-0.4, 0.0, 0.4, 0.8), (-0.3, 0.0, 0.3), (-0.8, 0.0, 0.8)))
"""Velocity commands (forward in m/s, sideways in m/s, turning in rad/s) that are measured one by one."""

_GRID_S = 5.0  # how long each of them is held


@dataclass(frozen=True, kw_only=True)
class Args:
    """Measures how well a policy walks in a simulator: gait, tracking of commands, falls and return."""

    out: Path = Path("runs/evaluate")
    """Folder of evaluation.json, gait.png, film.png and walk.gif."""
    policy: str = "walk"
    """Policy: walk (ships with the package), or a folder of experiments.train."""
    target: str = "mjx"
    """Engine of the simulator: mjx, mujoco_c or bullet."""
    set: tuple[str, ...] = ()
    """Parameters that are not nominal, as name=value, such as foot_friction=0.5 (a multiple of nominal)."""
    preset: str = "cpu"
    """Preset whose network and time limit are used: smoke (episodes of 0.8 s), cpu or gpu (20 s)."""
    physics: str = "exact"
    """Physics: exact (sub-steps of 1 ms) or fast (2 ms)."""
    episodes: int = 100
    """Number of full-length episodes (20 s; 0.8 s with smoke) without pushes, and again with pushes."""
    push: float = 0.5
    """Change of velocity by a push, in m/s; a push comes every 4 s."""
    seed: int = 0
    """Random seed of commands, resets and pushes."""
    video: bool = False
    """Also write the walk as walk.gif."""


def check(args: Args) -> dict[str, float]:
    """Checks the arguments, and reads the physical values of the target that `--set` gives, by name.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    for field, allowed in {"target": TARGETS, "preset": PRESETS}.items():
        if getattr(args, field) not in allowed:
            raise ValueError(f"{field}: got '{getattr(args, field)}', expected one of {', '.join(allowed)}")
    if args.episodes < 1:
        raise ValueError(f"episodes: got {args.episodes}, expected 1 or more")
    if not 0 <= args.push < float("inf"):
        raise ValueError(f"push: got {args.push}, expected a number that is not negative")
    return named_values("set", args.set, constants.ENTRIES)


def main(args: Args) -> None:
    """Makes the three measurements, prints them as a table, and writes evaluation.json and pictures.

    Raises:
      ValueError: an option is wrong, the policy cannot be loaded, or the engine is not installed.
    """
    compiler.set_up(preset(args.preset).xla_flags)
    params = check(args)
    checkpoint.check_writable(args.out)
    sizes = preset(args.preset)
    # A learner needs a parameter; foot friction at its nominal value changes nothing.
    entries = BITENO.chosen(",".join(dict.fromkeys(("foot_friction", *params))))
    task = dataclasses.replace(sizes.task, physics=args.physics)
    pushed = dataclasses.replace(task, push_mps=args.push)
    learners = {
        name: Learner(dataclasses.replace(sizes, task=task), entries)
        for name, task in (("none", task), ("pushes", pushed))
    }
    policy = starting_policy(args.policy, learners["none"])
    act = learners["none"].act(policy)
    values = parameters.nominal(entries) | params
    targets = {name: TARGETS[args.target](learner.robot, values) for name, learner in learners.items()}
    key = jax.random.PRNGKey(args.seed)
    short, long = (round(seconds / constants.POLICY_DT_S) for seconds in (_GRID_S, task.episode_s))
    command = np.repeat(np.array(GRID, np.float32)[:, None], short, axis=1)
    with bars() as progress:
        task = progress.add_task("walks", total=1 + len(targets))
        grid = record_walks(targets["none"], key, act, len(GRID), short, Commands(command=command))
        rows = {"grid": quality(*grid)}
        for name, target in targets.items():
            progress.advance(task)
            rows[name] = quality(*record_walks(target, jax.random.fold_in(key, len(rows)), act, args.episodes, long))
        progress.advance(task)

    _print_table(args, rows)
    by_command = [
        {"command": one, **quality(*jax.tree.map(lambda leaf, row=row: leaf[row : row + 1], grid))}
        for row, one in enumerate(GRID)
    ]
    write_json(
        args.out / "evaluation.json",
        {"args": args, "rows": rows, "grid": by_command, "versions": checkpoint.versions()},
    )
    # The pictures show a straight walk at medium speed.
    _, recording = jax.tree.map(lambda leaf: leaf[GRID.index((0.4, 0.0, 0.0))], grid)
    plots.gait(args.out / "gait.png", recording.foot_force[..., 2], recording.phase)
    try:
        film.strip(args.out / "film.png", learners["none"].robot.mj_model, recording.qpos)
        if args.video:
            film.gif(args.out / "walk.gif", learners["none"].robot.mj_model, recording.qpos)
    except film.NoPicture as error:
        console.print(f"no film: {error}", markup=False)


def _print_table(args: Args, rows: dict[str, dict[str, float]]) -> None:
    table = Table(title=f"{args.policy} in {args.target} {' '.join(args.set)}")
    table.add_column("")
    headings = {"grid": "command grid", "none": "no pushes", "pushes": "pushes"}
    for name in rows:
        table.add_column(headings[name], justify="right")
    for name in rows["grid"]:
        table.add_row(name, *(f"{row[name]:.3f}" for row in rows.values()))
    table.add_section()
    table.add_row("clock_hz", *[f"{constants.CLOCK_HZ:.3f}"] * len(rows))
    console.print(table)


if __name__ == "__main__":
    run(main, Args)
