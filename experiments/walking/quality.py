"""Measures how well a policy walks, in numbers that can be compared between engines."""

import jax
import numpy as np

from envs.biteno import gait
from envs.targets.protocol import Act, Commands, Recording, Target
from jaxtune.types import Trajectory


def record_walks(
    target: Target, key: jax.Array, act: Act, count: int, steps: int, commands: Commands | None = None
) -> tuple[Trajectory, Recording]:
    """Plays walks in a target and copies them from the device to NumPy arrays.

    Args:
      target: simulator that the policy walks in.
      key: random key of resets and commands.
      act: the policy.
      count: number of walks.
      steps: policy steps of a walk.
      commands: velocity commands of the walks; None means that the task draws them.

    Returns:
      The walks and the motion behind them, [count, steps, ...], as NumPy arrays.
    """
    return jax.tree.map(np.asarray, target.record(key, act, count, steps, commands))


def quality(trajectory: Trajectory, recording: Recording) -> dict[str, float]:
    """Summarises walks: gait (touchdowns, clearance, slip, ...), tracking, falls, and mean return under Table I.

    Args:
      trajectory: walks, [episodes, time], from `record_walks`.
      recording: the motion behind them.

    Returns:
      Means over the walks by name; units are in the names (see `envs.biteno.gait.quality`).
    """
    values = gait.quality(**recording, alive=trajectory.alive, fell=trajectory.fell)
    values["return"] = trajectory.score.sum(axis=1).mean()
    return {name: float(value) for name, value in values.items()}
