"""Episodes of BITeno in MJX: the simulated ones, and those of a target in the same engine."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from envs import domain
from envs.biteno import Biteno
from jaxtune.types import Named, Trajectory

Act = Callable[[jax.Array, jax.Array], tuple[jax.Array, dict]]
"""A policy: `(observation [obs], key) -> (action [act], extras)`."""

_CHUNK = 256  # small batches are fastest on a CPU; larger ones are worked off in turn


def rollout(robot: Biteno, key: jax.Array, act: Act, params: domain.Params, steps: int) -> Trajectory:
    """Plays one episode for every parameter draw.

    An episode ends where the robot falls or the simulation breaks; the broken step is counted and masked.

    Args:
      robot: robot and task.
      key: random key; commands, resets and noise depend on it alone.
      act: the policy.
      params: physical values by name, each [episodes].
      steps: length of an episode.
    """
    # Constant parameters would have the compiler work out every derived field of every model by itself, for minutes.
    params = jax.lax.optimization_barrier(dict(params))
    count = next(iter(params.values())).shape[0]
    episode = jax.vmap(lambda key, params: _episode(robot, key, act, params, steps))
    keys = jax.random.split(key, count)
    if count <= _CHUNK:
        return episode(keys, params)
    # Chunks of equal size; the last one is filled up with repetitions.
    chunks = -(-count // _CHUNK)
    size = -(-count // chunks)
    fill = jnp.arange(chunks * size) % count
    inputs = jax.tree.map(lambda x: x[fill].reshape(chunks, size, *x.shape[1:]), (keys, params))
    stacked = jax.lax.map(lambda item: episode(*item), inputs)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], stacked)


def _episode(robot: Biteno, key: jax.Array, act: Act, params: domain.Params, steps: int) -> Trajectory:
    key_reset, key_act = jax.random.split(key)

    def step(carry, key):
        state, alive = carry
        action, _ = act(state.obs, key)
        following = robot.step(params, state, action)
        broke = alive & (following.not_finite > 0)
        score = jnp.where(alive & ~broke, following.score, 0.0)
        record = (state.obs, action, alive & ~broke, score, broke)
        return (following, alive & (following.done == 0)), record

    start = (robot.reset(params, key_reset), jnp.asarray(True))
    (_, alive), (obs, action, valid, score, broke) = jax.lax.scan(step, start, jax.random.split(key_act, steps))
    return Trajectory(obs=obs, action=action, alive=valid, score=score, fell=~alive, not_finite=broke.any())


@dataclass(frozen=True, kw_only=True)
class MjxTarget:
    """A robot whose parameters are hidden from the tuner: it answers with episodes alone."""

    robot: Biteno
    params: Mapping[str, float]
    """True physical values by name; only a report may read them."""

    def episodes(self, key: jax.Array, act: Act, count: int, steps: int) -> Trajectory:
        """Measures `count` episodes of `steps` policy steps."""
        params = {name: jnp.full(count, value, jnp.float32) for name, value in self.params.items()}
        return rollout(self.robot, key, act, params, steps)


def simulate(robot: Biteno, key: jax.Array, act: Act, coordinates: Named, steps: int) -> Trajectory:
    """Plays one episode for every draw of the tuner's distribution, [episodes] by name in search coordinates."""
    return rollout(robot, key, act, domain.from_coordinates(robot.entries, coordinates), steps)
