"""Sets of one robot, read one after another: what they say together, and when they do not agree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import dist as dists
from jaxtune import pooling

CENTRE, RADIUS = {"a": 0.1, "b": -0.2}, 0.4
# The readings of the two trade against each other.
NOISE = 0.05 * np.array([[1.0, 0.6], [0.6, 1.0]])
SETS = 99
ALL = jnp.ones(SETS, bool)
DIST = toys.uniform(CENTRE, RADIUS)
join = jax.jit(pooling.joined)


def read(key, truth, noise=NOISE):
    """Estimates of what lies in the box, in radii: readings with noise, drawn to its middle as a regression does."""
    spread = jnp.eye(2) / 3.0
    readings = truth + jax.random.multivariate_normal(key, jnp.zeros(2), noise, truth.shape[:1])
    return readings @ jnp.linalg.inv(spread + noise) @ spread


def robots(key, noise=NOISE):
    """Simulated sets and one more, the measured one: true coordinates and estimates in radii."""
    key_truth, key_read = jax.random.split(key)
    truth = jax.random.uniform(key_truth, (SETS + 1, 2), minval=-1.0, maxval=1.0)
    return truth, read(key_read, truth, noise)


def before(key, truth, noise):
    """What earlier sets say of a robot [coords, in radii], if they err so much."""
    said = jax.random.multivariate_normal(key, truth, noise)
    return pooling.Past(estimate=dists.ravel(DIST.centre) + RADIUS * said, errors=RADIUS**2 * noise)


def many(noise, count=300):
    """Errors of the measured robot in radii: of its set, of earlier ones, together; and of simulated robots."""

    def one(key):
        key_sets, key_before, key_join = jax.random.split(key, 3)
        truth, estimates = robots(key_sets)
        past = before(key_before, truth[-1], noise)
        found, pooled, _ = pooling.joined(key_join, past, DIST, estimates, truth[:-1], ALL)
        earlier = (past.estimate - dists.ravel(DIST.centre)) / RADIUS
        last = (estimates[-1] - truth[-1], earlier - truth[-1], found[-1] - truth[-1])
        return *last, found[:-1] - truth[:-1], pooled

    return jax.vmap(one)(jax.random.split(jax.random.key(0), count))


def rms(errors):
    return np.sqrt((np.asarray(errors) ** 2).mean())


@pytest.mark.parametrize("more", [0.3, 1.0, 3.0])
def test_joined_estimates_are_as_exact_as_two_gaussians_allow(more):
    own, earlier, together, simulated, pooled = many(jnp.asarray(more * NOISE))
    together = together[pooled]
    best = np.linalg.inv(np.linalg.inv(NOISE) + np.linalg.inv(more * NOISE))
    assert rms(together) == pytest.approx(np.sqrt(np.trace(best) / 2), rel=0.08)
    # This set alone knows of the box, too.
    assert rms(together) < 1.01 * min(rms(own), rms(earlier))
    # Errors that simulated robots foretell are those of the measured one.
    assert rms(simulated) == pytest.approx(rms(together), rel=0.08)
    assert 0.96 < pooled.mean() <= 1.0


def test_the_middle_of_the_box_counts_once():
    """An estimate is drawn to the middle, where earlier sets have put the box; they must not pull a second time."""
    noise = jnp.eye(2) / 3.0
    truth, estimates = robots(jax.random.key(3), noise)
    estimates = estimates.at[-1].set(0.4)
    # As vague as can be: what is left is what the set says alone, 0.8 for a reading as noisy as the box is wide.
    past = pooling.Past(estimate=dists.ravel(DIST.centre), errors=100.0 * jnp.eye(2))
    found, pooled, _ = join(jax.random.key(4), past, DIST, estimates, truth[:-1], ALL)
    assert pooled
    np.testing.assert_allclose(found[-1], 0.8, atol=0.15)


def test_what_one_set_knows_of_a_sum_helps_its_parts():
    """The earlier sets know `a` alone, this one the sum of both: together they know `b`."""
    total = 0.3 * jnp.array([[1.0, -1.0], [-1.0, 1.0]]) + 1e-4 * jnp.eye(2)
    truth, estimates = robots(jax.random.key(5), total)
    past = before(jax.random.key(6), truth[-1], jnp.diag(jnp.array([1e-4, 1.0])))
    found, _, _ = join(jax.random.key(7), past, DIST, estimates, truth[:-1], ALL)
    assert jnp.abs(estimates[:-1] - truth[:-1])[:, 1].mean() > 0.2
    np.testing.assert_allclose(found[-1], truth[-1], atol=0.06)


@pytest.mark.parametrize("sets", [99, 19])
def test_a_set_that_contradicts_earlier_ones_stands_alone(sets):
    truth, estimates = robots(jax.random.key(8))
    truth, estimates = truth[-sets - 1 :], estimates[-sets - 1 :]
    past = before(jax.random.key(9), truth[-1] + 1.5, 0.01 * jnp.eye(2))
    found, pooled, p_value = join(jax.random.key(10), past, DIST, estimates, truth[:-1], ALL[:sets])
    assert not pooled
    assert p_value == pytest.approx(1.0 / (sets + 1))
    np.testing.assert_array_equal(found, estimates)


def test_nothing_is_known_before_the_first_set():
    truth, estimates = robots(jax.random.key(11))
    past = pooling.nothing(DIST)
    found, pooled, p_value = join(jax.random.key(12), past, DIST, estimates, truth[:-1], ALL)
    assert not pooled
    assert jnp.isnan(p_value)
    np.testing.assert_array_equal(found, estimates)


def test_sets_that_do_not_count_change_nothing():
    truth, estimates = robots(jax.random.key(13))
    past = before(jax.random.key(14), truth[-1], jnp.asarray(NOISE))
    valid = ALL.at[:9].set(False)
    one, _, p_one = join(jax.random.key(15), past, DIST, estimates, truth[:-1], valid)
    other, _, p_other = join(jax.random.key(15), past, DIST, estimates.at[:9].set(7.0), truth[:-1], valid)
    np.testing.assert_array_equal(one[-1], other[-1])
    assert p_one == p_other


def test_estimates_without_errors_stay_finite():
    truth, _ = robots(jax.random.key(16))
    past = before(jax.random.key(17), truth[-1], 1e-12 * jnp.eye(2))
    found, _, p_value = join(jax.random.key(18), past, DIST, truth, truth[:-1], ALL)
    assert jnp.isfinite(p_value)
    np.testing.assert_allclose(found, truth, atol=5e-3)


def test_a_coordinate_that_no_set_identified_is_read_as_if_alone():
    vague = jnp.diag(jnp.array([0.05, 1e3]))
    truth, estimates = robots(jax.random.key(19), vague)
    errors = jnp.array([[1e-4, jnp.nan], [jnp.nan, jnp.nan]])
    past = before(jax.random.key(20), truth[-1], 1e-4 * jnp.eye(2)).replace(errors=RADIUS**2 * errors)
    found, pooled, _ = join(jax.random.key(21), past, DIST, estimates, truth[:-1], ALL)
    assert pooled
    np.testing.assert_allclose(found[:, 0], truth[:, 0], atol=0.05)
    np.testing.assert_allclose(found[:, 1], estimates[:, 1], atol=0.1)
