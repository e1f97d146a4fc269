import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import reference

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
    np.testing.assert_allclose(gait.advance(jnp.array([0.2175, 0.0075]), -1), [0.2, 0.99], atol=1e-6)


def test_legs_stay_half_a_cycle_apart(fresh):
    phase = fresh.phase
    # A random start, over the whole cycle.
    assert phase.min() < 0.01
    assert phase.max() > 0.99
    for _ in range(100):
        np.testing.assert_allclose(np.mod(phase[:, 1] - phase[:, 0], 1.0), 0.5, atol=1e-4)
        phase = gait.advance(phase)
    assert np.all((phase >= 0) & (phase < 1))


def test_at_zero_command_it_steps_on_the_spot():
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


def test_at_zero_command_the_stance_leg_is_that_of_the_standing_pose():
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


@pytest.mark.parametrize("seed", range(5))
def test_motion_of_the_feet_is_mujocos(robot, seed):
    model = robot.mj_model
    qpos, qvel = reference.random_state(np.random.default_rng(seed), model, 0.1)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    centre, velocity = gait.foot_motion(jnp.asarray(qpos), jnp.asarray(qvel))
    for row, foot in enumerate(constants.FEET):
        np.testing.assert_allclose(centre[row], data.geom(foot).xpos, atol=1e-6)
        # The shank's point that is lowest now.
        lowest = data.geom(foot).xpos - [0.0, 0.0, model.geom(foot).size[0]]
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, lowest, model.geom(foot).bodyid[0])
        np.testing.assert_allclose(velocity[row], jacobian @ qvel, atol=1e-5)


def walk(steps=400, height=0.612):
    """Two feet that keep to the clock: still robot, forces by hand."""
    home = np.tile(np.array([0, 0, height, 1, 0, 0, 0, *constants.STAND_RAD], np.float32), (1, steps, 1))
    left = np.mod((np.arange(steps) + 1) * constants.CLOCK_HZ * constants.POLICY_DT_S, 1.0)
    phase = np.stack([left, np.mod(left + 0.5, 1.0)], axis=-1)[None]
    force = np.zeros((1, steps, 2, 3))
    force[..., 2] = np.where(phase < 0.5, 150.0, 0.0)
    force[..., 0] = 0.2 * force[..., 2]
    return {
        "qpos": home,
        "qvel": np.zeros((1, steps, 12), np.float32),
        "torque": np.full((1, steps, 6), 3.0),
        "foot_force": force,
        "command": np.zeros((1, steps, 3)),
        "phase": phase,
        "alive": np.ones((1, steps), bool),
        "fell": np.zeros(1, bool),
    }


def test_quality_of_a_gait_by_hand():
    values = gait.quality(**walk())
    # Seven periods in 4 s, each with one touchdown a foot; the left foot begins on the floor.
    assert 6.5 / 4 <= values["touchdowns_per_s"] <= 7 / 4
    assert values["clock_agreement"] == 1.0
    # The still foot's centre is 0.612 - 0.5824 above the floor, which is 0.4 mm below its radius.
    np.testing.assert_allclose(values["swing_clearance_m"], -0.0004, atol=1e-4)
    np.testing.assert_allclose(values["friction_use_p99"], 0.2, rtol=1e-6)
    np.testing.assert_allclose(values["torque_nm"], 3.0)
    assert values["power_w"] == values["slip_mps"] == values["speed_error_mps"] == values["falls_per_20s"] == 0.0


def test_quality_tells_a_buzz_a_slide_and_a_fall():
    case = walk()
    buzz = {**case, "foot_force": case["foot_force"] * (np.arange(400) % 8 < 4)[None, :, None, None]}
    assert gait.quality(**buzz)["touchdowns_per_s"] > 5
    slide = {**case, "qvel": case["qvel"].copy(), "command": case["command"] + [0.1, 0.0, 0.3]}
    slide["qvel"][..., 0] = 0.4
    slide["qvel"][..., 7] = 2.0
    values = gait.quality(**slide)
    # Commands for 0.1 m/s and 0.3 rad/s, went 0.4 and 0.
    np.testing.assert_allclose(values["speed_error_mps"], 0.3, rtol=1e-5)
    np.testing.assert_allclose(values["turn_error_radps"], 0.3, rtol=1e-5)
    # The left hip turns at 2 rad/s under 3 Nm.
    np.testing.assert_allclose(values["power_w"], 6.0, rtol=1e-5)
    # The right foot slides at 0.4 m/s while it touches, half of the time; the left one, swinging back at 2 rad/s over
    # 0.612 m, at 0.4 - 1.22.
    np.testing.assert_allclose(values["slip_mps"], (0.4 + 0.824) / 2, rtol=0.02)
    fallen = {**case, "alive": case["alive"] & (np.arange(400) < 200)[None], "fell": np.ones(1, bool)}
    # One fall in 2 s.
    np.testing.assert_allclose(gait.quality(**fallen)["falls_per_20s"], 10.0)


def test_no_episode_longer_than_a_second_has_no_speed_error():
    values = gait.quality(**walk(steps=80))
    assert np.isnan(values["speed_error_mps"])
    assert np.isnan(values["turn_error_radps"])
    assert np.isfinite(values["clock_agreement"])


def test_clearance_is_the_mean_over_whole_swings():
    case = walk()
    lifted = case["qpos"].copy()
    lifted[..., 2] += np.linspace(0.0, 0.4, 400)[None]
    values = gait.quality(**{**case, "qpos": lifted})
    # Each of the swings ends higher, by as much on the left as on the right.
    left = case["phase"][0, :, 0]
    ends = [np.flatnonzero(np.diff((phase < 0.5).astype(int)) == 1) for phase in (left, np.mod(left + 0.5, 1.0))]
    begins = [np.flatnonzero(np.diff((phase < 0.5).astype(int)) == -1) for phase in (left, np.mod(left + 0.5, 1.0))]
    whole = np.concatenate([end[end > begin[0]] for end, begin in zip(ends, begins, strict=True)])
    np.testing.assert_allclose(values["swing_clearance_m"], np.mean(0.4 * whole / 399) - 0.0004, atol=1e-4)
