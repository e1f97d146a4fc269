"""Sweeps the tuner's knobs as one compiled program: `python -m experiments.sweep --out DIR`.

Every combination of step size, widening factor, start radius, level and seed is a lane of one vmapped `Tuner.run`
against one target. The policy is fixed, so that a lane costs simulation and model training alone, and the update is
the paper's rule, which is the one that has a step size.
"""

import dataclasses
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from envs import domain
from envs.targets.mjx import MjxTarget
from experiments import checkpoint, plots
from experiments.config import chosen, preset
from experiments.loop import Loop, Policy
from experiments.sim2sim import Args as TuningArgs
from experiments.sim2sim import check as check_tuning
from experiments.sim2sim import engine, off, true_params
from experiments.train import console, run, starting_policy
from jaxtune import dist as dists
from jaxtune import tuner
from jaxtune.types import Verdict


@dataclass(frozen=True, kw_only=True)
class Args:
    """Tunes one simulator with every combination of the tuner's knobs at once."""

    out: Path = Path("runs/sweep")
    """Folder of the results."""
    case: str = "mass"
    """What is off: friction or mass."""
    start: float = 0.5
    """Where the simulator starts, as a multiple of the target."""
    step_sizes: tuple[float, ...] = (0.25, 0.5, 1.0)
    """Radii per unit vote."""
    widen_factors: tuple[float, ...] = (1.5, 2.0)
    """What a failed check multiplies the radius by."""
    radii: tuple[float, ...] = (0.2, 0.4)
    """First radii, in log space."""
    levels: tuple[float, ...] = (0.8, 0.95)
    """Quantiles of the held-out novelty that are the threshold."""
    seeds: int = 2
    """Number of seeds, from 0."""
    preset: str = "cpu"
    """Sizes: smoke, cpu or gpu."""
    policy: str = "walk"
    """Policy: walk (ships with the package), scratch (trained first), or a folder of experiments.train."""
    parameters: str = "legs6"
    """Parameters that are tuned: legs6, whole_body, or names joined by commas."""


def check(args: Args) -> TuningArgs:
    """Checks every combination as `experiments.sim2sim` would check it alone.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    shared = {
        field: getattr(args, field) for field in ("out", "case", "start", "seeds", "preset", "policy", "parameters")
    }
    for step_size, widen_factor, radius, level in itertools.product(
        args.step_sizes, args.widen_factors, args.radii, args.levels
    ):
        one = TuningArgs(**shared, step_size=step_size, widen_factor=widen_factor, radius=radius, level=level)
        check_tuning(one)
    if engine(one) != "mjx":
        raise ValueError(f"case: got '{one.case}', but a sweep is one program and needs a target in mjx")
    return one


def lanes(args: Args) -> np.ndarray:
    """All combinations, [step sizes, widening factors, radii, levels, seeds, 5]."""
    axes = (args.step_sizes, args.widen_factors, args.radii, args.levels, range(args.seeds))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def program(args: Args, loop: Loop, policy: Policy):
    """The sweep as one function of its lanes [lanes, 5]; returns state and info, [lanes, ...]."""
    target = MjxTarget(robot=loop.robot, params=true_params(args, loop.entries))
    fixed = dataclasses.replace(
        loop.tuner(target),
        train_policy=lambda key, policy, dist: (policy, {}),
        update=tuner.vote_update,
    )
    dist = loop.dist(domain.nominal(loop.entries), 1.0)

    def one(step_size, widen_factor, radius, level, seed):
        knobs = tuner.knobs().replace(step_size=step_size, widen_factor=widen_factor, level=level)
        begin = dist.replace(radius=dict.fromkeys(dist.radius, radius))
        state = fixed.init(policy, begin, knobs)
        state, info = fixed.run(jax.random.PRNGKey(seed.astype(int)), state, loop.preset.sweep_tunings)
        # Policy and episodes are the same or of no use in every lane.
        return state.dist, info

    return jax.jit(lambda columns: jax.vmap(one)(*columns.T))


def errors(loop: Loop, truth: dict, centre: dict, off: Sequence[str]) -> np.ndarray:
    """Mean of |estimate / truth - 1| over the parameters that were off, [lanes]."""
    estimate = domain.from_coordinates(loop.entries, centre)
    return np.mean([np.abs(np.asarray(estimate[name]) / truth[name] - 1) for name in off], axis=0)


def main(args: Args) -> None:
    """Runs the sweep; prints a table; writes summary.json and heat_map.png."""
    checkpoint.set_up_compiler(preset(args.preset).xla_flags)
    one = check(args)
    sizes, entries = preset(args.preset), chosen(args.parameters)
    sizes = dataclasses.replace(sizes, tuner=sizes.sweep, episode_steps=sizes.sweep_steps)
    loop = Loop(sizes, entries)
    checkpoint.open_run(args.out, {**dataclasses.asdict(args), "out": None, "sizes": sizes})
    policy = starting_policy(one.policy, loop, args.out)
    grid = lanes(args)
    sweep = program(args, loop, policy)
    begin = time.monotonic()
    dist, info = jax.block_until_ready(sweep(jnp.asarray(grid.reshape(-1, grid.shape[-1]))))
    seconds = time.monotonic() - begin

    astray = off(args, entries)
    final = errors(loop, true_params(args, loop.entries), dist.centre, astray).reshape(grid.shape[:-1])
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
            "off": astray,
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
    for column in ("step size", "widen", "radius", "level", "error at the end", "gate calls", "accepted"):
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
