import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtune import windows
from jaxtune.types import Trajectory

LENGTH = 5
# Steps lived by each of six episodes of 12: to the end, four falls (one of them leaves a single window, one none at
# all, one never began), and to the end again.
LIVED = (12, 9, 5, 4, 0, 12)
TIME = 12


def episodes(lived=LIVED, time=TIME):
    """Episodes whose observation says episode and step, so that a window tells where it was cut."""
    lived = np.asarray(lived)
    count = len(lived)
    episode, step = np.meshgrid(np.arange(count), np.arange(time), indexing="ij")
    alive = step < lived[:, None]
    return Trajectory(
        obs=jnp.asarray(np.stack([episode, step], axis=-1), jnp.float32),
        action=jnp.asarray(100.0 + step[..., None], jnp.float32),
        alive=jnp.asarray(alive),
        score=jnp.asarray(alive, jnp.float32),
        fell=jnp.asarray(lived < time),
        not_finite=jnp.zeros(count, bool),
    )


def brute_force(lived=LIVED, time=TIME, length=LENGTH):
    """Whether a window from here stays within the life of its episode."""
    return [[start + length <= life for start in range(time - length + 1)] for life in lived]


def test_steps_puts_the_action_after_the_observation():
    np.testing.assert_array_equal(windows.steps(episodes())[1, 3], [1.0, 3.0, 103.0])


@pytest.mark.parametrize("length", [1, 2, LENGTH, TIME])
def test_valid_starts_are_those_of_a_brute_force_loop(length):
    valid = windows.valid_starts(episodes().alive, length)
    np.testing.assert_array_equal(valid, brute_force(length=length))


def test_nothing_after_a_fall_is_valid_even_where_the_mask_comes_back():
    alive = jnp.ones((1, TIME), bool).at[0, 6].set(False)
    np.testing.assert_array_equal(windows.valid_starts(alive, LENGTH)[0], [True, True] + [False] * 6)


def test_whole_episodes_in_which_the_simulation_broke_are_masked():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(9, TIME, 5))
    values[2, 7:] *= 1e6  # flies apart, with finite numbers
    values[3, 7:] *= 100.0  # falls
    values[4, 7:, 0] *= 1e6  # one sensor does
    values[7, 7:, 0] *= 100.0
    values[:, :, 2] *= 1e-9  # rounding, but for one robot
    values[8, :, 2] *= 1e9
    values[:, :, 1] = np.arange(9)[:, None] == 5  # a flag that one robot alone ever sets
    broke = np.arange(9) == 6
    alive = ~broke[:, None] | (np.arange(TIME) < 5)
    before = episodes(lived=[TIME] * 9).replace(
        obs=jnp.asarray(values, jnp.float32), alive=jnp.asarray(alive), not_finite=jnp.asarray(broke)
    )
    # What follows an end may be anything.
    before = before.replace(obs=before.obs.at[6, 6:].set(jnp.nan))
    after = windows.without_broken(before)
    np.testing.assert_array_equal(after.not_finite, np.isin(np.arange(9), [2, 4, 6]))
    np.testing.assert_array_equal(after.alive, ~np.isin(np.arange(9), [2, 4, 6])[:, None] & np.ones(TIME, bool))
    np.testing.assert_array_equal(after.obs, before.obs)


def test_draw_returns_only_valid_windows_and_all_of_them_alike():
    count = 4800
    cut, episode = windows.draw(jax.random.key(1), episodes(), count, LENGTH)
    assert cut.shape == (count, LENGTH, 3)
    cut, episode = np.asarray(cut), np.asarray(episode)
    np.testing.assert_array_equal(cut[..., 0], np.broadcast_to(episode[:, None], (count, LENGTH)))
    start = cut[:, 0, 1].astype(int)
    np.testing.assert_array_equal(cut[..., 1], start[:, None] + np.arange(LENGTH))
    drawn = np.zeros((len(LIVED), TIME - LENGTH + 1), int)
    np.add.at(drawn, (episode, start), 1)
    valid = np.array(brute_force())
    assert drawn[~valid].sum() == 0
    # 8 + 5 + 1 + 8 = 22 valid windows, 218 draws expected of each, standard deviation 15.
    assert valid.sum() == 22
    np.testing.assert_allclose(drawn[valid], count / 22, atol=5 * 15)


def test_draw_differs_by_key_alone():
    def starts(seed):
        return windows.draw(jax.random.key(seed), episodes(), 50, LENGTH)[0][:, 0, 1]

    np.testing.assert_array_equal(starts(0), starts(0))
    assert np.any(starts(0) != starts(1))


@pytest.mark.parametrize("count", [10, 22, 30, 60])
def test_choose_returns_valid_windows_none_of_them_twice(count):
    cut, valid = windows.choose(jax.random.key(1), episodes(), count, LENGTH)
    assert cut.shape == (count, LENGTH, 3)
    # Of 22 that there are.
    assert valid.sum() == min(count, 22)
    starts = {tuple(window[0, :2].tolist()) for window in np.asarray(cut)[np.asarray(valid)]}
    assert len(starts) == valid.sum()
    assert all(start + LENGTH <= LIVED[int(episode)] for episode, start in starts)


def test_grid_is_every_nth_window_and_says_which_are_valid():
    cut, valid = windows.grid(episodes(), LENGTH, 3)
    # Starts 0, 3 and 6; a fourth at 9 would reach past step 12.
    assert cut.shape == (len(LIVED), 3, LENGTH, 3)
    np.testing.assert_array_equal(cut[2, :, 0, 1], [0, 3, 6])
    np.testing.assert_array_equal(cut[2, 1, :, 1], 3 + np.arange(LENGTH))
    np.testing.assert_array_equal(valid, np.array(brute_force())[:, ::3])


def test_grid_takes_leading_dimensions():
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf[::-1]]), episodes())
    cut, valid = windows.grid(stacked, LENGTH, 3)
    alone, alone_valid = windows.grid(episodes(), LENGTH, 3)
    np.testing.assert_array_equal(cut[1], alone[::-1])
    np.testing.assert_array_equal(valid[0], alone_valid)


def noisy():
    trajectory = episodes()
    obs = 3.0 + jax.random.normal(jax.random.key(2), trajectory.obs.shape) * jnp.array([0.5, 20.0])
    return trajectory.replace(obs=obs)


def test_scaler_is_numpy_on_living_steps():
    trajectory = noisy()
    lived = np.asarray(windows.steps(trajectory))[np.asarray(trajectory.alive)]
    scaler = windows.fit_scaler(trajectory)
    np.testing.assert_allclose(scaler.mean, lived.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(scaler.std, lived.std(axis=0), rtol=1e-4)
    scaled = scaler(jnp.asarray(lived))
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, rtol=1e-4)


@pytest.mark.parametrize("value", [7.0, 0.0, 100.3])
def test_scaler_leaves_a_constant_channel_finite(value):
    trajectory = episodes()
    scaler = windows.fit_scaler(trajectory.replace(action=jnp.full_like(trajectory.action, value)))
    assert np.isfinite(scaler(windows.steps(trajectory))).all()
    assert scaler.std[2] == pytest.approx(1e-3 * (value or 1.0))
    np.testing.assert_array_equal(scaler.varies, [True, True, False])


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_scaler_knows_no_unit(unit):
    trajectory = noisy()
    scaled = trajectory.replace(obs=unit * trajectory.obs)
    found, expected = (windows.fit_scaler(one)(windows.steps(one))[..., :2] for one in (scaled, trajectory))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


def test_scaler_ignores_what_a_broken_simulation_left_behind():
    trajectory = noisy()
    broken = trajectory.replace(obs=jnp.where(trajectory.alive[..., None], trajectory.obs, jnp.nan))
    expected, scaler = windows.fit_scaler(trajectory), windows.fit_scaler(broken)
    np.testing.assert_allclose(scaler.mean, expected.mean, rtol=1e-6)
    np.testing.assert_allclose(scaler.std, expected.std, rtol=1e-6)


def test_moments_are_those_of_numpy():
    window = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
    found = np.asarray(windows.moments(jnp.asarray(window)))
    centred = window[0] - window[0].mean(axis=0)
    np.testing.assert_allclose(found[0, :3], window[0].mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(found[0, 3:6], np.diff(window[0], axis=0).std(axis=0), rtol=1e-5)
    np.testing.assert_allclose(found[0, 9:15], (centred.T @ centred / 50)[np.triu_indices(3)], atol=1e-5)


def test_moments_that_involve_a_channel_are_those_that_change_with_it():
    noise = jax.random.normal(jax.random.key(0), (2, 60, 3))
    before = windows.moments(noise)
    marked = np.asarray(windows.involved(3), bool)
    for channel in range(3):
        changed = windows.moments(noise.at[:, :, channel].multiply(1.5)) != before
        np.testing.assert_array_equal(changed.any(axis=0), marked[channel])
