"""Runs the tuner with every combination of its settings: `python -m experiments.sweep --out DIR`.

Every combination of step size, widening factor, first radius, level and seed is a lane: a whole run of Algorithm 1
against one target, `Tuner.run` with the training of the policy in it. Lanes are vmapped and spread over all devices, so
many at a time as `--lanes` says, always by the same compiled program. What they found is written after each of these
pieces, and the same command goes on after the last one.
"""

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from envs.targets.mjx import MjxTarget
from experiments.common import checkpoint, compiler, files, hosts, plots
from experiments.common.cli import bars, console, count, run
from experiments.common.config import Preset, named_values, preset
from experiments.walking import memory
from experiments.walking.cases import Case, check_positive, check_seeds, checked_case, errors
from experiments.walking.comparison import UPDATES
from experiments.walking.learner import Learner, Policy
from experiments.walking.policies import default_policy, policy_of_run
from experiments.walking.robots import Kind, kind
from jaxtune import devices, tuner
from jaxtune.mjx import Entry, parameters
from jaxtune.types import Coords, Verdict

RESULTS = ("error", "gate_calls", "accepted", "return", "falls")
"""What is kept of every lane: mean error of the parameters that are off, gate calls and accepted sets over all tunings,
and mean return and falls of the last policy in the target."""


@dataclass(frozen=True, kw_only=True)
class Args(hosts.HostArgs):
    """Tunes one simulator with every combination of the tuner's settings, by one compiled program."""

    out: Path = Path("runs/sweep")
    """Folder of summary.json and heat_map.png. The same command with the same folder goes on after the last lanes."""
    robot: str = "biteno"
    """Robot and task: biteno, go2, playground:NAME (an environment of MuJoCo Playground) or playground-warp:NAME (the
    same by MuJoCo Warp), or path/to/file.py:function, which returns a jaxtune.mjx.Simulator or an environment."""
    case: str = "mass"
    """How the target differs: friction or mass."""
    start: float = 0.5
    """Where the simulator starts, as a multiple of the target's values."""
    truth: tuple[str, ...] = ()
    """True values of the target, name=value, in place of what the case says; parameters that are left out are
    nominal."""
    update: str = "vote"
    """How the distribution moves: vote (the paper's steps) or posterior, which has no step size."""
    step_sizes: tuple[float, ...] = (0.25, 0.5, 1.0)
    """Steps of the paper's update, in radii per unit of vote."""
    widen_factors: tuple[float, ...] = (1.5, 2.0)
    """Factors on the radius every time the gate rejects."""
    radii: tuple[float, ...] = (0.2, 0.4)
    """First radii (half widths of the distribution), in log space: 0.2 spans 0.82 to 1.22 times the centre."""
    levels: tuple[float, ...] = (0.8, 0.95)
    """Quantiles of the novelty of held-out simulated sets that are the gate's threshold."""
    seeds: tuple[int, ...] = (0, 1)
    """Random seeds; every combination runs once with each."""
    preset: str = "cpu"
    """Size of the run: smoke (a minute, to see that it works), cpu (two cores) or gpu (one GPU)."""
    fixed_policy: bool = False
    """Leave the policy as it is, where it is trained after every tuning otherwise."""
    lanes: int | None = None
    """Runs side by side, and between two files of results; the preset's number if not given."""
    policy: str | None = None
    """Starting policy: walk (biteno's, ships with the package), scratch (trained first), or a folder of
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
    sizes, robot = preset(args.preset).for_sweep(), kind(args.robot)
    entries = robot.chosen(args.parameters)
    truth = named_values("truth", args.truth, entries)
    case = checked_case(args.case, args.start, entries, engines=robot.engines, truth=truth)
    for option in ("step_sizes", "widen_factors", "radii", "levels"):
        values = getattr(args, option)
        if len(set(values)) < len(values):
            raise ValueError(f"{option}: got {values}, expected each value once")
    combinations = itertools.product(args.step_sizes, args.widen_factors, args.radii, args.levels)
    for step_size, widen_factor, radius, level in combinations:
        check_positive(radius=radius)
        tuner.knobs(step_size=step_size, widen_factor=widen_factor, level=level)
        sizes.tuner.check_level(level)
    check_seeds(args.seeds)
    if case.target != "mjx":
        raise ValueError(f"case: got '{args.case}', expected friction or mass: a sweep needs a target in mjx")
    if args.update not in UPDATES:
        raise ValueError(f"update: got '{args.update}', expected one of {', '.join(UPDATES)}")
    if args.update == "posterior" and len(args.step_sizes) > 1:
        raise ValueError(f"step_sizes: got {len(args.step_sizes)}, expected one: the posterior update has no step size")
    if args.lanes is not None and args.lanes < 1:
        raise ValueError(f"lanes: got {args.lanes}, expected 1 or more")
    return sizes, robot, entries, case


def lanes(args: Args) -> np.ndarray:
    """Lists all combinations of settings and seed as a grid; each is one lane of the vmapped program.

    Returns:
      [step sizes, widening factors, radii, levels, seeds, 5], the last axis in that order.
    """
    axes = (args.step_sizes, args.widen_factors, args.radii, args.levels, args.seeds)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def lane(args: Args, learner: Learner, truth: Mapping[str, float], policy: Policy) -> Callable:
    """Makes a whole run a function of its settings and seed, [5] in the order of `lanes`.

    Args:
      args: how the distribution moves, and whether the policy is trained.
      learner: gives the tuner its functions.
      truth: the target's physical values by name.
      policy: what walks first in every lane.

    Returns:
      A pure function. It returns the last distribution, the infos of all tunings without what training reported, and
      the mean return and the falls of the last policy in the target.
    """
    target, sizes = MjxTarget(robot=learner.robot, params=truth), learner.preset
    machine = UPDATES[args.update](learner.tuner(target))
    if args.fixed_policy:
        machine = dataclasses.replace(machine, train_policy=tuner.keep)
    dist = learner.dist(parameters.nominal(learner.entries), 1.0)  # each lane sets a radius of its own
    ends = dist.lower, dist.upper

    def one(settings):
        step_size, widen_factor, radius, level, seed = settings
        knobs = tuner.knobs().replace(step_size=step_size, widen_factor=widen_factor, level=level)
        # As `dist.make` has it: no wider than the bounds.
        begin = dist.replace(radius=jax.tree.map(lambda low, high: jnp.minimum(radius, high - low), *ends))
        state = machine.init(policy, begin, knobs)
        # Lanes are rows of one float array, so the seed comes as a float.
        key = jax.random.PRNGKey(seed.astype(int))
        state, info = machine.run(key, state, sizes.tunings)
        # The same key in all lanes: returns compare.
        walks = target.episodes(
            jax.random.PRNGKey(0), learner.act(state.policy), sizes.evaluation_episodes, sizes.episode_steps
        )
        # Policies are not returned, since every lane has one of its own.
        return state.dist, info.replace(train={}), walks.score.sum(axis=-1).mean(), walks.fell.sum()

    return one


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
      ValueError: an option is wrong, the lanes do not fit into memory, or the folder holds another run or belongs to a
        process that still works there.
    """
    compiler.set_up(preset(args.preset).xla_flags)
    hosts.join(args)
    sizes, robot, entries, case = check(args)
    args = dataclasses.replace(args, policy=args.policy or default_policy(robot))
    learner = Learner(sizes, entries, kind=robot)
    side_by_side = min(args.lanes or sizes.sweep_lanes, lanes(args)[..., 0].size)
    memory.check(learner, math.ceil(side_by_side / len(jax.devices())))
    identity = {**dataclasses.asdict(args), **robot.identity, "sizes": sizes}
    for option in ("out", *hosts.OPTIONS):
        del identity[option]
    policy = policy_of_run(args.policy, learner)
    checkpoint.open_run(args.out, identity)
    with checkpoint.lock(args.out / "summary.json"):
        sweep(args, learner, case, policy(args.out))


def sweep(args: Args, learner: Learner, case: Case, policy: Policy) -> None:
    """Tunes in all lanes, and writes and prints what they found.

    Args:
      args: options of the sweep.
      learner: gives the tuner its functions.
      case: how the target differs.
      policy: that walks, on both sides.
    """
    grid = lanes(args)
    truth, off = case.true_params(learner.entries, args.start), case.off(learner.entries)
    several = jax.vmap(lane(args, learner, truth, policy))
    tune = devices.on_all(jax.jit(lambda rows: devices.spread(several, (rows,))))
    rows = grid.reshape(-1, grid.shape[-1])
    size = min(args.lanes or learner.preset.sweep_lanes, len(rows))
    checkpoint.check_writable(args.out / "lanes")
    with bars() as progress:
        task = progress.add_task(f"tuning {len(rows)} simulators", total=len(rows))
        pieces = []
        for start in range(0, len(rows), size):
            path = args.out / "lanes" / f"{start:04d}.json"
            kept = files.exists(path)
            if not kept:
                # The last piece is filled up: another size would be another program.
                some = rows[(start + np.arange(size)) % len(rows)]
                begin = time.monotonic()
                found = _results(learner, truth, off, *jax.device_get(tune(jnp.asarray(some))))
                found = {name: values[: len(rows) - start] for name, values in found.items()}
                files.write_json(path, found | {"seconds": time.monotonic() - begin})
            pieces.append(files.read_json(path))
            count(progress, task, min(start + size, len(rows)), kept)
    names = ("step_size", "widen_factor", "radius", "level")
    of_lanes = {name: np.concatenate([piece[name] for piece in pieces]).reshape(grid.shape[:-1]) for name in RESULTS}
    summary = {
        "case": args.case,
        "start": args.start,
        "truth": args.truth,
        "preset": args.preset,
        "update": args.update,
        "trained": not args.fixed_policy,
        "off": off,
        "lanes": len(rows),
        "rows": [
            dict(zip(names, map(float, grid[index][0, :-1]), strict=True))
            | {name: values[index].tolist() for name, values in of_lanes.items()}
            for index in np.ndindex(grid.shape[:-2])
        ],
        "params": sorted(learner.entries),
        "seconds": {"total": sum(piece["seconds"] for piece in pieces)},
        "versions": checkpoint.versions(),
    }
    files.write_json(args.out / "summary.json", summary)
    _draw(args, of_lanes["error"].mean(axis=-1))
    _table(args, summary)


def _results(learner, truth, off, dist, info, value, falls) -> dict[str, list]:
    """What is kept of some lanes, [lanes] by name."""
    return {
        "error": mean_error(learner, truth, dist.centre, off).tolist(),
        "gate_calls": info.calls.sum(axis=-1).tolist(),
        "accepted": (info.verdicts == Verdict.ACCEPT).any(axis=-1).sum(axis=-1).tolist(),
        "return": value.tolist(),
        "falls": falls.tolist(),
    }


def _draw(args: Args, mean: np.ndarray) -> None:
    # [step, widen, radius, level] -> panels of (widen, level), each step by radius
    panels = mean.transpose(1, 3, 0, 2).reshape(-1, mean.shape[0], mean.shape[2])
    titles = [f"widen {factor:g}, level {level:g}" for factor in args.widen_factors for level in args.levels]
    rows, columns = ([f"{value:g}" for value in values] for values in (args.step_sizes, args.radii))
    plots.sweep(args.out / "heat_map.png", panels, rows, columns, ["step size", "first radius", *titles])


def _table(args: Args, summary: dict) -> None:
    count, seconds = summary["lanes"], summary["seconds"]["total"]
    case = " ".join(args.truth) or f"case {args.case}, start {args.start:g}X"
    table = Table(title=f"{case}: {count} runs in {seconds:.0f} s, one program")
    columns = "step size", "widening factor", "first radius", "level"
    for column in (*columns, "error at the end", "return in target", "gate calls", "accepted"):
        table.add_column(column, justify="right")
    for row in sorted(summary["rows"], key=lambda row: np.mean(row["error"])):
        table.add_row(
            *(f"{row[name]:g}" for name in ("step_size", "widen_factor", "radius", "level")),
            *(f"{np.mean(row[name]):.3g} +- {np.std(row[name]):.2g}" for name in ("error", "return")),
            *(f"{np.mean(row[name]):.1f}" for name in ("gate_calls", "accepted")),
        )
    console.print(table)


if __name__ == "__main__":
    run(main, Args)
