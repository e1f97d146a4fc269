"""What is believed of models, and statistics of segments that go together."""

from dataclasses import replace

import numpy as np
import pytest
from slider import DRAG, HYPOTHESES, WARPED, problem

from jaxtune.discovery import noise_floor, state, step
from jaxtune.discovery.belief import believed, posterior, rivals
from jaxtune.discovery.candidate import Candidate, total_cost
from jaxtune.discovery.evidence import Evidence, Thresholds, _in_smallest, ablate, or_known, passes, weigh_evidence
from jaxtune.discovery.fit import begin, polish, without
from jaxtune.discovery.resample import correlation_length, times_drawn, units
from jaxtune.discovery.result import AcceptedTerm, Settings

GOOD = Evidence(
    gain=50.0, confirmed=20.0, floors=2.0, left=1.1, relief=0.0, interval=(0.1, 0.2), inside=True, horizons=3, size=1.0
)


@pytest.fixture(scope="module")
def stepped():
    asked = problem({"coulomb": 0.5})
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    found, _ = step.step(Settings(), asked, floor, begun)
    return asked, floor, found


@pytest.mark.parametrize(
    ("test", "change"),
    [
        ("beyond_chance", {"gain": 9.0}),
        ("confirmed", {"confirmed": -2.6}),
        ("matters", {"floors": 0.9}),
        # Much is left: another form of what is there already would do the same.
        ("matters", {"left": 4.5}),
        ("clear_of_zero", {"interval": (-0.1, 0.2)}),
        ("inside_bounds", {"inside": False}),
        ("horizons", {"horizons": 1}),
        ("of_interest", {"size": 0.09}),
    ],
)
def test_every_test_can_fail_alone(test, change):
    thresholds = Thresholds(gain=10.0)
    assert all(passes(GOOD, thresholds).values())
    failed = [name for name, passed in passes(replace(GOOD, **change), thresholds).items() if not passed]
    assert failed == [test]


def test_a_size_is_seen_in_the_smallest_of_interest(stepped):
    asked, floor, found = stepped
    (coulomb,) = found.best.effects
    evidence, _ = weigh_evidence(asked, floor, found.best, coulomb, {})
    (value,) = found.best.fit.coordinates[found.best.fit.along(coulomb)]
    assert evidence.size == pytest.approx(abs(value) / np.abs(coulomb.probes).min())
    assert evidence.size > 1.0
    # Of several the largest; one that only shapes the effect counts for nothing.
    assert _in_smallest(
        np.array([0.3, -1.0, 9.0]), np.array([[0.1, 0, 0], [-0.3, 0, 0], [0, 0.5, 0]])
    ) == pytest.approx(3.0)


def test_an_effect_that_is_free_anyway_may_be_clear_of_zero_in_its_form():
    damping = HYPOTHESES[1]
    form = replace(WARPED, name="damping")
    asked = problem({"cubic": 8.0}, forms=(form,))
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    at = floor[asked.main_horizon]
    evaluate = at.residuals["train"]
    start = [begun.nominal.coordinates]
    fits = begin(begun.nominal, [(damping, form)], [np.array([0.1, 1.0])], start, evaluate)
    (fit,) = polish(fits, evaluate, 6)
    candidate = Candidate((damping, form), fit, at.residuals["select"](fit.vector[None])[0])
    evidence, ablated = weigh_evidence(asked, floor, candidate, damping, {})
    assert ablated.hypotheses == ()
    assert evidence.gain > 100.0
    assert evidence.interval[0] > 0.0
    assert evidence.interval[0] < 8.0 < evidence.interval[1]


@pytest.mark.parametrize("alone", [True, False])
def test_an_effect_may_be_all_in_its_form(alone):
    form = replace(WARPED, name="drag", alone=alone)
    asked = problem({"cubic": 8.0}, hypotheses=(*HYPOTHESES, DRAG), forms=(form,))
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    evaluate = floor[asked.main_horizon].residuals["train"]
    points, base = [np.array([0.0, 8.0])], begun.null.fit
    (fit,) = polish(begin(base, [(DRAG, form)], points, [base.coordinates], evaluate), evaluate, 0)
    candidate = Candidate((DRAG, form), fit, floor[asked.main_horizon].residuals["select"](fit.vector[None])[0])
    evidence, _ = weigh_evidence(asked, floor, candidate, DRAG, {})
    assert evidence.inside == alone
    assert (evidence.size > 1.0) == alone


def test_a_fit_that_was_not_finished_is_no_evidence(stepped):
    asked, floor, found = stepped
    at, (mass, coulomb) = floor[asked.main_horizon], (HYPOTHESES[0], HYPOTHESES[2])
    evaluate = at.residuals["train"]
    candidates = []
    for group, point in (((coulomb, mass), [0.5, 0.02]), ((coulomb,), [0.3])):
        fits = begin(found.nominal, [group], [np.array(point)], [found.nominal.coordinates], evaluate)
        (fit,) = polish(fits, evaluate, 6 * (len(group) - 1))
        candidates.append(Candidate(group, fit, at.residuals["select"](fit.vector[None])[0]))
    both, unfinished = candidates
    fitted = {unfinished.key: unfinished}
    assert unfinished.fit.cost > both.fit.cost + 20.0
    evidence, ablated = weigh_evidence(asked, floor, both, mass, fitted)
    # The nominal mass says the same, and costs nearly as much as that of the hypothesis.
    assert abs(evidence.gain) < 2.0
    assert ablated.fit.vector[0] == pytest.approx(both.fit.vector[0], abs=0.02)
    assert or_known(ablate(at, both, mass), {unfinished.key: ablated}) is ablated


@pytest.mark.parametrize(("mass", "kept"), [(-0.2, -2.0), (0.7, 3.0)])
def test_a_nominal_parameter_stands_where_the_hypothesis_about_it_left_it(stepped, mass, kept):
    asked, floor, found = stepped
    at = floor[asked.main_horizon]
    start = [np.zeros(len(at.prior.sd))]
    (fit,) = begin(found.nominal, [(HYPOTHESES[0],)], [np.array([mass])], start, at.residuals["train"])
    # A deviation is a tenth, and three of them are the most.
    back = without(fit, HYPOTHESES[0], at.prior, at.slopes)
    np.testing.assert_allclose(back.coordinates, [kept, 0.0])
    np.testing.assert_allclose(back.vector[0], 0.1 * kept)


def test_models_that_are_equal_are_believed_alike(stepped):
    asked, floor, found = stepped
    at = floor[asked.main_horizon]
    twin = replace(found.best, hypotheses=(replace(HYPOTHESES[2], name="twin"),))
    candidates = [found.best, twin, found.null]
    probabilities = posterior(asked, at, candidates, found.price)
    np.testing.assert_allclose(probabilities, [0.5, 0.5, 0.0], atol=1e-6)
    assert {one.hypothesis.name: one.probability for one in believed(candidates, probabilities)} == {
        "coulomb": pytest.approx(0.5),
        "twin": pytest.approx(0.5),
    }
    (effect,) = found.best.hypotheses
    evidence, ablated = weigh_evidence(asked, floor, found.best, effect, {})
    term, sure = AcceptedTerm(effect, evidence, Thresholds(gain=found.price)), np.array([1.0, 0.0, 0.0])
    assert rivals(at, candidates, probabilities, found.best, term, Settings()) == ("twin",)
    # What leaves as much as the model without the effect is none, also where a form explains most of the gain.
    idle = replace(ablated, hypotheses=twin.hypotheses)
    assert rivals(at, [found.best, idle, found.null], sure, found.best, term, Settings()) == ()
    form = replace(HYPOTHESES[3], name=effect.name, form="more")
    shaped = replace(found.best, hypotheses=(effect, form))
    plain = off(at, found.best, 0, size=3.0)
    assert total_cost(at, plain, 0.0) > total_cost(at, shaped, 0.0) + 0.3 * evidence.gain
    assert rivals(at, [shaped, plain, idle, found.null], np.append(sure, 0.0), shaped, term, Settings()) == ()
    # Without the effect a segment may break.
    broken = replace(term, evidence=replace(evidence, gain=np.inf))
    assert rivals(at, [found.best, idle, found.null], sure, found.best, broken, Settings()) == ()


def test_evidence_compares_with_the_model_without_the_effect(stepped):
    asked, floor, found = stepped
    (coulomb,) = found.best.hypotheses
    evidence, ablated = weigh_evidence(asked, floor, found.best, coulomb, {})
    assert ablated.hypotheses == ()
    assert all(passes(evidence, Thresholds(gain=found.price)).values())
    low, high = evidence.interval
    assert low < 0.5 < high
    # The null that was fitted from the nominal model is the same model.
    known, _ = weigh_evidence(asked, floor, found.best, coulomb, {"null": found.null})
    assert known.gain == pytest.approx(evidence.gain, rel=0.05)


def off(at, candidate, component, segments=slice(None), size=50.0):
    """The same model, but off by `size` floor units in a component, in some segments of train and select."""
    train, select = (at.unflatten(values).copy() for values in (candidate.fit.residual, candidate.select))
    train[segments, :, component] = size
    select[segments, :, component] = size
    return replace(candidate, fit=replace(candidate.fit, residual=train.ravel()), select=select.ravel())


def test_an_effect_that_shows_in_few_motions_matters(stepped):
    asked, floor, found = stepped
    (coulomb,) = found.best.hypotheses
    at = floor[asked.main_horizon]
    # Without it six segments of train are far off, as where a motor saturates, and none of select.
    far = off(at, found.best, 0, slice(6))
    far = replace(found.best, fit=replace(found.best.fit, residual=far.fit.residual))
    evidence, _ = weigh_evidence(asked, floor, found.best, coulomb, {"null": replace(far, hypotheses=())})
    assert evidence.floors > 5.0 * evidence.left
    # One or two of a hundred are no evidence.
    few = off(at, found.best, 0, slice(1))
    few = replace(found.best, fit=replace(found.best.fit, residual=few.fit.residual))
    evidence, _ = weigh_evidence(asked, floor, found.best, coulomb, {"null": replace(few, hypotheses=())})
    assert evidence.floors < 0.5


def test_an_effect_that_shows_in_one_run_matters(stepped):
    asked, floor, found = stepped
    (coulomb,) = found.best.hypotheses
    at = floor[asked.main_horizon]
    run = asked.data["train"][at.horizon].run
    rare = np.flatnonzero(run == run[0])[:4]

    def evidence(segments):
        far = off(at, found.best, 0, segments, size=6.0)
        far = replace(found.best, hypotheses=(), fit=replace(found.best.fit, residual=far.fit.residual))
        return weigh_evidence(asked, floor, found.best, coulomb, {"null": far})[0]

    # Of all segments but a few the fall is one floor unit.
    assert evidence(rare).floors > 2.0
    assert evidence(rare[:2]).floors < 0.5


def test_what_is_left_counts_where_the_effect_helps(stepped):
    asked, floor, found = stepped
    (coulomb,) = found.best.hypotheses
    at = floor[asked.main_horizon]
    plain, ablated = weigh_evidence(asked, floor, found.best, coulomb, {})
    # The component that the effect does not help most is off by 50 floor units, with it and without it.
    before, now = (at.unflatten(np.concatenate([one.fit.residual, one.select])) ** 2 for one in (ablated, found.best))
    other = 1 - int((before.mean(axis=(0, 1)) - now.mean(axis=(0, 1))).argmax())
    evidence, _ = weigh_evidence(asked, floor, off(at, found.best, other), coulomb, {"null": off(at, ablated, other)})
    assert evidence.left == pytest.approx(plain.left, rel=0.2)
    assert evidence.left < 2.0


def test_whole_runs_are_drawn_where_there_are_enough():
    run = np.repeat(np.arange(12), 5)
    squares = np.ones((60, 1))
    assert len(set(units(run, squares, 8).tolist())) == 12
    # Else blocks of three segments or more, which stay within a run.
    blocks = units(run, squares, 2)
    assert len(set(zip(run.tolist(), blocks.tolist(), strict=True))) == len(set(blocks.tolist())) == 12


def test_blocks_stay_within_runs_of_any_number_and_length():
    run = np.repeat([0, 2, 1, 3], [9, 9, 5, 7])
    blocks = units(run, np.random.default_rng(0).normal(size=(30, 1)) ** 2, 2)
    assert all(len(np.unique(run[blocks == number])) == 1 for number in np.unique(blocks))
    assert len(np.unique(blocks)) > 4


def test_blocks_are_longer_than_the_correlation():
    rng = np.random.default_rng(0)
    run = np.zeros(400, int)
    slow = np.repeat(rng.exponential(size=(40, 1)), 10, axis=0)
    assert correlation_length(run, rng.exponential(size=(400, 1))) <= 2
    assert 5 <= correlation_length(run, slow) <= 12
    count = np.bincount(units(run, slow, 1))
    assert count.min() >= 5


def test_a_draw_stands_for_as_many_segments_as_there_are():
    unit = np.repeat(np.arange(9), [3, 3, 3, 4, 4, 3, 3, 3, 3])
    times = times_drawn(unit, draws=50, seed=1)
    np.testing.assert_allclose(times.sum(axis=1), len(unit))
    # Segments of a unit are drawn together.
    assert all((times[:, unit == number].T[0] == times[:, unit == number].T).all() for number in range(9))


def test_segments_of_a_run_must_follow_on_each_other():
    with pytest.raises(ValueError, match="apart from each other"):
        units(np.array([0, 1, 0]), np.ones((3, 1)), 1)
