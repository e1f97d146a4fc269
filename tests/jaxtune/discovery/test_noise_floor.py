"""The floor is what null logs leave once they are fitted, not what a fit that stopped short leaves."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import slider as toy

from jaxtune.discovery.noise_floor import _sound, measure


def floor_of(draws, monkeypatch):
    """Mean floor [components] with null logs of these nominal parameters, in prior standard deviations."""
    monkeypatch.setattr(toy, "DRAWS", draws)
    problem = toy.problem({})
    found = measure(problem, lambda text: None)[problem.main_horizon]
    assert len(found.null_residuals) == len(draws)
    return found.scale["train"].mean(axis=0), found


def test_parameters_a_fifth_off_do_not_raise_the_floor(monkeypatch):
    monkeypatch.setattr(toy, "NOISE", 2e-4)
    still, _ = floor_of(np.zeros((12, 2)), monkeypatch)
    moved, found = floor_of(np.random.default_rng(1).choice([-2.0, 2.0], (12, 2)), monkeypatch)
    # One step leaves five to forty times that here.
    np.testing.assert_allclose(moved, still, rtol=0.05)
    for log in found.null_residuals:
        # Of residuals in floor units, all of one size.
        assert np.mean(log**2) == pytest.approx(1.0, abs=0.25)


def test_fits_to_null_logs_find_what_was_drawn(monkeypatch):
    draws = np.random.default_rng(2).uniform(-1.5, 1.5, (6, 2))
    _, found = floor_of(draws, monkeypatch)
    np.testing.assert_allclose(found.null_coordinates, draws, atol=0.3)


def spoilt(problem, logs):
    """A problem of which some null logs hold a number in train that no simulation can be compared with."""
    every = [dict(log) for log in problem.null_logs]
    for number in logs:
        segments = every[number]["train"][problem.main_horizon]
        signals = {name: values.copy() for name, values in segments.signals.items()}
        next(iter(signals.values()))[3, 0, 0] = np.inf
        every[number]["train"] = {**every[number]["train"], problem.main_horizon: replace(segments, signals=signals)}
    return replace(problem, null_logs=every)


def test_a_null_log_that_breaks_decides_nothing():
    problem = toy.problem({})
    at = problem.main_horizon
    whole = measure(problem, lambda text: None)[at]
    found = measure(spoilt(problem, [1]), lambda text: None)[at]
    count = len(whole.null_residuals)
    assert len(found.null_residuals) == len(found.null_coordinates) == count - 1
    np.testing.assert_allclose(found.scale["train"].mean(axis=0), whole.scale["train"].mean(axis=0), rtol=0.2)
    assert np.isfinite(found.null_residuals).all()
    with pytest.raises(ValueError, match=f"null logs: got 1 of {count}"):
        measure(spoilt(problem, range(1, count)), lambda text: None)


def test_a_null_log_that_comes_apart_widens_nothing():
    problem = toy.problem({})
    at = problem.main_horizon
    whole = measure(problem, lambda text: None)[at]
    every = [dict(log) for log in problem.null_logs]
    segments = every[1]["train"][at]
    every[1]["train"] = {
        **every[1]["train"],
        at: replace(
            segments,
            signals={"q": 1e3 + segments.signals["q"]}
            | {name: values for name, values in segments.signals.items() if name != "q"},
        ),
    }
    found = measure(replace(problem, null_logs=every), lambda text: None)[at]
    assert len(found.null_residuals) == len(whole.null_residuals) - 1
    np.testing.assert_allclose(found.scale["train"].mean(axis=0), whole.scale["train"].mean(axis=0), rtol=0.2)


def test_a_null_log_in_which_a_joint_slips_counts():
    # On the robot it stuck, and in the other null logs.
    left = np.full((8, 4, 5, 2), 1e-3)
    left[3, :, :, 1] = 0.02
    assert _sound(left, np.array([0.1, 0.1])).all()
    left[3, :, :, 1] = 0.2
    np.testing.assert_array_equal(np.flatnonzero(~_sound(left, np.array([0.1, 0.1]))), [3])


def test_a_component_that_never_changes_has_the_floor_of_its_noise(monkeypatch):
    monkeypatch.setattr(toy, "NOISE", 0.0)
    monkeypatch.setattr(toy, "DRAWS", np.zeros((6, 2)))
    problem = replace(toy.problem({}), least_floor=np.array([1e-3, 2e-3]))
    floor = measure(problem, lambda text: None)[problem.main_horizon]
    np.testing.assert_allclose(floor.scale["train"], [[1e-3, 2e-3]] * len(floor.scale["train"]))


def floor_of_repeats(masses, told_alike=True):
    """Mean floor [components] where a motion of train was repeated by sliders whose masses are off by so much."""
    problem = toy.problem({})
    runs = [toy.measured({"mass": mass}, number, count=20, motion=7) for number, mass in enumerate(masses)]
    both = {}
    for horizon in toy.HORIZONS:
        one, two = (run[horizon] for run in runs)
        both[horizon] = replace(
            one,
            inputs=jax.tree.map(lambda *leaves: np.concatenate(leaves), one.inputs, two.inputs),
            signals={name: np.concatenate([one.signals[name], two.signals[name]]) for name in one.signals},
            run=np.concatenate([one.run, 100 + two.run]),
            regimes=np.concatenate([one.regimes, two.regimes]),
            repeats=np.tile(np.arange(20), 2) if told_alike else None,
        )
    found = measure(replace(problem, data={**problem.data, "train": both}), lambda text: None)
    return found[problem.main_horizon].scale["train"].mean(axis=0)


def test_what_a_robot_does_not_repeat_is_part_of_the_floor():
    alone = floor_of_repeats((0.1, 0.1), told_alike=False)
    np.testing.assert_allclose(floor_of_repeats((0.1, 0.1)), alone, rtol=0.3)
    assert (floor_of_repeats((0.4, -0.4)) > 1.5 * alone).any()
    # The floor is of the robot, whatever the model.
    np.testing.assert_allclose(floor_of_repeats((0.3, 0.3)), alone, rtol=0.3)
