"""The screen finds effects at about their size, and pairs of which neither shows alone."""

from dataclasses import replace

import numpy as np
import pytest
from slider import AXES, EACH, HELD, HYPOTHESES, ONE_SIZE, WARPED, problem

from jaxtune.discovery import fit, noise_floor, state
from jaxtune.discovery.curves import groups_of, simulate_library
from jaxtune.discovery.fit import Fit, Free
from jaxtune.discovery.least_squares import Counts
from jaxtune.discovery.profile import Changes, profile_of
from jaxtune.discovery.screen import _smallest, promising, screen


def screened(truth, pairs=0, forms=(), unknowns=None, hypotheses=HYPOTHESES, rubs=0.0):
    asked = problem(truth, forms=forms, hypotheses=hypotheses, rubs=rubs)
    if unknowns is not None:
        asked = replace(asked, unknowns=unknowns, unknown_bounds=np.tile([0.0, 2.0], (len(unknowns), 1)))
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    at = floor[asked.main_horizon]
    return screen(at, begun.nominal, groups_of(hypotheses, forms), price=10.0, pairs=pairs, say=lambda text: None)


def test_the_best_lead_is_what_is_hidden_at_about_its_size():
    found = screened({"coulomb": 0.6, "mass": 0.08, "damping": -0.1})
    lead = found.leads[0]
    assert [hypothesis.name for hypothesis in lead.hypotheses] == ["coulomb"]
    assert lead.point[0] == pytest.approx(0.6, rel=0.4)
    # The nominal parameters answer it near where they are: a tenth is one prior deviation.
    np.testing.assert_allclose(lead.start, [0.8, -1.0], atol=0.8)
    assert lead.cost < found.cost


def test_an_effect_that_shows_in_one_form_alone_is_screened_in_that_form():
    truth = {"coulomb": 0.6, "held": 0.5}
    lead = screened(truth, forms=(HELD,)).leads[0]
    assert [one.key for one in lead.hypotheses] == ["coulomb@slider", "coulomb(held)@slider"]
    np.testing.assert_allclose(lead.point, [0.6, 0.5], rtol=0.4)
    unseen = screened(truth, forms=(replace(HELD, screened=False),))
    assert unseen.leads[0].hypotheses[0].name != "coulomb"
    assert unseen.leads[0].cost > lead.cost + 50.0
    # In its first form it is a lead without the other one.
    assert len(screened({"coulomb": 0.6}, forms=(HELD,)).leads[0].hypotheses) == 1


def test_a_form_that_shows_beside_another_alone_is_screened_beside_it():
    truth, held = {"coulomb": 0.6, "held": 0.5, "cubic": 3.0}, replace(HELD, screened=False)
    found = screened(truth, forms=(held, replace(WARPED, beside="held")))
    lead = found.leads[0]
    assert [one.key for one in lead.hypotheses] == ["coulomb@slider", "coulomb(warped)@slider", "coulomb(held)@slider"]
    # The form has its smallest size, and the other one that which may be expected.
    np.testing.assert_allclose(lead.point, [0.6, WARPED.probes[0, 0], held.prior[0]], rtol=0.4)
    unseen = screened(truth, forms=(held, WARPED))
    assert unseen.leads[0].cost > lead.cost + 50.0


def test_sizes_of_their_own_are_screened_in_a_form_too():
    # Damping, which nothing holds, and friction.
    rows = np.concatenate([HYPOTHESES[1].directions, HYPOTHESES[2].directions])
    bounds = np.concatenate([HYPOTHESES[1].bounds, HYPOTHESES[2].bounds])
    each = replace(EACH, directions=rows, bounds=bounds)
    one_size = replace(ONE_SIZE, directions=rows.sum(axis=0, keepdims=True), bounds=bounds[1:])
    held = replace(HELD, name="both", places=EACH.places, directions=HELD.directions + HYPOTHESES[4].directions)
    truth = {"damping": 1.0, "coulomb": 0.6, "held": 0.5}
    # A form also holds the friction that the nominal model has.
    for rubs in (0.0, 0.4):
        lead = screened(truth, forms=(held,), hypotheses=(one_size, each), rubs=rubs).leads[0]
        assert [one.key for one in lead.hypotheses] == ["both@one&two", "both(held)@one+two"]
        np.testing.assert_allclose(lead.point, [1.0, 0.6, 0.5], rtol=0.4)


def test_a_form_that_is_free_anyway_is_where_a_lead_begins():
    lead = screened({"coulomb": 0.6, "held": 0.5}, forms=(HELD,), unknowns=0.25 * HELD.directions).leads[0]
    assert [one.key for one in lead.hypotheses] == ["coulomb@slider"]
    assert lead.point == pytest.approx([0.6], rel=0.4)
    assert lead.start[-1] == pytest.approx(2.0, abs=0.5)


def test_two_that_hide_each_other_are_found_as_a_pair():
    found = screened({"coulomb": 0.8, "push": 0.8}, pairs=2)
    assert {hypothesis.name for hypothesis in found.pairs[0].hypotheses} == {"coulomb", "push"}
    assert found.pairs[0].cost < found.leads[0].cost


def test_the_changes_of_the_nominal_model_find_what_to_screen_beside_another_model():
    asked = problem({"coulomb": 0.8, "push": 0.8})
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    at, (coulomb,) = floor[asked.main_horizon], [h for h in HYPOTHESES if h.name == "coulomb"]
    base = fit.begin(begun.nominal, [(coulomb,)], [np.array([0.8])], [begun.nominal.coordinates], at.residuals["train"])
    library = simulate_library(at, begun.nominal, groups_of(HYPOTHESES, ()), lambda text: None)
    others = groups_of([h for h in HYPOTHESES if h is not coulomb], ())
    assert [h.name for h in promising(at, base[0], others, library, 10.0, 1)] == ["push"]
    assert len(promising(at, base[0], others, library, 10.0, 3)) == 3


EVEN = np.ones((1, 2))


def fit_of(rng, count=3, rows=60, parts=2):
    free = Free(np.eye(count), np.ones(count), np.tile([-3.0, 3.0], (count, 1)), np.ones(count, bool))
    counts = Counts(components=parts, bins=rows, independent=0.5)
    jacobian = rng.normal(size=(rows * parts, count))
    return Fit(free, 0.1 * rng.normal(size=count), rng.normal(size=rows * parts), jacobian, counts)


@pytest.mark.parametrize("seed", range(4))
def test_a_profile_is_no_dearer_than_any_answer_within_bounds(seed):
    rng = np.random.default_rng(seed)
    fit = fit_of(rng)
    change = 3.0 * rng.normal(size=(1, len(fit.residual)))
    (cost,), (at,) = profile_of(fit, change, EVEN).costs(Changes(np.arange(1), np.ones((1, 1))))

    def cost_at(coordinates):
        residual = fit.residual + change[0] + fit.jacobian @ (coordinates - fit.coordinates)
        return fit.counts.cost(fit.counts.mean_squares(residual)).sum() + (coordinates**2).sum()

    assert cost == pytest.approx(cost_at(at), rel=1e-4)
    assert cost <= min(cost_at(at + 0.3 * rng.normal(size=3)) for _ in range(200)) + 1e-3


def test_few_segments_do_not_move_a_parameter_but_count_where_a_change_explains_them():
    rng = np.random.default_rng(0)
    slope = rng.normal(size=(20, 30, 1))
    bump = np.zeros((20, 30, 1))
    bump[:2] = 40.0 * (slope[:2] + rng.normal(size=(2, 30, 1)))
    free = Free(np.eye(1), np.full(1, 10.0), np.array([[-50.0, 50]]), np.ones(1, bool))
    counts = Counts(components=1, bins=30, independent=0.3)
    residual = (rng.normal(size=(20, 30, 1)) + slope + bump).ravel()
    fit = Fit(free, np.zeros(1), residual, slope.reshape(-1, 1), counts)
    profile = profile_of(fit, -bump.reshape(1, -1), counts.shares(residual))
    (without, explained), at = profile.costs(Changes(np.arange(1), np.array([[0.0], [1.0]])))
    even = profile_of(fit, -bump.reshape(1, -1), np.ones((20, 1)))
    # The parameter is 1 off. The two segments that lack the bump would move it to -5.
    np.testing.assert_allclose(at[:, 0], -1.0, atol=0.3)
    assert abs(even.costs(Changes(np.arange(1), np.zeros((1, 1))))[1][0, 0] + 1.0) > 2.0
    assert without - explained > 50.0


def test_a_moved_profile_is_the_profile_of_the_moved_model():
    rng = np.random.default_rng(0)
    fit = fit_of(rng)
    library = rng.normal(size=(3, len(fit.residual)))
    change = Changes(np.array([0, 2]), np.array([[0.5, -1.0]]))
    direction, other = Changes(np.array([1]), np.ones((1, 1))), Changes(np.array([2]), rng.normal(size=(4, 1)))
    wide = Free(np.eye(4), np.array([1.0, 1, 1, 1e6]), np.tile([-9.0, 9], (4, 1)), np.ones(4, bool))
    grown = replace(
        fit,
        free=replace(wide, bounds=np.array([[-3.0, 3]] * 3 + [[-1e9, 1e9]])),
        coordinates=np.append(fit.coordinates, 0.0),
        residual=fit.residual + 0.5 * library[0] - library[2],
        jacobian=np.column_stack([fit.jacobian, library[1]]),
    )
    found = profile_of(fit, library, EVEN).moved(change).with_directions(direction).costs(other)
    for mine, want in zip(found, profile_of(grown, library, EVEN).costs(other), strict=True):
        np.testing.assert_allclose(mine, want, rtol=1e-5, atol=1e-6)


def test_a_profile_keeps_bounds():
    fit = fit_of(np.random.default_rng(0))
    fit = replace(fit, free=replace(fit.free, sd=np.full(3, 100.0)))
    change = -50.0 * fit.jacobian[:, :1].T
    _, at = profile_of(fit, change, EVEN).costs(Changes(np.arange(1), np.ones((1, 1))))
    assert (np.abs(at) <= 3.0 + 1e-6).all()
    assert at[0, 0] == pytest.approx(3.0)


def test_axes_are_named_as_the_toy_names_them():
    assert [hypothesis.name for hypothesis in HYPOTHESES] == list(AXES[:5])


def test_an_effect_is_looked_for_at_its_smallest_size_of_interest():
    # A tiny loss, which is all that the model can lose, is no size of interest; of x, y and z any may show.
    assert _smallest(np.array([[-0.002], [0.03], [0.3]]), np.ones(3, bool)) == [1]
    assert _smallest(0.1 * np.concatenate([np.eye(3), -np.eye(3), 2 * np.eye(3)]), np.ones(9, bool)) == [0, 1, 2]
    # What can only be lost.
    assert _smallest(np.array([[-0.3], [-0.1]]), np.ones(2, bool)) == [1]
    # A torque limit beyond the declared one changes nothing.
    assert _smallest(np.array([[0.15], [0.5], [1.0]]), np.array([False, True, True])) == [1]
    assert _smallest(np.array([[0.15], [0.5]]), np.zeros(2, bool)) == [0]
