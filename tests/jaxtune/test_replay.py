import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sled
import toys

from jaxtune import dist as dists
from jaxtune import mjx, pooling, replay, tuner
from jaxtune.shooting import ReplayConfig
from jaxtune.tuner import Tuner, TunerConfig
from jaxtune.types import Verdict
from jaxtune.update import no_update

EPISODES, SETS = 3, 19
NAMES = ("friction", "mass")
EXACT, QUIET, NOISY = toys.Slider(noise=0.0), toys.Slider(noise=0.004), toys.Slider()
SIZES = {EXACT: ReplayConfig(sets=SETS), **dict.fromkeys((QUIET, NOISY), ReplayConfig(window=20, sets=SETS))}


@pytest.fixture(scope="module")
def dist():
    return toys.uniform(dict.fromkeys(NAMES, 0.0), radius=0.2)


@partial(jax.jit, static_argnums=(0, 3))
def calibration(slider, dist, seed, count=SETS):
    """Simulated sets, and their coordinates."""
    truth = dists.sample(jax.random.key(seed), dist, count)
    each = {name: jnp.repeat(values, EPISODES) for name, values in truth.items()}
    sets = slider.simulate(jax.random.key(seed + 1), toys.policy(), each)
    return jax.tree.map(lambda leaf: leaf.reshape(count, EPISODES, *leaf.shape[1:]), sets), truth


@partial(jax.jit, static_argnums=0)
def fitted(slider, dist, measured, sets):
    others = calibration(slider, dist, 7)
    return replay.estimate(SIZES[slider], slider.replay(), *sets, measured, dist, 0.9, *others)


def estimate(slider, dist, measured):
    return fitted(slider, dist, measured, calibration(slider, dist, 5))


def measured(slider, seed=3, **truth):
    return slider.measure(truth, EPISODES)(jax.random.key(seed), toys.policy())


@pytest.mark.parametrize("friction, mass", [(0.13, -0.18), (0.0, 0.0)])
def test_exact_states_give_exact_coordinates(dist, friction, mass):
    found = estimate(EXACT, dist, measured(EXACT, friction=friction, mass=mass))
    np.testing.assert_allclose(0.2 * found.estimate, [friction, mass], atol=2e-4)
    assert found.p_value > 0.05
    assert (found.interval < 0.05).all()


def test_rounding_does_not_rank_exact_fits(dist):
    # Of 20 robots one would be the worst of 20 by chance, and its estimate would not be taken.
    robots, _ = calibration(EXACT, dist, 29, 20)
    found = [estimate(EXACT, dist, jax.tree.map(lambda leaf, k=k: leaf[k], robots)).p_value for k in range(20)]
    np.testing.assert_array_equal(found, 1.0)


def test_a_truth_outside_the_distribution_is_found(dist):
    found = estimate(EXACT, dist, measured(EXACT, friction=-0.5, mass=0.6))
    np.testing.assert_allclose(0.2 * found.estimate, [-0.5, 0.6], atol=2e-3)


def test_an_estimate_stays_within_its_bounds():
    narrow = toys.uniform(dict.fromkeys(NAMES, 0.0), radius=0.2, bound=0.3)
    found = estimate(EXACT, narrow, measured(EXACT, friction=0.0, mass=0.6))
    assert (jnp.abs(0.2 * found.estimate) <= 0.3 + 1e-6).all()


def test_intervals_of_noisy_states_hold_together_as_often_as_they_say(dist):
    truths = dists.sample(jax.random.key(8), dist, 40)
    held, errors = 0, []
    for number in range(40):
        truth = {name: float(values[number]) for name, values in truths.items()}
        found = estimate(NOISY, dist, measured(NOISY, seed=100 + number, **truth))
        error = np.abs(found.estimate - dists.normalise(dist, truth))
        held += bool((error <= found.interval).all())
        errors.append(error)
    # 0.9 of 40, less three standard deviations.
    assert held >= 30
    # Staying at the centre would err by half a radius in the mean.
    assert np.mean(errors) < 0.3


def test_what_no_coordinates_explain_does_not_fit(dist):
    found = estimate(EXACT, dist, measured(EXACT, friction=0.0, mass=0.0, wind=0.5))
    assert found.p_value == pytest.approx(1 / (SETS + 1))


def test_further_sets_are_fitted_where_none_fits_as_badly(dist):
    sets = calibration(EXACT, dist, 5, 50)
    usual = fitted(EXACT, dist, measured(EXACT, friction=0.13, mass=-0.18), sets)
    assert usual.sets == SETS
    assert usual.p_value * (SETS + 1) == pytest.approx(round(float(usual.p_value) * (SETS + 1)))
    # Three parts, the last of which is filled up.
    strange = measured(EXACT, friction=0.0, mass=0.0, wind=0.5)
    found = fitted(EXACT, dist, strange, sets)
    assert found.sets == 50
    assert found.p_value == pytest.approx(1 / 51)
    few = estimate(EXACT, dist, strange)
    np.testing.assert_allclose(found.estimate, few.estimate, atol=1e-5)
    # More sets say nearly the same of errors.
    np.testing.assert_allclose(found.interval, few.interval, rtol=1.0)
    # Nothing to fit, nothing to compare with further sets.
    fallen = strange.replace(alive=strange.alive.at[:, 1:].set(False))
    assert fitted(EXACT, dist, fallen, sets).sets == SETS


@partial(jax.jit, static_argnums=0)
def misfit(slider, dist, one, sets):
    """The p-value where the last of the fitted sets say how features err, as in a tuning."""
    last = jax.tree.map(lambda leaf: leaf[-SETS:], sets)
    return replay.estimate(SIZES[slider], slider.replay(), *sets, one, dist, 0.9, *last).p_value


@pytest.mark.slow
def test_robots_that_nothing_is_wrong_with_are_called_unexplained_one_time_in_a_hundred(dist):
    # 50 calibrations of 99 sets, 40 robots each; the last time 13 and 56 of 2,000.
    p_values = []
    for number in range(50):
        sets = calibration(NOISY, dist, 1000 + 7 * number, 99)
        robots, _ = calibration(NOISY, dist, 5000 + 13 * number, 40)
        p_values += [misfit(NOISY, dist, jax.tree.map(lambda leaf, k=k: leaf[k], robots), sets) for k in range(40)]
    p_values = np.array(p_values)
    # Of 50 calibrations the mean rate varies by a tenth of a percent beside chance: three standard deviations.
    assert 0.002 < (p_values <= 0.01 + 1e-6).mean() < 0.01 + 3 * np.hypot(np.sqrt(0.01 * 0.99 / 2000), 0.001)
    assert 0.01 < (p_values <= 0.05 + 1e-6).mean() < 0.05 + 3 * np.hypot(np.sqrt(0.05 * 0.95 / 2000), 0.005)


def test_pieces_after_a_fall_do_not_count(dist):
    whole = measured(EXACT, friction=0.1, mass=0.1)
    spoilt = whole.replace(
        alive=whole.alive.at[1, 30:].set(False), state={"slider": whole.state["slider"].at[1, 30:].set(jnp.nan)}
    )
    np.testing.assert_allclose(0.2 * estimate(EXACT, dist, spoilt).estimate, [0.1, 0.1], atol=2e-4)


def test_pieces_that_break_do_not_spoil_the_others(dist):
    broken = measured(EXACT, friction=0.1, mass=0.1)
    # Of one step alone: the piece that begins there cannot be simulated.
    broken = broken.replace(state={"slider": broken.state["slider"].at[0, 10].set(jnp.inf)})
    found = estimate(EXACT, dist, broken)
    np.testing.assert_allclose(0.2 * found.estimate, [0.1, 0.1], atol=2e-4)
    # A camera that lost the robot once is no physics that is missing.
    assert found.p_value == 1.0


def test_a_coordinate_that_shows_nowhere_stays_where_it_is(dist):
    idle = toys.uniform(dict.fromkeys(("friction", "idle", "mass"), 0.0), radius=0.2)
    found = estimate(EXACT, idle, measured(EXACT, friction=0.13, mass=-0.18, idle=0.05))
    np.testing.assert_array_equal(found.identifiable, [True, False, True])
    assert (found.wide >= found.interval).all()

    def some(key, config, collected, measured, dist, knobs):
        # An update that errs as much in it, and more in the others.
        off = jnp.diag(jnp.array([1e-3, 0.2, 1e-3]))
        info = no_update(dist).replace(identifiable=jnp.array([True, False, True]), errors=off)
        return dist, info

    one = machine(EXACT, verify=accept, update=some)
    state, tune = one.init(toys.policy(), idle, tuner.knobs()), jax.jit(one.tune)
    for seed in range(3):
        after, info = tune(jax.random.key(seed), state, measured(EXACT, seed=seed, friction=0.1, mass=-0.15, idle=0.1))
        assert info.update.replayed
        np.testing.assert_allclose(dists.ravel(after.dist.centre), [0.1, 0.0, -0.15], atol=1e-3)
        np.testing.assert_allclose(after.dist.radius["idle"], 0.2, rtol=1e-6)
        assert after.dist.radius["mass"] < 0.05
        np.testing.assert_array_equal(info.update.identifiable, [True, False, True])


def test_a_simulated_set_without_a_piece_counts_as_a_bad_fit(dist):
    one, (sets, truth) = measured(EXACT, friction=0.13, mass=-0.18), calibration(EXACT, dist, 5)
    dead = sets.replace(alive=sets.alive.at[4, :, 1:].set(False))
    found = fitted(EXACT, dist, one, (dead, truth))
    np.testing.assert_allclose(0.2 * found.estimate, [0.13, -0.18], atol=2e-4)
    assert (found.interval < 0.05).all()
    assert np.isfinite(found.errors).all()
    assert found.p_value >= 2 / (SETS + 1)
    # Of which there are too many for a quantile, or the measured one itself.
    none = sets.replace(alive=sets.alive.at[:, :, 1:].set(False))
    assert not np.isfinite(fitted(EXACT, dist, one, (none, truth)).interval).any()
    fallen = one.replace(alive=one.alive.at[:, 1:].set(False))
    assert not np.isfinite(fitted(EXACT, dist, fallen, (sets, truth)).estimate).any()


def test_a_median_is_of_the_other_sets():
    values = jnp.array([[1.0], [2.0], [9.0], [jnp.nan], [4.0]])
    np.testing.assert_allclose(replay._medians(values)[:, 0], [4.0, 4.0, 2.0, 3.0, 2.0, 3.0])


def machine(slider, **changes):
    return Tuner(
        config=dataclasses.replace(toys.TINY, set_episodes=EPISODES, replay=SIZES[slider], min_radius=0.01),
        train_policy=toys.train_policy,
        simulate=slider.simulate,
        replay=slider.replay(),
        **changes,
    )


def accept(key, config, collected, measured, knobs):
    return tuner.GateInfo(novelty=jnp.zeros(()), threshold=jnp.ones(()))


def stay(errors, key, config, collected, measured, dist, knobs):
    """An update that moves nothing, and says how far it errs."""
    none = jnp.zeros(len(NAMES))
    info = tuner.UpdateInfo(step=none, interval=none + 1.0, identifiable=none > 0, loss=jnp.zeros(()))
    return dist, info.replace(errors=errors * jnp.eye(len(NAMES)))


@pytest.mark.parametrize(
    "slider, errors, extra, replayed",
    [
        (EXACT, 0.1, {}, True),
        (NOISY, 1e-9, {}, False),  # the estimate before errs less
        (EXACT, 0.1, {"wind": 0.5}, False),  # the states do not fit
    ],
)
def test_the_tuner_takes_the_better_estimate(dist, slider, errors, extra, replayed):
    one = machine(slider, verify=accept, update=partial(stay, errors))
    state = one.init(toys.policy(), dist, tuner.knobs())
    truth = {"friction": 0.1, "mass": -0.15}
    after, info = jax.jit(one.tune)(jax.random.key(0), state, measured(slider, **truth, **extra))
    assert bool(info.update.replayed) == replayed
    assert np.isfinite(info.update.p_replay)
    if replayed:
        np.testing.assert_allclose(dists.ravel(after.dist.centre), [0.1, -0.15], atol=1e-3)
        assert (dists.ravel(after.dist.radius) < 0.2).all()
        assert info.update.identifiable.all()
        assert "estimated from measured states" in tuner.explain(info)
    else:
        jax.tree.map(np.testing.assert_array_equal, after.dist, dist)
        assert "measured states give no better estimate" in tuner.explain(info)


@pytest.mark.parametrize(
    "held_out, wind, verdict", [(99, 0.5, "UNEXPLAINED"), (99, 0.0, "ACCEPT"), (59, 0.5, "ACCEPT")]
)
def test_states_that_no_coordinates_explain_are_unexplained_at_one_percent(dist, held_out, wind, verdict):
    one = machine(EXACT, verify=accept, update=partial(stay, 0.1))
    one = dataclasses.replace(one, config=dataclasses.replace(one.config, held_out_sets=held_out))
    state = one.init(toys.policy(), dist, tuner.knobs())
    set_ = measured(EXACT, friction=0.1, mass=-0.15, wind=wind)
    after, info = jax.jit(one.tune)(jax.random.key(0), state, set_)
    assert Verdict(int(info.verdicts[0])).name == verdict
    if wind:
        assert info.update.p_replay == pytest.approx(1 / (held_out + 1))
        jax.tree.map(np.testing.assert_array_equal, after.dist, dist)
        assert ("no parameters explain" in tuner.explain(info).lower()) == (verdict == "UNEXPLAINED")
        assert ("measured states fit worse than" in tuner.explain(info)) == (verdict == "UNEXPLAINED")
        assert after.past.tunings == (0 if verdict == "UNEXPLAINED" else state.past.tunings)


@pytest.mark.parametrize("second, agrees", [({"friction": 0.1, "mass": -0.15}, True), ({"friction": -0.1}, False)])
def test_states_of_several_sets_inform_the_estimate_unless_they_contradict(dist, second, agrees):
    one = machine(QUIET, verify=accept, update=partial(stay, 0.5))
    one = dataclasses.replace(one, config=dataclasses.replace(one.config, min_radius=0.2))
    tune, state = jax.jit(one.tune), one.init(toys.policy(), dist, tuner.knobs())
    state, info = tune(jax.random.key(0), state, measured(QUIET, friction=0.1, mass=-0.15))
    assert state.past.tunings == 1
    assert np.isnan(info.update.p_past)
    truth = {"mass": -0.15} | second
    after, info = tune(jax.random.key(1), state, measured(QUIET, seed=4, **truth))
    assert info.update.replayed
    assert info.update.pooled == agrees
    assert after.past.tunings == (2 if agrees else 1)
    if agrees:
        assert jnp.trace(after.past.errors) < jnp.trace(state.past.errors)
    else:
        forgotten = state.replace(past=pooling.nothing(dist))
        alone, _ = tune(jax.random.key(1), forgotten, measured(QUIET, seed=4, **truth))
        np.testing.assert_allclose(after.past.errors, alone.past.errors, rtol=1e-3)
    np.testing.assert_allclose(dists.ravel(after.dist.centre), [truth["friction"], -0.15], atol=0.03)


def test_a_held_out_robot_that_falls_at_once_leaves_the_distribution_finite(dist):
    def simulate(key, policy, coords):
        episodes = EXACT.simulate(key, policy, coords)
        falls = jnp.arange(len(episodes.alive)) // EPISODES == 4
        return episodes.replace(alive=episodes.alive & ~(falls[:, None] & (jnp.arange(EXACT.steps) > 0)))

    one = machine(EXACT, verify=accept, update=partial(stay, 0.1))
    one = dataclasses.replace(one, simulate=simulate, config=dataclasses.replace(one.config, episodes=3 * EPISODES))
    state = one.init(toys.policy(), dist, tuner.knobs())
    after, info = jax.jit(one.tune)(jax.random.key(0), state, measured(EXACT, friction=0.1, mass=-0.15))
    assert np.isfinite(dists.ravel(after.dist.radius)).all()
    assert np.isfinite(dists.ravel(after.dist.centre)).all()
    assert np.isfinite(info.update.interval).all()


def test_a_rejected_set_is_not_replayed(dist):
    reject = lambda *args: accept(*args).replace(novelty=jnp.full((), 2.0))  # noqa: E731
    one = machine(EXACT, verify=reject, update=partial(stay, 0.1))
    _, info = jax.jit(one.tune)(
        jax.random.key(0), one.init(toys.policy(), dist, tuner.knobs()), measured(EXACT, friction=0.0, mass=0.0)
    )
    assert np.isnan(info.update.p_replay)
    assert not info.update.replayed


def test_states_that_are_missing_or_of_another_robot_are_refused(dist):
    one = machine(EXACT)
    state, whole = one.init(toys.policy(), dist, tuner.knobs()), measured(EXACT, friction=0.0, mass=0.0)
    for changed, message in (
        (whole.replace(state=None), "measured, state: got none"),
        (whole.replace(state={"cart": whole.state["slider"]}), "measured, state: got 'cart', expected some of slider"),
        (whole.replace(state={"slider": whole.state["slider"][..., :1]}), "measured, state, slider: got shape"),
        (whole.replace(state={}), "measured, state: got none"),
    ):
        with pytest.raises(ValueError, match=message):
            one.tune(jax.random.key(0), state, changed)
    needing = dataclasses.replace(one, replay=dataclasses.replace(one.replay, needs=("slider", "spring")))
    with pytest.raises(ValueError, match="measured, state: got slider, expected 'spring' as well"):
        needing.tune(jax.random.key(0), state, whole)
    without = dataclasses.replace(one, simulate=lambda *args: EXACT.simulate(*args).replace(state=None))
    with pytest.raises(ValueError, match="simulate, state: got none"):
        without.tune(jax.random.key(0), state, whole)
    long = dataclasses.replace(one, config=dataclasses.replace(one.config, replay=ReplayConfig(window=60)))
    with pytest.raises(ValueError, match="expected more than 60"):
        long.tune(jax.random.key(0), state, whole)
    many = dataclasses.replace(one, config=dataclasses.replace(one.config, replay=ReplayConfig(sets=20)))
    with pytest.raises(ValueError, match="sets: got 20, expected 1 to 19 held-out sets"):
        many.tune(jax.random.key(0), state, whole)


def test_a_robot_without_muscles_is_replayed_at_the_default_sizes():
    simulator = mjx.Simulator(sled.Sled(), steps=60, parameters={"mass": sled.TABLE["mass"]})
    act = lambda policy, obs, key: jax.random.normal(key, (1,))  # noqa: E731
    machine = Tuner(
        config=TunerConfig(),
        train_policy=tuner.keep,
        simulate=simulator.simulate(act, states=True),
        replay=simulator.replay(),
    )
    key, policy = jax.random.key(0), jnp.zeros(())
    measured = jax.eval_shape(simulator.measure(act, {"mass": 1.2}, 5, states=True), key, policy)
    state = machine.init(policy, simulator.dist(0.4), tuner.knobs())
    after, _ = jax.eval_shape(machine.tune, key, state, measured)
    assert jax.tree.structure(after) == jax.tree.structure(state)
