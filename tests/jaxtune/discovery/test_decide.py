"""Resampling, comparison and pairs, against what they must be."""

import numpy as np
import pytest
from slider import HYPOTHESES

from jaxtune.discovery import decide, resample
from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.problem import pair_of
from jaxtune.discovery.resample import blocks, standard_error

RUN = np.repeat([4, 1, 7], [10, 5, 2])


def test_blocks_follow_on_each_other_and_stay_in_their_run():
    drawn = blocks(RUN, draws=50)
    assert drawn.shape == (50, len(RUN))
    for draw in drawn:
        for start in range(0, len(RUN) - 2, 3):
            piece = draw[start : start + 3]
            assert len(set(RUN[piece])) == 1
            rows = np.flatnonzero(RUN[piece[0]] == RUN)
            # The first follows on the last.
            following = [rows[(np.searchsorted(rows, index) + 1) % len(rows)] for index in piece[:-1]]
            np.testing.assert_array_equal(piece[1:], following)
    # Every segment is drawn as often as any other: 50 x 17 draws of 17.
    counts = np.bincount(blocks(RUN, draws=4000).ravel(), minlength=len(RUN))
    np.testing.assert_allclose(counts / 4000, 1.0, atol=0.1)


def test_the_standard_error_knows_that_neighbours_go_together():
    rng = np.random.default_rng(0)
    run = np.repeat(np.arange(20), 30)
    alone = rng.standard_normal(600)
    assert standard_error(alone, blocks(run)) == pytest.approx(1 / np.sqrt(600), rel=0.1)
    # Three at a time alike: a third as many count, and blocks of three, which do not begin where these do, see
    # (1 + 2 x 2/3 x 2/3 + 2 x 1/3 x 1/3) / 3 of three times the variance.
    together = np.repeat(rng.standard_normal(200), 3)
    assert standard_error(together, blocks(run)) == pytest.approx(np.sqrt(1 + 8 / 9 + 2 / 9) / np.sqrt(600), rel=0.15)


def test_the_threshold_over_many_is_higher_than_over_one():
    rng = np.random.default_rng(1)
    run = np.repeat(np.arange(8), 25)
    gains = {str(i): rng.standard_normal(200) for i in range(12)}
    one = resample.max_t({"0": gains["0"]}, run, 0.05)
    # One-sided: 1.64 for one normal, and 1 - 0.05 ** (1 / 12) of it, 2.63, for the largest of twelve.
    assert one == pytest.approx(1.64, abs=0.15)
    assert resample.max_t(gains, run, 0.05) == pytest.approx(2.63, abs=0.25)


def test_a_difference_that_nobody_cares_for_is_none():
    rng = np.random.default_rng(2)
    run = np.repeat(np.arange(4), 10)
    loss = 1.0 + 0.2 * rng.uniform(size=40)
    lost = {"best": loss, "a hair worse": loss + 0.01, "worse": loss + 0.1}
    # No scatter at all in the differences: both are significant.
    assert resample.alike(lost, blocks(run), 2.0) == ["best", "a hair worse"]


def test_the_better_hypothesis_wins_when_it_is_fitted_again():
    rng = np.random.default_rng(3)
    run = np.repeat(np.arange(4), 10)
    right, wrong = rng.standard_normal((2, 40, 5))
    # The right one explains its share of what is left once it is fitted; the wrong one has nothing to do with it.
    residual = 0.1 * rng.standard_normal((40, 5))
    start = {
        name: Linear((residual - 0.3 * right).ravel(), slope.reshape(-1, 1), np.zeros(1), np.ones(1), 1.0)
        for name, slope in {"right": right, "wrong": wrong}.items()
    }
    fits = {}
    for name, fit in start.items():
        step = fit.step()
        fits[name] = Linear(fit.residual + fit.jacobian @ step, fit.jacobian, step, fit.sd, fit.weight)
    assert resample.bagged(fits, run) == {"right": 1.0, "wrong": 0.0}
    # Slopes that promise what a fit has not found are not believed.
    assert resample.bagged({"found": fits["right"], "promised": start["right"]}, run) == {"found": 1.0, "promised": 0.0}
    alike = resample.bagged({"one": fits["wrong"], "other": fits["wrong"]}, run)
    assert sum(alike.values()) == 1.0


def test_a_pair_is_two_hypotheses_side_by_side():
    one, two = HYPOTHESES[2], HYPOTHESES[3]
    pair = pair_of(one, two)
    point = np.array([0.4, -0.3])
    np.testing.assert_allclose(point @ pair.directions, 0.4 * one.directions[0] - 0.3 * two.directions[0])
    np.testing.assert_allclose(pair.bounds, np.concatenate([one.bounds, two.bounds]))
    # Each is looked for alone.
    assert ((pair.probes != 0).sum(axis=1) == 1).all()
    assert pair.probes.shape == (len(one.probes) + len(two.probes), 2)


def test_what_shows_in_few_segments_is_confirmed_there():
    run = np.repeat([0, 1], 15)
    before = np.random.default_rng(0).standard_normal((30, 4, 2))
    after = before.copy()
    before[[2, 9, 20]] += 10.0
    # Three blocks gain 800 each or nearly, of which one does not count; a t of the same gains is low.
    gain = resample.confirmed(before, after, run, 0.5)
    expected = 0.5 * ((before[[2, 9, 20]] ** 2).sum() - (after[[2, 9, 20]] ** 2).sum())
    assert gain == pytest.approx(expected * 2 / 3, rel=0.1)
    assert resample.t_statistic(resample.paired(before, after), run) < 2.0
    # One block proves nothing, and what is worse elsewhere counts.
    lucky = after.copy()
    lucky[2] += 10.0
    assert resample.confirmed(lucky, after, run, 0.5) == 0.0
    assert resample.confirmed(lucky, after + 0.1 * np.sign(after), run, 0.5) < 0.0


def test_either_way_of_being_significant_is_enough():
    sure = {"floors": 9.0, "interval": (1.0, 2.0), "inside": True, "horizons": 3, "chosen": 1.0}
    least = decide.Thresholds(t=2.0, gain=100.0)
    for t, confirmed, enough in ((3.0, -5.0, True), (1.0, 101.0, True), (1.0, 99.0, False)):
        evidence = decide.Evidence(gain=500.0, t=t, confirmed=confirmed, **sure)
        assert decide.passes(evidence, least)["significant"] is enough
        assert all(decide.passes(evidence, least).values()) is enough
