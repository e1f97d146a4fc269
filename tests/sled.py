"""A pushed mass: a robot of another hand for the tests, as a user writes one for `--robot tests/sled.py:simulator`."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from jaxtune.mjx import Simulator, action_delay, field, mass, strength

SLED = """
<mujoco>
  <option timestep="0.005"><flag contact="disable"/></option>
  <worldbody>
    <body name="sled"><joint name="rail" type="slide" axis="1 0 0" damping="0.5"/><geom size="0.1" mass="2"/></body>
  </worldbody>
  <actuator><motor name="push" joint="rail"/></actuator>
</mujoco>
"""
SUBSTEPS = 4


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    data: mjx.Data
    obs: jax.Array
    reward: jax.Array
    done: jax.Array


class Sled:
    """An environment as a user writes one, with a model where `with_model` looks for it.

    It observes position, velocity and the force that it was given, is rewarded for speed, and ends beyond 1.5 m.
    """

    dt = 0.02
    impl = "jax"

    def __init__(self):
        self.mj_model = mujoco.MjModel.from_xml_string(SLED)
        self._mjx_model = mjx.put_model(self.mj_model, impl=self.impl)

    @property
    def mjx_model(self):
        return self._mjx_model

    def reset(self, key):
        data = mjx.make_data(self.mj_model, impl=self.impl)
        data = data.replace(qvel=0.1 * jax.random.normal(key, (1,)))
        return self._state(data, jnp.zeros(1))

    def step(self, state, action):
        data = state.data.replace(ctrl=action)
        data = jax.lax.fori_loop(0, SUBSTEPS, lambda _, data: mjx.step(self._mjx_model, data), data)
        return self._state(data, action)

    def _state(self, data, action):
        obs = jnp.concatenate([data.qpos, data.qvel, action])
        return State(data=data, obs=obs, reward=data.qvel[0], done=(jnp.abs(data.qpos[0]) > 1.5).astype(float))


class Warped(Sled):
    """The same, simulated by MuJoCo Warp."""

    impl = "warp"


class Keyed(Sled):
    """The same with a dictionary of observations."""

    def _state(self, data, action):
        plain = super()._state(data, action)
        return State(data=data, obs={"state": plain.obs[:2], "told": action}, reward=plain.reward, done=plain.done)


TABLE = {
    "mass": mass("sled", bounds=(0.5, 2.0)),
    "damping": field("dof_damping", joints="rail", bounds=(0.2, 5.0)),
    "strength": strength("push", bounds=(0.5, 2.0)),
    "delay": action_delay(bounds_s=(0.0, 0.05)),
}


def simulator():
    """The robot, with its table."""
    return Simulator(Sled(), steps=60, parameters=TABLE)


def environment():
    """The environment alone, for which a table is proposed."""
    return Sled()


def keyed():
    """Dictionary observations, of which both parts are compared."""
    return Simulator(Keyed(), steps=60, parameters=TABLE, observe=("state", "told"))


def with_a_state():
    """Dictionary observations, of which `state` is what a policy is given, as in Playground."""
    return Keyed()


class Unnamed(Sled):
    """Dictionary observations, of which nobody knows which are compared."""

    def _state(self, data, action):
        plain = super()._state(data, action)
        return State(data=data, obs={"seen": plain.obs[:2], "told": action}, reward=plain.reward, done=plain.done)


def without_keys():
    """The same without a word on what is compared."""
    return Unnamed()


def of_steps(steps):
    """A function that needs to be told something."""
    return Simulator(Sled(), steps=steps, parameters=TABLE)


def short():
    """Episodes shorter than a window of the tuner."""
    return of_steps(30)


class Timeless(Sled):
    """An environment that does not say how long its steps take."""

    dt = property()


def timeless():
    """The same without its control period."""
    return Timeless()


def nothing():
    """What a function returns that forgot to."""
