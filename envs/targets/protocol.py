"""The interface of a target: a robot that walks under a policy, returns episodes and hides its parameters."""

from collections.abc import Callable, Mapping
from typing import Protocol

import chex
import jax

from envs.biteno import Motion, State
from jaxtune.types import Trajectory

Act = Callable[[jax.Array, jax.Array], jax.Array]
"""A policy: `(observation [obs], key) -> action [act]`."""


@chex.dataclass(frozen=True)
class Commands:
    """Velocity commands and gait clocks of episodes, in place of those that the task would draw.

    Use them to simulate what a robot was commanded in measured episodes, or to walk a fixed grid of commands.
    """

    command: jax.Array  # [episodes, time, 3] m/s, m/s, rad/s
    phase: jax.Array | None = None  # [episodes, 2] cycles, at the start; drawn by the task where None


@chex.dataclass(frozen=True)
class Recording:
    """The motion behind the steps of a `Trajectory`, [episodes, time, ...], at the end of each step.

    Measures of a gait (`envs.biteno.gait.quality`) need it; the tuner does not see it.
    """

    qpos: jax.Array  # [13]
    qvel: jax.Array  # [12]
    torque: jax.Array  # [6] Nm
    foot_force: jax.Array  # [2, 3] N
    command: jax.Array  # [3], under which the step was taken
    phase: jax.Array  # [2] cycles, at the step's end


def watch(before: State, after: State, motion: Motion) -> Recording:
    """Makes the `Recording` of one step, from the states before and after it and the engine's motion.

    Hand it to `envs.targets.mjx.rollout` to record episodes.
    """
    return Recording(
        qpos=after.qpos,
        qvel=after.qvel,
        torque=motion.torque,
        foot_force=motion.foot_force,
        command=before.command,
        phase=after.phase,
    )


class Target(Protocol):
    """A robot to be tuned to, real or hidden in another simulator.

    A target knows nothing of the tuner: it only walks under policies. Tests and reports alone may read `params`.
    """

    params: Mapping[str, float]
    """True physical values by name, where they are known."""

    def episodes(self, key: jax.Array, act: Act, count: int, steps: int, states: bool = False) -> Trajectory:
        """Measures episodes under a policy.

        Args:
          key: random key of resets, commands, noise and the policy.
          act: the policy.
          count: number of episodes.
          steps: length of an episode in policy steps of 10 ms.
          states: True to measure the robot's states too (`Trajectory.state`).

        Returns:
          The episodes; steps after a fall are masked.
        """

    def record(
        self, key: jax.Array, act: Act, count: int, steps: int, commands: Commands | None = None
    ) -> tuple[Trajectory, Recording]:
        """Measures episodes and records the motion behind them.

        Args:
          key: random key, as in `episodes`.
          act: the policy.
          count: number of episodes.
          steps: length of an episode in policy steps.
          commands: in place of those that the task would draw.

        Returns:
          The episodes, and their motion.
        """
