"""What the prior says against coordinates: a Gaussian for nominal parameters, a heavy tail for sizes of effects."""

from dataclasses import replace

import numpy as np
import pytest

from jaxtune.discovery.fit import Fit, Free, refine, taken_over
from jaxtune.discovery.least_squares import Counts
from jaxtune.discovery.problem import Hypothesis

NOISE = np.random.default_rng(1).standard_normal(200)
SLOPE = 3.0 * np.random.default_rng(2).standard_normal(200)


def free(sd, nominal):
    count = len(sd)
    return Free(np.eye(count), np.array(sd), np.tile([-50.0, 50.0], (count, 1)), np.array(nominal))


@pytest.mark.parametrize("seed", range(5))
def test_the_gaussian_in_its_place_touches_the_prior_and_is_nowhere_below(seed):
    rng = np.random.default_rng(seed)
    here, others = rng.normal(0, 5, 3), rng.normal(0, 5, (1000, 3))
    prior = free([0.1, 1.0, 2.0], [False, False, True])
    stand_in = lambda there: prior.penalty(here) + ((there**2 - here**2) / prior.deviations(here) ** 2).sum()  # noqa: E731
    assert all(prior.penalty(there) <= stand_in(there) + 1e-9 for there in others)
    near = here + 1e-6 * rng.normal(size=3)
    assert prior.penalty(near) - prior.penalty(here) == pytest.approx(stand_in(near) - prior.penalty(here), rel=1e-3)


def fitted(sd, nominal):
    """One coordinate, which is one, from 200 residuals."""

    def evaluate(vectors):
        return NOISE + (vectors - 1.0) @ SLOPE[None]

    counts = Counts(components=1, bins=10, independent=1.0)
    residual = evaluate(np.zeros((1, 1)))[0]
    (fit,) = refine([Fit(free([sd], [nominal]), np.zeros(1), residual, SLOPE[:, None], counts)], evaluate, 20)
    return fit


def test_an_effect_of_ten_deviations_costs_no_more_than_what_ten_sizes_are_worth():
    believed, far = fitted(10.0, False), fitted(0.1, False)
    assert far.coordinates[0] == pytest.approx(1.0, abs=0.1)
    assert 0.0 < far.cost - believed.cost < np.log(150.0)


def test_a_nominal_parameter_of_ten_deviations_is_held_back():
    assert fitted(0.1, True).cost > fitted(10.0, True).cost + 50.0


def test_a_hypothesis_takes_over_what_is_free_along_its_own_axes_alone():
    # Four axes: three of one link's centre of mass, one of another parameter.
    directions = np.array([[0.6, 0.8, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.5, 0.0, 0.0, 0.5]])
    known = Free(directions, np.ones(4), np.tile([-3.0, 3.0], (4, 1)), np.array([True, True, True, True]))
    centre = Hypothesis(
        name="com_offset",
        family="inertia",
        places=("link",),
        directions=np.eye(3, 4),
        probes=np.eye(3),
        bounds=np.tile([-1.0, 1.0], (3, 1)),
        prior=np.ones(3),
        joints=(0,),
    )
    np.testing.assert_array_equal(taken_over(known, centre), [True, True, False, False])
    # What another effect moves is not free under every hypothesis.
    tried = replace(known, nominal=np.array([False, True, True, True]))
    np.testing.assert_array_equal(taken_over(tried, centre), [False, True, False, False])
