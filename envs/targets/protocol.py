"""What a target is: it lets a policy walk and answers with episodes, and hides its parameters."""

from collections.abc import Callable, Mapping
from typing import Protocol

import chex
import jax

from envs.biteno import Motion, State
from jaxtune.types import Trajectory

Act = Callable[[jax.Array, jax.Array], tuple[jax.Array, dict]]
"""A policy: `(observation [obs], key) -> (action [act], extras)`."""


@chex.dataclass(frozen=True)
class Commands:
    """Velocity commands and gait clocks of episodes, in place of those that the task would draw."""

    command: jax.Array  # [episodes, time, 3] m/s, m/s, rad/s
    phase: jax.Array | None = None  # [episodes, 2] cycles, where the gait clock starts; drawn where None


@chex.dataclass(frozen=True)
class Recording:
    """Motion behind the steps of a `Trajectory`, [episodes, time, ...]; what it says of a step is its end."""

    qpos: jax.Array  # [13]
    qvel: jax.Array  # [12]
    torque: jax.Array  # [6] Nm
    foot_force: jax.Array  # [2, 3] N
    command: jax.Array  # [3], under which the step was taken
    phase: jax.Array  # [2] cycles, at the step's end


def watch(before: State, after: State, motion: Motion) -> Recording:
    """What is recorded of a step."""
    return Recording(
        qpos=after.qpos,
        qvel=after.qvel,
        torque=motion.torque,
        foot_force=motion.foot_force,
        command=before.command,
        phase=after.phase,
    )


class Target(Protocol):
    """A robot to be tuned to. Only a report may read its parameters."""

    params: Mapping[str, float]

    def episodes(self, key: jax.Array, act: Act, count: int, steps: int) -> Trajectory:
        """Measures `count` episodes of `steps` policy steps."""

    def record(
        self, key: jax.Array, act: Act, count: int, steps: int, commands: Commands | None = None
    ) -> tuple[Trajectory, Recording]:
        """The same with the motion behind it."""
