import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import dist as dists
from jaxtune import regression, surface
from jaxtune.regression import RegressionConfig

TWO = {"friction": 0.0, "mass": 0.0}
CONFIG = RegressionConfig()


@pytest.fixture(scope="module")
def fitted():
    episodes, coords, dist = toys.simulated(TWO, 256)
    model = jax.jit(lambda *args: regression.train(CONFIG, *args))(episodes, coords, dist)
    return model, jax.jit(surface.train)(model), dist


def misfits(fitted, truths, at=None):
    """Misfits of sets of three episodes, at their true coordinates or at others."""
    model, ways, dist = fitted
    found = []
    for seed, truth in enumerate(truths):
        episodes = toys.Slider().measure(truth, 3)(jax.random.key(seed), toys.policy())
        _, moments, _ = regression.answers(CONFIG, model, episodes)
        coords = dists.normalise(dist, {name: jnp.float32((at or truth)[name]) for name in TWO})
        found.append(float(surface.misfit(ways, moments, coords)))
    return np.array(found)


def test_what_the_surface_predicts_is_no_misfit_and_what_it_does_not_is(fitted):
    truths = [{"friction": friction, "mass": mass} for friction in (-0.3, 0.0, 0.3) for mass in (-0.3, 0.1, 0.3)]
    own = misfits(fitted, truths)
    # Elsewhere in the box, or with a push that no coordinates explain.
    elsewhere = misfits(fitted, truths, at={"friction": 0.35, "mass": -0.35})
    pushed = misfits(fitted, [truth | {"wind": 0.5} for truth in truths])
    assert pushed.min() > own.max()
    assert np.median(elsewhere) > own.max()


def test_the_misfit_is_the_residual_in_units_of_the_scatter_of_episodes(fitted):
    model, ways, dist = fitted
    episodes = toys.Slider().measure({"friction": 0.1, "mass": 0.2}, 3)(jax.random.key(0), toys.policy())
    _, moments, _ = regression.answers(CONFIG, model, episodes)
    coords = dists.normalise(dist, {"friction": jnp.float32(0.1), "mass": jnp.float32(0.2)})
    # Straight from the definition, in double precision, without the inversion lemma.
    c = np.asarray(coords, float)
    terms = np.array([1.0, *c, c[0] * c[0], c[0] * c[1], c[1] * c[1]])
    rest = np.asarray(moments, float) - terms @ np.asarray(ways.coefficients, float)
    residual = np.asarray(ways.residual, float)
    scatter = residual.T @ residual / len(residual) + float(ways.penalty) * np.eye(residual.shape[1])
    expected = rest @ np.linalg.solve(scatter, rest)
    np.testing.assert_allclose(float(surface.misfit(ways, moments, coords)), expected, rtol=1e-2)


def test_residuals_are_of_predictions_that_leave_the_episode_out(fitted):
    model, ways, _ = fitted
    truth, read = (np.asarray(values, float) for values in (model.truth, model.read))
    left = 7
    kept = np.arange(len(truth)) != left
    terms = np.column_stack([np.ones(len(truth)), truth, truth[:, 0] ** 2, truth.prod(axis=1), truth[:, 1] ** 2])
    coefficients = np.linalg.lstsq(terms[kept], read[kept], rcond=None)[0]
    np.testing.assert_allclose(ways.residual[left], read[left] - terms[left] @ coefficients, atol=2e-4)


@pytest.mark.parametrize(("episodes", "terms"), [(24, 6), (23, 3), (12, 3), (11, 1)])
def test_few_episodes_determine_a_polynomial_of_lower_degree(episodes, terms):
    assert surface._terms(jnp.zeros((3, 2)), episodes).shape == (3, terms)


def test_episodes_without_a_window_change_nothing(fitted):
    episodes, coords, dist = toys.simulated(TWO, 256)
    short = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[:32]]), episodes)
    short = short.replace(alive=short.alive.at[256:, 20:].set(False), obs=short.obs.at[256:, 20:].set(1e3))
    more = {name: jnp.concatenate([values, values[:32]]) for name, values in coords.items()}
    model = jax.jit(lambda *args: regression.train(CONFIG, *args))(short, more, dist)
    with_them = surface.train(model)
    np.testing.assert_allclose(with_them.coefficients, fitted[1].coefficients, atol=2e-3)
    np.testing.assert_array_equal(with_them.residual[256:], 0.0)
    np.testing.assert_allclose(with_them.penalty, fitted[1].penalty, rtol=1e-2)
