"""BITenos at the ends of all their bounds, and batches that are spoilt: nothing of it gets into a network."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.common.config import PRESETS
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from experiments.walking.robots import BITENO
from jaxtune import tuner
from jaxtune.mjx import parameters

DRAWS = 1000


@pytest.fixture(scope="module")
def learner():
    sizes = PRESETS["smoke"]
    sizes = replace(sizes, policy_radius=10.0, tuner=replace(sizes.tuner, episodes=100))
    return Learner(sizes, BITENO.chosen("whole_body"))


def corners(learner, key, count):
    """Coordinates of robots whose parameters are all at one end of their bounds or the other."""
    dist = learner.dist(parameters.nominal(learner.entries), 10.0)
    sides = jax.random.bernoulli(key, shape=(len(dist.centre), count))
    return {
        name: jnp.where(side, dist.upper[name], dist.lower[name])
        for name, side in zip(sorted(dist.centre), sides, strict=True)
    }


def finite(values):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.device_get(values)))


@pytest.mark.slow
def test_robots_at_their_bounds_walk_fall_or_are_counted(learner):
    policy = starting_policy("walk", learner)
    coords = corners(learner, jax.random.PRNGKey(0), DRAWS)
    episodes = jax.jit(lambda policy: learner.simulate(jax.random.PRNGKey(1), policy, coords))(policy)
    assert np.isfinite(np.where(episodes.alive[..., None], episodes.obs, 0.0)).all()
    lived = episodes.alive.any(axis=1)
    assert np.all(lived | episodes.not_finite | episodes.fell)
    assert episodes.not_finite.mean() < 0.01


@pytest.mark.slow
def test_training_and_tuning_with_spoilt_batches_end_with_finite_networks_and_a_report(learner):
    policy = starting_policy("walk", learner)
    dist = learner.dist(parameters.nominal(learner.entries), 10.0)
    train = jax.jit(lambda key, policy: learner.train(key, policy, dist, 2))
    for number in range(10):
        # A robot of the batch is where no robot can be.
        broken = policy.robots.pipeline_state
        broken = broken.replace(qvel=broken.qvel.at[number].set(jnp.nan if number % 2 else 1e30))
        policy = policy.replace(robots=policy.robots.replace(pipeline_state=broken))
        policy, metrics = train(jax.random.PRNGKey(number), policy)
        assert finite(policy.learner) and finite(metrics["reward"])
    machine = learner.tuner()
    collected = machine.collect(jax.random.PRNGKey(2), policy, dist)
    measured = jax.tree.map(lambda leaf: leaf[0], collected.held_out)
    obs = measured.obs.at[0, 30].set(jnp.nan)
    alive = measured.alive.at[0, 30:].set(False)
    measured = measured.replace(obs=obs, alive=alive, not_finite=measured.not_finite.at[0].set(True))
    state = machine.init(policy, dist, tuner.knobs())
    state, info = jax.jit(machine.tune)(jax.random.PRNGKey(3), state, measured)
    assert finite(state.dist) and finite(state.policy.learner)
    assert info.not_finite >= 1
    assert len(tuner.explain(info)) > 0
