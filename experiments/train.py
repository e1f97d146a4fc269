"""Trains a walking policy and saves it: `python -m experiments.train --out DIR`."""

import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from envs import correction, domain
from experiments import checkpoint, plots
from experiments.checkpoint import write_json
from experiments.config import WALK, chosen, preset
from experiments.loop import Loop, Policy

console = Console()


@dataclass(frozen=True, kw_only=True)
class Args:
    """Trains BITeno to walk, from scratch."""

    out: Path
    """Folder of the policy: orbax checkpoint, config.json, curve.json, curve.png."""
    preset: str = "cpu"
    """Sizes: smoke, cpu or gpu."""
    parameters: str = "legs6"
    """Parameters that vary in training, within the preset's policy_radius: a set's name or names joined by commas."""
    model: Path | None = None
    """Folder of a corrected model that discovery wrote (`OUT/model`), to train in instead of the nominal one."""
    updates: int | None = None
    """PPO updates; the preset's scratch_updates where not given."""
    seed: int = 0
    """Seed of everything random."""


def policy_config(loop: Loop) -> dict:
    """What a saved policy must agree in with the run that loads it."""
    task, ppo = loop.preset.task, loop.preset.ppo
    return {"base": task.base, "action_scale": task.action_scale, "hidden": list(ppo.hidden)}


def walk(key: jax.Array, loop: Loop, updates: int, progress: Progress | None = None) -> tuple[Policy, list[dict]]:
    """Trains from scratch at the nominal parameters.

    Returns:
      The policy, and a line of metrics for every chunk of updates.
    """
    key_init, key_train = jax.random.split(key)
    policy = loop.init(key_init)
    dist = loop.dist(domain.nominal(loop.entries), loop.preset.policy_radius)
    chunk = min(loop.preset.chunk, updates)
    train = jax.jit(lambda key, policy: loop.train(key, policy, dist, chunk))
    task = progress.add_task("training", total=updates * loop.preset.ppo.steps_per_update) if progress else None
    curve, start = [], time.monotonic()
    for index in range(-(-updates // chunk)):
        policy, metrics = train(jax.random.fold_in(key_train, index), policy)
        line = {name: float(jnp.mean(value)) for name, value in metrics.items()}
        steps = (index + 1) * chunk * loop.preset.ppo.steps_per_update
        curve.append({"steps": steps, "seconds": time.monotonic() - start, **line})
        if progress:
            progress.update(task, completed=steps, description=f"reward {100 * line['reward']:.2f} a second")
    return policy, curve


def starting_policy(name: str, loop: Loop, out: Path | None = None) -> Policy:
    """Loads a policy: `walk`, which ships, a folder, or `scratch`, which is trained first and kept in `out`."""
    fresh = loop.init(jax.random.PRNGKey(0))
    place = WALK if name == "walk" else Path(name)
    if name == "scratch":
        place = out / "policy"
        if not (place / "config.json").exists():
            with bars() as progress:
                policy, curve = walk(jax.random.PRNGKey(0), loop, loop.preset.scratch_updates, progress)
            checkpoint.save(place, policy.learner, policy_config(loop))
            write_json(place / "curve.json", {"curve": curve})
    learner = checkpoint.load(place, fresh.learner, policy_config(loop))
    return loop.init(jax.random.PRNGKey(0), learner)


def bars() -> Progress:
    """The progress display of every command."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    return Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console)


def main(args: Args) -> None:
    """Trains, saves and draws the curve."""
    checkpoint.set_up_compiler(preset(args.preset).xla_flags)
    sizes, entries = preset(args.preset), chosen(args.parameters)
    updates = sizes.scratch_updates if args.updates is None else args.updates
    if updates < 1:
        raise ValueError(f"updates: got {updates}, expected 1 or more")
    loop = Loop(sizes, entries, correction=args.model and correction.read(args.model))
    with bars() as progress:
        policy, curve = walk(jax.random.PRNGKey(args.seed), loop, updates, progress)
    checkpoint.save(args.out, policy.learner, policy_config(loop))
    write_json(args.out / "curve.json", {"args": args, "curve": curve})
    plots.training(args.out / "curve.png", curve)
    first, last = curve[0], curve[-1]
    if len(curve) > 1:
        speed = (last["steps"] - first["steps"]) / (last["seconds"] - first["seconds"])
        console.print(f"{speed:,.0f} environment steps a second after compilation")
    console.print(f"{last['steps']:,} steps in {last['seconds']:.0f} s, saved to {args.out}")


def run(main, args_type) -> None:
    """Reads the command line; bad input ends in one line that names the field."""
    args = tyro.cli(args_type, description=args_type.__doc__)
    try:
        main(args)
    except ValueError as error:
        console.print(f"[red]error:[/red] {escape(str(error))}", highlight=False)
        raise SystemExit(2) from error


if __name__ == "__main__":
    run(main, Args)
