import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import baselines
from jaxtune.tuner import Tuner, calibrated_gate, knobs, posterior_update
from jaxtune.types import Verdict

TRUTH = {"friction": 0.5, "mass": -0.5}
CONFIG = dataclasses.replace(
    toys.TINY, spm=dataclasses.replace(toys.TINY_SPM, train_steps=100, batch=64, hidden=(32, 32, 32))
)


@pytest.fixture(scope="module")
def tuner():
    slider = toys.Slider()
    return Tuner(
        config=CONFIG, train_policy=toys.train_policy, simulate=slider.simulate, measure=slider.measure(TRUTH, 2)
    )


@pytest.fixture(scope="module")
def spm(tuner):
    return baselines.spm(tuner)


@pytest.fixture(scope="module")
def spm_step(spm):
    return toys.quick_jit(spm.step)


def start(method, **settings):
    return method.init(toys.policy(), toys.uniform(dict.fromkeys(TRUTH, 0.0), 0.2), knobs(**settings))


def test_spm_accepts_what_a_gate_would_ring_for_and_keeps_its_radius(spm, spm_step):
    state = start(spm, threshold=-1e6)  # which no gate that looks at it lets pass
    first = state.dist
    for seed in range(3):
        before = state.dist
        state, info = spm_step(jax.random.key(seed), state)
        assert info.calls == 1
        np.testing.assert_array_equal(info.verdicts, [Verdict.ACCEPT, -1, -1])
        assert state.dist.radius == first.radius
        assert info.dist.centre == before.centre
        assert state.dist.centre != before.centre
        # The paper's rule goes no further than its step size in a tuning.
        assert np.all(np.abs(info.update.step) <= 0.5)
        np.testing.assert_allclose(
            state.dist.centre["mass"], before.centre["mass"] + 0.2 * info.update.step[1], rtol=1e-5
        )
    assert state.policy["rounds"] == 3


def test_spm_goes_towards_the_truth(spm, spm_step):
    state, _ = spm_step(jax.random.key(0), start(spm))
    assert state.dist.centre["mass"] < -0.02


def test_spm_is_the_same_tuner_with_two_functions_swapped(tuner, spm):
    assert dataclasses.replace(spm, verify=calibrated_gate, update=posterior_update) == tuner


def test_open_gate_needs_a_step_to_read(spm):
    measured = spm.measure(jax.random.key(0), toys.policy())
    gate = baselines.open_gate(None, CONFIG, None, measured, knobs())
    assert gate.novelty <= gate.threshold
    empty = measured.replace(alive=jnp.zeros_like(measured.alive))
    assert np.isnan(baselines.open_gate(None, CONFIG, None, empty, knobs()).novelty)


def test_untuned_trains_and_leaves_the_distribution_alone(tuner):
    untuned = baselines.Untuned(tuner=dataclasses.replace(tuner, measure=None))
    state = start(untuned)
    first = state.dist
    step = jax.jit(untuned.step)
    for seed in range(3):
        state, info = step(jax.random.key(seed), state)
        assert info.train["rounds"] == seed + 1
        assert info.calls == 0
        np.testing.assert_array_equal(info.verdicts, -1)
        np.testing.assert_array_equal(info.update.step, 0.0)
    assert state.policy["rounds"] == 3
    assert state.dist == first


def test_histories_of_all_methods_have_one_shape(tuner, spm):
    shapes = [
        jax.eval_shape(method.step, jax.random.key(0), start(method))
        for method in (tuner, spm, baselines.Untuned(tuner=tuner))
    ]
    first = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), shapes[0])
    for other in shapes[1:]:
        assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), other) == first
