"""The best step within bounds, against what can be found by hand and by trying."""

import numpy as np
import pytest

from jaxtune.discovery.least_squares import Counts, Linear


def linear(slope, value, offset=None):
    count = slope.shape[1]
    return Linear(value, slope, np.zeros(count) if offset is None else offset, np.full(count, 1e6), np.ones(len(value)))


def test_what_meets_a_bound_takes_the_others_along():
    # The columns are nearly alike: freely (-5, 6); with x >= 0 the other makes it alone, y = 1.05 (6 - 0.99 * 5).
    root = np.linalg.cholesky(np.array([[1.0, 0.99], [0.99, 1.0]])).T
    problem = linear(root, -root @ np.array([-5.0, 6.0]))
    np.testing.assert_allclose(problem.step(), [-5.0, 6.0], rtol=1e-5)
    bounds = np.array([[0.0, 100.0], [-100.0, 5.0]])
    np.testing.assert_allclose(problem.step(bounds=bounds), [0.0, 1.05], atol=1e-5)


def test_bounds_are_of_the_point_and_not_of_the_step():
    problem = linear(np.eye(2), np.array([-3.0, 1.0]), offset=np.array([1.0, 1.0]))
    np.testing.assert_allclose(problem.step(bounds=np.array([[-9.0, 2.0], [-9.0, 9.0]])), [1.0, -1.0], atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_no_other_step_within_bounds_is_better(seed):
    rng = np.random.default_rng(seed)
    problem = linear(rng.normal(size=(30, 4)) * [1.0, 10.0, 0.1, 1.0], rng.normal(size=30))
    bounds = np.sort(rng.normal(0, 0.1, (4, 2)), axis=1)
    loss = lambda step: np.sum((problem.residual + problem.jacobian @ step) ** 2)  # noqa: E731
    found = problem.step(bounds=bounds)
    assert ((bounds[:, 0] - 1e-9 <= found) & (found <= bounds[:, 1] + 1e-9)).all()
    others = rng.uniform(*bounds.T, (5000, 4))
    assert loss(found) <= min(map(loss, others)) + 1e-9


def test_the_cost_is_that_of_the_floor_below_it_and_logarithmic_above():
    counts = Counts(components=2, independent=0.5, systematic=0.1)
    # 10 rows; mean squares 0.6 and e^2: 10 (0.5 * 0.6 + 0.5 + 0.1 * 2).
    assert counts.cost(np.array([0.6, np.e**2]), 10) == pytest.approx(10.0)
    residual = np.tile([0.5, 3.0], 10)
    np.testing.assert_allclose(counts.mean_squares(residual), [0.25, 9.0])
    # What is nine times the floor weighs a ninth of the systematic share.
    np.testing.assert_allclose(counts.weights(residual).reshape(10, 2), np.tile([0.5, 0.1 / 9.0], (10, 1)))
