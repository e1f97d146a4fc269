"""Sampling at other times: lines between rows, means where rows come faster, held values as they are."""

import numpy as np

from envs.logs.sampling import held, sampled


def test_between_two_rows_lies_a_line():
    time, at = np.array([0.0, 1.0, 3.0]), np.array([0.25, 1.0, 2.0])
    values = np.stack([time**2, -time], axis=1)
    np.testing.assert_allclose(sampled(time, values, at, 1.0), [[0.25, -0.25], [1, -1], [5, -2]])


def test_a_line_stays_a_line_where_rows_come_faster():
    time = np.sort(np.random.default_rng(0).uniform(0, 1, 500))
    at = np.linspace(0.1, 0.9, 33)
    np.testing.assert_allclose(sampled(time, 3 * time - 1, at, 0.025), 3 * at - 1, atol=1e-12)


def test_what_is_too_fast_to_be_seen_is_gone():
    # A whole number of periods of 200 Hz in each of 10 ms: the mean is nothing. Every tenth row would be 1 throughout.
    time = np.arange(0, 1, 0.001)
    at = np.arange(0.1, 0.9, 0.01)
    fast = np.cos(2 * np.pi * 200 * time)
    np.testing.assert_allclose(fast[100:900:10], 1.0)
    np.testing.assert_allclose(sampled(time, fast, at, 0.01), 0.0, atol=1e-9)


def test_what_is_slow_stays():
    # The mean of a sine of frequency f over a period P is sin(pi f P) / (pi f P) of it: 0.9836 at 10 Hz and 10 ms.
    time, at = np.arange(0, 1, 0.001), np.arange(0.1, 0.9, 0.01)
    expected = 0.98363 * np.sin(2 * np.pi * 10 * at)
    np.testing.assert_allclose(sampled(time, np.sin(2 * np.pi * 10 * time), at, 0.01), expected, atol=1e-3)


def test_held_values_change_when_they_did():
    time, values = np.array([0.0, 1.0, 2.0]), np.array([[5.0], [6.0], [7.0]])
    np.testing.assert_array_equal(held(time, values, np.array([-1, 0, 0.99, 1, 5]))[:, 0], [5, 5, 5, 6, 7])
