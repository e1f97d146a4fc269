"""Simulated episodes of anyone's MJX environment, with its physical parameters as an argument.

    env = registry.load("CheetahRun", config_overrides={"impl": "jax"})
    sim = Simulator(env, steps=150, parameters={"torso": mass("torso", bounds=(0.4, 2.5))})
    machine = Tuner(config=TunerConfig(), train_policy=tuner.keep, simulate=sim.simulate(act))

An environment has `reset(key) -> state` and `step(state, action) -> state`, with `obs`, `reward` and `done` in its
state: those of MuJoCo Playground and of Brax's MJX backend have. Every episode is simulated in a copy of it that has a
model of its own.

With `impl="warp"`, where Warp is installed, MuJoCo Warp simulates in MJX's place, on one device. Its environments say
beforehand how many contacts all robots have room for (Playground's `naconmax`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from mujoco import mjx

from jaxtune import dist as dists
from jaxtune.mjx import environments, parameters
from jaxtune.mjx.engine import Engine, value_of
from jaxtune.mjx.entry import Entry
from jaxtune.mjx.environments import WithModel, data_of, model_of, with_data, with_model
from jaxtune.mjx.episodes import replay, rollout
from jaxtune.mjx.parameters import Params
from jaxtune.shooting import Replay
from jaxtune.types import Coords, ParamDist, Trajectory

Act = Callable[[Any, Any, jax.Array], jax.Array]
"""A policy: `(policy, observation of one environment, key) -> action [act]`. The policy is a pytree of arrays."""
_EXPLODED = 1e8  # an observation in whatever unit


@chex.dataclass(frozen=True)
class State:
    """A robot between two control steps, and what the last one earned."""

    env: Any  # the environment's own state
    obs: Any  # what the policy is given
    past: jax.Array  # [time, act] latest actions, newest first, as many as a delay needs
    reward: jax.Array
    score: jax.Array  # the same: what is trained is what is scored
    done: jax.Array
    not_finite: jax.Array  # 1 where observation or reward is not finite
    steps: jax.Array  # control steps since the reset
    terms: dict  # the environment's metrics that are single numbers
    key: jax.Array


@dataclass(frozen=True)
class Simulator:
    """Simulates episodes of an environment whose parameters are drawn from a distribution, for `jaxtune.tuner`.

    Attributes:
      env: the environment, not vectorised: without wrappers that reset it, vmap it or repeat actions.
      steps: length of an episode in control steps.
      parameters: the table, by name; `jaxtune.mjx.rows` has the usual rows, and `parameters_of` proposes one.
      observe: for dictionary observations, the key or keys that the tuner compares, or a function of the observation.
        The policy is given the whole dictionary.
      with_model: gives an environment another model; the default is for Playground and for Brax.
      model: the nominal model, where `env` has it in another place than theirs do.

    Raises:
      ValueError: from the constructor, for whatever cannot be right in the table or the environment. It names the
        parameter, what was given and what is allowed.
    """

    env: Any
    steps: int
    parameters: Mapping[str, Entry]
    observe: str | Sequence[str] | Callable[[Any], jax.Array] | None = None
    with_model: WithModel = with_model
    model: mjx.Model | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.model is None:
            object.__setattr__(self, "model", model_of(self.env))
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(f"steps: got {self.steps!r}, expected at least 1, a whole number")
        self._engine.check()
        if not self.parameters:
            raise ValueError("parameters: got none, expected a row for each that may be wrong")
        environments.check_delay(self.env, self.parameters, self.steps)
        environments.check_reach(self.env, self.model, self.with_model)
        self._check_reset()
        self._check_influence()

    def _check_reset(self) -> None:
        """Checks what an environment starts with, by shape: one robot, and the observation that `observe` names."""
        named = (self.observe,) if isinstance(self.observe, str) or callable(self.observe) else self.observe or ()
        if not isinstance(named, Sequence) or not all(isinstance(name, str) or callable(name) for name in named):
            raise ValueError(f"observe: got {self.observe!r}, expected a key, keys, or a function")
        environments.check_start(self._start, jax.eval_shape(self.observed, self._start.obs))
        self.layout  # noqa: B018  names what is wrong with `observe`

    def _check_influence(self) -> None:
        nominal = parameters.nominal(self.parameters)
        start = jax.eval_shape(self.reset, nominal, jax.random.PRNGKey(0))
        action = jax.ShapeDtypeStruct((self.action_size,), jnp.float32)
        environments.check_influence(lambda *args: self.move(*args)[0], self.parameters, nominal, start, action)

    @property
    def entries(self) -> Mapping[str, Entry]:
        """The table, by the name that other robots have it under."""
        return self.parameters

    def dist(self, radius: float | Coords = 0.2, centre: Params | None = None) -> ParamDist:
        """Makes the distribution that a search begins with.

        Args:
          radius: half width in coordinates, the same for all or by name, of every one: 0.2 spans multipliers of 0.82
            to 1.22, and a fifth of half the bounds of what is added.
          centre: physical values by name; those that are left out are nominal.
        """
        return parameters.distribution(self.parameters, radius, centre or {})

    def physical(self, dist: ParamDist) -> dict[str, dict[str, float]]:
        """Reads a distribution in physical values: by name, the centre (`value`) and the ends of its box."""
        low, high = dists.box(dist)
        ends = {"low": low, "value": dist.centre, "high": high}
        found = {end: parameters.from_coords(self.parameters, coords) for end, coords in ends.items()}
        names = parameters.select(self.parameters, tuple(dist.centre))
        return {name: {end: float(values[name]) for end, values in found.items()} for name in names}

    def simulate(self, act: Act, *, states: bool = False) -> Callable[[jax.Array, Any, Coords], Trajectory]:
        """Makes the `simulate` of a tuner: one episode for every draw of the coordinates, compiled.

        Args:
          act: the policy.
          states: True to give the robots' states as well, for a tuner with a `replay`.

        Raises:
          ValueError: the policy is no function.
        """
        _check_act(act)

        def simulate(key: jax.Array, policy: Any, coords: Coords) -> Trajectory:
            return self.rollout(key, act, policy, parameters.from_coords(self.parameters, coords), states)

        # A tuner traces it several times, and the trace of an environment takes seconds.
        return jax.jit(simulate)

    def replay(self) -> Replay:
        """Makes the `replay` of a tuner, for robots whose states are measured (`jaxtune.mjx.replay`)."""
        return replay(self, self.parameters)

    def measure(
        self, act: Act, params: Params, episodes: int, *, states: bool = False
    ) -> Callable[[jax.Array, Any], Trajectory]:
        """Makes a `measure` that stands in for a robot: the same environment with parameters that are hidden.

        Args:
          act: the policy.
          params: true physical values by name; those that are left out are nominal.
          episodes: in a measured set, as in `TunerConfig.set_episodes`.
          states: True to measure the robot's states as well.

        Raises:
          ValueError: the policy is no function, a name is not in the table, a value is out of bounds, or there are no
            episodes.
        """
        _check_act(act)
        parameters.check_values(self.parameters, params)
        if not isinstance(episodes, int) or episodes < 1:
            raise ValueError(f"episodes: got {episodes!r}, expected a whole number of at least 1")
        truth = parameters.nominal(self.parameters) | dict(params)

        def measure(key: jax.Array, policy: Any) -> Trajectory:
            params = {name: jnp.full(episodes, value) for name, value in truth.items()}
            return self.rollout(key, act, policy, params, states)

        return jax.jit(measure)

    def rollout(self, key: jax.Array, act: Act, policy: Any, params: Params, states: bool = False) -> Trajectory:
        """Simulates one episode for every draw of the parameters, [draws] physical values by name.

        Parameters that are left out stay nominal. An episode ends where the environment is done or a number is not
        finite; the latter is counted in `not_finite`.
        """
        return rollout(self, key, Partial(act, policy), params, self.steps, states=states)[0]

    def reset(self, params: Params, key: jax.Array) -> State:
        """Starts an episode of one robot with these parameters; those that are left out are nominal."""
        key_reset, key = jax.random.split(key)
        # Environments of Playground and Brax keep raw keys in their states.
        return self._begun(params, self._env(params).reset(environments.raw(key_reset)), key)

    def _begun(self, params: Params, start: Any, key: jax.Array) -> State:
        nothing = jnp.zeros((), jnp.float32)
        return self._as_state(
            start,
            past=jnp.zeros((len(self._delay_weights(params)), self.action_size)),
            reward=nothing,
            done=nothing,
            not_finite=nothing,
            steps=jnp.zeros((), jnp.int32),
            key=key,
        )

    def move(self, params: Params, state: State, action: jax.Array) -> tuple[State, Any]:
        """Moves one robot by a control step under its action [act].

        Returns:
          Its state, and the environment's own.
        """
        # Before the first action there was none: it is as if it had been given all along.
        past = jnp.where(state.steps == 0, action, jnp.roll(state.past, 1, axis=0).at[0].set(action))
        following = self._env(params).step(state.env, jnp.sum(self._delay_weights(params)[:, None] * past, axis=0))
        # One that is finite but has exploded would spoil the statistics of all others, as one that is not.
        finite = (jnp.abs(self.observed(following.obs)) < _EXPLODED).all() & jnp.isfinite(following.reward)
        state = self._as_state(
            following,
            past=past,
            reward=jnp.where(finite, jnp.asarray(following.reward, jnp.float32), 0.0),
            done=jnp.where(finite, jnp.asarray(following.done, jnp.float32), 1.0),
            not_finite=(~finite).astype(jnp.float32),
            steps=state.steps + 1,
            key=jax.random.split(state.key, 1)[0],
        )
        return state, following

    def kept(self, state: State) -> dict[str, Any]:
        """Takes what the next steps depend on out of a state: positions, velocities and past actions.

        What else an environment remembers, such as a command, is not among it.
        """
        data = data_of(state.env)
        found = {name: getattr(data, name) for name in ("qpos", "qvel", "act", "qacc_warmstart")}
        return found | {"past": state.past, "steps": state.steps}

    def resumed(self, params: Params, kept: Mapping[str, Any]) -> State:
        """Makes a state of what was kept of one, or measured: `qpos` and `qvel` at least.

        Without `past`, an action that the robot's delay had not let through yet is taken to be the next one.
        """
        start = self._begun(params, jax.tree.map(jnp.asarray, self._reset_once), jax.random.PRNGKey(0))
        own = {name: value for name, value in kept.items() if name not in ("past", "steps")}
        known = {name: kept[name] for name in ("past", "steps") if name in kept}
        return start.replace(env=with_data(start.env, data_of(start.env).replace(**own)), **known)

    @cached_property
    def _reset_once(self) -> Any:
        """The environment's state after a reset of the nominal robot, in numbers.

        Some settle the robot for hundreds of steps, which no piece of an episode should hold.
        """
        with jax.ensure_compile_time_eval():
            return jax.device_get(jax.jit(self._env({}).reset)(environments.raw(jax.random.PRNGKey(0))))

    @cached_property
    def action_size(self) -> int:
        """Number of components of an action: the environment's `action_size`, or the number of actuators."""
        return int(getattr(self.env, "action_size", self.model.nu))

    @property
    def observation_size(self) -> int:
        """Number of components of what is observed (`observe`)."""
        return sum(self.layout.values())

    @cached_property
    def layout(self) -> dict[str, int]:
        """Parts of what is observed and their sizes, in order: the keys of a dictionary observation, else `obs`."""
        start = self._start.obs
        whole = jax.eval_shape(self.observed, start).shape[0]
        return {name: start[name].shape[0] for name in self._keys} if self._keys else {"obs": whole}

    @cached_property
    def _start(self) -> Any:
        """Shapes of the environment's own state at the start of an episode."""
        start = jax.eval_shape(self.env.reset, jax.random.PRNGKey(0))
        for name in ("obs", "reward", "done"):
            if not hasattr(start, name):
                raise ValueError(f"env: got a reset that returns {type(start).__name__} without '{name}'")
        return start

    def observed(self, obs: Any) -> jax.Array:
        """Makes one array of an observation, by `observe`.

        Raises:
          ValueError: a dictionary has no such key.
        """
        if callable(self.observe):
            return self.observe(obs)
        if isinstance(obs, Mapping):
            if not self._keys or not set(self._keys) <= obs.keys():
                raise ValueError(f"observe: got {self.observe!r}, expected some of {', '.join(obs)}")
            return jnp.concatenate([obs[name] for name in self._keys], axis=-1)
        if self.observe is not None:
            raise ValueError(f"observe: got {self.observe!r}, but the environment's observation is one array")
        return obs

    def randomization_fn(
        self, dist: ParamDist, *, leave_out: Sequence[str] = ()
    ) -> Callable[[mjx.Model, jax.Array], tuple[mjx.Model, mjx.Model]]:
        """Makes the `randomization_fn` of Brax's and Playground's training: robots drawn from a distribution.

        It takes a model and keys `rng` [environments], and returns the model with a batch of values in the fields that
        differ, and the axes to vmap over. Their `train` functions bind the keys themselves.

        Args:
          dist: the distribution.
          leave_out: names of parameters that stay nominal.

        Raises:
          ValueError: the table has an action delay that is not left out: it is not part of a model. Or it lacks a
            name.
        """
        parameters.select(self.parameters, leave_out)
        table = {name: entry for name, entry in self.parameters.items() if name not in leave_out}
        for name, entry in table.items():
            if entry.kind == "control":
                raise ValueError(
                    f"parameter '{name}': it is not part of the model, so no randomization_fn can draw it; expected it "
                    f"in leave_out=('{name}',), or a training that draws it itself"
                )
        changed = self._engine.written(table)

        def randomize(model: mjx.Model, rng: jax.Array) -> tuple[mjx.Model, mjx.Model]:
            def fields(key):
                drawn = {name: draws[0] for name, draws in dists.sample(key, dist, 1).items() if name in table}
                nominal = self._engine.nominal if self._engine.is_warp else model
                robot = parameters.apply(nominal, parameters.from_coords(table, drawn), table)
                return {name: value_of(robot, name) for name in changed}

            axes = jax.tree.map(lambda _: None, model).tree_replace(dict.fromkeys(changed, 0))
            return model.tree_replace(jax.vmap(fields)(rng)), axes

        return randomize

    @property
    def _keys(self) -> tuple[str, ...]:
        if callable(self.observe):
            return ()
        return (self.observe,) if isinstance(self.observe, str) else tuple(self.observe or ())

    def _env(self, params: Params) -> Any:
        return self.with_model(self.env, self._engine.robot(params))

    @cached_property
    def _engine(self) -> Engine:
        return Engine(self.env, self.model, self.parameters)

    @staticmethod
    def _as_state(own, *, reward, **fields) -> State:
        terms = {name: value for name, value in getattr(own, "metrics", {}).items() if jnp.ndim(value) == 0}
        return State(env=own, obs=own.obs, reward=reward, score=reward, terms=terms, **fields)

    def _delay_weights(self, params) -> jax.Array:
        """Shares of the latest actions in what the environment is given, newest first: two of them interpolate."""
        for name, entry in self.parameters.items():
            if entry.kind == "control":
                longest = math.ceil(entry.bounds[1] / float(self.env.dt) - 1e-6)
                return jnp.maximum(1.0 - jnp.abs(jnp.arange(longest + 1) - params.get(name, 0.0) / self.env.dt), 0.0)
        return jnp.ones(1)


def _check_act(act: Any) -> None:
    if not callable(act):
        raise ValueError(f"act: got {type(act).__name__}, expected a function (policy, observation, key) -> action")
