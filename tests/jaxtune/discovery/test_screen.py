"""The screen finds effects at about their size, and pairs of which neither shows alone."""

from dataclasses import replace

import numpy as np
import pytest
from slider import AXES, HYPOTHESES, problem

from jaxtune.discovery import fit, noise_floor, state
from jaxtune.discovery.fit import Fit, Free
from jaxtune.discovery.least_squares import Counts
from jaxtune.discovery.profile import Changes, profile_of
from jaxtune.discovery.screen import promising, screen, simulate_library


def screened(truth, pairs=0):
    asked = problem(truth)
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    at = floor[asked.main_horizon]
    return screen(at, begun.nominal, HYPOTHESES, pairs=pairs, say=lambda text: None)


def test_the_best_lead_is_what_is_hidden_at_about_its_size():
    found = screened({"coulomb": 0.6, "mass": 0.08, "damping": -0.1})
    lead = found.leads[0]
    assert [hypothesis.name for hypothesis in lead.hypotheses] == ["coulomb"]
    assert lead.point[0] == pytest.approx(0.6, rel=0.4)
    # The nominal parameters answer it near where they are: a tenth is one prior deviation.
    np.testing.assert_allclose(lead.start, [0.8, -1.0], atol=0.8)
    assert lead.cost < found.cost


def test_two_that_hide_each_other_are_found_as_a_pair():
    found = screened({"coulomb": 0.8, "push": 0.8}, pairs=2)
    assert {hypothesis.name for hypothesis in found.pairs[0].hypotheses} == {"coulomb", "push"}
    assert found.pairs[0].cost < found.leads[0].cost


def test_the_changes_of_the_nominal_model_find_what_to_screen_beside_another_model():
    asked = problem({"coulomb": 0.8, "push": 0.8})
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    at, (coulomb,) = floor[asked.main_horizon], [h for h in HYPOTHESES if h.name == "coulomb"]
    base = fit.begin(begun.nominal, [(coulomb,)], [np.array([0.8])], [begun.nominal.coordinates], at.residuals["train"])
    library = simulate_library(at, begun.nominal, HYPOTHESES, lambda text: None)
    others = [h for h in HYPOTHESES if h is not coulomb]
    assert [h.name for h in promising(at, base[0], others, library, 1)] == ["push"]
    assert len(promising(at, base[0], others, library, 3)) == 3


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
    (cost,), (at,) = profile_of(fit, change).costs(Changes(np.arange(1), np.ones((1, 1))))

    def cost_at(coordinates):
        residual = fit.residual + change[0] + fit.jacobian @ (coordinates - fit.coordinates)
        rows = len(residual) // fit.counts.components
        mean_squares = (residual.reshape(rows, -1) ** 2).mean(axis=0)
        return fit.counts.pooled_cost(mean_squares, rows) + (coordinates**2).sum()

    assert cost == pytest.approx(cost_at(at), rel=1e-4)
    assert cost <= min(cost_at(at + 0.3 * rng.normal(size=3)) for _ in range(200)) + 1e-3


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
    found = profile_of(fit, library).moved(change).with_directions(direction).costs(other)
    for mine, want in zip(found, profile_of(grown, library).costs(other), strict=True):
        np.testing.assert_allclose(mine, want, rtol=1e-5, atol=1e-6)


def test_a_profile_keeps_bounds():
    fit = fit_of(np.random.default_rng(0))
    fit = replace(fit, free=replace(fit.free, sd=np.full(3, 100.0)))
    change = -50.0 * fit.jacobian[:, :1].T
    _, at = profile_of(fit, change).costs(Changes(np.arange(1), np.ones((1, 1))))
    assert (np.abs(at) <= 3.0 + 1e-6).all()
    assert at[0, 0] == pytest.approx(3.0)


def test_axes_are_named_as_the_toy_names_them():
    assert [hypothesis.name for hypothesis in HYPOTHESES] == list(AXES[:5])
