import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import baselines
from jaxtune import spm as models
from jaxtune.explain import explain
from jaxtune.tuner import Tuner, calibrated_gate, knobs, posterior_update
from jaxtune.types import Verdict

TRUTH = {"friction": 0.5, "mass": -0.5}
SLIDER = toys.Slider()


@pytest.fixture(scope="module")
def tuner():
    return Tuner(
        config=toys.TINY,
        train_policy=toys.train_policy,
        simulate=SLIDER.simulate,
        measure=SLIDER.measure(TRUTH, 2),
    )


@pytest.fixture(scope="module")
def spm(tuner):
    return baselines.spm(tuner)


def start(method, **settings):
    return method.init(toys.policy(), toys.uniform(dict.fromkeys(TRUTH, 0.0), 0.2), knobs(**settings))


@pytest.fixture
def unanimous(monkeypatch):
    """A search-parameter model that knows the way without training: friction up, mass down."""
    monkeypatch.setattr(models, "train", lambda *_: (None, jnp.zeros(())))
    monkeypatch.setattr(models, "vote", lambda *_: jnp.array([1.0, -1.0]))


def test_spm_accepts_what_a_gate_would_reject_and_keeps_its_radius(spm, unanimous):
    state = start(spm, threshold=1e-6)  # which no gate that looks at it lets pass
    step = jax.jit(spm.step)
    for seed in range(3):
        before = state.dist
        state, info = step(jax.random.key(seed), state)
        assert info.calls == 1
        np.testing.assert_array_equal(info.verdicts, [Verdict.ACCEPT, -1, -1])
        assert info.dist.centre == before.centre
        assert info.dist.radius == state.dist.radius == dict.fromkeys(TRUTH, jnp.float32(0.2))
        # The paper's rule: half of a radius of 0.2 for a vote of one.
        np.testing.assert_allclose(state.dist.centre["friction"], 0.1 * (seed + 1), rtol=1e-5)
        np.testing.assert_allclose(state.dist.centre["mass"], -0.1 * (seed + 1), rtol=1e-5)
    assert state.policy["rounds"] == 3


def test_spm_is_the_same_tuner_with_two_functions_swapped(tuner, spm):
    assert dataclasses.replace(spm, config=tuner.config, verify=calibrated_gate, update=posterior_update) == tuner
    # The paper's steps are meant for one set each.
    assert spm.config == dataclasses.replace(tuner.config, refinements=0)


def test_open_gate_needs_a_step_to_read(spm):
    measured = spm.measure(jax.random.key(0), toys.policy())
    gate = baselines.open_gate(None, toys.TINY, None, measured, knobs())
    assert gate.novelty <= gate.threshold
    empty = measured.replace(alive=jnp.zeros_like(measured.alive))
    assert np.isnan(baselines.open_gate(None, toys.TINY, None, empty, knobs()).novelty)
    # A number that is not finite would move the centre to nowhere; after an end it is not read.
    broken = measured.replace(obs=measured.obs.at[0, 40, 0].set(jnp.nan))
    assert np.isnan(baselines.open_gate(None, toys.TINY, None, broken, knobs()).novelty)
    ended = broken.replace(alive=broken.alive.at[0, 40:].set(False))
    assert baselines.open_gate(None, toys.TINY, None, ended, knobs()).novelty == 0.0


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


def test_what_tests_nothing_is_explained_in_a_sentence(tuner):
    untuned = baselines.Untuned(tuner=tuner)
    _, info = untuned.tune(jax.random.key(0), start(untuned))
    assert explain(info) == "Nothing was tested: the distribution stays as it is."
