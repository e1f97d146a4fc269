import jax.numpy as jnp
import numpy as np
import pytest

from envs.biteno import constants, rewards

STILL = {
    "velocity": [0.0, 0.0, 0.0],
    "command": [0.0, 0.0, 0.0],
    "gyro": [0.0, 0.0, 0.0],
    "gravity": [0.0, 0.0, -1.0],
    "joint": [0.0, -0.35, 0.70, 0.0, -0.35, 0.70],
    "joint_velocity": [0.0] * 6,
    "last_joint_velocity": [0.0] * 6,
    "torque": [0.0] * 6,
    "action": [0.0] * 6,
    "last_action": [0.0] * 6,
    "joint_reference": [0.0, -0.35, 0.70, 0.0, -0.35, 0.70],
}


def terms(**changes):
    return rewards.terms(**{name: jnp.array(value) for name, value in {**STILL, **changes}.items()})


def expect(values, **expected):
    """Those named have these values, all others those of the robot that stands still as it was told."""
    still = dict.fromkeys(constants.TABLE_ONE, 0.0) | {"linear_tracking": 1.0, "angular_tracking": 1.0}
    assert values.keys() == still.keys()
    for name, value in {**still, **expected}.items():
        np.testing.assert_allclose(values[name], value, rtol=1e-5, atol=1e-9, err_msg=name)


def test_standing_still_at_zero_command_pays_tracking_alone():
    expect(terms())


def test_linear_tracking_is_of_the_ground_plane():
    # Off by 0.3 and 0.4 m/s: exp(-4 (0.09 + 0.16)) = exp(-1) = 0.3678794.
    expect(terms(command=[0.8, -0.1, 0.0], velocity=[0.5, 0.3, 0.0]), linear_tracking=0.3678794)


def test_angular_tracking_is_of_the_yaw_rate():
    # Off by half a rad/s: exp(-4 / 4) = 0.3678794.
    expect(terms(command=[0.0, 0.0, 0.8], gyro=[0.0, 0.0, 0.3]), angular_tracking=0.3678794)


def test_linear_velocity_z():
    # 0.3^2 = 0.09, and up is as bad as down.
    expect(terms(velocity=[0.0, 0.0, -0.3]), linear_velocity_z=0.09)
    expect(terms(velocity=[0.0, 0.0, 0.3]), linear_velocity_z=0.09)


def test_angular_velocity_xy():
    # 0.6^2 + 0.8^2 = 1.
    expect(terms(gyro=[0.6, -0.8, 0.0]), angular_velocity_xy=1.0)


def test_torque():
    # 1 + 4 + 9 + 16 + 25 + 36 = 91.
    expect(terms(torque=[1.0, -2.0, 3.0, -4.0, 5.0, -6.0]), torque=91.0)


def test_orientation_is_the_horizontal_part_of_gravity():
    # 0.36^2 + 0.48^2 = 0.1296 + 0.2304 = 0.36, where the whole vector's square is 1 upright or lying.
    expect(terms(gravity=[0.36, 0.48, -0.8]), orientation=0.36)


def test_joint_acceleration_is_a_difference_over_the_policy_step():
    # 0.1 rad/s more in 0.01 s is 10 rad/s^2, 0.2 rad/s less is -20: 100 + 400 = 500.
    expect(
        terms(joint_velocity=[1.1, 0, 0, 0, 0, 2.0], last_joint_velocity=[1.0, 0, 0, 0, 0, 2.2]),
        joint_acceleration=500.0,
    )


def test_action_rate():
    # 0.5^2 + 1.5^2 = 2.5.
    expect(
        terms(action=[1.0, 0, 0, 0, -1.0, 0], last_action=[0.5, 0, 0, 0, 0.5, 0]),
        action_rate=2.5,
    )


def test_joint_default_and_raibert_each_have_their_own_reference():
    # Off the stand by 0.1, 0.15 and 0.3 rad: 0.01 + 0.0225 + 0.09 = 0.1225.
    joint = [0.1, -0.20, 0.70, 0.0, -0.35, 1.0]
    # Off the reference by 0.2 rad in a knee: 0.04.
    reference = [0.1, -0.20, 0.90, 0.0, -0.35, 1.0]
    expect(terms(joint=joint, joint_reference=reference), joint_default=0.1225, raibert=0.04)


def test_weights_are_those_of_table_one():
    assert constants.TABLE_ONE == {
        "linear_tracking": 2.0,
        "angular_tracking": 1.5,
        "linear_velocity_z": -1.25,
        "angular_velocity_xy": -0.1,
        "torque": -5e-6,
        "orientation": -10.0,
        "joint_acceleration": -2e-7,
        "action_rate": -0.1,
        "joint_default": -0.35,
        "raibert": -1.25,
    }


def test_every_term_is_weighed_and_multiplied_by_the_policy_step():
    # 1 to 10 in the order of the table: 2 + 3 - 3.75 - 0.4 - 0.000025 - 60 - 0.0000014 - 0.8 - 3.15 - 12.5
    # = -75.6000264, times 0.01 s.
    values = {name: jnp.float32(rank) for rank, name in enumerate(constants.TABLE_ONE, start=1)}
    np.testing.assert_allclose(rewards.weigh(values, constants.TABLE_ONE), -0.756000264, rtol=1e-6)


@pytest.mark.parametrize("weights", [constants.TABLE_ONE, constants.WALKING])
def test_the_most_an_episode_can_earn_is_seventy(weights):
    # (2.0 + 1.5) x 20 s.
    np.testing.assert_allclose(2000 * rewards.weigh(terms(), weights), 70.0, rtol=1e-5)


def test_clock_contact_counts_feet_that_disagree_with_the_clock():
    def disagree(left_n, right_n, phase):
        force = jnp.array([[5.0, 0.0, left_n], [0.0, 9.0, right_n]])
        return rewards.shaping(foot_force=force, phase=jnp.array(phase))["clock_contact"]

    # The left foot should stand, the right one swing.
    assert disagree(150.0, 0.0, [0.2, 0.7]) == 0.0
    assert disagree(0.0, 150.0, [0.2, 0.7]) == 2.0
    # 15 N are half of what counts as firm.
    np.testing.assert_allclose(disagree(150.0, 15.0, [0.2, 0.7]), 0.5, rtol=1e-6)
    np.testing.assert_allclose(disagree(15.0, 0.0, [0.2, 0.7]), 0.5, rtol=1e-6)
