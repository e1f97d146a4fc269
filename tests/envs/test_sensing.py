import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import sensing
from envs.biteno import Biteno, TaskConfig

# No two numbers are alike, so that none can stand in another's place.
READINGS = {
    "velocity": [0.5, -0.25, 0.1],
    "command": [0.8, -0.3, 0.4],
    "gyro": [1.0, -2.0, 0.6],
    "gravity": [0.6, 0.0, -0.8],
    "joint": [0.01, -0.33, 0.73, -0.04, -0.30, 0.64],
    "joint_velocity": [1.0, 2.0, 3.0, -4.0, -5.0, -6.0],
    "last_action": [0.11, 0.12, 0.13, 0.14, 0.15, 0.16],
    "joint_error": [0.21, 0.22, 0.23, 0.24, 0.25, 0.26],
    "phase": [0.25, 0.5],
    "stand": [0.0, -0.35, 0.70] * 2,
}
OBSERVATION = [
    *(1.0, -0.5, 0.2),  # 0: velocity, twice
    *(1.6, -0.6, 0.1),  # 3: command, twice, twice and a quarter
    *(0.25, -0.5, 0.15),  # 6: angular velocity, a quarter
    *(0.6, 0.0, -0.8),  # 9: gravity
    *(0.01, 0.02, 0.03, -0.04, 0.05, -0.06),  # 12: joints less 0, -0.35, 0.70
    *(0.05, 0.10, 0.15, -0.20, -0.25, -0.30),  # 18: joint velocity, a twentieth
    *(0.11, 0.12, 0.13, 0.14, 0.15, 0.16),  # 24: last action
    *(0.21, 0.22, 0.23, 0.24, 0.25, 0.26),  # 30: joint error
    *(1.0, 0.0),  # 36: sine and cosine of a quarter of a turn, the left foot's
    *(0.0, -1.0),  # 38: and of half a turn, the right foot's
]
# Where each channel that carries noise stands, and how far it may be off: the width of the noise times the scale.
NOISY = {
    "velocity": (slice(0, 3), 0.1 * 2.0),
    "gyro": (slice(6, 9), 0.2 * 0.25),
    "gravity": (slice(9, 12), 0.05),
    "joint": (slice(12, 18), 0.01),
    "joint_velocity": (slice(18, 24), 1.5 * 0.05),
}
DRAWS = 2000


def test_observation_index_by_index():
    obs = sensing.observe(**{name: jnp.array(value) for name, value in READINGS.items()})
    assert obs.shape == (40,)
    np.testing.assert_allclose(obs, OBSERVATION, atol=1e-6)


def test_another_request_changes_its_channels_alone():
    obs = sensing.with_command(jnp.array(OBSERVATION), jnp.array([-0.4, 0.2, -0.6]), jnp.array([0.5, 0.75]))
    np.testing.assert_allclose(sensing.phase(obs), 0.5, atol=1e-6)
    # Twice, twice and a quarter; sine and cosine of half a turn and of three quarters.
    clock = [0.0, -1.0, -1.0, 0.0]
    np.testing.assert_allclose(obs, [*OBSERVATION[:3], -0.8, 0.4, -0.15, *OBSERVATION[6:36], *clock], atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_rotation_into_the_body_is_mujocos(seed):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    quat /= np.linalg.norm(quat)
    vector = rng.normal(size=3)
    back, expected = np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(back, quat)
    mujoco.mju_rotVecQuat(expected, vector, back)
    got = sensing.rotate_inverse(jnp.asarray(quat, jnp.float32), jnp.asarray(vector, jnp.float32))
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_gravity_upright_nose_down_and_on_its_left_side():
    half = np.sqrt(0.5)
    np.testing.assert_allclose(sensing.projected_gravity(jnp.array([1.0, 0, 0, 0])), [0, 0, -1], atol=1e-6)
    # A quarter turn about y points the nose, x, to the ground; one about x lifts the left side, y, to the sky.
    np.testing.assert_allclose(sensing.projected_gravity(jnp.array([half, 0, half, 0])), [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(sensing.projected_gravity(jnp.array([half, half, 0, 0])), [0, -1, 0], atol=1e-6)


def test_clock_is_sine_and_cosine_foot_by_foot():
    # An eighth of a turn: both are the root of a half, 0.707107. Three quarters: -1 and 0.
    np.testing.assert_allclose(sensing.clock(jnp.array([0.125, 0.75])), [0.707107, 0.707107, -1, 0], atol=1e-6)


@pytest.fixture(scope="module")
def noise():
    """What `disturb` adds at half and at full scale, [DRAWS, ...] by channel."""
    readings = {name: jnp.array(value) for name, value in READINGS.items()}

    @jax.jit
    @jax.vmap
    def added(key):
        full = sensing.disturb(key, readings, 1.0)
        half = sensing.disturb(key, readings, 0.5)
        return jax.tree.map(jnp.subtract, (full, half), (readings, readings))

    return added(jax.random.split(jax.random.key(0), DRAWS))


def test_noise_fills_its_width_and_no_more(noise):
    full, half = noise
    widths = {"velocity": 0.1, "gyro": 0.2, "gravity": 0.05, "joint": 0.01, "joint_velocity": 1.5}
    assert widths == sensing.NOISE
    for name, width in widths.items():
        # Of 2000 draws the largest of a channel misses the edge by more than a hundredth with a chance of e^-10.
        assert np.all(np.abs(full[name]).max(axis=0) <= width * (1 + 1e-4)), name
        assert np.all(full[name].max(axis=0) > 0.99 * width), name
        assert np.all(full[name].min(axis=0) < -0.99 * width), name
        # Standard deviation of a uniform draw is width / sqrt(3); the mean of 2000 is known to 0.013 width.
        np.testing.assert_allclose(full[name].mean(axis=0), 0.0, atol=4 * 0.013 * width)
        np.testing.assert_allclose(half[name], 0.5 * full[name], atol=1e-6)


def test_noise_spares_what_the_robot_knows_for_certain(noise):
    full, _ = noise
    for name in ("command", "last_action", "joint_error", "phase"):
        np.testing.assert_array_equal(full[name], 0.0)


def test_noise_of_different_channels_is_not_the_same(noise):
    full, _ = noise
    flat = np.concatenate([full[name] / width for name, width in sensing.NOISE.items()], axis=1)
    correlation = np.corrcoef(flat.T) - np.eye(flat.shape[1])
    # Of independent channels it is 1 / sqrt(2000) = 0.022 wide.
    assert np.abs(correlation).max() < 5 * 0.022


def test_a_noisy_robots_observation_is_off_by_the_scaled_width(fresh, reset_keys):
    noisy = Biteno(TaskConfig(noise=1.0))
    state = jax.jit(jax.vmap(lambda key: noisy.reset({}, key)))(reset_keys)
    # The noise is in the reading, not in the robot.
    np.testing.assert_array_equal(state.qpos, fresh.qpos)
    off = np.abs(state.obs - fresh.obs).max(axis=0)
    expected = np.zeros(40)
    for where, width in NOISY.values():
        expected[where] = width
    np.testing.assert_allclose(off, expected, rtol=0.01, atol=1e-5)
