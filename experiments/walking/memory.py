"""Whether a run fits into memory, estimated from its sizes before anything is traced or compiled.

A program holds a multiple of the observations and actions that it works on. The multiples are those of XLA's memory
analysis of BITeno's programs on a CPU, between 64 and 256 environments and between 195 and 895 episodes.
"""

import math
import os
from pathlib import Path

import jax

from experiments.walking.learner import Learner
from jaxtune.readings import SETS

_TRAINING = 14.0  # of a PPO update's rollout: its batches, their gradients, the physics of a step
_TUNING = 2.0  # of a tuning's episodes: windows, and batches of them
_SCORED = 20.0  # of sets that are scored side by side: their windows, and what networks make of them
_KEPT = 2.6  # of all measured sets, whose episodes are kept
_MODELS = 100e6  # B, of both models while they are trained
_USABLE = 0.9  # share of a device's memory
_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of a container, in bytes; `max` where there is none


def needed(learner: Learner, sets: int = 0) -> dict[str, float]:
    """Estimates the memory that training, a tuning and the scoring of many sets take, each by itself.

    Args:
      learner: robot and sizes.
      sets: measured sets that are scored at once, as by a self-test.

    Returns:
      Bytes by name: `training` over all devices, and `tuning` and `scoring` on each, as every device learns from all
      episodes.
    """
    sizes, tuner = learner.preset, learner.preset.tuner
    step = 4.0 * (learner.robot.observation_size + learner.robot.action_size)
    rollout = step * sizes.ppo.steps_per_update
    if learner.states:
        kept = jax.eval_shape(lambda key: learner.robot.kept(learner.robot.reset({}, key)), jax.random.PRNGKey(0))
        step += 4.0 * sum(leaf.size for leaf in jax.tree.leaves(kept))
    episodes = step * sizes.episode_steps * (tuner.episodes + tuner.held_out_sets * tuner.set_episodes)
    beside = min(sets, SETS["cpu" if jax.default_backend() == "cpu" else "other"])
    scores = (_KEPT * sets + _SCORED * beside) * step * sizes.episode_steps * tuner.set_episodes
    tuning = _TUNING * episodes + _MODELS
    return {"training": _TRAINING * rollout, "tuning": tuning, "scoring": tuning + scores if sets else 0.0}


def check(learner: Learner, lanes: int | None = None, sets: int = 0) -> None:
    """Checks that a run fits.

    Args:
      learner: robot and sizes.
      lanes: runs side by side on each device; None for a single one, whose training all devices share.
      sets: measured sets that are scored at once.

    Raises:
      ValueError: it does not; says how much is needed for what, and how much there is.
    """
    there, devices = available(), len(jax.devices())
    for what, size in needed(learner, sets).items():
        # Every device learns from all episodes of a single run.
        size *= lanes or (1.0 / devices if what == "training" else 1.0)
        if size > _USABLE * there:
            envs, episodes = learner.preset.ppo.num_envs, learner.preset.tuner.episodes
            several = (lanes or 1) > 1
            runs = f", {lanes} runs side by side" if several else ""
            raise ValueError(
                f"{'lanes' if several else 'preset'}: {what} takes about {size / 2**30:.3g} GiB on a device ({envs} "
                f"environments, {episodes} episodes{runs}), expected less than {_USABLE * there / 2**30:.3g} GiB, "
                f"{_USABLE:.0%} of what it has"
            )


def available() -> float:
    """Memory of a device in bytes; the devices of a CPU have equal shares of the machine's."""
    own = jax.local_devices()
    if own[0].platform != "cpu":
        return (own[0].memory_stats() or {}).get("bytes_limit", math.inf)
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    # A container may have less than its machine.
    limit = _LIMIT.read_text().strip() if _LIMIT.exists() else ""
    return min(there, int(limit) if limit.isdecimal() else there) / len(own)
