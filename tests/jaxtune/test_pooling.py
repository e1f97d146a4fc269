"""Sets of one robot, read one after another: what they say together, and when they do not agree."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import dist as dists
from jaxtune import pooling

RADIUS, SETS = 0.4, 99
# The readings of the two trade against each other.
NOISE = 0.05 * np.array([[1.0, 0.6], [0.6, 1.0]])
ALL = jnp.ones(SETS, bool)
DIST = toys.uniform({"a": 0.1, "b": -0.2}, RADIUS)
# One bound cuts the box, so that its middle is not its centre.
CUT = toys.uniform({"a": 1.1, "b": -0.2}, RADIUS)
join = jax.jit(pooling.joined)


def read(key, truth, noise=NOISE, episodes=1):
    """Estimates of what lies in the box, in radii: drawn to its middle as much as single episodes ask for."""
    readings = truth + jax.random.multivariate_normal(key, jnp.zeros(2), jnp.asarray(noise), truth.shape[:1])
    return readings @ jnp.linalg.inv(jnp.eye(2) / 3.0 + episodes * noise) / 3.0


def past_of(dist, estimate, errors):
    """What earlier sets said, in radii."""
    return pooling.learnt(pooling.nothing(dist), False, dist, estimate, jnp.asarray(errors), 10**6)


def robots(key, noise=NOISE, dist=DIST, sets=SETS):
    """Simulated sets and one more, the measured one: true coordinates and estimates in radii."""
    key_truth, key_read = jax.random.split(key)
    low, high = dists.normalised_box(dist)
    truth = jax.random.uniform(key_truth, (sets + 1, 2), minval=low, maxval=high)
    return truth, read(key_read, truth, noise)


def rms(errors):
    return np.sqrt((np.asarray(errors) ** 2).mean())


@functools.cache
def many(more, episodes):
    """Errors of measured robots whose box earlier sets have put around what they said, as a tuner does.

    Returns:
      In radii: of what earlier sets said, of both; of simulated robots; and whether they were joined.
    """
    noise = jnp.asarray(more * NOISE)

    def one(key):
        key_sets, key_before, key_read, key_join = jax.random.split(key, 4)
        off = jax.random.multivariate_normal(key_before, jnp.zeros(2), noise)
        dist = dists.move(DIST, off)  # the robot's truth is the centre of DIST
        truth = jax.random.uniform(key_sets, (SETS, 2), minval=-1.0, maxval=1.0)
        every = jnp.concatenate([truth, -off[None]])
        estimates = read(key_read, every, episodes=episodes)
        past = past_of(dist, jnp.zeros(2), noise)
        found, pooled, _ = pooling.joined(key_join, past, dist, estimates, truth, ALL)
        return off, found[-1] + off, found[:-1] - truth, pooled

    return jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 400))


@pytest.mark.parametrize("episodes", [1, 5])
@pytest.mark.parametrize("more", [0.3, 1.0, 3.0])
def test_joined_estimates_are_as_exact_as_two_gaussians_allow(more, episodes):
    earlier, together, simulated, pooled = many(more, episodes)
    together = together[pooled]
    best = np.linalg.inv(np.linalg.inv(NOISE) + np.linalg.inv(more * NOISE))
    # Earlier sets count nine tenths, factors are of 99 robots, and the box has edges.
    assert rms(together) == pytest.approx(np.sqrt(np.trace(best) / 2), rel=0.1)
    assert rms(together) < 0.95 * min(rms(earlier), np.sqrt(np.trace(NOISE) / 2))
    # Errors that simulated robots foretell are those of the measured one.
    assert rms(simulated) == pytest.approx(rms(together), rel=0.12)
    assert 0.97 < pooled.mean() <= 1.0


def test_what_one_set_knows_of_a_sum_helps_its_parts():
    """The earlier sets know `a` alone, this one the sum of both: together they know `b`."""
    total = 0.3 * jnp.array([[1.0, -1.0], [-1.0, 1.0]]) + 1e-4 * jnp.eye(2)
    truth, estimates = robots(jax.random.key(5), total)
    past = past_of(DIST, truth[-1].at[1].set(0.0), jnp.diag(jnp.array([1e-4, 1 / 3])))
    found, _, _ = join(jax.random.key(7), past, DIST, estimates, truth[:-1], ALL)
    assert jnp.abs(estimates[:-1] - truth[:-1])[:, 1].mean() > 0.15
    assert jnp.abs(found[:-1] - truth[:-1])[:, 1].mean() < 0.08
    np.testing.assert_allclose(found[-1], truth[-1], atol=0.12)


@pytest.mark.parametrize("sets", [99, 19])
def test_a_set_that_contradicts_earlier_ones_stands_alone(sets):
    truth, estimates = robots(jax.random.key(8), sets=sets)
    past = past_of(DIST, truth[-1] + 1.5, 0.01 * jnp.eye(2))
    found, pooled, p_value = join(jax.random.key(10), past, DIST, estimates, truth[:-1], ALL[:sets])
    assert not pooled
    assert p_value == pytest.approx(1.0 / (sets + 1))
    np.testing.assert_array_equal(found, estimates)


def test_nothing_is_known_before_the_first_set():
    truth, estimates = robots(jax.random.key(11))
    found, pooled, p_value = join(jax.random.key(12), pooling.nothing(DIST), DIST, estimates, truth[:-1], ALL)
    assert not pooled
    assert jnp.isnan(p_value)
    np.testing.assert_array_equal(found, estimates)


def test_sets_that_do_not_count_change_nothing():
    truth, estimates = robots(jax.random.key(13))
    past = past_of(DIST, truth[-1], NOISE)
    valid = ALL.at[:9].set(False)
    one, _, p_one = join(jax.random.key(15), past, DIST, estimates, truth[:-1], valid)
    other, _, p_other = join(jax.random.key(15), past, DIST, estimates.at[:9].set(jnp.nan), truth[:-1], valid)
    np.testing.assert_array_equal(one[9:], other[9:])
    assert p_one == p_other
    _, pooled, p_value = join(jax.random.key(15), past, DIST, estimates, truth[:-1], ~ALL)
    assert not pooled
    assert jnp.isnan(p_value)


@pytest.mark.parametrize("noise", [1e-12, 1e6])
def test_estimates_without_errors_and_without_knowledge_stay_finite(noise):
    truth, _ = robots(jax.random.key(16))
    past = past_of(DIST, truth[-1], noise * np.array([[1.0, 0.999], [0.999, 1.0]]))
    found, _, p_value = join(jax.random.key(18), past, DIST, truth, truth[:-1], ALL)
    assert jnp.isfinite(p_value)
    np.testing.assert_allclose(found, truth, atol=5e-3)


def test_a_coordinate_that_no_set_identified_is_answered_with_the_middle():
    vague = jnp.diag(jnp.array([0.05, 1e3]))
    truth, estimates = robots(jax.random.key(19), vague, dist=CUT)
    low, high = dists.normalised_box(CUT)
    middle = (low + high) / 2
    assert abs(middle[0]) > 0.2
    estimates = middle + read(jax.random.key(20), truth - middle, vague)
    past = past_of(CUT, middle.at[0].set(truth[-1, 0]), jnp.diag(jnp.array([1e-4, 1 / 3])))
    found, pooled, _ = join(jax.random.key(21), past, CUT, estimates, truth[:-1], ALL)
    assert pooled
    np.testing.assert_allclose(found[:, 0], truth[:, 0], atol=0.05)
    assert rms(found[:, 1] - middle[1]) < 0.1


def test_errors_are_joined_as_estimates_are():
    past = past_of(DIST, jnp.zeros(2), 0.9 * jnp.diag(jnp.array([0.04, 1 / 3])))
    error = jnp.array([0.2, 0.3])
    # Of two that are as exact, less what both know of the box; and nothing of one that knows no more than the box.
    found = pooling.joined_error(past, True, DIST, error)
    np.testing.assert_allclose(found, [(25.0 + 25.0 - 3.0) ** -0.5, 0.3], rtol=1e-5)
    np.testing.assert_array_equal(pooling.joined_error(past, False, DIST, error), error)


@pytest.mark.parametrize("vague, off", [(1.0, 0.0), (400.0, 0.5)])
def test_earlier_sets_that_know_less_than_the_box_cost_nothing(vague, off):
    """Re-readings narrow the box, while what earlier sets said stays."""
    truth, estimates = robots(jax.random.key(22), 0.5 * jnp.eye(2))
    past = past_of(DIST, off * jnp.ones(2), vague / 3.0 * jnp.eye(2))
    found, pooled, _ = join(jax.random.key(23), past, DIST, estimates, truth[:-1], ALL)
    assert pooled
    assert rms(found[:-1] - truth[:-1]) < 1.05 * rms(estimates[:-1] - truth[:-1])


def test_no_combination_is_known_exactly_by_chance():
    """With as many sets as coordinates, mean products of errors are of lower rank than that."""
    off = jax.random.normal(jax.random.key(24), (9, 9))
    dist = toys.uniform({str(number): 0.0 for number in range(9)})
    past = pooling.learnt(pooling.nothing(dist), False, dist, jnp.zeros(9), off.T @ off / 9, 9)
    assert jnp.linalg.eigvalsh(past.errors / 0.16).min() > 0.2


def test_a_box_is_as_wide_as_errors_along_every_direction():
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(4, 4))
    errors = mixed @ mixed.T * np.outer([1.0, 0.1, 3.0, 0.5], [1.0, 0.1, 3.0, 0.5])
    half = np.asarray(pooling.half_widths(jnp.asarray(errors), 10**6))
    assert np.linalg.eigvalsh(np.diag(half**2) / 3.0 - errors).min() > -1e-5
    # Of independent errors, no more than that.
    alone = np.diag([4.0, 0.01, 0.0])
    np.testing.assert_allclose(pooling.half_widths(jnp.asarray(alone), 10**6), np.sqrt(3.0 * np.diag(alone)), rtol=2e-3)


@pytest.mark.parametrize("coords", [2, 5])
def test_what_nothing_tells_stays_in_the_box_however_often_it_is_read(coords):
    rng = np.random.default_rng(0)
    # Readings tell all differences exactly, and the mean not at all: the middle of the box is the best answer.
    share, held = np.full((coords, coords), 1.0 / coords), []
    for _ in range(200):
        truth, centre, half = rng.uniform(-1.0, 1.0, coords), np.zeros(coords), np.ones(coords)
        for _ in range(4):
            sets = rng.uniform(-half, half, (99, coords))
            off = -sets @ share
            errors = off.T @ off / len(off)
            step = truth - centre - share @ (truth - centre)
            wide = np.quantile(np.abs(off).max(axis=1), 0.99)
            half = np.minimum(half, np.maximum(wide, pooling.half_widths(jnp.asarray(errors), len(sets))))
            centre = centre + step
        held.append((np.abs(truth - centre) <= half).all())
    assert np.mean(held) > 0.97
