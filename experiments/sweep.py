"""Runs the tuner with every combination of its settings: `python -m experiments.sweep --out DIR`.

Every combination of step size, widening factor, first radius, level and seed is a lane of one vmapped `Tuner.run`
against one target. The policy is fixed, so a lane costs only simulation and the training of the tuner's two models.
The update is the paper's, because the posterior update has no step size.
"""

import dataclasses
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from envs.targets.mjx import MjxTarget
from experiments.common import checkpoint, plots
from experiments.common.cli import bars, console, run
from experiments.common.config import Preset, named_values, preset
from experiments.walking.cases import Case, check_positive, checked_case, errors
from experiments.walking.learner import Learner, Policy
from experiments.walking.policies import default_policy, starting_policy
from experiments.walking.robots import Kind, kind
from jaxtune import dist as dists
from jaxtune import tuner
from jaxtune.mjx import Entry, parameters
from jaxtune.types import Coords, Verdict


@dataclass(frozen=True, kw_only=True)
class Args:
    """Tunes one simulator with every combination of the tuner's settings, as one compiled program."""

    out: Path = Path("runs/sweep")
    """Folder of summary.json and heat_map.png."""
    robot: str = "biteno"
    """Robot and task: biteno, go2, playground:NAME (an environment of MuJoCo Playground), or path/to/file.py:function,
    which returns a jaxtune.mjx.Simulator or an environment."""
    case: str = "mass"
    """How the target differs: friction or mass."""
    start: float = 0.5
    """Where the simulator starts, as a multiple of the target's values."""
    truth: tuple[str, ...] = ()
    """True values of the target, name=value, in place of what the case says; parameters that are left out are
    nominal."""
    step_sizes: tuple[float, ...] = (0.25, 0.5, 1.0)
    """Steps of the paper's update, in radii per unit of vote."""
    widen_factors: tuple[float, ...] = (1.5, 2.0)
    """Factors on the radius every time the gate rejects."""
    radii: tuple[float, ...] = (0.2, 0.4)
    """First radii (half widths of the distribution), in log space: 0.2 spans 0.82 to 1.22 times the centre."""
    levels: tuple[float, ...] = (0.8, 0.95)
    """Quantiles of the novelty of held-out simulated sets that are the gate's threshold."""
    seeds: int = 2
    """Number of random seeds of every combination; they count from 0."""
    preset: str = "cpu"
    """Size of the run: smoke (a minute, to see that it works), cpu (two cores) or gpu (one GPU)."""
    policy: str | None = None
    """Policy, which stays fixed: walk (biteno's, ships with the package), scratch (trained first), or a folder of
    experiments.train; if not given, the one that ships, or scratch where none does."""
    parameters: str | None = None
    """Parameters that are tuned: names joined by commas, or a set: for biteno legs6 (foot friction and the six link
    masses; its default) or whole_body (friction, trunk mass, link masses with left and right tied), for other robots
    all, their default."""


def check(args: Args) -> tuple[Preset, Kind, dict[str, Entry], Case]:
    """Checks the arguments, and every combination of the tuner's settings, before anything is compiled.

    Returns:
      Sizes, with those of a sweep in the place of a single tuning's, the robot, the table of its parameters that are
      tuned, and the case.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    sizes, robot = preset(args.preset), kind(args.robot)
    entries = robot.chosen(args.parameters)
    truth = named_values("truth", args.truth, entries)
    case = checked_case(args.case, args.start, entries, engines=robot.engines, truth=truth)
    combinations = itertools.product(args.step_sizes, args.widen_factors, args.radii, args.levels)
    for step_size, widen_factor, radius, level in combinations:
        check_positive(radius=radius, seeds=args.seeds)
        tuner.knobs(step_size=step_size, widen_factor=widen_factor, level=level)
    if case.target != "mjx":
        raise ValueError(f"case: got '{args.case}', expected friction or mass: a sweep needs a target in mjx")
    return dataclasses.replace(sizes, tuner=sizes.sweep, episode_steps=sizes.sweep_steps), robot, entries, case


def lanes(args: Args) -> np.ndarray:
    """Lists all combinations of settings and seed as a grid; each is one lane of the vmapped program.

    Returns:
      [step sizes, widening factors, radii, levels, seeds, 5], the last axis in that order.
    """
    axes = (args.step_sizes, args.widen_factors, args.radii, args.levels, range(args.seeds))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def program(learner: Learner, truth: Mapping[str, float], policy: Policy) -> Callable:
    """Makes the sweep one compiled function of its lanes, [lanes, 5] -> (distribution, info), both [lanes, ...].

    Args:
      learner: gives the tuner its functions.
      truth: the target's physical values by name.
      policy: what walks in every lane; it is never trained.
    """
    target = MjxTarget(robot=learner.robot, params=truth)
    fixed = dataclasses.replace(learner.tuner(target), train_policy=tuner.keep, update=tuner.vote_update)
    dist = learner.dist(parameters.nominal(learner.entries), 1.0)  # each lane sets a radius of its own

    def one(step_size, widen_factor, radius, level, seed):
        knobs = tuner.knobs().replace(step_size=step_size, widen_factor=widen_factor, level=level)
        begin = dist.replace(radius=dict.fromkeys(dist.radius, radius))
        state = fixed.init(policy, begin, knobs)
        # Lanes are rows of one float array, so the seed comes as a float.
        state, info = fixed.run(jax.random.PRNGKey(seed.astype(int)), state, learner.preset.sweep_tunings)
        # The policy is the same in every lane, and returning it would copy it as often.
        return state.dist, info

    return jax.jit(lambda columns: jax.vmap(one)(*columns.T))


def mean_error(learner: Learner, truth: Mapping[str, float], centre: Coords, off: Sequence[str]) -> np.ndarray:
    """Averages the error (`experiments.walking.cases.errors`) over the parameters whose true value is not nominal.

    Args:
      learner: holds the table that turns coordinates into physical values.
      truth: physical values by name.
      centre: estimates in coordinates, [lanes] by name.
      off: names that are averaged over.

    Returns:
      [lanes] mean error.
    """
    found = errors(learner.entries, parameters.from_coords(learner.entries, centre), truth)
    return np.mean([found[name] for name in off], axis=0)


def main(args: Args) -> None:
    """Runs the sweep, prints a table with the best combination first, and writes summary.json and heat_map.png.

    Raises:
      ValueError: an option is wrong, or the folder holds another run or belongs to a process that still works there.
    """
    checkpoint.set_up_compiler(preset(args.preset).xla_flags)
    sizes, robot, entries, case = check(args)
    args = dataclasses.replace(args, policy=args.policy or default_policy(robot))
    learner = Learner(sizes, entries, kind=robot)
    checkpoint.open_run(args.out, {**dataclasses.asdict(args), "out": None, "sizes": sizes})
    with checkpoint.lock(args.out / "summary.json"):
        sweep(args, learner, case)


def sweep(args: Args, learner: Learner, case: Case) -> None:
    """Tunes in all lanes, and writes and prints what they found.

    Args:
      args: options of the sweep.
      learner: gives the tuner its functions.
      case: how the target differs.
    """
    policy = starting_policy(args.policy, learner, args.out)
    grid, entries = lanes(args), learner.entries
    truth = case.true_params(entries, args.start)
    tune = program(learner, truth, policy)
    begin = time.monotonic()
    with bars() as progress:
        # One program: nothing is known of how far it is.
        progress.add_task(f"compiling, then tuning {grid[..., 0].size} simulators", total=None)
        dist, info = jax.block_until_ready(tune(jnp.asarray(grid.reshape(-1, grid.shape[-1]))))
    seconds = time.monotonic() - begin

    off = case.off(entries)
    final = mean_error(learner, truth, dist.centre, off).reshape(grid.shape[:-1])
    calls = np.asarray(info.calls).sum(axis=-1).reshape(grid.shape[:-1])
    names = ("step_size", "widen_factor", "radius", "level")
    rows = [
        dict(zip(names, map(float, grid[index][0, :-1]), strict=True))
        | {"error": final[index].tolist(), "gate_calls": calls[index].tolist()}
        for index in np.ndindex(grid.shape[:-2])
    ]
    accepted = np.asarray(info.verdicts == Verdict.ACCEPT).any(axis=-1).reshape(*grid.shape[:-1], -1)
    for row, index in zip(rows, np.ndindex(grid.shape[:-2]), strict=True):
        row["accepted"] = accepted[index].sum(axis=-1).tolist()
    checkpoint.write_json(
        args.out / "summary.json",
        {
            "case": args.case,
            "start": args.start,
            "preset": args.preset,
            "off": off,
            "lanes": grid[..., 0].size,
            "rows": rows,
            "params": dists.names(dist),
            "seconds": {"total": seconds},
            "versions": checkpoint.versions(),
        },
    )
    _draw(args, final.mean(axis=-1))
    _table(args, rows, seconds, grid[..., 0].size)


def _draw(args: Args, mean: np.ndarray) -> None:
    # [step, widen, radius, level] -> panels of (widen, level), each step by radius
    panels = mean.transpose(1, 3, 0, 2).reshape(-1, mean.shape[0], mean.shape[2])
    titles = [f"widen {factor:g}, level {level:g}" for factor in args.widen_factors for level in args.levels]
    rows, columns = ([f"{value:g}" for value in values] for values in (args.step_sizes, args.radii))
    plots.sweep(args.out / "heat_map.png", panels, rows, columns, ["step size", "first radius", *titles])


def _table(args: Args, rows: Sequence[dict], seconds: float, count: int) -> None:
    table = Table(title=f"case {args.case}, start {args.start:g}X: {count} lanes in {seconds:.0f} s, one program")
    columns = "step size", "widening factor", "first radius", "level", "error at the end", "gate calls", "accepted"
    for column in columns:
        table.add_column(column, justify="right")
    for row in sorted(rows, key=lambda row: np.mean(row["error"])):
        table.add_row(
            *(f"{row[name]:g}" for name in ("step_size", "widen_factor", "radius", "level")),
            f"{np.mean(row['error']):.3f} +- {np.std(row['error']):.3f}",
            f"{np.mean(row['gate_calls']):.1f}",
            f"{np.mean(row['accepted']):.1f}",
        )
    console.print(table)


if __name__ == "__main__":
    run(main, Args)
