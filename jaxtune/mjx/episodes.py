"""Simulated episodes of any robot whose physical parameters are an argument, batched and compiled."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxtune import devices
from jaxtune.mjx import parameters
from jaxtune.mjx.entry import Entry
from jaxtune.mjx.parameters import Params
from jaxtune.shooting import Replay
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

    def kept(self, state: State) -> Mapping[str, Any]:
        """Takes what the next steps depend on out of a state: `qpos`, `qvel` and whatever else, by name."""

    def resumed(self, params: Params, kept: Mapping[str, Any]) -> State:
        """Makes a state of what was kept of one, or measured."""


@devices.precisely
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
    states: bool = False,
    until: jax.Array | None = None,
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
      states: True to keep the robot's states (`Trajectory.state`), for a `replay`.
      until: number of steps that are simulated, so that one program serves several lengths; all of them if None. The
        steps after it hold zeros.

    Returns:
      The episodes, and what was watched of them, [episodes, time, ...].

    Raises:
      ValueError: the policy's action is not one array of the robot's `action_size`.
    """
    # Without the barrier the compiler would fold constant parameters into every derived field of every model, and take
    # minutes.
    params = jax.lax.optimization_barrier({name: jnp.asarray(value) for name, value in params.items()})

    def episode(act, until, key, params, given):
        key_reset, key_act = jax.random.split(key)

        def step(carry, now):
            (state, alive), (key, number) = carry, now
            state = prepare(state, given, number)
            action = _checked(act(state.obs, key), robot.action_size)
            following, motion = robot.move(params, state, action)
            broke = alive & (following.not_finite > 0)
            lives = alive & ~broke
            record = robot.observed(state.obs), action, lives, jnp.where(lives, following.score, 0.0), broke
            kept = robot.kept(state) if states else None
            return (following, alive & (following.done == 0)), (record, kept, watch(state, following, motion))

        def step_or_none(carry, now):
            if until is None:
                return step(carry, now)
            nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(step, carry, now)[1])
            return jax.lax.cond(now[1] < until, step, lambda carry, _: (carry, nothing), carry, now)

        start = robot.reset(params, key_reset)
        during = jax.random.split(key_act, steps), jnp.arange(steps)
        (_, alive), (record, kept, watched) = jax.lax.scan(step_or_none, (start, jnp.asarray(True)), during)
        obs, action, lives, score, broke = record
        ended = {"fell": ~alive, "not_finite": broke.any()}
        return Trajectory(obs=obs, action=action, alive=lives, score=score, state=kept, **ended), watched

    keys = jax.random.split(key, len(next(iter(params.values()))))
    # A partial's arguments are what a policy depends on.
    act = act if isinstance(act, Partial) else Partial(act)
    return devices.in_chunks(episode, (keys, params, given), _CHUNK, shared=(act, until))


def replay(robot: Robot, table: Mapping[str, Entry]) -> Replay:
    """Makes the `replay` of a tuner: pieces of an episode, simulated from measured states.

    Their ends are compared by positions and velocities. A quaternion must have the sign that simulation gives it.

    Args:
      robot: robot and task.
      table: of the parameters that are tuned.
    """

    def read(kept: Mapping[str, Any]) -> jax.Array:
        return jnp.concatenate([kept["qpos"], kept["qvel"]])

    def play(kept, actions, coords):
        params = jax.lax.optimization_barrier(parameters.from_coords(table, coords))
        move = lambda state, action: (robot.move(params, state, action)[0], None)  # noqa: E731
        return read(robot.kept(jax.lax.scan(move, robot.resumed(params, kept), actions)[0]))

    return Replay(play=play, read=read, needs=("qpos", "qvel"))


def _checked(action: Any, size: int) -> jax.Array:
    # One number would be broadcast to all motors, without a word.
    if not hasattr(action, "shape") or action.shape != (size,):
        got = f"shape {action.shape}" if hasattr(action, "shape") else f"a {type(action).__name__}"
        raise ValueError(f"act: got {got}, expected an action of shape ({size},)")
    return action
