"""The learned one-step model: it finds the coordinates of a robot that is known, and minds none that shows nowhere."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.walking.one_step import OneStepConfig, estimate, train
from jaxtune import dist as dists
from jaxtune.types import Trajectory

STEPS = 40
CONFIG = OneStepConfig(hidden=(64, 64), train_steps=1500, batch=128)
NOMINAL = {"idle": 1.0, "mass": 1.0, "rubs": 0.5}
DIST = dists.make(NOMINAL, 0.3, dict.fromkeys(NOMINAL, 0.1), dict.fromkeys(NOMINAL, 3.0))


def played(key, mass, rubs):
    """A mass on a rail that a random force pushes; it observes place and speed."""
    force = jax.random.normal(key, (len(mass), STEPS, 1))

    def step(state, push):
        place, speed = state
        after = speed + 0.1 * (push - rubs * speed) / mass
        return (place + 0.1 * after, after), jnp.stack([place, speed], axis=-1)

    start = (jnp.zeros_like(mass), jnp.zeros_like(mass))
    _, obs = jax.lax.scan(step, start, force[..., 0].T)
    alive = jnp.ones(force.shape[:2], bool)
    return Trajectory(
        obs=jnp.swapaxes(obs, 0, 1),
        action=force,
        alive=alive,
        score=0.0 * alive,
        fell=jnp.zeros(len(mass), bool),
        not_finite=jnp.zeros(len(mass), bool),
    )


@pytest.fixture(scope="module")
def model():
    key = jax.random.key(0)
    coords = dists.sample(key, DIST, 300)
    return train(key, CONFIG, played(key, coords["mass"], coords["rubs"]), coords, DIST)


@pytest.mark.parametrize(("mass", "rubs"), [(0.8, 0.6), (1.2, 0.4)])
def test_it_finds_the_coordinates_of_a_robot(model, mass, rubs):
    measured = played(jax.random.key(1), jnp.full(5, mass), jnp.full(5, rubs))
    _, found, rubbing = np.asarray(estimate(CONFIG, model, measured))
    assert found == pytest.approx((mass - 1.0) / 0.3, abs=0.1)
    assert rubbing == pytest.approx((rubs - 0.5) / 0.3, abs=0.2)
    # What follows an end does not count, whatever it is.
    ended = dataclasses.replace(
        measured,
        alive=measured.alive.at[2:, 20:].set(False),
        obs=measured.obs.at[2:, 20:].set(jnp.nan),
    )
    np.testing.assert_allclose(estimate(CONFIG, model, ended)[1:], [found, rubbing], atol=0.2)


def test_of_no_steps_it_says_the_middle(model):
    nothing = played(jax.random.key(1), jnp.full(5, 0.8), jnp.full(5, 0.6))
    nothing = dataclasses.replace(nothing, alive=jnp.zeros_like(nothing.alive))
    np.testing.assert_array_equal(estimate(CONFIG, model, nothing), jnp.zeros(3))
