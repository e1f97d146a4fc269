"""Environments of others: where Playground and Brax keep model and data, and whether one can have other parameters."""

import copy
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.extend.core import Literal
from mujoco import mjx

from jaxtune.mjx.entry import Entry
from jaxtune.mjx.parameters import Params

WithModel = Callable[[Any, mjx.Model], Any]
"""`(env, model) -> env`: a copy of an environment that simulates this model."""
_DATA = ("data", "pipeline_state")


def with_model(env: Any, model: mjx.Model) -> Any:
    """Copies an environment of MuJoCo Playground or of Brax's MJX backend, and gives the copy another model.

    The copy is shallow, and the environment stays as it was. What an environment computed from its model when it was
    made (joint limits, a standing height) stays nominal. Where that matters, or for an environment of another make,
    hand `Simulator` a function of your own.
    """
    env = copy.copy(env)
    # Playground's `mjx_model` is a property that reads `_mjx_model`.
    setattr(env, next((name for name in ("_mjx_model", "mjx_model") if name in vars(env)), "sys"), model)
    return env


def model_of(env: Any) -> mjx.Model:
    """Finds the model of an environment of MuJoCo Playground or of Brax's MJX backend.

    Raises:
      ValueError: it has none where theirs have it, or is of another engine of Brax.
    """
    for name in ("mjx_model", "sys"):
        model = getattr(env, name, None)
        if _is_model(model):
            # Brax's other engines have a model of the same type, and never read it.
            if name == "sys" and getattr(env, "backend", "mjx") != "mjx":
                raise ValueError(f"env: got an environment of Brax's backend '{env.backend}', expected 'mjx'")
            return model
    raise ValueError(
        f"env: got {type(env).__name__}, which has no MJX model in 'mjx_model' (MuJoCo Playground) or 'sys' (Brax with "
        "backend='mjx'); hand over model= and with_model="
    )


def data_of(state: Any) -> Any:
    """Finds MuJoCo's data in the state of an environment of Playground (`data`) or of Brax (`pipeline_state`).

    Raises:
      ValueError: the state has neither.
    """
    for name in _DATA:
        if hasattr(state, name):
            return getattr(state, name)
    raise ValueError(f"env: got a state without {' or '.join(_DATA)}, which holds the robot's positions")


def with_data(state: Any, data: Any) -> Any:
    """Copies a state, with other data where `data_of` finds it."""
    changed = {next(name for name in _DATA if hasattr(state, name)): data}
    # A named tuple is no dataclass.
    return state._replace(**changed) if hasattr(state, "_replace") else dataclasses.replace(state, **changed)


def raw(key: jax.Array) -> jax.Array:
    """Makes a random key of the old kind, which environments of Playground and Brax keep in their states."""
    return key if key.dtype == np.uint32 else jax.random.key_data(key)


def check_delay(env: Any, table: Mapping[str, Entry], steps: int) -> None:
    """Checks the delay of a table, if it has one, against episodes of so many control steps.

    Raises:
      ValueError: there are two, the environment has no control period, or an episode is shorter than the delay.
    """
    delays = {name: entry for name, entry in table.items() if entry.kind == "control"}
    if len(delays) > 1:
        raise ValueError(f"parameters: got {' and '.join(delays)}, expected one action_delay at most")
    for name, entry in delays.items():
        if not hasattr(env, "dt"):
            raise ValueError(f"parameter '{name}': the environment has no dt, the control period in seconds")
        longest = steps * float(env.dt)
        if entry.bounds[1] > longest:
            raise ValueError(
                f"parameter '{name}', bounds: got {entry.bounds} s, expected at most an episode, {longest:g} s"
            )


def check_reach(env: Any, model: mjx.Model, give: WithModel) -> None:
    """Checks that a function gives another model to the environment that simulates; of the default one, that it does.

    Raises:
      ValueError: it is no function, or it is the default, which does not reach the model of this environment.
    """
    if not callable(give):
        raise ValueError(f"with_model: got {give!r}, expected a function (env, model) -> env")
    if give is not with_model:
        if not hasattr(made := give(env, model), "step"):
            raise ValueError(f"with_model: got a function that returns {type(made).__name__}, expected an environment")
        return
    inner = getattr(env, "unwrapped", env)
    if inner is not env:
        raise ValueError(
            f"env: got {type(env).__name__} around {type(inner).__name__}, expected an environment without "
            "wrappers, or with_model= that gives another model to what it wraps"
        )
    other = model.replace(body_mass=2.0 * model.body_mass)
    try:
        reached = model_of(with_model(env, other)) is other
    except (AttributeError, TypeError, ValueError):
        reached = False
    if not reached:
        raise ValueError(
            f"with_model: got none, and the default does not reach the model of {type(env).__name__}; expected a "
            "function (env, model) -> env"
        )


def check_start(start: Any, observed: jax.ShapeDtypeStruct) -> None:
    """Checks by shape that an environment starts with one robot, whose observation is a vector.

    Raises:
      ValueError: it is that of several.
    """
    others = [np.shape(getattr(start, name)) for name in ("reward", "done")]
    if any(others) or len(np.shape(observed)) != 1:
        raise ValueError(
            f"env: got a reset with an observation of shape {np.shape(observed)}, reward and done of shape "
            f"{' and '.join(map(str, others))}, expected those of one robot: [obs], () and ()"
        )


def check_influence(move: Callable, table: Mapping[str, Entry], params: Params, start: Any, action: Any) -> None:
    """Checks that every parameter reaches the step of the environment, which may simulate another model.

    Args:
      move: `(params, state, action) -> state`.
      table: the parameters.
      params: values of all of them.
      start: a state, or its shapes. Where it holds a model, nothing can be said: the step may simulate that one.
      action: an action, or its shape.

    Raises:
      ValueError: one does not.
    """
    if any(_is_model(one) for one in jax.tree.leaves(start, is_leaf=_is_model)):
        return
    reach = _reaching(move, params, start, action)
    for name, entry in table.items():
        if name not in reach and entry.kind != "control":
            raise ValueError(
                f"parameter '{name}': got an environment whose step does not depend on it; expected with_model= that "
                "gives another model to what simulates, or other fields"
            )


def _is_model(value: Any) -> bool:
    return isinstance(value, mjx.Model)


def _reaching(function: Callable, inputs: Params, *others: Any) -> set[str]:
    """Names of the inputs that any output of a function may depend on, by its equations; nothing is computed.

    An equation that calls a program counts as one: all that goes in reaches all that comes out.
    """
    jaxpr = jax.make_jaxpr(function)(inputs, *others).jaxpr
    reach = {var: {name} for var, name in zip(jaxpr.invars, sorted(inputs), strict=False)}

    def of(variables) -> set[str]:
        return set().union(*(reach.get(var, ()) for var in variables if not isinstance(var, Literal)))

    for equation in jaxpr.eqns:
        if names := of(equation.invars):
            reach |= dict.fromkeys(equation.outvars, names)
    return of(jaxpr.outvars)
