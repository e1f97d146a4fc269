"""Policies that walk: training one from scratch, and loading one by name.

A policy on disk is a folder: PPO's state as an orbax checkpoint, and a `config.json` with what the state depends on
(`policy_config`). The one that ships is `experiments/policies/walk`.
"""

import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
from rich.progress import Progress

from experiments.common import checkpoint, files, hosts
from experiments.common.cli import bars, console
from experiments.common.files import write_json
from experiments.walking.learner import Learner, Policy
from experiments.walking.robots import Kind
from jaxtune import devices
from jaxtune.mjx import parameters

_KEEP_S = 60.0  # between two checkpoints of a training


def policy_config(learner: Learner) -> dict:
    """Lists the settings that a saved policy shares with the run that loads it.

    With another reference pose, action scale or network, the same weights would be another policy. So `starting_policy`
    refuses a folder whose config differs.
    """
    return {**learner.kind.config(learner.preset), "hidden": list(learner.preset.ppo.hidden)}


def walk(
    key: jax.Array, learner: Learner, updates: int, progress: Progress | None = None, kept: Path | None = None
) -> tuple[Policy, list[dict[str, float]]]:
    """Trains a walking policy from scratch, on robots around the nominal parameters.

    A training that was interrupted goes on from its last checkpoint, to the result that it would have had.

    Args:
      key: random key of everything.
      learner: robot and sizes; `preset.policy_radius` is how far its robots are from nominal.
      updates: PPO updates, rounded up to whole chunks of `preset.chunk`.
      progress: display of steps and reward; None shows nothing.
      kept: folder of the checkpoints, one a minute; None keeps none.

    Returns:
      The policy, and a line of metrics (means over the chunk) for every chunk of updates.

    Raises:
      ValueError: the folder's checkpoint is damaged, or of a training with another config or more updates; the policy
        is not finite when it is kept; or a whole chunk of updates took no gradient step.
    """
    key_init, key_train = jax.random.split(key)
    policy = learner.init(key_init)
    dist = learner.dist(parameters.nominal(learner.entries), learner.preset.policy_radius)
    chunk = min(learner.preset.chunk, updates)
    # A policy carries its training robots, which a GPU need not hold twice.
    train = devices.on_all(jax.jit(lambda key, policy: learner.train(key, policy, dist, chunk), donate_argnums=1))
    task = progress.add_task("training", total=updates * learner.preset.ppo.steps_per_update) if progress else None
    curve = []
    identity = {
        **policy_config(learner),
        "key": jax.random.key_data(key),
        "parameters": learner.entries,
        "correction": learner.correction and learner.correction.digest,
        "chunk": chunk,
        "preset": learner.preset,
    }
    if kept and files.exists(kept / "config.json"):
        policy, curve = checkpoint.load(kept, policy, identity), checkpoint.read_notes(kept)
        if len(curve) * chunk > updates + chunk - 1:
            raise ValueError(f"updates: got {updates}, but {kept} holds a training of {len(curve) * chunk}")
    last = time.monotonic()
    start = last - (curve[-1]["seconds"] if curve else 0.0)
    for index in range(len(curve), -(-updates // chunk)):
        policy, metrics = train(jax.random.fold_in(key_train, index), policy)
        line = {name: float(jnp.mean(value)) for name, value in metrics.items()}
        steps = (index + 1) * chunk * learner.preset.ppo.steps_per_update
        if line["skipped"] == 1.0:
            raise ValueError(
                f"training: no gradient step was taken in the updates before step {steps:,}: rewards or observations "
                "were not finite in each of them; check the environment"
            )
        curve.append({"steps": steps, "seconds": time.monotonic() - start, **line})
        if progress:
            rate = line["reward"] / learner.kind.control_s
            progress.update(task, completed=steps, description=f"reward {rate:.2f} per second")
        # Hosts have clocks of their own, and must agree.
        if kept and hosts.from_first(lambda last=last: time.monotonic() - last >= _KEEP_S):
            checkpoint.check_finite("policy", policy.learner)
            checkpoint.save(kept, policy, identity, curve)
            last = time.monotonic()
    return policy, curve


def trained(
    key: jax.Array,
    learner: Learner,
    updates: int,
    out: Path,
    check: Callable[[], None] = lambda: None,
    told: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[Policy, list[dict[str, float]]]:
    """Trains a policy with `walk`, showing progress, and saves it with its curve; goes on where it was interrupted.

    Args:
      key: random key of everything.
      learner: robot and sizes.
      updates: PPO updates.
      out: folder of the policy.
      check: looks at what the folder holds, before it is written to and while no other process may.
      told: what is saved beside the curve, such as options.

    Returns:
      As `walk`.

    Raises:
      ValueError: nothing can be written there, another process trains there, the policy is not finite, or a whole
        chunk of updates took no gradient step.
    """
    checkpoint.check_writable(out)
    kept = out / "training"
    with checkpoint.lock(kept), bars() as progress:
        hosts.from_first(check)
        policy, curve = walk(key, learner, updates, progress, kept)
        skipped = sum(line["skipped"] for line in curve) / len(curve)
        if skipped > 0:
            console.print(f"{skipped:.2%} of the gradient steps were not taken, since a number was not finite")
        checkpoint.check_finite("policy", policy.learner)
        checkpoint.save(out, policy.learner, policy_config(learner))
        write_json(out / "curve.json", {**told, "curve": curve})
        hosts.from_first(lambda: shutil.rmtree(kept, ignore_errors=True))
    return policy, curve


def default_policy(kind: Kind) -> str:
    """Returns the name of the policy that a command begins with where its user names none."""
    return "scratch" if kind.policy is None else "walk"


def policy_of_run(name: str, learner: Learner) -> Callable[[Path], Policy]:
    """Loads the policy of a run before its folder is made, so that one that cannot be loaded leaves no folder.

    Args:
      name: as of `starting_policy`; `scratch` is not trained yet.
      learner: robot and sizes of the run.

    Returns:
      What gives the policy once the folder of the run is there.

    Raises:
      ValueError: as `starting_policy`.
    """
    if name == "scratch":
        return lambda out: starting_policy(name, learner, out)
    policy = starting_policy(name, learner)
    return lambda _: policy


def starting_policy(name: str, learner: Learner, out: Path | None = None) -> Policy:
    """Loads the policy that a command begins with.

    Args:
      name: `walk`, which ships with the package; a folder of `experiments.train`; or `scratch`, which is trained first
        and kept in `out`, where a second call finds it.
      learner: robot and sizes of the run.
      out: folder of the run; only `scratch` needs it.

    Returns:
      The policy, on freshly reset training robots.

    Raises:
      ValueError: the robot ships no policy, the folder holds none, or one that is not finite or of another config;
        names the field that differs.
    """
    fresh = learner.init(jax.random.PRNGKey(0))
    place = Path(name)
    if name == "walk":
        place = learner.kind.policy
        if place is None:
            raise ValueError(f"policy: got 'walk', but {learner.kind.name} ships none; expected scratch or a folder")
    if name == "scratch" and out is None:
        raise ValueError("policy: got 'scratch', expected a policy that exists, such as a folder of experiments.train")
    if name == "scratch":
        place = out / "policy"
        if not files.exists(place / "config.json"):
            trained(jax.random.PRNGKey(0), learner, learner.preset.scratch_updates, place)
    ppo = checkpoint.load(place, fresh.learner, policy_config(learner))
    checkpoint.check_finite(f"policy: {place}", ppo)
    # Disk holds networks, optimiser and statistics alone. Robots are new, so they may have another model by now.
    return fresh.replace(learner=ppo)
