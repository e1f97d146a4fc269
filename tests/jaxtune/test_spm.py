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


@pytest.fixture(scope="module")
def train():
    return jax.jit(lambda *args: spm.train(args[0], CONFIG, *args[1:]))


@pytest.fixture(scope="module")
def simulated():
    dist = toys.uniform(CENTRE)
    params = dists.sample(jax.random.key(0), dist, 1024)
    return toys.Slider().simulate(jax.random.key(1), toys.policy(), params), params, dist


@pytest.fixture(scope="module")
def trained(train, simulated):
    return train(jax.random.key(2), *simulated)


@pytest.fixture(scope="module")
def model(trained):
    return trained[0]


@pytest.fixture(scope="module")
def read(model):
    """Vote and estimate for a slider this many radii off the centre."""
    answer = jax.jit(lambda measured: (spm.vote(CONFIG, model, measured), spm.estimate(CONFIG, model, measured)))

    def measure(**radii):
        truth = {name: value + 0.4 * radii.get(name, 0.0) for name, value in CENTRE.items()}
        return answer(toys.Slider().measure(truth, 3)(jax.random.key(3), toys.policy()))

    return measure


@pytest.mark.parametrize(("name", "index"), [("friction", FRICTION), ("mass", MASS)])
def test_vote_points_to_the_truth_of_each_parameter_alone(read, name, index):
    above, _ = read(**{name: 0.6})
    below, _ = read(**{name: -0.6})
    assert above[index] > 0.5
    assert below[index] < -0.5
    assert np.all(np.abs(above) <= 1.0)


@pytest.mark.parametrize("friction", [-0.7, 0.0, 0.7])
@pytest.mark.parametrize("mass", [-0.7, 0.0, 0.7])
def test_estimate_is_the_truth(read, friction, mass):
    _, estimate = read(friction=friction, mass=mass)
    np.testing.assert_allclose(estimate[FRICTION:], [friction, mass], atol=0.25)


def test_estimate_of_a_truth_outside_is_the_edge_of_the_box(read):
    _, estimate = read(mass=2.0)
    assert 0.9 < estimate[MASS] <= 1.0


def test_what_does_not_show_is_answered_with_the_middle_of_the_box(read):
    for colour in (-0.9, 0.9):
        vote, estimate = read(colour=colour)
        assert abs(vote[COLOUR]) < 0.35
        assert abs(estimate[COLOUR]) < 0.35


def test_answers_over_a_sweep_fall_as_one_minus_a_distribution_function_does(model):
    measured = toys.Slider().measure(CENTRE, 3)(jax.random.key(4), toys.policy())
    sweep = jnp.linspace(-1.0, 1.0, 9)[:, None] * jnp.ones(3)
    curve = np.asarray(jax.nn.sigmoid(spm.logits(CONFIG, model, measured, sweep)))
    assert np.all(np.diff(curve, axis=0) < 0.02)
    np.testing.assert_allclose(curve[0], 1.0, atol=0.1)
    np.testing.assert_allclose(curve[-1], 0.0, atol=0.1)
    # Nothing is known of the colour, so its curve is that of the uniform draw.
    np.testing.assert_allclose(curve[:, COLOUR], 1.0 - (sweep[:, 0] + 1.0) / 2.0, atol=0.2)


def test_a_guess_of_one_parameter_does_not_tilt_the_answer_for_another(model):
    measured = toys.Slider().measure(CENTRE, 3)(jax.random.key(4), toys.policy())
    others = jnp.array([[0.0, 0.0, guess] for guess in (-0.9, 0.0, 0.9)])
    sweep = others.at[:, FRICTION].set(0.5), others.at[:, FRICTION].set(-0.5)
    assert np.all(spm.logits(CONFIG, model, measured, sweep[0])[:, FRICTION] < 0)
    assert np.all(spm.logits(CONFIG, model, measured, sweep[1])[:, FRICTION] > 0)


def test_guesses_are_judged_one_by_one(model):
    measured = toys.Slider().measure(CENTRE, 3)(jax.random.key(4), toys.policy())
    guesses = jax.random.uniform(jax.random.key(5), (4, 3), minval=-1.0)
    together = spm.logits(CONFIG, model, measured, guesses)
    for row in range(4):
        np.testing.assert_allclose(
            spm.logits(CONFIG, model, measured, guesses[row : row + 1])[0], together[row], rtol=1e-3, atol=1e-4
        )


def ended(trajectory, episode, from_step=0):
    """The same set, in which one episode ends early."""
    return trajectory.replace(alive=trajectory.alive.at[episode, from_step:].set(False))


def test_windows_after_an_end_are_no_evidence(model):
    measured = toys.Slider().measure(CENTRE, 3)(jax.random.key(4), toys.policy())
    centre = jnp.zeros((1, 3))
    first_two = jax.tree.map(lambda leaf: leaf[:2], measured)
    # Step 49 is the last of a first window of 50.
    np.testing.assert_allclose(
        spm.logits(CONFIG, model, ended(measured, 2, 49), centre),
        spm.logits(CONFIG, model, first_two, centre),
        rtol=1e-3,
    )


def test_what_a_broken_simulation_left_behind_is_no_evidence(model):
    measured = ended(toys.Slider().measure(CENTRE, 3)(jax.random.key(4), toys.policy()), 2, 49)
    broken = measured.replace(obs=jnp.where(measured.alive[..., None], measured.obs, jnp.nan))
    np.testing.assert_allclose(spm.estimate(CONFIG, model, broken), spm.estimate(CONFIG, model, measured), rtol=1e-3)


def test_no_evidence_says_nothing(model):
    nothing = toys.Slider().measure(CENTRE, 3)(jax.random.key(4), toys.policy())
    nothing = nothing.replace(alive=jnp.zeros_like(nothing.alive))
    np.testing.assert_array_equal(spm.vote(CONFIG, model, nothing), 0.0)
    np.testing.assert_allclose(spm.estimate(CONFIG, model, nothing), 0.0, atol=1e-6)


def test_ignorance_costs_what_the_calculation_says(train, simulated, trained):
    trajectory, params, dist = simulated
    _, loss = trained
    # Labels that the episodes know nothing of. A uniform guess at place u of the box is right with probability u, so
    # its
    # entropy is that of u, whose mean over u is 1/2 nat; the first of the four guesses is the centre, at log 2.
    _, ignorant = train(
        jax.random.key(2), jax.tree.map(lambda leaf: leaf[:1].repeat(1024, 0), trajectory), params, dist
    )
    expected = (np.log(2) + 3 * 0.5) / 4
    np.testing.assert_allclose(ignorant, expected, atol=0.02)
    # Two parameters of three show.
    assert loss < 0.7 * expected


def with_logits(monkeypatch, curve):
    """A model that answers a sweep of guesses [guesses, params] with a given curve."""
    monkeypatch.setattr(spm, "logits", lambda config, model, trajectory, guesses: curve(guesses))
    # Normalised, the second parameter's box ends at (1 - 0.75) / 0.5 = 0.5.
    bounds = {"a": jnp.float32(-1), "b": jnp.float32(-1)}, {"a": jnp.float32(1), "b": jnp.float32(1)}
    dist = dists.make({"a": jnp.float32(0), "b": jnp.float32(0.75)}, 0.5, *bounds)
    return SPM(variables={}, scaler=windows.Scaler(mean=jnp.zeros(3), std=jnp.ones(3)), dist=dist)


def any_set():
    return toys.Slider().measure(CENTRE, 1)(jax.random.key(0), toys.policy())


@pytest.mark.parametrize("truth", [(-0.83, 0.41), (0.0, 0.0), (0.999, -0.999)])
def test_crossing_of_a_straight_line_is_exact(monkeypatch, truth):
    model = with_logits(monkeypatch, lambda guesses: 7.0 * (jnp.array(truth) - guesses))
    np.testing.assert_allclose(spm.estimate(CONFIG, model, any_set()), truth, atol=1e-5)


def test_a_curve_that_never_crosses_ends_at_the_edge_of_the_cut_box(monkeypatch):
    model = with_logits(monkeypatch, jnp.ones_like)
    np.testing.assert_allclose(spm.estimate(CONFIG, model, any_set()), [1.0, 0.5], atol=1e-6)
    model = with_logits(monkeypatch, lambda guesses: -jnp.ones_like(guesses))
    np.testing.assert_allclose(spm.estimate(CONFIG, model, any_set()), [-1.0, -1.0], atol=1e-6)


def test_a_curve_that_crosses_thrice_counts_where_it_is_positive(monkeypatch):
    # Between 3, -1, 1, -3 it is positive over 3/4, 1/2 and 1/4 of the three parts: half of the box.
    knots = jnp.array([3.0, -1.0, 1.0, -3.0])
    config = spm.SPMConfig(window=50, sweep=4)
    model = with_logits(monkeypatch, lambda guesses: jnp.broadcast_to(knots[:, None], guesses.shape))
    np.testing.assert_allclose(spm.estimate(config, model, any_set()), [0.0, -0.25], atol=1e-6)


def test_vote_is_twice_the_probability_less_one(monkeypatch):
    def fixed(guesses):
        np.testing.assert_array_equal(guesses, [[0.0, 0.0]])
        return jnp.array([[jnp.log(3.0), -jnp.log(3.0)]])  # odds of 3 to 1

    model = with_logits(monkeypatch, fixed)
    np.testing.assert_allclose(spm.vote(CONFIG, model, any_set()), [0.5, -0.5], rtol=1e-5)
