"""Policies: saved, loaded, and the same next step; what belongs to another config is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import domain
from experiments import checkpoint
from experiments.config import PRESETS, WALK, chosen
from experiments.loop import Loop
from experiments.train import policy_config


@pytest.fixture(scope="module")
def loop():
    return Loop(PRESETS["smoke"], chosen("foot_friction"), chosen("torque_scale"))


@pytest.fixture(scope="module")
def train(loop):
    dist = loop.dist(domain.nominal(loop.entries), 0.3)
    return jax.jit(lambda key, policy: loop.train(key, policy, dist, 1))


def test_saved_policy_takes_the_same_next_step(loop, train, tmp_path):
    policy = loop.init(jax.random.PRNGKey(0))
    checkpoint.save(tmp_path, policy.learner, policy_config(loop))
    other = loop.init(jax.random.PRNGKey(7))
    loaded = other.replace(learner=checkpoint.load(tmp_path, other.learner, policy_config(loop)), robots=policy.robots)
    expected, _ = train(jax.random.PRNGKey(1), policy)
    found, metrics = train(jax.random.PRNGKey(1), loaded)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert np.isfinite(metrics["loss"]).all()
    # What was loaded, and what a step returns, is as good an input as what was made: nothing is compiled twice.
    train(jax.random.PRNGKey(2), found)
    assert train._cache_size() == 1


def test_robots_train_within_the_policy_radius_and_with_hidden_parameters(loop, train):
    policy = loop.init(jax.random.PRNGKey(0))
    other = policy.replace(radius=jnp.float32(0.2), hidden={"torque_scale": jnp.float32(0.75)})
    drawn, wider = (train(jax.random.PRNGKey(1), one)[0].robots.info["params"] for one in (policy, other))
    np.testing.assert_array_equal(drawn["torque_scale"], 1.0)
    np.testing.assert_array_equal(wider["torque_scale"], 0.75)
    # The distribution's radius is 0.3.
    for params, radius in ((drawn, loop.preset.policy_radius), (wider, 0.2)):
        spread = np.abs(np.log(params["foot_friction"]))
        assert 0.5 * radius < spread.max() <= radius + 1e-6
    assert train._cache_size() == 1


def test_policy_of_another_config_is_refused(loop, tmp_path):
    learner = loop.init(jax.random.PRNGKey(0)).learner
    checkpoint.save(tmp_path, learner, policy_config(loop))
    task = dataclasses.replace(loop.preset.task, action_scale=0.5)
    other = Loop(dataclasses.replace(loop.preset, task=task), loop.entries)
    with pytest.raises(ValueError, match=r"config\.action_scale is 0\.25 there, expected 0\.5"):
        checkpoint.load(tmp_path, learner, policy_config(other))


def test_missing_policy_is_named(loop, tmp_path):
    with pytest.raises(ValueError, match=r"policy: .*no config\.json"):
        checkpoint.load(tmp_path, None, policy_config(loop))


def test_shipped_policy_loads_and_has_learnt(loop):
    fresh = loop.init(jax.random.PRNGKey(0)).learner
    shipped = checkpoint.load(WALK, fresh, policy_config(loop))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(shipped.params))
    # A learner that has seen the task knows that joints do not all move alike.
    assert np.ptp(shipped.normalizer.std) > 0.1
