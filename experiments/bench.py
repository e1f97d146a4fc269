"""Speeds, and how often the gate rings: `python -m experiments.bench speed`, `python -m experiments.bench alarm`.

Ratios come from one run on one machine; nothing here is a test.
"""

import dataclasses
import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.table import Table

from envs import domain
from experiments import checkpoint
from experiments.config import chosen, preset
from experiments.loop import Loop
from experiments.sim2sim import Args as TuningArgs
from experiments.sim2sim import starting_policy
from experiments.train import console, run
from jaxtune import dist as dists
from jaxtune import tuner


@dataclass(frozen=True, kw_only=True)
class Args:
    """Measures one thing and writes it as JSON."""

    what: tyro.conf.Positional[Literal["speed", "alarm"]]
    """speed: training steps a second with both physics presets. alarm: first gate calls over many seeds."""
    out: Path = Path("runs/bench")
    """Folder of the results."""
    preset: str = "cpu"
    """Sizes: smoke, cpu or gpu."""
    policy: str = "walk"
    """Policy of the alarm: walk, or a folder of experiments.train."""
    seeds: int = 10
    """Gate calls for each target."""
    radius: float = 0.2
    """Radius of the alarm's distribution, in log space."""


def speed(args: Args) -> dict:
    """Environment steps a second of whole PPO updates, compilation apart."""
    rows = {}
    for physics in ("exact", "fast"):
        sizes = preset(args.preset)
        sizes = dataclasses.replace(sizes, task=dataclasses.replace(sizes.task, physics=physics))
        loop = Loop(sizes, chosen("legs6"))
        dist = loop.dist(domain.nominal(loop.entries), sizes.policy_radius)
        train = jax.jit(lambda key, policy, loop=loop, dist=dist: loop.train(key, policy, dist, loop.preset.chunk))
        policy, key = loop.init(jax.random.PRNGKey(0)), jax.random.PRNGKey(1)
        seconds = []
        for _ in range(4):
            begin = time.monotonic()
            policy, _ = jax.block_until_ready(train(key, policy))
            seconds.append(time.monotonic() - begin)
        steps = sizes.chunk * sizes.ppo.steps_per_update
        rows[physics] = {"first_call_s": seconds[0], "steps_per_second": steps / min(seconds[1:])}
    return rows


def alarm(args: Args) -> dict:
    """First gate calls with the target outside the radius, at its edge and drawn within it."""
    sizes = preset(args.preset)
    loop = Loop(sizes, chosen("legs6"))
    policy = starting_policy(TuningArgs(policy=args.policy), loop)
    dist = loop.dist(domain.nominal(loop.entries), args.radius)
    machine = loop.tuner(None, sizes.policy_radius)

    @jax.jit
    def call(key, params):
        key_collect, key_verify, key_measure = jax.random.split(key, 3)
        params = {name: jnp.full(sizes.tuner.set_episodes, value) for name, value in params.items()}
        measured = loop.simulate(key_measure, policy, params)
        collected = machine.collect(key_collect, policy, dist)
        return tuner.calibrated_gate(key_verify, sizes.tuner, collected, measured, tuner.knobs())

    def masses(multiplier: float) -> dict:
        truth = {name: multiplier if name.endswith("_mass") else 1.0 for name in loop.entries}
        return dict(domain.to_coordinates(loop.entries, truth))

    def drawn(seed: int) -> dict:
        return jax.tree.map(lambda x: x[0], dists.sample(jax.random.PRNGKey(1000 + seed), dist, 1))

    targets = {
        "masses, start 0.5X": lambda seed: masses(2.0),
        "masses, start 1.5X": lambda seed: masses(2.0 / 3.0),
        "centre of the radius": lambda seed: masses(1.0),
        "drawn within the radius": drawn,
    }
    rows = {}
    for name, target in targets.items():
        calls = [call(jax.random.PRNGKey(seed), target(seed)) for seed in range(args.seeds)]
        novelty, threshold = (np.array([float(gate[field]) for gate in calls]) for field in ("novelty", "threshold"))
        rows[name] = {
            "rings": int((novelty > threshold).sum()),
            "of": args.seeds,
            "novelty": novelty,
            "threshold": threshold,
            "p_value": [float(gate.p_value) for gate in calls],
        }
        console.print(f"{name}: rings in {rows[name]['rings']} of {args.seeds}")
    return rows


def main(args: Args) -> None:
    """Measures, prints and writes."""
    checkpoint.enable_compilation_cache()
    begin = time.monotonic()
    rows = {"speed": speed, "alarm": alarm}[args.what](args)
    table = Table(title=args.what)
    for column in ("", *next(iter(rows.values()))):
        table.add_column(column)
    for name, row in rows.items():
        table.add_row(name, *(np.array2string(np.asarray(value), precision=2) for value in row.values()))
    console.print(table)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    args.out.mkdir(parents=True, exist_ok=True)
    result = {
        "args": args,
        "rows": rows,
        "seconds": time.monotonic() - begin,
        "peak_gib": peak,
        "versions": checkpoint.versions(),
    }
    checkpoint.write_json(args.out / f"{args.what}.json", result)


if __name__ == "__main__":
    run(main, Args)
