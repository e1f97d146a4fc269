"""Trains a policy and saves it: `python -m experiments.train --out DIR`."""

from dataclasses import dataclass
from pathlib import Path

import jax

from envs import corrected
from experiments.common import compiler, hosts, plots
from experiments.common.cli import console, run
from experiments.common.config import preset
from experiments.common.files import as_json, read_json
from experiments.walking import memory
from experiments.walking.learner import Learner
from experiments.walking.policies import trained
from experiments.walking.robots import kind


@dataclass(frozen=True, kw_only=True)
class Args(hosts.HostArgs):
    """Trains a policy from scratch with PPO, and saves it for the other commands."""

    out: Path
    """Folder of the policy: orbax checkpoint, config.json, curve.json, curve.png."""
    robot: str = "biteno"
    """Robot and task: biteno, go2, playground:NAME (an environment of MuJoCo Playground) or playground-warp:NAME (the
    same by MuJoCo Warp), or path/to/file.py:function, which returns a jaxtune.mjx.Simulator or an environment."""
    preset: str = "cpu"
    """Size of the run: smoke (seconds, to see that it works), cpu (two cores) or gpu (one GPU)."""
    parameters: str | None = None
    """Parameters that are randomised in training, a little (the preset's policy_radius): names joined by commas, or a
    set: for biteno legs6 (foot friction and the six link masses; its default) or whole_body (friction, trunk mass, link
    masses with left and right tied), for other robots all, their default."""
    model: Path | None = None
    """Folder of a corrected model that discovery wrote (`OUT/model`), to train in instead of the nominal model; for
    biteno alone."""
    updates: int | None = None
    """Number of PPO updates; the preset's scratch_updates if not given."""
    seed: int = 0
    """Random seed of networks, robots, commands and exploration."""


def main(args: Args) -> None:
    """Trains, saves the policy, draws the training curve, and prints the speed.

    Raises:
      ValueError: an option is wrong, the corrected model cannot be read, the training does not fit into memory, or the
        folder holds another policy or another command's run.
    """
    compiler.set_up(preset(args.preset).xla_flags)
    hosts.join(args)
    sizes, robot = preset(args.preset), kind(args.robot)
    entries = robot.chosen(args.parameters)
    updates = sizes.scratch_updates if args.updates is None else args.updates
    if updates < 1:
        raise ValueError(f"updates: got {updates}, expected 1 or more")
    hosts.from_first(lambda: _check_folder(args))
    learner = Learner(sizes, entries, correction=args.model and corrected.read(args.model), kind=robot)
    memory.check(learner)
    # Again, since another process may have been at work there.
    key, check = jax.random.PRNGKey(args.seed), lambda: _check_folder(args)
    _, curve = trained(key, learner, updates, args.out, check, {"args": args})
    plots.training(args.out / "curve.png", curve, robot.control_s, robot.shown)
    first, last = curve[0], curve[-1]
    # The first chunk includes compilation, so the speed is that of the others.
    if len(curve) > 1:
        speed = (last["steps"] - first["steps"]) / (last["seconds"] - first["seconds"])
        console.print(f"{speed:,.0f} environment steps per second after compilation")
    console.print(f"{last['steps']:,} steps in {last['seconds']:.0f} s, saved to {args.out}")


def _check_folder(args: Args) -> None:
    """Checks that no other policy, and no run of another command, would be overwritten."""
    if (args.out / "training").exists() or not (args.out / "config.json").exists():
        return
    if not (args.out / "curve.json").exists():
        raise ValueError(f"out: {args.out} holds a run of another command, expected a new folder")
    # Without options it was killed before its last line.
    there, now = read_json(args.out / "curve.json").get("args", {}), as_json(args)
    for name in there.keys() & now.keys() - {"out", *hosts.OPTIONS}:
        if there[name] != now[name]:
            raise ValueError(f"{name}: got {now[name]}, but {args.out} holds a policy with {there[name]}")


if __name__ == "__main__":
    run(main, Args)
