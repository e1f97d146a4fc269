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


def test_what_is_taken_back_costs_what_the_others_cannot_answer():
    rng = np.random.default_rng(3)
    slope, point = rng.normal(size=(40, 4)), np.array([0.5, -1.0, 2.0, 0.3])
    # The third column is the sum of the first two, so those can stand in for it; and nobody can for the last.
    slope[:, 2] = slope[:, 0] + slope[:, 1]
    problem = linear(slope, rng.normal(size=40), offset=point)
    best = problem.residual + slope @ np.linalg.lstsq(slope, -problem.residual, rcond=None)[0]
    problem = linear(slope, best, offset=point)
    third, last = (np.arange(4) == index for index in (2, 3))
    lost = problem.without([third, last, ~last], np.ones(4, bool))
    assert lost[0] == pytest.approx(0.0, abs=1e-6)
    moved = best - 0.3 * slope[:, 3]
    left = moved + slope[:, :2] @ np.linalg.lstsq(slope[:, :2], -moved, rcond=None)[0]
    assert lost[1] == pytest.approx((left**2).sum() - (best**2).sum(), rel=1e-5)
    # What may not answer stays where it is.
    moved = best - slope[:, :3] @ point[:3]
    assert problem.without([~last], np.zeros(4, bool))[0] == pytest.approx((moved**2).sum() - (best**2).sum(), rel=1e-5)


COUNTS = Counts(components=2, bins=10, independent=0.5)


def direct(mean_squares, variance):
    """The cost of one component, for 5 independent rows and 4 degrees of freedom."""
    return (5 * np.log(variance) + 9 * np.log(1 + 5 * mean_squares / (4 * variance))).sum()


@pytest.mark.parametrize("scale", [0.3, 5.0, 300.0])
def test_the_cost_is_at_the_likeliest_variance_and_never_below_the_floor(scale):
    mean_squares = scale * np.random.default_rng(0).exponential(1.0, (50, 2))
    variances = np.geomspace(1.0, 1e4, 4001)
    least = [min(direct(column, variance) for variance in variances) for column in mean_squares.T]
    of_segments = COUNTS.cost(mean_squares)
    assert of_segments.shape == (50,)
    assert of_segments.sum() == pytest.approx(sum(least), rel=1e-4)


def test_a_segment_that_nothing_explains_counts_by_its_logarithm():
    mean_squares = np.ones((50, 2))
    costs = []
    for outlier in (1e2, 1e3, 1e4):
        mean_squares[7, 0] = outlier
        costs.append(COUNTS.cost(mean_squares).sum())
        # The others hardly notice.
        np.testing.assert_allclose(COUNTS.cost(mean_squares)[8], COUNTS.cost(np.ones((50, 2)))[8], rtol=0.1)
    assert np.diff(costs) == pytest.approx(9 * np.log(10), rel=0.05)


def test_weights_are_the_slope_of_the_cost():
    rng = np.random.default_rng(1)
    residual = 3.0 * rng.normal(size=(6, 10, 2)) * rng.uniform(0.2, 3.0, (6, 1, 2))
    weights = COUNTS.weights(residual.ravel()).reshape(residual.shape)
    for segment, part in ((0, 0), (3, 1), (5, 0)):
        moved = [residual.copy(), residual.copy()]
        for sign, one in zip((-1, 1), moved, strict=True):
            one[segment, :, part] *= 1 + sign * 1e-4
        costs = [COUNTS.cost(COUNTS.mean_squares(one.ravel())).sum() for one in moved]
        # d C / d r = 2 w r, so that scaling r changes C by 2 w r^2.
        slope = 2 * (weights * residual**2)[segment, :, part].sum()
        assert (costs[1] - costs[0]) / 2e-4 == pytest.approx(slope, rel=1e-3)


def test_costs_of_many_models_are_those_of_each_alone():
    residual = np.random.default_rng(0).normal(size=(3, 6 * COUNTS.bins * COUNTS.components)) * [[0.5], [2.0], [9.0]]
    together = COUNTS.cost(COUNTS.mean_squares(residual))
    alone = [COUNTS.cost(COUNTS.mean_squares(one)) for one in residual]
    np.testing.assert_allclose(together, alone, rtol=1e-3)


def test_a_rare_segment_is_left_out_of_the_usual_and_a_common_one_is_not():
    # 100 segments of two components, a mean square of 1 each: the worst 2 are left out, in every component its own.
    mean_squares = np.ones((100, 2))
    mean_squares[[3, 50], 0] = 400.0
    mean_squares[[7, 8, 9], 1] = 99.0
    np.testing.assert_allclose(Counts.usual(mean_squares), [1.0, (97 * 1.0 + 99.0) / 98])
    mean_squares[11, 1] = np.inf
    np.testing.assert_array_equal(np.isnan(Counts.usual(mean_squares)), [False, True])
    # Of few segments each counts.
    np.testing.assert_allclose(Counts.usual(np.array([[1.0], [4.0]])), [2.5])
