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
from jaxtune.mjx import in_chunks, parameters
from jaxtune.types import Coords, Trajectory


def rollout(
    robot: Biteno,
    key: jax.Array,
    act: Act,
    params: parameters.Params,
    steps: int,
    commands: Commands | None = None,
    watch: Callable[..., Any] = lambda before, after, motion: (),
) -> tuple[Trajectory, Any]:
    """Simulates one episode for every draw of the parameters.

    An episode ends where the robot falls or a number is not finite; that step is counted in `not_finite` and masked.

    Args:
      robot: robot and task.
      key: random key; commands, resets and noise depend on it alone.
      act: the policy.
      params: physical values by name, each [episodes].
      steps: length of an episode in policy steps.
      commands: commands and starts of the gait clock, in place of those that the task would draw.
      watch: what is recorded of a step, `(state before, state after, motion) -> pytree`.

    Returns:
      The episodes, and what was recorded of them, [episodes, time, ...].
    """
    # Without the barrier the compiler would fold constant parameters into every derived field of every model, and take
    # minutes.
    params = jax.lax.optimization_barrier(dict(params))
    keys = jax.random.split(key, next(iter(params.values())).shape[0])
    inputs = (keys, params) + (() if commands is None else (commands,))
    return in_chunks(lambda *drawn: _episode(robot, act, steps, watch, *drawn), inputs)


def _episode(robot, act, steps, watch, key, params, commands=None) -> tuple[Trajectory, Any]:
    key_reset, key_act = jax.random.split(key)
    state = robot.reset(params, key_reset)
    if commands is not None and commands.phase is not None:
        state = robot.with_command(state, commands.command[0], commands.phase)

    def step(carry, now):
        (state, alive), (key, command) = carry, now
        state = state if command is None else robot.with_command(state, command, state.phase)
        action, _ = act(state.obs, key)
        following, motion = robot.move(params, state, action)
        broke = alive & (following.not_finite > 0)
        score = jnp.where(alive & ~broke, following.score, 0.0)
        record = (state.obs, action, alive & ~broke, score, broke), watch(state, following, motion)
        return (following, alive & (following.done == 0)), record

    during = (jax.random.split(key_act, steps), None if commands is None else commands.command)
    (_, alive), (record, watched) = jax.lax.scan(step, (state, jnp.asarray(True)), during)
    obs, action, valid, score, broke = record
    trajectory = Trajectory(obs=obs, action=action, alive=valid, score=score, fell=~alive, not_finite=broke.any())
    return trajectory, watched


@dataclass(frozen=True, kw_only=True)
class MjxTarget:
    """A target in the tuner's own engine: only its parameters are hidden. Its methods are pure and may be jitted."""

    robot: Biteno
    params: Mapping[str, float]
    """True physical values by name; only tests and reports may read them."""

    def episodes(self, key: jax.Array, act: Act, count: int, steps: int) -> Trajectory:
        """Measures episodes under a policy; `envs.targets.protocol.Target` describes arguments and result.

        It can be traced, so it may serve as the `measure` of a tuner.
        """
        return rollout(self.robot, key, act, self._params(count), steps)[0]

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
    robot: Biteno, key: jax.Array, act: Act, coords: Coords, steps: int, commands: Commands | None = None
) -> Trajectory:
    """Simulates one episode for every draw of the tuner's distribution: the `simulate` that a tuner is given.

    Args:
      robot: robot and task; its table translates coordinates into physical values.
      key: random key.
      act: the policy.
      coords: draws in search coordinates by name, each [episodes].
      steps: length of an episode in policy steps.
      commands: in place of those that the task would draw.
    """
    return rollout(robot, key, act, parameters.from_coords(robot.entries, coords), steps, commands)[0]
