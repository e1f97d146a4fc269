"""Where fits begin, and how they move."""

from dataclasses import replace

import numpy as np
import pytest
from slider import HYPOTHESES, problem

from jaxtune.discovery import noise_floor, state
from jaxtune.discovery.fit import Free, fit_at, polish, refine
from jaxtune.discovery.least_squares import Counts

ALONG, ACROSS, OTHER, NOISE = np.random.default_rng(3).standard_normal((4, 400))
LENGTH = 0.05


class Evaluate:
    """Residuals that turn with the logarithm of a length, coordinate 0, and are linear in coordinate 1.

    They are least at `LENGTH` and at 1; something across the first direction is never explained.
    """

    def __call__(self, vectors):
        turn = np.log((vectors[:, :1] + 1e-4) / (LENGTH + 1e-4))
        bent = 20.0 * (np.sin(turn) * ALONG + (1.0 - np.cos(turn)) * ACROSS)
        return NOISE - 20.0 * ACROSS + bent + 5.0 * (vectors[:, 1:] - 1.0) * OTHER

    def changes(self, bases, residuals, moves):
        return [self(base + mine) - own for base, own, mine in zip(bases, residuals, moves, strict=True)]


def test_slopes_along_a_short_length_are_taken_by_its_own_size():
    free = Free(np.eye(2), np.ones(2), np.array([[0.0, 5.0], [-3.0, 3.0]]), np.ones(2, bool))
    counts, evaluate = Counts(components=1, bins=10, independent=1.0), Evaluate()
    begun = fit_at(free, np.array([LENGTH, 0.0]), counts, evaluate)
    # By a third of a deviation, as of parameters that may have any sign, the length would be seven times as long.
    tangent = 20.0 * ALONG / (LENGTH + 1e-4)
    assert np.linalg.norm(begun.jacobian[:, 0] - tangent) < 0.3 * np.linalg.norm(tangent)
    # With that slope no step lowers the cost, and the other coordinate stays where it is, too.
    (found,) = polish([begun], evaluate, 4)
    assert abs(found.coordinates[0] - LENGTH) < 0.01
    assert found.coordinates[1] > 0.5


def test_effects_are_looked_for_where_the_null_has_the_other_unknowns():
    free = {"unknowns": 0.25 * HYPOTHESES[2].directions, "unknown_bounds": np.array([[0.0, 4.0]])}
    asked = replace(problem({"coulomb": 0.4, "mass": 0.08}), **free)
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    # Nominal parameters are those of the model, where they cannot make up for what is missing.
    np.testing.assert_array_equal(begun.nominal.coordinates[:2], 0.0)
    assert 0.25 * begun.nominal.coordinates[2] == pytest.approx(0.4, rel=0.1)
    evaluate = floor[asked.main_horizon].residuals["train"]
    np.testing.assert_allclose(begun.nominal.residual, evaluate(begun.nominal.vector[None])[0], atol=1e-5)
    assert begun.null.fit.cost < begun.nominal.cost


class Valley:
    """Residuals with a valley: 300 times steeper across it than along it. They are least at (1, -1)."""

    def __call__(self, vectors):
        across, along = vectors.sum(axis=1, keepdims=True), vectors[:, :1] - vectors[:, 1:] - 2.0
        return NOISE + 300.0 * across * ALONG + along * ACROSS

    changes = Evaluate.changes


def test_fits_do_not_creep_along_a_valley():
    free = Free(np.eye(2), np.ones(2), np.array([[-3.0, 3.0]] * 2), np.ones(2, bool))
    begun = fit_at(free, np.zeros(2), Counts(components=1, bins=10, independent=1.0), Valley())
    (found,) = refine([begun], Valley(), 4)
    np.testing.assert_allclose(found.coordinates, [1.0, -1.0], atol=0.15)


def test_slopes_do_not_bend_over_a_secant():
    class Bent:
        def __call__(self, vectors):
            return vectors @ np.ones((1, 400)) + vectors**2 @ np.ones((1, 400))

        changes = Evaluate.changes

    free = Free(np.eye(1), np.ones(1), np.array([[-3.0, 3.0]]), np.ones(1, bool))
    begun = fit_at(free, np.array([0.2]), Counts(components=1, bins=10, independent=1.0), Bent())
    np.testing.assert_allclose(begun.jacobian, 1.4, rtol=0.05)
