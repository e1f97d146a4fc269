"""Simulated episodes of any robot whose physical parameters are an argument, batched and compiled."""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxtune import devices
from jaxtune.mjx.parameters import Params
from jaxtune.types import Trajectory

_CHUNK = {"cpu": 256, "other": 8192}  # robots side by side on a device: small batches stay in a CPU's cache


class State(Protocol):
    """What an episode reads of a robot's state; a robot's own has more."""

    obs: Any
    """What the policy is given."""
    score: jax.Array
    """Reward of the last step."""
    done: jax.Array
    """1 where the episode has ended, otherwise 0."""
    not_finite: jax.Array
    """1 where it ended because the simulation broke."""


class Robot(Protocol):
    """One robot and its task as pure functions, unbatched: `Simulator` is one, of anyone's environment."""

    observation_size: int
    action_size: int

    def reset(self, params: Params, key: jax.Array) -> State:
        """Starts an episode."""

    def observed(self, obs: Any) -> jax.Array:
        """Makes one array of an observation: what the tuner compares, and what a policy learns on."""

    def move(self, params: Params, state: State, action: jax.Array) -> tuple[State, Any]:
        """Moves the robot by one control step; returns its state, and anything that a `watch` may want to see."""


def rollout(
    robot: Robot,
    key: jax.Array,
    act: Callable[[Any, jax.Array], jax.Array],
    params: Params,
    steps: int,
    *,
    given: Any = None,
    prepare: Callable[[State, Any, jax.Array], State] = lambda state, given, step: state,
    watch: Callable[[State, State, Any], Any] = lambda before, after, motion: (),
) -> tuple[Trajectory, Any]:
    """Simulates one episode for every draw of the parameters.

    An episode ends where the robot is done or a number is not finite. The latter is counted in `not_finite`, and the
    step masked.

    Args:
      robot: robot and task.
      key: random key; resets and everything random in an episode depend on it alone.
      act: the policy, `(observation, key) -> action [act]`. What it depends on and is traced is bound by
        `jax.tree_util.Partial`, so that all devices get it.
      params: physical values by name, each [episodes].
      steps: length of an episode in control steps.
      given: pytree, [episodes, ...], of what else differs between episodes, such as commands.
      prepare: changes a state before a step, `(state, given, number of the step) -> state`.
      watch: what else is recorded of a step, `(state before, state after, motion) -> pytree`.

    Returns:
      The episodes, and what was watched of them, [episodes, time, ...].

    Raises:
      ValueError: the policy's action is not one array of the robot's `action_size`.
    """
    # Without the barrier the compiler would fold constant parameters into every derived field of every model, and take
    # minutes.
    params = jax.lax.optimization_barrier({name: jnp.asarray(value) for name, value in params.items()})

    def episode(act, key, params, given):
        key_reset, key_act = jax.random.split(key)

        def step(carry, now):
            (state, alive), (key, number) = carry, now
            state = prepare(state, given, number)
            action = _checked(act(state.obs, key), robot.action_size)
            following, motion = robot.move(params, state, action)
            broke = alive & (following.not_finite > 0)
            lives = alive & ~broke
            record = robot.observed(state.obs), action, lives, jnp.where(lives, following.score, 0.0), broke
            return (following, alive & (following.done == 0)), (record, watch(state, following, motion))

        start = robot.reset(params, key_reset)
        during = jax.random.split(key_act, steps), jnp.arange(steps)
        (_, alive), (record, watched) = jax.lax.scan(step, (start, jnp.asarray(True)), during)
        obs, action, lives, score, broke = record
        episodes = Trajectory(obs=obs, action=action, alive=lives, score=score, fell=~alive, not_finite=broke.any())
        return episodes, watched

    keys = jax.random.split(key, len(next(iter(params.values()))))
    # A partial's arguments are what a policy depends on.
    act = act if isinstance(act, Partial) else Partial(act)
    return devices.in_chunks(episode, (keys, params, given), _CHUNK, shared=(act,))


def _checked(action: Any, size: int) -> jax.Array:
    # One number would be broadcast to all motors, without a word.
    if not hasattr(action, "shape") or action.shape != (size,):
        got = f"shape {action.shape}" if hasattr(action, "shape") else f"a {type(action).__name__}"
        raise ValueError(f"act: got {got}, expected an action of shape ({size},)")
    return action
