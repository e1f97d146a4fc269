import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import dist as dists
from jaxtune import spm, windows
from jaxtune.spm import SPM

CONFIG = toys.SPM
# Sorted by name: colour enters no equation of the slider.
CENTRE = {"colour": 0.0, "friction": 0.1, "mass": -0.1}
COLOUR, FRICTION, MASS = range(3)

measured = functools.partial(toys.measured, CENTRE)


@pytest.fixture(scope="module")
def simulated():
    return toys.simulated(CENTRE, 512)


@pytest.fixture(scope="module")
def trained(simulated):
    return toys.train_spm(jax.random.key(2), CONFIG, *simulated)


@pytest.fixture(scope="module")
def model(trained):
    return trained[0]


@pytest.fixture(scope="module")
def estimate(model):
    return jax.jit(lambda measured: spm.estimate(CONFIG, model, measured))


@pytest.fixture(scope="module")
def logits(model):
    return jax.jit(lambda measured, guesses: spm.logits(CONFIG, model, measured, guesses))


@pytest.fixture(scope="module")
def vote(model):
    return jax.jit(lambda measured: spm.vote(CONFIG, model, measured))


@pytest.mark.parametrize(("name", "index"), [("friction", FRICTION), ("mass", MASS)])
def test_vote_points_to_the_truth_of_each_parameter_alone(vote, name, index):
    above = vote(measured(**{name: 0.6}))
    below = vote(measured(**{name: -0.6}))
    assert above[index] > 0.5
    assert below[index] < -0.5
    assert np.all(np.abs(above) <= 1.0)


@pytest.mark.parametrize("friction", [-0.7, 0.0, 0.7])
@pytest.mark.parametrize("mass", [-0.7, 0.0, 0.7])
def test_estimate_is_the_truth(estimate, friction, mass):
    np.testing.assert_allclose(estimate(measured(friction=friction, mass=mass))[FRICTION:], [friction, mass], atol=0.2)


def test_a_model_reads_raw_steps_as_well(simulated):
    config = dataclasses.replace(CONFIG, reads="steps")
    model, _ = toys.train_spm(jax.random.key(2), config, *simulated)
    estimate = jax.jit(lambda measured: spm.estimate(config, model, measured))
    for mass in (-0.7, 0.7):
        np.testing.assert_allclose(estimate(measured(mass=mass))[MASS], mass, atol=0.3)
    assert len(model.inputs.mean) == CONFIG.window * len(model.steps.mean)


def test_estimate_of_a_truth_outside_is_the_edge_of_the_box(estimate):
    assert 0.9 < estimate(measured(mass=2.0))[MASS] <= 1.0


def test_a_coordinate_that_does_not_show_is_estimated_in_the_middle_of_the_box(vote, estimate):
    for colour in (-0.9, 0.9):
        assert abs(vote(measured(colour=colour))[COLOUR]) < 0.35
        assert abs(estimate(measured(colour=colour))[COLOUR]) < 0.35


def test_answers_over_a_sweep_fall_as_one_minus_a_distribution_function_does(logits):
    sweep = jnp.linspace(-1.0, 1.0, 9)[:, None] * jnp.ones(3)
    curve = np.asarray(jax.nn.sigmoid(logits(measured(), sweep)))
    assert np.all(np.diff(curve, axis=0) < 0.02)
    np.testing.assert_allclose(curve[0, FRICTION:], 1.0, atol=0.1)
    np.testing.assert_allclose(curve[-1, FRICTION:], 0.0, atol=0.1)
    # Nothing is known of the colour, so its curve is that of the uniform draw.
    np.testing.assert_allclose(curve[:, COLOUR], 1.0 - (sweep[:, 0] + 1.0) / 2.0, atol=0.25)


def test_a_guess_of_one_parameter_does_not_turn_the_answer_for_another(logits):
    low, high = (
        logits(measured(), jnp.array([[0.0, friction, mass] for mass in (-0.9, 0.0, 0.9)]))[:, FRICTION]
        for friction in (-0.5, 0.5)
    )
    assert np.all(low > 0)
    assert np.all(high < 0)


def test_guesses_are_answered_one_by_one(logits):
    guesses = jax.random.uniform(jax.random.key(5), (3, 3), minval=-1.0)
    alone = jnp.concatenate([logits(measured(), guesses[row : row + 1]) for row in range(3)])
    np.testing.assert_allclose(logits(measured(), guesses), alone, rtol=1e-3, atol=1e-4)


def last_ended(at_step):
    """A set whose last episode ended early."""
    whole = measured()
    return whole.replace(alive=whole.alive.at[-1, at_step:].set(False))


def test_windows_after_an_end_are_no_evidence(logits):
    centre = jnp.zeros((1, 3))
    first_two = jax.tree.map(lambda leaf: leaf[:2], measured())
    # Step 49 is the last of a first window of 50.
    np.testing.assert_allclose(logits(last_ended(49), centre), logits(first_two, centre), rtol=1e-3)
    assert np.all(logits(last_ended(50), centre) != logits(last_ended(49), centre))


def test_what_a_broken_simulation_left_behind_is_no_evidence(estimate):
    ended = last_ended(49)
    broken = ended.replace(obs=jnp.where(ended.alive[..., None], ended.obs, jnp.nan))
    np.testing.assert_allclose(estimate(broken), estimate(ended), rtol=1e-3)


def test_a_set_without_a_valid_window_gives_no_vote_and_the_middle(vote, estimate):
    nothing = measured()
    nothing = nothing.replace(alive=jnp.zeros_like(nothing.alive))
    np.testing.assert_array_equal(vote(nothing), 0.0)
    np.testing.assert_allclose(estimate(nothing), 0.0, atol=1e-6)


def test_loss_of_a_model_that_learns_nothing_is_the_entropy_of_the_labels(simulated, trained):
    trajectory, coords, dist = simulated
    _, loss = trained
    # Labels that the episodes know nothing of. A uniform guess at place u of the box is right with probability u, so
    # its entropy is that of u, whose mean over u is 1/2 nat; the first of the four guesses is the centre, at log 2.
    all_alike = jax.tree.map(lambda leaf: leaf[:1].repeat(512, 0), trajectory)
    _, ignorant = toys.train_spm(jax.random.key(2), CONFIG, all_alike, coords, dist)
    expected = (np.log(2) + 3 * 0.5) / 4
    np.testing.assert_allclose(ignorant, expected, atol=0.02)
    # Two parameters of three show.
    assert loss < 0.7 * expected


def with_logits(monkeypatch, curve):
    """A model that answers a sweep of guesses [guesses, coords] with a given curve."""
    monkeypatch.setattr(spm, "logits", lambda config, model, trajectory, guesses: curve(guesses))
    # Normalised, the second parameter's box ends at (1 - 0.75) / 0.5 = 0.5.
    bounds = {"a": jnp.float32(-1), "b": jnp.float32(-1)}, {"a": jnp.float32(1), "b": jnp.float32(1)}
    dist = dists.make({"a": jnp.float32(0), "b": jnp.float32(0.75)}, 0.5, *bounds)
    scaler = windows.Scaler(mean=jnp.zeros(3), std=jnp.ones(3), varies=jnp.ones(3, bool))
    return SPM(variables={}, steps=scaler, inputs=scaler, dist=dist)


@pytest.mark.parametrize("truth", [(-0.83, 0.41), (0.0, 0.0), (0.999, -0.999)])
def test_crossing_of_a_straight_line_is_exact(monkeypatch, truth):
    model = with_logits(monkeypatch, lambda guesses: 7.0 * (jnp.array(truth) - guesses))
    np.testing.assert_allclose(spm.estimate(CONFIG, model, measured()), truth, atol=1e-5)


def test_a_curve_that_never_crosses_ends_at_the_edge_of_the_cut_box(monkeypatch):
    model = with_logits(monkeypatch, jnp.ones_like)
    np.testing.assert_allclose(spm.estimate(CONFIG, model, measured()), [1.0, 0.5], atol=1e-6)
    model = with_logits(monkeypatch, lambda guesses: -jnp.ones_like(guesses))
    np.testing.assert_allclose(spm.estimate(CONFIG, model, measured()), [-1.0, -1.0], atol=1e-6)


def test_a_curve_that_crosses_thrice_counts_where_it_is_positive(monkeypatch):
    # Between 3, -1, 3, -3 it is positive over 3/4, 3/4 and 1/2 of the three parts: two thirds of the box.
    knots = jnp.array([3.0, -1.0, 3.0, -3.0])
    config = spm.SPMConfig(window=50, sweep=4)
    model = with_logits(monkeypatch, lambda guesses: jnp.broadcast_to(knots[:, None], guesses.shape))
    np.testing.assert_allclose(spm.estimate(config, model, measured()), [1 / 3, 0.0], atol=1e-6)


def test_vote_is_twice_the_probability_less_one(monkeypatch):
    def fixed(guesses):
        np.testing.assert_array_equal(guesses, [[0.0, 0.0]])
        return jnp.array([[jnp.log(3.0), -jnp.log(3.0)]])  # odds of 3 to 1

    model = with_logits(monkeypatch, fixed)
    np.testing.assert_allclose(spm.vote(CONFIG, model, measured()), [0.5, -0.5], rtol=1e-5)
