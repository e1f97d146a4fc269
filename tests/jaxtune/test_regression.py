import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import dist as dists
from jaxtune import regression
from jaxtune.regression import RegressionConfig

CONFIG = RegressionConfig(stride=5)
# Sorted by name: colour enters no equation of the slider.
CENTRE = {"colour": 0.0, "friction": 0.1, "mass": -0.1}
COLOUR, FRICTION, MASS = range(3)

measured = functools.partial(toys.measured, CENTRE)

fit = jax.jit(regression.train, static_argnums=0)


@pytest.fixture(scope="module")
def simulated():
    return toys.simulated(CENTRE, 256)


@pytest.fixture(scope="module")
def model(simulated):
    return fit(CONFIG, *simulated)


@pytest.fixture(scope="module")
def estimate(model):
    return jax.jit(lambda measured: regression.estimate(CONFIG, model, measured))


def test_robots_that_it_has_not_seen_are_found(estimate):
    errors = []
    for seed in range(10):
        friction, mass = np.random.default_rng(seed).uniform(-0.9, 0.9, 2)
        errors.append(np.abs(estimate(measured(friction=friction, mass=mass)) - jnp.array([0.0, friction, mass])))
    worst = np.max(errors, axis=0)
    assert worst[FRICTION] < 0.35
    assert worst[MASS] < 0.15


def test_what_no_episode_shows_is_answered_with_the_middle(estimate, model):
    assert abs(estimate(measured(friction=0.5, mass=0.5))[COLOUR]) < 0.3
    # As wrong as a uniform draw is.
    np.testing.assert_allclose(model.error[COLOUR], 1 / np.sqrt(3), atol=0.08)


def test_the_error_of_what_is_left_out_is_that_of_fits_without_it(simulated, model):
    trajectory, coords, dist = simulated
    # Few episodes, so that one more or less matters.
    few = jax.tree.map(lambda leaf: leaf[:40], (trajectory, coords))
    whole, square = fit(CONFIG, *few, dist), []
    truth = np.asarray(dists.normalise(dist, few[1]))
    for index in range(0, 40, 4):
        rest = jax.tree.map(lambda leaf, index=index: np.delete(leaf, index, axis=0), few)
        one = jax.tree.map(lambda leaf, index=index: leaf[index : index + 1], few[0])
        found = regression.estimate(CONFIG, fit(CONFIG, *rest, dist), one)
        square.append((found - truth[index]) ** 2)
    np.testing.assert_allclose(np.sqrt(np.mean(square, axis=0)), whole.error, rtol=0.6)


def test_an_estimate_stays_in_the_box(estimate):
    far = estimate(measured(mass=3.0))
    assert np.all(np.abs(far) <= 1.0 + 1e-6)
    assert far[MASS] > 0.8


def test_a_box_that_a_bound_cuts_is_answered_in_its_own_middle(simulated):
    trajectory, coords, dist = simulated
    cut = dist.replace(upper={name: CENTRE[name] + 0.1 for name in CENTRE})
    dead = trajectory.replace(alive=jnp.zeros_like(trajectory.alive))
    model = fit(CONFIG, trajectory, coords, cut)
    none = jax.tree.map(lambda leaf: leaf[:2], dead)
    np.testing.assert_allclose(regression.estimate(CONFIG, model, none), (0.25 - 1.0) / 2, atol=1e-6)


def test_what_comes_after_an_end_counts_for_nothing(simulated, model, estimate):
    trajectory, coords, dist = simulated
    ends = jnp.arange(trajectory.alive.shape[1]) < 80
    alive = trajectory.alive & ends
    poisoned = trajectory.replace(
        alive=alive,
        obs=jnp.where(alive[..., None], trajectory.obs, jnp.nan),
        action=jnp.where(alive[..., None], trajectory.action, jnp.nan),
    )
    zeroed = jax.tree.map(lambda leaf: jnp.nan_to_num(leaf), poisoned)
    for leaf, other in zip(*(jax.tree.leaves(fit(CONFIG, t, coords, dist)) for t in (poisoned, zeroed)), strict=True):
        np.testing.assert_array_equal(leaf, other)
    one = jax.tree.map(lambda leaf: leaf[:3], poisoned)
    assert np.isfinite(estimate(one)).all()


def test_an_episode_that_ended_at_once_teaches_nothing(simulated):
    trajectory, coords, dist = simulated
    some = jax.tree.map(lambda leaf: leaf[:60], (trajectory, coords))
    dead = jnp.arange(60) >= 50
    with_dead = some[0].replace(alive=some[0].alive & ~dead[:, None])
    kept = jax.tree.map(lambda leaf: leaf[:50], some)
    ours, theirs = fit(CONFIG, with_dead, some[1], dist), fit(CONFIG, *kept, dist)
    assert not np.asarray(ours.weights)[50:].any()
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-3, atol=1e-3)
    one = measured(friction=0.4, mass=-0.4)
    found = [regression.estimate(CONFIG, model, one) for model in (ours, theirs)]
    np.testing.assert_allclose(found[0][1:], found[1][1:], atol=0.05)


def test_longer_episodes_count_for_more(estimate):
    heavy, light = measured(1, mass=0.6), measured(1, mass=-0.6)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), heavy, light)
    length = both.alive.shape[1]
    cut = both.replace(alive=both.alive & (jnp.arange(length) < jnp.array([[length], [CONFIG.window + CONFIG.stride]])))
    assert estimate(cut)[MASS] > estimate(both)[MASS] + 0.2
