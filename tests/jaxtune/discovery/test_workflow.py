"""Discovery on a slider whose truth is known."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from slider import AXES, HYPOTHESES, WILD, problem

from jaxtune.discovery import noise_floor, state, step, workflow
from jaxtune.discovery.compete import Contest
from jaxtune.discovery.result import Settings


def discover(truth, seed=0, **kwargs):
    return workflow.discover(problem(truth, seed, **kwargs))


def measured_floor(asked):
    return noise_floor.measure(asked, None, lambda text: None)


def test_hidden_friction_is_named_with_its_size():
    result = discover({"coulomb": 0.5, "mass": 0.08, "damping": -0.1})
    assert result.verdict == "named"
    assert [term.hypothesis.name for term in result.terms] == ["coulomb"]
    axis = AXES.index("coulomb")
    error = result.errors[-1]
    assert abs(result.fit.vector[axis] - 0.5) < max(4 * error, 0.02)
    assert error < 0.05
    # Nominal parameters were found beside it: a tenth of a prior deviation is 0.01.
    assert result.fit.vector[0] == pytest.approx(0.08, abs=0.03)
    assert result.gap["after"] < 1.3 < result.gap["null"] < result.gap["before"]


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_named_where_nothing_is_hidden(seed):
    truth = dict(zip(("mass", "damping"), 0.1 * np.random.default_rng(seed).uniform(-1, 1, 2), strict=True))
    result = discover(truth, seed + 1)
    assert result.verdict == "no_missing_effect"
    assert not result.terms
    assert not result.changed


def test_a_parameter_far_from_its_prior_is_a_change_and_not_an_effect():
    result = discover({"damping": 1.5})
    assert result.verdict == "parameter_change"
    assert {term.hypothesis.name for term in result.terms} | {AXES[axis] for axis in result.changed} == {"damping"}
    assert result.fit.vector[AXES.index("damping")] == pytest.approx(1.5, abs=0.1)


def test_two_effects_are_named_one_after_the_other():
    result = discover({"coulomb": 1.2, "push": 1.2})
    assert {term.hypothesis.name for term in result.terms} == {"coulomb", "push"}
    assert result.proof["others"]["without push@slider"] > result.gap["after"] + 1.0
    assert result.proof["others"]["without coulomb@slider"] > result.gap["after"] + 1.0


def test_what_no_hypothesis_explains_is_unnamed():
    result = discover({"cubic": 12.0})
    assert result.verdict == "unnamed"
    assert not result.changed
    assert result.where[0]["excess_floor_units"] > 1.0


def test_two_that_do_not_pay_alone_are_tried_together(monkeypatch):
    accept = step.accept

    def pairs_alone(settings, problem, floor, before, contest):
        return accept(settings, problem, floor, before, contest) if contest.hypotheses[0].parts else (before, ())

    monkeypatch.setattr(step, "accept", pairs_alone)
    result = discover({"coulomb": 0.5, "push": 0.6})
    assert {term.hypothesis.name for term in result.terms} == {"coulomb", "push"}
    assert result.verdict == "named"
    vector = result.fit.vector
    assert vector[AXES.index("coulomb")] == pytest.approx(0.5, abs=0.05)
    assert vector[AXES.index("push")] == pytest.approx(0.6, abs=0.05)
    assert result.gap["after"] < 1.3 < result.gap["null"]
    # Where nothing is missing none are tried.
    monkeypatch.setattr(step, "starts_of_pairs", None)
    assert discover({}).verdict == "no_missing_effect"


def test_what_does_not_move_the_signals_is_not_testable():
    result = discover({"coulomb": 0.5})
    assert result.not_testable == ("nothing",)


def test_a_hypothesis_that_breaks_the_simulation_is_marked_and_the_rest_go_on(monkeypatch):
    # Its slopes are not finite, so no screen would choose it: it is put on the list by hand.
    asked = problem({"coulomb": 0.5}, hypotheses=(*HYPOTHESES, WILD))
    monkeypatch.setattr(step, "candidates", lambda *args: [HYPOTHESES[2], WILD])
    found, info = step.step(Settings(), asked, floor := measured_floor(asked), state.begin(asked, floor, None))
    assert info.accepted
    assert found.terms[0].hypothesis.name == "coulomb"
    assert found.not_finite == ("wild@slider",)


def test_a_run_that_was_cut_goes_on_from_the_last_accepted_effect():
    truth = {"coulomb": 0.6, "push": 0.8}
    saved = []
    result = workflow.discover(problem(truth), save=lambda state: saved.append(json.loads(json.dumps(state))))
    assert len(saved) == 2
    said = []
    resumed = workflow.discover(problem(truth), saved=saved[0], say=said.append)
    assert [term.hypothesis.key for term in resumed.terms] == [term.hypothesis.key for term in result.terms]
    assert resumed.terms[0].evidence == result.terms[0].evidence
    np.testing.assert_allclose(resumed.fit.vector, result.fit.vector, atol=1e-5)
    assert resumed.gap == pytest.approx(result.gap, rel=1e-4)
    assert resumed.proof["others"] == pytest.approx(result.proof["others"], rel=1e-3)
    assert resumed.not_testable == result.not_testable
    # The first effect was not decided upon again.
    assert [text.split()[:2] for text in said if "Evidence" in text] == [[result.terms[1].hypothesis.key, "accepted:"]]


@pytest.mark.parametrize(("at_floor", "screens"), [(1.5, 1), (0.0, 2)])
def test_at_the_floor_nobody_looks_for_more(monkeypatch, at_floor, screens):
    looked, screen = [], step.screen
    monkeypatch.setattr(step, "screen", lambda *args: looked.append(1) or screen(*args))
    result = workflow.discover(problem({"coulomb": 0.5}), Settings(at_floor=at_floor))
    assert [term.hypothesis.name for term in result.terms] == ["coulomb"]
    assert len(looked) == screens


def test_what_promises_too_little_is_not_fitted(monkeypatch):
    begun = {}

    def compete(settings, problem, floor, bases, starts):
        begun.update({start.hypothesis.key: None for start in starts})
        return Contest((), {}, ())

    def tried(promising):
        """Hypotheses that are fitted, and what they promise as shares of what chance gains."""
        begun.clear()
        asked = problem({"coulomb": 0.5})
        floor = measured_floor(asked)
        found, _ = step.step(Settings(promising=promising), asked, floor, state.begin(asked, floor, None))
        return {key: found.promise[key] / found.least_gain for key in begun}

    monkeypatch.setattr(step, "compete", compete)
    everything = tried(0.0)
    best = max(everything, key=everything.get)
    assert best == "coulomb@slider"
    assert len(everything) > 1
    assert set(tried(0.9 * everything[best])) == {h for h in everything if everything[h] > 0.9 * everything[best]}
    assert not tried(1.1 * everything[best])


def test_a_step_changes_nothing_that_it_is_given():
    asked = problem({"coulomb": 0.6, "push": 0.8})
    floor = measured_floor(asked)
    before = state.begin(asked, floor, None)
    arrays = lambda: pickle.dumps([(at.scale, at.slopes, at.null_fits) for at in floor.values()])  # noqa: E731
    kept = pickle.dumps(before), arrays()
    first, info = step.step(Settings(), asked, floor, before)
    assert info.accepted
    assert (pickle.dumps(before), arrays()) == kept
    # The same step from the same state is the same step.
    again, _ = step.step(Settings(), asked, floor, before)
    assert state.to_json(asked, again) == state.to_json(asked, first)


def test_a_saved_state_is_the_state_that_was_saved():
    asked = problem({"coulomb": 0.6, "push": 0.8})
    floor = measured_floor(asked)
    found, _ = step.step(Settings(), asked, floor, state.begin(asked, floor, None))
    saved = json.loads(json.dumps(state.to_json(asked, found)))
    loaded = state.from_json(asked, floor, saved)
    assert json.loads(json.dumps(state.to_json(asked, loaded))) == saved
    assert loaded.terms == found.terms
    assert loaded.screened
    for horizon, fit in found.fits.items():
        np.testing.assert_allclose(loaded.fits[horizon].residual, fit.residual, atol=1e-3)


def test_what_null_logs_taught_serves_other_logs_of_the_same_motion():
    calibration = workflow.calibrate(problem({}))
    asked = problem({"coulomb": 0.5})
    with_null_logs = workflow.discover(asked)
    result = workflow.discover(replace(asked, null_logs=()), calibration=calibration)
    assert [term.hypothesis.name for term in result.terms] == ["coulomb"]
    np.testing.assert_allclose(result.fit.vector, with_null_logs.fit.vector, atol=1e-6)
    assert result.gap == pytest.approx(with_null_logs.gap)
    assert result.terms[0].thresholds.gain == calibration.gain
