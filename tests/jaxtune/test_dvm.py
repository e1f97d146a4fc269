import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import dist as dists
from jaxtune import dvm, windows
from jaxtune.dvm import DVM

CONFIG = toys.DVM
CENTRE = {"friction": 0.0, "mass": 0.0}
LOG_2_PI = math.log(2 * math.pi)


@pytest.fixture(scope="module")
def trained():
    dist = toys.uniform(CENTRE, radius=0.2)
    simulated = toys.Slider().simulate(jax.random.key(1), toys.policy(), dists.sample(jax.random.key(0), dist, 512))
    return toys.train_dvm(jax.random.key(2), CONFIG, simulated)


@pytest.fixture(scope="module")
def model(trained):
    return trained[0]


@pytest.fixture(scope="module")
def score(model):
    """Mean novelty, validity and cover of every window of a measured set."""
    novelty = jax.jit(lambda measured: dvm.novelty(CONFIG, model, measured))
    return lambda measured: jax.tree.map(np.asarray, novelty(measured))


def measured(**truth):
    return toys.Slider().measure(CENTRE | truth, 3)(jax.random.key(3), toys.policy())


@pytest.mark.parametrize("time", [1, 7, 50])
def test_double_is_the_transpose_of_halve(time):
    rng = np.random.default_rng(time)
    x = rng.normal(size=(2, time, 3)).astype(np.float32)
    y = rng.normal(size=(2, math.ceil(time / 2), 12)).astype(np.float32)
    halved, doubled = jax.jit(lambda x, y: (dvm._halve(x), dvm._double(y, time)))(x, y)
    assert halved.shape == y.shape
    assert doubled.shape == x.shape
    # <halve(x), y> = <x, double(y)> for every x and y.
    np.testing.assert_allclose(np.vdot(halved, y), np.vdot(x, doubled), rtol=1e-4)


def test_halve_by_hand():
    # Patches of four steps, the first starting one step before the window, the last ending one after it.
    x = jnp.arange(1.0, 5.0).reshape(1, 4, 1)
    np.testing.assert_array_equal(dvm._halve(x), [[[0, 1, 2, 3], [2, 3, 4, 0]]])


def test_window_survives_encoder_and_decoder_in_shape():
    config = dvm.DVMConfig(window=50, latent=3, channels=4)
    network = dvm._VAE(config, 5)
    window, noise = jnp.zeros((2, 50, 5)), jnp.zeros((2, 3))
    (elbo, latent), _ = jax.eval_shape(network.init_with_output, jax.random.key(0), window, noise)
    assert elbo.shape == (2,)
    assert latent.shape == (2, 3)


def blank(config=CONFIG, channels=3, **params):
    """Variables of a network that encodes and decodes everything as zero, but for what is given."""
    network = dvm._VAE(config, channels)
    shapes = jnp.zeros((1, config.window, channels)), jnp.zeros((1, config.latent))
    variables = jax.eval_shape(network.init, jax.random.key(0), *shapes)
    variables = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), variables)
    return {"params": {**variables["params"], **params}}


apply = jax.jit(dvm._VAE(CONFIG, 3).apply)


def test_elbo_by_hand():
    # Latent mean 0.3 and log deviation -0.5 in each of six dimensions, reconstruction 0, noise exp(0.2) in every
    # channel.
    latent = {
        "kernel": jnp.zeros((4 * 16, 12)),  # 50 steps are 25, 13, 7, 4 after four halvings
        "bias": jnp.concatenate([jnp.full(6, 0.3), jnp.full(6, -0.5)]),
    }
    variables = blank(to_latent=latent, log_std=jnp.full(3, 0.2))
    x = jax.random.normal(jax.random.key(1), (2, 50, 3))
    elbo, mean = apply(variables, x, jnp.ones((2, 6)))
    likelihood = -0.5 * np.sum(np.square(x), axis=(1, 2)) / math.exp(0.4) - 150 * (0.2 + 0.5 * LOG_2_PI)
    divergence = 6 * (0.5 * (0.3**2 + math.exp(-1.0) - 1.0) + 0.5)
    np.testing.assert_allclose(elbo, likelihood - divergence, rtol=1e-5)
    np.testing.assert_allclose(mean, 0.3, rtol=1e-6)


def test_noise_level_has_a_floor():
    x = jnp.zeros((1, 50, 3))
    floor, _ = apply(blank(log_std=jnp.full(3, -3.0)), x, jnp.zeros((1, 6)))
    below, _ = apply(blank(log_std=jnp.full(3, -9.0)), x, jnp.zeros((1, 6)))
    np.testing.assert_allclose(floor, 150 * (3.0 - 0.5 * LOG_2_PI), rtol=1e-5)
    np.testing.assert_array_equal(below, floor)


novelty_of = functools.partial(jax.jit, static_argnums=0)(dvm.novelty)


def placed(reach, neighbours=3):
    """Every window is encoded at the origin; four simulated ones lie at 0.1, 0.2, 0.4 and 3 from it."""
    config = dataclasses.replace(CONFIG, neighbours=neighbours)
    latent = jnp.zeros((4, 6)).at[:, 2].set(jnp.array([0.4, -0.1, 3.0, 0.2]))
    scaler = windows.Scaler(mean=jnp.zeros(3), std=jnp.ones(3), varies=jnp.ones(3, bool))
    elbo = jnp.array([-100.0, -300.0, 7.0, -200.0])
    return config, DVM(variables=blank(), scaler=scaler, latent=latent, elbo=elbo, reach=jnp.float32(reach))


@pytest.mark.parametrize(
    ("reach", "neighbours", "expected"),
    [
        (0.25, 3, (-300.0 - 200.0) / 2),  # the third of three is out of reach
        (0.25, 1, -300.0),
        (1.0, 3, -200.0),
        (5.0, 3, -200.0),  # the fourth is within reach and one too many
        (5.0, 4, (-600.0 + 7.0) / 4),
    ],
)
def test_novelty_is_the_mean_over_near_neighbours_less_its_own_elbo(reach, neighbours, expected):
    config, model = placed(reach, neighbours)
    trajectory = measured()
    novelty, valid, covered = novelty_of(config, model, trajectory)
    cut, _ = windows.grid(trajectory, config.window, config.stride)
    # A blank network at rest: unit noise, no divergence but that of a unit Gaussian, which is none.
    own = -0.5 * np.sum(np.square(cut), axis=(2, 3)).reshape(-1) - 75 * LOG_2_PI
    assert novelty.shape == valid.shape == covered.shape == (9,)  # three windows of three episodes
    assert valid.all() and covered.all()
    np.testing.assert_allclose(novelty, expected - own, rtol=1e-4)


def test_no_neighbour_within_reach_is_reported_and_finite():
    novelty, valid, covered = novelty_of(*placed(reach=0.05), measured())
    assert valid.all()
    assert not covered.any()
    np.testing.assert_array_equal(novelty, 0.0)


def test_elbo_rises_in_training(trained, model):
    _, elbo = trained
    # A window of unit-variance channels without any structure: 150 numbers at 1.42 nats each.
    assert elbo > -0.6 * 150 * 0.5 * (1 + LOG_2_PI)
    assert np.isfinite(model.elbo).all()
    assert model.latent.shape == (CONFIG.references, CONFIG.latent)
    assert model.reach > 0


def test_windows_of_the_same_world_are_not_novel(score):
    novelty, valid, covered = score(measured(friction=0.1, mass=-0.1))
    assert valid.all() and covered.all()
    assert abs(novelty.mean()) < 3.0


@pytest.mark.parametrize(
    "shifted", [{"wind": 0.5}, {"mass": 0.6}, {"mass": -0.6}, {"friction": -0.6, "mass": 0.6}], ids=str
)
def test_windows_of_another_world_are_novel(score, shifted):
    novelty, _, covered = score(measured(**shifted))
    assert np.isfinite(novelty).all()
    # Eq. 2 as printed would have the other sign.
    assert not covered.any() or novelty[covered].mean() > 5.0


def test_a_world_far_away_has_no_neighbours_and_no_infinities(score):
    far = measured()
    novelty, valid, covered = score(far.replace(obs=1e3 * far.obs))
    assert valid.all()
    assert not covered.any()
    np.testing.assert_array_equal(novelty, 0.0)


def test_windows_after_a_fall_are_not_valid(score):
    trajectory = measured()
    _, valid, _ = score(trajectory.replace(alive=trajectory.alive.at[0].set(False).at[1, 55:].set(False)))
    # Starts 0, 5 and 10 of windows of 50 in three episodes: dead from the start, for 55 steps, for all 60.
    np.testing.assert_array_equal(valid.reshape(3, 3), [[0, 0, 0], [1, 1, 0], [1, 1, 1]])


@pytest.mark.slow
def test_few_windows_are_still_each_others_neighbours():
    """Episodes of one window each, fewer than references: copies would bring the reach to nothing."""
    dist, slider = toys.uniform(CENTRE, radius=0.2), toys.Slider(steps=CONFIG.window)
    draws = dists.sample(jax.random.key(0), dist, 100)
    simulated, others = (slider.simulate(jax.random.key(seed), toys.policy(), draws) for seed in (1, 5))
    model, _ = toys.train_dvm(jax.random.key(2), CONFIG, simulated)
    _, valid, covered = dvm.novelty(CONFIG, model, others)
    assert valid.all()
    assert covered.mean() > 0.8
