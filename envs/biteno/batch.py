"""BITeno many times behind Brax's interface, for training."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env as BraxEnv
from brax.envs.base import State as BraxState

from envs.biteno import constants
from envs.biteno.env import Biteno, State
from jaxtune.mjx import parameters


class BraxBiteno(BraxEnv):
    """A batch of robots behind Brax's interface, each with its own parameters, reset when its episode ends.

    The parameters travel in `state.info["params"]`: set them with `with_params`, nothing is compiled anew.
    """

    def __init__(self, robot: Biteno):
        self._robot = robot
        self._limit = round(robot.config.episode_s / constants.POLICY_DT_S)

    def reset(self, rng: jax.Array) -> BraxState:
        """Resets a batch of nominal robots, one for each key in `rng` [batch, ...]."""
        count = rng.shape[0]
        params = {
            name: jnp.full(count, value, jnp.float32) for name, value in parameters.nominal(self._robot.entries).items()
        }
        return self.start(params, rng)

    def start(self, params: parameters.Params, keys: jax.Array) -> BraxState:
        """Resets a batch of robots with the given parameters, each value [batch]."""
        robots = jax.vmap(self._robot.reset)(params, keys)
        return self._as_brax(params, robots, robots, jnp.zeros_like(robots.done))

    @staticmethod
    def with_params(state: BraxState, params: parameters.Params) -> BraxState:
        """The same robots, wherever they are, with other parameters [batch]."""
        # A weakly typed value would have the next step compiled anew.
        params = {name: jnp.asarray(value, jnp.float32) for name, value in params.items()}
        return state.replace(info={**state.info, "params": params})

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Steps every robot under its action [batch, 6]; those whose episode ended start a new one."""
        params = state.info["params"]
        robots = jax.vmap(self._robot.step)(params, state.pipeline_state, action)
        truncation = (robots.steps >= self._limit) * (1.0 - robots.done)
        ended = (robots.done + truncation) > 0
        fresh = jax.vmap(self._robot.reset)(params, robots.key)
        following = jax.tree.map(
            lambda new, old: jnp.where(ended.reshape(-1, *[1] * (old.ndim - 1)), new, old), fresh, robots
        )
        return self._as_brax(params, robots, following, truncation)

    @staticmethod
    def _as_brax(params, robots: State, following: State, truncation: jax.Array) -> BraxState:
        # Brax calls an episode cut by the clock done as well, and tells it apart by `truncation`.
        return BraxState(
            pipeline_state=following,
            obs=following.obs,
            reward=robots.reward,
            done=jnp.maximum(robots.done, truncation),
            metrics={**robots.terms, "score": robots.score, "not_finite": robots.not_finite},
            info={"params": params, "truncation": truncation},
        )

    @property
    def observation_size(self) -> int:
        return self._robot.observation_size

    @property
    def action_size(self) -> int:
        return self._robot.action_size

    @property
    def backend(self) -> str:
        return "mjx"
