"""Episodes of BITeno in MJX: those that the tuner simulates, and those of a target in the same engine.

Both are `rollout`, so a target in MJX differs from the tuner's simulator in its parameters alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from envs.biteno import Biteno
from envs.targets.protocol import Act, Commands, Recording, watch
from jaxtune import mjx
from jaxtune.mjx import parameters
from jaxtune.types import Coords, Trajectory


def rollout(
    robot: Biteno,
    key: jax.Array,
    act: Act,
    params: parameters.Params,
    steps: int,
    commands: Commands | None = None,
    watch: Callable[..., Any] = lambda before, after, motion: (),
    states: bool = False,
    until: jax.Array | None = None,
) -> tuple[Trajectory, Any]:
    """Simulates one episode for every draw of the parameters (`jaxtune.mjx.rollout`).

    Args:
      robot: robot and task.
      key: random key; commands, resets and noise depend on it alone.
      act: the policy.
      params: physical values by name, each [episodes].
      steps: length of an episode in policy steps.
      commands: commands and starts of the gait clock, in place of those that the task would draw.
      watch: what is recorded of a step, `(state before, state after, motion) -> pytree`.
      states: True to keep the robot's states (`Trajectory.state`).
      until: number of steps that are simulated; all if None.

    Returns:
      The episodes, and what was recorded of them, [episodes, time, ...].
    """
    if commands is None:
        return mjx.rollout(robot, key, act, params, steps, watch=watch, states=states, until=until)

    def prepare(state, commands, step):
        phase = state.phase if commands.phase is None else jnp.where(step == 0, commands.phase, state.phase)
        return robot.with_command(state, commands.command[step], phase)

    given = {"given": commands, "prepare": prepare}
    return mjx.rollout(robot, key, act, params, steps, **given, watch=watch, states=states, until=until)


@dataclass(frozen=True, kw_only=True)
class MjxTarget:
    """A target in the tuner's own engine: only its parameters are hidden. Its methods are pure and may be jitted."""

    robot: Biteno
    params: Mapping[str, float]
    """True physical values by name; only tests and reports may read them."""

    def episodes(
        self,
        key: jax.Array,
        act: Act,
        count: int,
        steps: int,
        states: bool = False,
        until: jax.Array | None = None,
    ) -> Trajectory:
        """Measures episodes under a policy; `envs.targets.protocol.Target` describes arguments and result.

        It can be traced, so it may serve as the `measure` of a tuner. Only `until` steps are simulated where they are
        given; the others hold zeros.
        """
        return rollout(self.robot, key, act, self._params(count), steps, states=states, until=until)[0]

    def record(
        self, key: jax.Array, act: Act, count: int, steps: int, commands: Commands | None = None
    ) -> tuple[Trajectory, Recording]:
        """Measures episodes and their motion; `envs.targets.protocol.Target` describes arguments and result.

        Use it to judge a gait (`envs.biteno.gait.quality`).
        """
        return rollout(self.robot, key, act, self._params(count), steps, commands, watch)

    def _params(self, count: int) -> dict:
        return {name: jnp.full(count, value, jnp.float32) for name, value in self.params.items()}


def simulate(
    robot: Biteno,
    key: jax.Array,
    act: Act,
    coords: Coords,
    steps: int,
    commands: Commands | None = None,
    states: bool = False,
) -> Trajectory:
    """Simulates one episode for every draw of the tuner's distribution: the `simulate` that a tuner is given.

    Args:
      robot: robot and task; its table translates coordinates into physical values.
      key: random key.
      act: the policy.
      coords: draws in search coordinates by name, each [episodes].
      steps: length of an episode in policy steps.
      commands: in place of those that the task would draw.
      states: True to keep the robots' states.
    """
    params = parameters.from_coords(robot.entries, coords)
    return rollout(robot, key, act, params, steps, commands, states=states)[0]
