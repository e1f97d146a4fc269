import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs.biteno import constants, gait

STANDING = jnp.zeros(3)


def foot_in_mujoco(model, side, angles):
    """Where MuJoCo puts the foot's centre, from its hip, in the trunk's axes."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.keyframe("home").qpos
    for joint, angle in zip(("abad", "hip", "knee"), angles, strict=True):
        data.joint(f"{side}_{joint}").qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    return data.geom(f"{side}_foot").xpos - data.body(f"{side}_abductor").xpos


def around_the_clock(reference, command):
    """A reference of 401 phases from 0 to 1, both feet at the same one."""
    phase = np.linspace(0.0, 1.0, 401, dtype=np.float32)
    return phase, np.asarray(jax.vmap(reference, (0, None))(np.stack([phase, phase], axis=-1), jnp.array(command)))


@pytest.mark.parametrize("side", constants.SIDES)
def test_inverse_kinematics_is_mujocos_inverted(robot, side):
    rng = np.random.default_rng(0)
    # A box well within the 0.62 m that the leg is long: its farthest corner is 0.609 m away.
    feet = rng.uniform([-0.2, -0.15, -0.55], [0.2, 0.15, -0.3], (30, 3)).astype(np.float32)
    angles = np.asarray(gait.leg_angles(jnp.asarray(feet)))
    assert np.all(angles[:, 2] > 0)  # the knee folds one way
    for foot, angle in zip(feet, angles, strict=True):
        np.testing.assert_allclose(foot_in_mujoco(robot.mj_model, side, angle), foot, atol=1e-6)


def test_a_foot_out_of_reach_is_answered_with_a_straight_leg():
    angles = gait.leg_angles(jnp.array([0.0, 0.0, -0.7]))
    np.testing.assert_allclose(angles, 0.0, atol=1e-6)


def test_the_clock_runs_at_its_rate_and_wraps():
    # 1.75 Hz x 0.01 s = 0.0175 of a cycle.
    np.testing.assert_allclose(gait.advance(jnp.array([0.2, 0.99])), [0.2175, 0.0075], atol=1e-6)


def test_legs_stay_half_a_cycle_apart(fresh):
    phase = fresh.phase
    # A random start, over the whole cycle.
    assert phase.min() < 0.01
    assert phase.max() > 0.99
    for _ in range(100):
        np.testing.assert_allclose(np.mod(phase[:, 1] - phase[:, 0], 1.0), 0.5, atol=1e-4)
        phase = gait.advance(phase)
    assert np.all((phase >= 0) & (phase < 1))


def test_told_to_stand_it_steps_on_the_spot():
    # Phases of stance, of a quarter and of the middle of the swing.
    feet = np.stack([gait.foot_reference(jnp.array([a, b]), STANDING) for a, b in ((0.1, 0.4), (0.625, 0.75))])
    np.testing.assert_allclose(feet[..., :2], 0.0, atol=1e-7)
    # On the floor in stance; 0.08 sin(pi / 4) = 0.0566 m and the whole 0.08 m above it in swing.
    np.testing.assert_allclose(feet[0, :, 2], -0.582, atol=1e-6)
    np.testing.assert_allclose(feet[1, :, 2], [-0.582 + 0.0565685, -0.582 + 0.08], atol=1e-6)


def test_the_swing_lifts_by_eight_centimetres_and_no_more():
    phase, feet = around_the_clock(gait.foot_reference, [0.8, 0.2, 0.5])
    lift = feet[..., 2] + 0.582
    np.testing.assert_allclose(lift.max(axis=0), 0.08, atol=1e-6)
    assert np.all(lift.argmax(axis=0) == 300)
    np.testing.assert_allclose(lift[phase <= 0.5], 0.0, atol=1e-6)
    assert np.all(lift[(phase > 0.5025) & (phase < 0.9975)] > 0)


def test_told_to_stand_the_stance_leg_is_that_of_the_standing_pose():
    # The depth of 0.582 m against the pose's 0.5824: 0.4 mm, which the knee takes up by 0.004 rad.
    reference = gait.joint_reference(jnp.array([0.2, 0.3]), STANDING)
    np.testing.assert_allclose(reference, constants.STAND_RAD, atol=0.005)
    # A swinging knee folds: 2 acos(0.502 / 0.62) = 1.255 rad, the hip half of it.
    reference = gait.joint_reference(jnp.array([0.25, 0.75]), STANDING)
    np.testing.assert_allclose(reference[3:], [0.0, -0.6275, 1.255], atol=1e-3)


@pytest.mark.parametrize(
    ("command", "sweep"),
    [
        ((1.0, 0.0, 0.0), [[-1.0, 0.0], [-1.0, 0.0]]),
        ((0.0, 0.3, 0.0), [[0.0, -0.3], [0.0, -0.3]]),
        # Turning left about the trunk, 0.5 x 0.1 m/s: the left hip goes back, so its foot goes forward under it.
        ((0.0, 0.0, 0.5), [[0.05, 0.0], [-0.05, 0.0]]),
    ],
)
def test_a_foot_in_stance_sweeps_back_as_fast_as_the_command_asks(command, sweep):
    # A tenth of a cycle takes 0.1 / 1.75 = 0.05714 s.
    start, end = (gait.foot_reference(jnp.array([phase, phase]), jnp.array(command)) for phase in (0.2, 0.3))
    np.testing.assert_allclose((end - start)[:, :2] / 0.0571429, sweep, atol=1e-5)


def test_a_stride_is_symmetric_about_the_hip():
    # At 1 m/s the stance of 0.5 / 1.75 = 0.2857 s covers 0.2857 m: half of it ahead, half of it behind.
    ahead, middle, behind = (
        gait.foot_reference(jnp.array([phase, phase]), jnp.array([1.0, 0.0, 0.0]))[:, 0] for phase in (0.0, 0.25, 0.5)
    )
    np.testing.assert_allclose(ahead, 0.142857, atol=1e-6)
    np.testing.assert_allclose(middle, 0.0, atol=1e-6)
    np.testing.assert_allclose(behind, -0.142857, atol=1e-6)


def test_a_foot_moves_without_jumps_all_around_the_clock():
    _, angles = around_the_clock(gait.joint_reference, [1.0, 0.3, 0.8])
    # The steepest is the knee at take-off, about 8 rad a cycle; 1/400 of it, with room.
    assert np.abs(np.diff(angles, axis=0)).max() < 0.04
    np.testing.assert_allclose(angles[0], angles[-1], atol=1e-5)


@pytest.mark.parametrize("corner", range(8))
def test_the_reference_of_every_command_is_within_reach_and_range(robot, corner):
    signs = [1 - 2 * (corner >> bit & 1) for bit in range(3)]
    command = jnp.array(robot.config.command_max) * jnp.array(signs)
    lower, upper = (robot.mj_model.jnt_range[1:, side] for side in (0, 1))
    _, feet = around_the_clock(gait.foot_reference, command)
    assert np.all(np.linalg.norm(feet, axis=-1) < 2 * constants.LINK_M)
    _, angles = around_the_clock(gait.joint_reference, command)
    assert np.all((angles > lower) & (angles < upper))
