"""Simulated episodes of anyone's MJX environment, with its physical parameters as an argument.

    env = registry.load("CheetahRun", config_overrides={"impl": "jax"})
    sim = Simulator(env, steps=150, parameters={"torso": mass("torso", bounds=(0.4, 2.5))})
    machine = Tuner(config=TunerConfig(), train_policy=tuner.keep, simulate=sim.simulate(act))

An environment has `reset(key) -> state` and `step(state, action) -> state`, with `obs`, `reward` and `done` in its
state: those of MuJoCo Playground and of Brax's MJX backend have. Every episode is simulated in a copy of it that has a
model of its own.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

from jaxtune import dist as dists
from jaxtune.mjx import parameters
from jaxtune.mjx.derived_fields import DERIVED
from jaxtune.mjx.parameters import Entry, Params
from jaxtune.types import Coords, ParamDist, Trajectory

_CHUNK = 256  # small batches are fastest on a CPU; larger ones are simulated in turn

Act = Callable[[Any, Any, jax.Array], jax.Array]
"""A policy: `(policy, observation of one environment, key) -> action [act]`."""
WithModel = Callable[[Any, mjx.Model], Any]
"""`(env, model) -> env`: a copy of an environment that simulates this model."""


def with_model(env: Any, model: mjx.Model) -> Any:
    """Copies an environment of MuJoCo Playground or of Brax's MJX backend, and gives the copy another model.

    The copy is shallow, and the environment stays as it was. What an environment computed from its model when it was
    made (joint limits, a standing height) stays nominal. Where that matters, or for an environment of another make,
    hand `Simulator` a function of your own.
    """
    env = copy.copy(env.unwrapped)
    if hasattr(env, "_mjx_model"):
        env._mjx_model = model
    else:
        env.sys = model
    return env


def in_chunks(function: Callable[..., Any], inputs: Any) -> Any:
    """Maps a function over the first axis of its inputs, `_CHUNK` at a time in parallel.

    Args:
      function: of one item; it is vmapped.
      inputs: tuple of arguments, pytrees whose leaves are all [count, ...].

    Returns:
      What the function returns, [count, ...].
    """
    several = jax.vmap(function)
    count = len(jax.tree.leaves(inputs)[0])
    if count <= _CHUNK:
        return several(*inputs)
    # Chunks of equal size need one compilation; the last one is filled up with repetitions.
    chunks = -(-count // _CHUNK)
    size = -(-count // chunks)
    fill = jnp.arange(chunks * size) % count
    inputs = jax.tree.map(lambda x: x[fill].reshape(chunks, size, *x.shape[1:]), inputs)
    stacked = jax.lax.map(lambda item: several(*item), inputs)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], stacked)


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
            object.__setattr__(self, "model", _model_of(self.env))
        if self.steps < 1:
            raise ValueError(f"steps: got {self.steps}, expected at least 1")
        if not self.parameters:
            raise ValueError("parameters: got none, expected a row for each that may be wrong")
        parameters.check(self.model, self.parameters)
        delays = [name for name, entry in self.parameters.items() if entry.kind == "control"]
        if len(delays) > 1:
            raise ValueError(f"parameters: got {' and '.join(delays)}, expected one action_delay at most")
        if delays and not hasattr(self.env, "dt"):
            raise ValueError(f"parameter '{delays[0]}': the environment has no dt, the control period in seconds")

    def dist(self, radius: float = 0.2, centre: Params | None = None) -> ParamDist:
        """Makes the distribution that a search begins with.

        Args:
          radius: half width in coordinates: 0.2 spans multipliers of 0.82 to 1.22, and a fifth of half the bounds of
            what is added.
          centre: physical values by name; those that are left out are nominal.
        """
        return parameters.distribution(self.parameters, radius, centre or {})

    def physical(self, dist: ParamDist) -> dict[str, dict[str, float]]:
        """Reads a distribution in physical values: by name, the centre (`value`) and the ends of its box."""
        low, high = dists.box(dist)
        ends = {"low": low, "value": dist.centre, "high": high}
        found = {end: parameters.from_coords(self.parameters, coords) for end, coords in ends.items()}
        return {name: {end: float(values[name]) for end, values in found.items()} for name in self.parameters}

    def simulate(self, act: Act) -> Callable[[jax.Array, Any, Coords], Trajectory]:
        """Makes the `simulate` of a tuner: one episode for every draw of the coordinates."""

        def simulate(key: jax.Array, policy: Any, coords: Coords) -> Trajectory:
            return self.rollout(key, act, policy, parameters.from_coords(self.parameters, coords))

        return simulate

    def measure(self, act: Act, params: Params, episodes: int) -> Callable[[jax.Array, Any], Trajectory]:
        """Makes a `measure` that stands in for a robot: the same environment with parameters that are hidden.

        Args:
          act: the policy.
          params: true physical values by name; those that are left out are nominal.
          episodes: in a measured set, as in `TunerConfig.set_episodes`.
        """
        parameters.check_values(self.parameters, params)
        truth = parameters.nominal(self.parameters) | dict(params)

        def measure(key: jax.Array, policy: Any) -> Trajectory:
            return self.rollout(key, act, policy, {name: jnp.full(episodes, value) for name, value in truth.items()})

        return measure

    def rollout(self, key: jax.Array, act: Act, policy: Any, params: Params) -> Trajectory:
        """Simulates one episode for every draw of the parameters, [draws] physical values by name.

        Parameters that are left out stay nominal. An episode ends where the environment is done or a number is not
        finite; the latter is counted in `not_finite`.
        """
        # Without the barrier the compiler would fold constant parameters into every derived field of every model, and
        # take minutes.
        params = jax.lax.optimization_barrier({name: jnp.asarray(value) for name, value in params.items()})
        count = len(next(iter(params.values())))
        return in_chunks(
            lambda key, params: self._episode(act, policy, key, params), (jax.random.split(key, count), params)
        )

    def randomization_fn(self, dist: ParamDist) -> Callable[[mjx.Model, jax.Array], tuple[mjx.Model, mjx.Model]]:
        """Makes the `randomization_fn` of Brax's and Playground's training: robots drawn from a distribution.

        It takes a model and keys [environments], and returns the model with a batch of values in the fields that
        differ, and the axes to vmap over. Their `train` functions bind the keys themselves.

        Raises:
          ValueError: the table has an action delay, which is not part of a model.
        """
        for name, entry in self.parameters.items():
            if entry.kind == "control":
                raise ValueError(f"parameter '{name}': it is not part of the model, so no randomization_fn can draw it")
        changed = {*DERIVED, *(field for entry in self.parameters.values() for field in entry.field_names)}

        def randomize(model: mjx.Model, keys: jax.Array) -> tuple[mjx.Model, mjx.Model]:
            def fields(key):
                drawn = jax.tree.map(lambda draw: draw[0], dists.sample(key, dist, 1))
                robot = parameters.apply(model, parameters.from_coords(self.parameters, drawn), self.parameters)
                return {name: _get(robot, name) for name in changed}

            axes = jax.tree.map(lambda _: None, model).tree_replace(dict.fromkeys(changed, 0))
            return model.tree_replace(jax.vmap(fields)(keys)), axes

        return randomize

    def _episode(self, act, policy, key, params) -> Trajectory:
        key_reset, key_act = jax.random.split(key)
        env = self.with_model(self.env, parameters.apply(self.model, params, self.parameters))
        # Environments of Playground and Brax keep raw keys in their states.
        start = env.reset(key_reset if key_reset.dtype == jnp.uint32 else jax.random.key_data(key_reset))
        weights = self._delay_weights(params)

        def step(carry, now):
            (state, alive, past), (key, first) = carry, now
            action = act(policy, state.obs, key)
            # Before the first action there was none: it is as if it had been given all along.
            past = jnp.where(first, action, jnp.roll(past, 1, axis=0).at[0].set(action))
            following = env.step(state, jnp.sum(weights[:, None] * past, axis=0))
            broke = alive & ~(jnp.isfinite(self._observed(following.obs)).all() & jnp.isfinite(following.reward))
            lives = alive & ~broke
            record = self._observed(state.obs), action, lives, jnp.where(lives, following.reward, 0.0), broke
            return (following, lives & (following.done == 0), past), record

        past = jnp.zeros((len(weights), *jax.eval_shape(act, policy, start.obs, key_act).shape))
        during = jax.random.split(key_act, self.steps), jnp.arange(self.steps) == 0
        (_, alive, _), (obs, action, lives, score, broke) = jax.lax.scan(step, (start, jnp.asarray(True), past), during)
        return Trajectory(obs=obs, action=action, alive=lives, score=score, fell=~alive, not_finite=broke.any())

    def _delay_weights(self, params) -> jax.Array:
        """Shares of the latest actions in what the environment is given, newest first: two of them interpolate."""
        for name, entry in self.parameters.items():
            if entry.kind == "control":
                longest = math.ceil(entry.bounds[1] / float(self.env.dt) - 1e-6)
                return jnp.maximum(1.0 - jnp.abs(jnp.arange(longest + 1) - params.get(name, 0.0) / self.env.dt), 0.0)
        return jnp.ones(1)

    def _observed(self, obs: Any) -> jax.Array:
        if callable(self.observe):
            return self.observe(obs)
        if isinstance(obs, Mapping):
            keys = (self.observe,) if isinstance(self.observe, str) else self.observe or ()
            if not keys or not set(keys) <= obs.keys():
                raise ValueError(f"observe: got {self.observe!r}, expected some of {', '.join(obs)}")
            return jnp.concatenate([obs[name] for name in keys], axis=-1)
        if self.observe is not None:
            raise ValueError(f"observe: got {self.observe!r}, but the environment's observation is one array")
        return obs


def _model_of(env: Any) -> mjx.Model:
    for place in (env, getattr(env, "unwrapped", env)):
        for name in ("mjx_model", "sys"):
            model = getattr(place, name, None)
            if isinstance(model, mjx.Model):
                return model
    raise ValueError(
        f"env: got {type(env).__name__}, which has no MJX model in 'mjx_model' (MuJoCo Playground) or 'sys' (Brax with "
        "backend='mjx'); hand over model= and with_model="
    )


def _get(model: mjx.Model, path: str) -> jax.Array:
    for name in path.split("."):
        model = getattr(model, name)
    return model
