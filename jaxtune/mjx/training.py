"""A batch of robots behind Brax's environment interface, for PPO (`jaxtune.ppo`).

Every robot has its own physical parameters, and starts a new episode by itself when one ends.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env as BraxEnv
from brax.envs.base import State as BraxState
from mujoco import mjx

from jaxtune import devices
from jaxtune.mjx.entry import Entry
from jaxtune.mjx.episodes import Robot
from jaxtune.mjx.parameters import Params, nominal


class TrainingBatch(BraxEnv):
    """A batch of robots behind Brax's interface, each with its own physical parameters.

    A robot whose episode ends, because it is done or by the time limit, starts a new one in the same step. The
    parameters travel in `state.info["params"]`; `with_params` changes them without compiling anything again. An episode
    cut by the time limit is marked in `state.info["truncation"]`, so that PPO does not take the cut for a fall.

    Args:
      robot: robot and task, unbatched: BITeno, a `Simulator`, or any `Robot` whose states have `reward`, `score`,
        `steps`, `terms` and `key` as a `Simulator`'s have.
      entries: the parameter table; robots are nominal until they get other values.
      limit: length of an episode in control steps.
    """

    def __init__(self, robot: Robot, entries: Mapping[str, Entry], limit: int):
        self._robot, self._entries, self._limit = robot, entries, limit

    def reset(self, rng: jax.Array) -> BraxState:
        """Resets a batch of nominal robots, one for each key in `rng` [batch, ...]; Brax's own entry point."""
        count = rng.shape[0]
        params = {name: jnp.full(count, value, jnp.float32) for name, value in nominal(self._entries).items()}
        return self.start(params, rng)

    @devices.precisely
    def start(self, params: Params, keys: jax.Array) -> BraxState:
        """Resets a batch of robots with the given parameters.

        Args:
          params: physical values by name, [batch] each; every name of the robot's table.
          keys: [batch] random keys, of `jax.random.PRNGKey`'s kind.
        """
        robots = jax.vmap(self._robot.reset)(params, keys)
        return self._as_brax(params, robots, robots, jnp.zeros_like(robots.done))

    @staticmethod
    def with_params(state: BraxState, params: Params) -> BraxState:
        """Gives the robots other parameters, [batch] by name, in the middle of their episodes.

        The tuner's distribution moves while PPO trains on; robots do not start anew because of it.
        """
        # A weakly typed value would have the next step compiled anew.
        params = {name: jnp.asarray(value, jnp.float32) for name, value in params.items()}
        return state.replace(info={**state.info, "params": params})

    @devices.precisely
    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Moves every robot by one control step under its action [batch, act].

        Reward, `done` and metrics are of the step; observations of robots whose episode ended are those of the next
        one.
        """
        params = state.info["params"]
        robots, _ = jax.vmap(self._robot.move)(params, state.pipeline_state, action)
        # An episode that ends by a fall in the very step of the time limit counts as a fall: its value is zero.
        truncation = (robots.steps >= self._limit) * (1.0 - robots.done)
        ended = (robots.done + truncation) > 0

        def restart():
            # New random states, where Brax's own wrapper would go back to one cached state.
            return jax.vmap(_choose)(ended, jax.vmap(self._robot.reset)(params, robots.key), robots)

        # All robots are reset and most of the results thrown away, so it is not done where no episode ended.
        following = jax.lax.cond(ended.any(), restart, lambda: robots)
        return self._as_brax(params, robots, following, truncation)

    def _as_brax(self, params, robots, following, truncation) -> BraxState:
        # Brax counts an episode that the time limit cut as done, and distinguishes it by `truncation`.
        return BraxState(
            pipeline_state=following,
            obs=jax.vmap(self._robot.observed)(following.obs),
            reward=robots.reward,
            done=jnp.maximum(robots.done, truncation),
            metrics={**robots.terms, "score": robots.score, "not_finite": robots.not_finite},
            info={"params": params, "truncation": truncation},
        )

    @property
    def observation_size(self) -> int:
        """Number of components of an observation."""
        return self._robot.observation_size

    @property
    def action_size(self) -> int:
        """Number of components of an action."""
        return self._robot.action_size

    @property
    def backend(self) -> str:
        """Name of the physics engine; Brax's environment interface requires it, and nothing here reads it."""
        return "mjx"


def _choose(condition: jax.Array, one: Any, other: Any) -> Any:
    """One of two states of a robot. Warp's data has arrays that all robots share, so its own `where` chooses."""
    whole = lambda leaf: isinstance(leaf, mjx.Data)  # noqa: E731
    return jax.tree.map(
        lambda new, old: old.where(condition, new) if whole(old) else jnp.where(condition, new, old),
        one,
        other,
        is_leaf=whole,
    )
