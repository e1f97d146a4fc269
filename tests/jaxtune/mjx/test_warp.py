"""Environments that MuJoCo Warp simulates, here on a CPU: the same robots as MJX's own implementation has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sled import TABLE, Sled, Warped

from jaxtune import dist as dists
from jaxtune.mjx import Simulator, TrainingBatch
from jaxtune.mjx.parameters import nominal

pytest.importorskip("warp")
STEPS = 30


def act(policy, obs, key):
    return policy * jnp.ones(1)


@pytest.fixture(scope="module")
def sleds():
    return {env.impl: Simulator(env(), steps=STEPS, parameters=TABLE) for env in (Sled, Warped)}


@pytest.mark.slow
def test_every_robot_has_its_own_parameters(sleds):
    coords = dists.sample(jax.random.PRNGKey(1), sleds["jax"].dist(0.3), 5)
    expected, found = (
        sleds[impl].simulate(act)(jax.random.PRNGKey(0), jnp.asarray(1.5), coords) for impl in ("jax", "warp")
    )
    assert np.ptp(found.obs[:, -1, 0]) > 0.05
    np.testing.assert_allclose(found.obs, expected.obs, atol=1e-4)
    np.testing.assert_array_equal(found.alive, expected.alive)


def test_derived_fields_follow(sleds):
    params = nominal(TABLE) | {"mass": 1.7}
    expected, found = (sleds[impl]._env(params).mjx_model for impl in ("jax", "warp"))
    assert found.impl.value == "warp"
    assert float(found.body_mass[1]) == pytest.approx(3.4)
    for name in ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6)


@pytest.mark.slow
def test_robots_of_a_training_start_anew_one_by_one(sleds):
    starts = {}
    for impl, sled in sleds.items():
        batch = TrainingBatch(sled, TABLE, limit=STEPS)
        state = batch.reset(jax.random.split(jax.random.PRNGKey(0), 3))
        data = state.pipeline_state.env.data
        # The second is about to leave the rail.
        data = data.replace(qpos=jnp.array([[0.0], [1.499], [0.5]]), qvel=jnp.array([[0.2], [3.0], [-0.1]]))
        robots = state.pipeline_state
        state = state.replace(pipeline_state=robots.replace(env=_with(robots.env, data)))
        starts[impl] = jax.jit(batch.step)(state, jnp.full((3, 1), 0.5))
    expected, found = starts["jax"], starts["warp"]
    np.testing.assert_array_equal(found.done, [0.0, 1.0, 0.0])
    np.testing.assert_allclose(found.obs, expected.obs, atol=1e-5)
    assert abs(float(found.obs[1, 0])) < 0.1
    np.testing.assert_allclose(found.reward, expected.reward, atol=1e-5)
    for name in ("qpos", "qvel"):
        ours, theirs = (getattr(state.pipeline_state.env.data, name) for state in (found, expected))
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def _with(env, data):
    return type(env)(data=data, obs=env.obs, reward=env.reward, done=env.done)


def test_a_randomization_draws_what_warp_reads(sleds):
    sled = sleds["warp"]
    randomize = sled.randomization_fn(sled.dist(0.3), leave_out=("delay",))
    model, axes = randomize(sled.model, jax.random.split(jax.random.PRNGKey(0), 4))
    assert model.body_mass.shape == (4, 2) and axes.body_mass == 0
    assert np.ptp(model.dof_invweight0) > 0.01
    assert axes.dof_M0 is None and model.dof_M0.shape == (1,)


def test_what_warp_has_once_for_all_robots_is_refused(monkeypatch):
    from mujoco.mjx.warp import types

    monkeypatch.setitem(types._BATCH_DIM["Model"], "dof_damping", False)
    with pytest.raises(ValueError, match="parameter 'damping', fields: got 'dof_damping', which MJX's Warp"):
        Simulator(Warped(), steps=STEPS, parameters=TABLE)


def test_the_model_that_it_was_made_of_must_be_there():
    env = Warped()
    del env.mj_model
    with pytest.raises(ValueError, match="env: got Warped with a model of impl='warp' but no mj_model"):
        Simulator(env, steps=STEPS, parameters=TABLE)
