"""A robot on the rig moves as MuJoCo C moves it."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import reference
import rigs

from envs import beginning, history, models, segments, sensing, stepping
from envs.biteno import constants
from envs.effects import LIBRARY
from envs.logs import Controller, Run
from envs.models import suspended
from envs.null_logs import Robot
from envs.rig import Rig

START = np.array([0.5, -0.7])


def agrees(read, expected):
    # Single precision, over 150 steps.
    np.testing.assert_allclose(read["q"], expected[:, 0], atol=5e-6)
    np.testing.assert_allclose(read["dq"], expected[:, 1], atol=1e-4)


@pytest.fixture(scope="module")
def plain(arm):
    """The arm as compiled from its file."""
    return rigs.compiled(rigs.ARM, arm.rig)


@pytest.fixture(scope="module")
def pendulum():
    return Rig(models.spec("pendulum"), ("hinge",), rigs.CONTROL_HZ)


RUBBING = {
    "coulomb": {name: {"torque_nm": 0.5} for name in rigs.ARM_JOINTS},
    "presliding": {name: {"travel_rad": 0.004} for name in rigs.ARM_JOINTS},
}


def steps_of(target):
    """Every 30 steps another target, the same for the first joint the other way round."""
    levels = np.repeat([0.0, 0.4, -0.3, 0.5, 0.1], rigs.STEPS // 5)[:, None]
    return target + levels * np.array([-1.0, 1.0])


# Against MuJoCo C.


def test_positions_that_a_simulator_has_half_a_step_ahead_are_read_ahead(arm, plain):
    segment = rigs.segment(arm.rig, START, steps_of(START), kp=[60.0, 30.0], kd=[0.8, 0.4], speed=1.5)
    half = 0.5 * arm.rig.dt
    # What MuJoCo calls positions, in the controller and in the log.
    as_they_are = rigs.in_mujoco(
        arm.rig,
        plain,
        segment,
        sense=lambda seen: np.stack([seen[0] + half * seen[1], seen[1]]),
        start=np.stack([START - half * 1.5, np.full(2, 1.5)]),
    )
    agrees(arm.play(segment, position_lead={"robot": {"seconds": half}}), as_they_are)
    assert np.abs(arm.play(segment)["q"] - as_they_are[:, 0]).max() > 1e-3


def test_an_arm_without_effects_moves_as_in_mujoco(arm, plain):
    # Steps beyond what 1.2 Nm can do, and a gravity torque.
    segment = rigs.segment(arm.rig, START, steps_of(START), kp=[12.0, 8.0], kd=[0.4, 0.2], limit=[1.2, 0.9], speed=1.5)
    read = arm.play(segment)
    agrees(read, rigs.in_mujoco(arm.rig, plain, segment))
    assert np.ptp(read["q"], axis=0).min() > 0.05
    # Both limits were reached, and no more; what the law says at a tick is held for five steps of the physics.
    np.testing.assert_allclose(np.abs(read["tau"]).max(axis=0), [1.2, 0.9], rtol=1e-6)
    np.testing.assert_array_equal(read["tau"].reshape(-1, 5, 2), read["tau"][::5, None] * np.ones((5, 1)))


def test_a_suspended_biteno_moves_as_in_mujoco():
    rig = Rig(models.spec("biteno"), constants.JOINTS, rigs.CONTROL_HZ)
    start = np.array([0.0, -0.35, 0.7] * 2)
    target = start + np.array([0.2, 0.3, -0.4, -0.1, -0.2, 0.3])
    segment = rigs.segment(rig, start, target, kp=60.0, kd=2.0, limit=15.0)
    model = suspended(models.spec("biteno"))
    model.opt.timestep = rig.dt
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    read = rigs.Player(rig).play(segment)
    agrees(read, rigs.in_mujoco(rig, model, segment))
    assert np.ptp(read["q"], axis=0).min() > 0.05


def test_a_robot_without_motors_swings_as_in_mujoco(arm, plain):
    segment = rigs.segment(arm.rig, START, START, limit=0.0, speed=[2.0, -3.0])
    agrees(arm.play(segment), rigs.in_mujoco(arm.rig, plain, segment))


@pytest.mark.parametrize("integrator", ["RK4", "implicitfast"])
def test_the_models_integrator_changes_nothing(arm, plain, integrator):
    text = rigs.ARM.replace('timestep="0.001"', f'timestep="0.001" integrator="{integrator}"')
    assert text != rigs.ARM
    rig = Rig(mujoco.MjSpec.from_string(text), rigs.ARM_JOINTS, rigs.CONTROL_HZ).scaled(rigs.ARM_SCALES)
    segment = rigs.segment(rig, START, START, limit=0.0, speed=[2.0, -3.0])
    agrees(rigs.Player(rig).play(segment), rigs.in_mujoco(arm.rig, plain, segment))


def test_a_robot_that_is_fed_torques_moves_as_in_mujoco(arm, plain):
    segment = rigs.segment(arm.rig, START, START, feed=[1.0, -0.5], emf=[0.1, 0.05])
    agrees(arm.play(segment), rigs.in_mujoco(arm.rig, plain, segment))


def late(steps):
    """What was `steps` ago; before the first, the first."""
    seen = []

    def past(now):
        seen.append(now)
        return seen[max(len(seen) - 1 - steps, 0)]

    return past


def shifted(target):
    return target[np.maximum(np.arange(len(target)) - 7, 0)]


BIAS = np.array([0.02, -0.03])
SIGNALS = {
    "torque_scale": ({"shoulder": {"ratio": 0.8}}, lambda: {"motor": lambda torque: torque * [0.8, 1.0]}),
    # Of the motor's, so after that of the controller.
    "torque_limit": (
        {"elbow": {"torque_nm": 0.5}},
        lambda: {"motor": lambda torque: np.clip(torque, [-9, -0.5], [9, 0.5])},
    ),
    "command_delay": ({name: {"seconds": 0.007} for name in rigs.ARM_JOINTS}, lambda: {"command": shifted}),
    # Read by the log and by the controller alike.
    "encoder_bias": (
        {name: {"rad": bias} for name, bias in zip(rigs.ARM_JOINTS, BIAS, strict=True)},
        lambda: {"sense": lambda seen: seen + np.array([BIAS, 0.0 * BIAS]), "start": [START - BIAS, [0.0, 0.0]]},
    ),
    "sensor_delay": ({name: {"seconds": 0.004} for name in rigs.ARM_JOINTS}, lambda: {"sense": late(4)}),
}


@pytest.mark.parametrize("name", SIGNALS)
def test_effects_enter_where_they_belong(arm, plain, name):
    places, there = SIGNALS[name]
    segment = rigs.segment(arm.rig, START, steps_of(START), kp=[12.0, 8.0], kd=[0.4, 0.2], limit=3.0)
    expected = rigs.in_mujoco(arm.rig, plain, segment, **there())
    agrees(arm.play(segment, **{name: places}), expected)
    assert np.abs(arm.play(segment)["q"] - expected[:, 0]).max() > 2e-3


def test_a_wrong_gain_is_one_of_the_position_alone(arm, plain):
    drive = {"kd": 0.3, "limit": 3.0}
    segment = rigs.segment(arm.rig, START, steps_of(START), kp=10.0, **drive)
    stiffer = rigs.segment(arm.rig, START, steps_of(START), kp=[14.0, 10.0], **drive)
    read = arm.play(segment, gain_error={"shoulder": {"ratio": 1.4}})
    agrees(read, rigs.in_mujoco(arm.rig, plain, stiffer))


def test_a_motor_may_brake_more_than_its_constants_say(arm, plain):
    drive = {"kp": 12.0, "kd": 0.0, "limit": 3.0}
    segment = rigs.segment(arm.rig, START, steps_of(START), emf=[0.2, 0.1], **drive)
    braked = rigs.segment(arm.rig, START, steps_of(START), emf=[0.3, 0.1], **drive)
    agrees(arm.play(segment, back_emf={"shoulder": {"ratio": 1.5}}), rigs.in_mujoco(arm.rig, plain, braked))


def test_a_robot_read_late_starts_where_it_is_and_not_where_it_was_read(arm, plain):
    # Reads 10 ms old: having come with 2 and -1 rad/s, it is 0.02 and -0.01 rad further than what is read.
    speed = np.array([2.0, -1.0])
    segment = rigs.segment(arm.rig, START, START, limit=0.0, speed=speed)
    read = arm.play(segment, sensor_delay={name: {"seconds": 0.01} for name in rigs.ARM_JOINTS})
    expected = rigs.in_mujoco(arm.rig, plain, segment, start=[START + 0.01 * speed, speed])
    np.testing.assert_allclose(read["q"][10:], expected[:-10, 0], atol=2e-5)
    np.testing.assert_allclose(read["dq"][10:], expected[:-10, 1], atol=5e-4)
    # Until then, what it came by.
    np.testing.assert_allclose(read["q"][:10], START + 0.001 * np.arange(10)[:, None] * speed, atol=2e-5)


@pytest.mark.parametrize("damping", [0.1, 1.0])
def test_a_wound_up_arm_rests_where_its_springs_let_it(arm, plain, damping):
    # At rest the gears pass on the gravity torque g of the joint's posture; the motor is g / k ahead of it, the target
    # g / kp ahead of the motor. However slowly the controller lets them wind up (kd / k, 3 to 50 ms), they have
    # been so for ever.
    joint, gears, gain = np.array([0.9, 0.4]), np.array([30.0, 20.0]), np.array([12.0, 8.0])
    data = mujoco.MjData(plain)
    data.qpos[:] = joint
    mujoco.mj_forward(plain, data)
    motor = joint + data.qfrc_bias / gears
    segment = rigs.segment(arm.rig, motor, motor + data.qfrc_bias / gain, kp=gain, kd=damping)
    springs = {name: {"nm_per_rad": k} for name, k in zip(rigs.ARM_JOINTS, gears, strict=True)}
    read = arm.play(segment, compliance=springs)
    # Encoders are the motors'.
    np.testing.assert_allclose(read["q"], motor + np.zeros_like(read["q"]), atol=1e-4)
    np.testing.assert_allclose(read["tau"][-1], data.qfrc_bias, rtol=1e-3)
    # Without them it is out of balance, by 0.1 rad of the shoulder's posture.
    assert np.abs(arm.play(segment)["q"] - motor).max() > 2e-3


GAINS = {"kp": np.array([60.0, 40.0]), "kd": np.array([2.0, 1.0]), "torque_limit_nm": np.array([20.0, 20.0])}


def recut(arm, target, signals=("q", "dq"), **effects):
    """Segments of 0.15 s of a run that the rig itself has played, read every 5 ms."""
    dt, rows = arm.rig.dt, slice(None, None, 5)
    # The first segment begins 0.06 s after the motion.
    target = np.concatenate([np.repeat(target[:1], round((segments.HISTORY_S - 0.06) / dt), axis=0), target])
    read = arm.play(rigs.segment(arm.rig, target[0], target, *GAINS.values(), steps=len(target)), **effects)
    run = Run(
        name="run_000",
        condition="slow",
        split=None,
        controller=Controller(kind="pd", rate_hz=rigs.CONTROL_HZ, gains=GAINS, between_rows="hold"),
        time=dt * np.arange(len(target))[rows],
        signals={name: read[name][rows] for name in signals} | {"target": target[rows]},
    )
    return segments.cut([run], 0.15, dt)


def errors(arm, cut, **effects):
    """How far off each segment is simulated, [segments, joints] rad (rms)."""
    played = [
        arm.play(jax.tree.map(lambda leaf, one=one: leaf[one], cut.segments), **effects)["q"]
        for one in range(len(cut.run))
    ]
    return np.sqrt(((np.array(played) - cut.signals["q"]) ** 2).mean(axis=1))


def test_bristles_of_a_segment_are_where_its_motion_has_wound_them(arm):
    # Up and down again by 60 mrad, in 2 s each: after the reversal bristles of 4 mrad need longer than the 0.12 s
    # before a segment to be wound the other way.
    target = START + np.concatenate([np.linspace(0.0, 0.06, 2000), np.linspace(0.06, 0.0, 2000)])[:, None]
    cut = recut(arm, target, **RUBBING)
    # As if each segment's history began with a robot that had always been there.
    past = cut.segments.past
    stayed = {
        "past": np.repeat(past[:, -1:], past.shape[1], axis=1),
        "past_told": np.asarray(cut.segments.past_target)[:, -1],
    }
    unwound = replace(cut, segments=cut.segments.replace(**stayed))
    assert np.ptp(cut.signals["q"], axis=(0, 1)).min() > 0.03
    error, without = (np.sqrt((errors(arm, one, **RUBBING) ** 2).mean()) for one in (cut, unwound))
    assert error < 0.2 * without


def weight(arm, plain):
    """Torques of gravity at `START`, [joints] Nm."""
    data = mujoco.MjData(plain)
    data.qpos[arm.rig.qpos] = START
    mujoco.mj_forward(plain, data)
    return data.qfrc_bias[arm.rig.dof]


KP = np.array([12.0, 8.0])
CARRIED = np.array([0.3, -0.3])  # Nm, what gravity and motors leave to a friction of 0.5 Nm


@pytest.mark.parametrize(
    ("driven", "effects"),
    [
        (lambda gravity: {"target": START + (gravity + CARRIED) / KP, "kp": KP, "kd": [0.4, 0.2]}, {}),
        (lambda gravity: {"target": START, "feed": gravity + CARRIED}, {}),
        (
            lambda gravity: {"target": START + (gravity + CARRIED) / KP, "kp": KP, "kd": [0.4, 0.2]},
            {"constant_push": {name: {"nm": 0.1} for name in rigs.ARM_JOINTS}},
        ),
        (
            lambda gravity: {"target": START + 0.05 + (gravity + CARRIED) / KP, "kp": KP, "kd": [0.4, 0.2]},
            {"encoder_bias": {name: {"rad": 0.05} for name in rigs.ARM_JOINTS}},
        ),
        # With its motors off, and friction of what hangs on it.
        (lambda gravity: {"target": START}, {"load_friction": {name: {"ratio": 1.2} for name in rigs.ARM_JOINTS}}),
    ],
    ids=["driven", "fed", "pushed", "biased", "hanging"],
)
def test_a_robot_that_rests_on_its_friction_stays_there(arm, plain, driven, effects):
    segment = rigs.segment(arm.rig, START, **driven(weight(arm, plain)))
    if "encoder_bias" in effects:
        read = segment.measured + np.float32([[0.05], [0.0], [0.0], [0.0]])
        segment = segment.replace(measured=read, past=segment.past + np.float32(0.05))
    read = arm.play(segment, **RUBBING, **effects)["q"]
    np.testing.assert_allclose(read, np.tile(read[0], (rigs.STEPS, 1)), atol=2e-6)


def test_a_robot_that_has_just_come_to_rest_is_not_balanced(arm, plain):
    target = START + (weight(arm, plain) + CARRIED) / KP
    segment = rigs.segment(arm.rig, START, target, kp=KP, kd=[0.4, 0.2])
    # Through some of its bristles' travel, from where it was.
    came = segment.past + np.array([[-1e-3, 1e-3], [0.0, 0.0]], np.float32)
    read = arm.play(segment.replace(past=came, past_told=segment.past_told + came[0] - START), **RUBBING)
    assert np.ptp(read["q"], axis=0).min() > 1e-4


TIME = 0.001 * np.arange(4000)[:, None]
SWING = np.array([0.4, -0.5]) + np.array([0.3, 0.4]) * np.sin(2 * np.pi * np.array([0.5, 0.7]) * (1 + TIME / 2) * TIME)


@pytest.mark.parametrize(
    ("name", "value", "most"),
    [
        ("sensor_lag", {"seconds": 0.008}, 0.5e-3),
        ("sensor_delay", {"seconds": 0.008}, 0.5e-3),
        ("command_delay", {"seconds": 0.008}, 0.3e-3),
        ("command_delay", {"seconds": 0.1}, 0.3e-3),
        ("torque_lag", {"seconds": 0.008}, 0.3e-3),
        ("target_slew", {"rad_per_s": 1.0}, 4e-3),
        # It is behind throughout.
        ("target_slew", {"rad_per_s": 0.3}, 1.5e-3),
        ("backlash", {"rad": 0.02}, 1e-3),
        ("backlash", {"rad": 0.005}, 0.8e-3),
        ("compliance", {"nm_per_rad": 200.0}, 2e-3),
    ],
)
def test_a_segment_begins_as_the_effect_has_left_the_robot(arm, name, value, most):
    # 200 rows a second of targets that change as often, without noise. What smoothing makes of 1 to 4 Hz is 0.13 mrad.
    effect = {name: dict.fromkeys(rigs.ARM_JOINTS, value)}
    cut = recut(arm, np.repeat(SWING[::5], 5, axis=0), **effect)
    error, without = (np.sqrt((one**2).mean()) for one in (errors(arm, cut, **effect), errors(arm, cut)))
    assert error < most
    assert without > 3 * error


@pytest.mark.parametrize(
    ("name", "value"), [("sensor_lag", {"seconds": 0.008, "velocity_faster": 1.0}), ("velocity_lag", {"seconds": 0.02})]
)
def test_a_segment_begins_right_where_one_signal_alone_is_filtered(arm, name, value):
    # Velocities that do not agree with positions are not used (`experiments.discovery.measured.drop_useless`).
    effect = {name: dict.fromkeys(rigs.ARM_JOINTS, value)}
    cut = recut(arm, np.repeat(SWING[::5], 5, axis=0), signals=("q",), **effect)
    error, without = (np.sqrt((one**2).mean()) for one in (errors(arm, cut, **effect), errors(arm, cut)))
    assert error < 0.6e-3
    assert without > 3 * error


@pytest.mark.parametrize("rotor", [0.0, 0.0001, 0.05])
def test_a_segment_begins_where_gears_have_left_light_and_heavy_rotors(rotor):
    arm = rigs.Player(Rig(with_rotor(rotor), rigs.ARM_JOINTS, rigs.CONTROL_HZ))
    for effect in ({"backlash": {"elbow": {"rad": 0.02}}}, {"compliance": {"elbow": {"nm_per_rad": 60.0}}}):
        cut = recut(arm, np.repeat(SWING[::5], 5, axis=0), **effect)
        error, without = (np.sqrt((one**2).mean()) for one in (errors(arm, cut, **effect), errors(arm, cut)))
        assert error < 1.2e-3
        assert without > 1.5 * error


@pytest.mark.parametrize("rotor", [0.0001, 0.02])
def test_a_segment_begins_where_its_encoders_saw_nothing_of_the_play(rotor):
    arm = rigs.Player(Rig(with_rotor(rotor, damping=0.5), rigs.ARM_JOINTS, rigs.CONTROL_HZ))
    effect = {"backlash": {"elbow": {"rad": 0.04, "at_motor": 1.0}}, "joint_encoder": {"elbow": {"at_joint": 1.0}}}
    cut = recut(arm, np.repeat(SWING[::5], 5, axis=0), **effect)
    error, without = (np.sqrt((one**2).mean()) for one in (errors(arm, cut, **effect), errors(arm, cut)))
    assert error < 2e-3
    assert without > 2.0 * error


@pytest.mark.parametrize("rotor", [0.0001, 0.02])
@pytest.mark.parametrize(
    ("gears", "most"), [({"backlash": {"rad": 0.04}}, 2e-3), ({"compliance": {"nm_per_rad": 60.0}}, 3e-3)]
)
def test_a_segment_begins_where_the_log_and_not_the_controller_sees_the_joint(rotor, gears, most):
    arm = rigs.Player(Rig(with_rotor(rotor, damping=0.5), rigs.ARM_JOINTS, rigs.CONTROL_HZ))
    ((name, value),) = gears.items()
    effect = {name: {"elbow": value}, "joint_log": {"elbow": {"at_joint": 1.0}}}
    cut = recut(arm, np.repeat(SWING[::5], 5, axis=0), **effect)
    error, without, blind = (
        np.sqrt((one**2).mean())
        for one in (errors(arm, cut, **effect), errors(arm, cut), errors(arm, cut, **{name: {"elbow": value}}))
    )
    assert error < most
    assert min(without, blind) > 2.0 * error


GEARS = {"backlash": {"rad": 0.04}, "compliance": {"nm_per_rad": 60.0}}


def with_rotor(rotor, friction=0.0, damping=0.0):
    """The arm with another rotor at its elbow. What rubs there would be of the rotor or of the link."""
    spec = mujoco.MjSpec.from_string(rigs.ARM)
    elbow = spec.joint("elbow")
    elbow.armature, elbow.frictionloss, elbow.damping = rotor, friction, [damping, 0.0, 0.0]
    return spec


def of_two_bodies(effect, spec, at_motor, damping=0.05, joint="elbow"):
    """That arm in MuJoCo C, its rotor a body: between it and its link is a joint with a range or with a spring.

    Steps of 1 ms that solve for the gears lose about as much as 0.05 Nm s/rad beside the spring.
    """
    motor = spec.joint(joint)
    if at_motor < 1.0:
        # A tendon along both joints rubs as the link does.
        link = spec.add_tendon(name="link", frictionloss=(1.0 - at_motor) * motor.frictionloss)
        link.damping = (1.0 - at_motor) * motor.damping
        motor.frictionloss, motor.damping = at_motor * motor.frictionloss, at_motor * motor.damping
        for name in (joint, "gears"):
            link.wrap_joint(name, 1.0)
    gears = motor.parent.add_joint(name="gears", axis=motor.axis, pos=motor.pos, type=motor.type)
    if effect == "backlash":
        half = 0.5 * GEARS[effect]["rad"]
        gears.limited, gears.range, gears.solref_limit = mujoco.mjtLimited.mjLIMITED_TRUE, [-half, half], [0.0005, 1.0]
    else:
        gears.stiffness = [GEARS[effect]["nm_per_rad"], 0.0, 0.0]
    gears.damping = [damping, 0.0, 0.0]
    model = suspended(spec)
    model.dof_armature[model.joint("gears").dofadr[0]] = 0.0
    model.opt.timestep = 0.0001
    return model


def read_and_true(rig, values, segment):
    """Positions that are read of a robot, which are those of its motors, and those of its joints, [steps, 2 joints]."""
    model = rig.model(values)
    data, memory, future = beginning.begin(rig.chain, model, rig._data, values, segment)

    def step(carry, x):
        data, memory = carry
        joint = rig.chain.joints(data)[0]
        data, memory, read = rig.chain.step(model, data, memory, values, x)
        return (data, memory), (read["q"], joint)

    return jnp.hstack(jax.lax.scan(step, (data, memory), future)[1])


@pytest.mark.parametrize(
    ("rotor", "rubs", "rate_hz", "period", "most"),
    [
        (0.0001, {}, 1000.0, 1e-4, 9e-3),
        (0.005, {}, 200.0, 5e-3, 9e-3),
        (0.2, {}, 200.0, 5e-3, 3e-3),
        (0.005, {"friction": 0.5, "damping": 0.1}, 200.0, 5e-3, 9e-3),
        (0.2, {"friction": 1.0, "damping": 0.5}, 200.0, 5e-3, 5e-3),
    ],
)
def test_gears_between_a_rotor_and_a_link_are_those_of_two_bodies(rotor, rubs, rate_hz, period, most):
    # What is read, and where the links are. The forearm has 0.013 kg m^2, so rotors are lighter or much heavier. The
    # light ones swing by 0.8 rad. For the lightest one the rig's controller acts continuously: once in a period it
    # would throw it about.
    arm = rigs.Player(Rig(with_rotor(rotor, **rubs), rigs.ARM_JOINTS, rate_hz))
    for effect, at_motor in itertools.product(GEARS, (0.0, 0.5, 1.0) if rubs else (0.0,)):
        expected, segment = pushed(arm, of_two_bodies(effect, with_rotor(rotor, **rubs), at_motor), effect, period)
        right, wrong = (
            np.abs(arm.run(read_and_true, arm.vector(**{effect: {"elbow": gears}}), segment) - expected).max(axis=0)
            for gears in (GEARS[effect] | {"at_motor": share} for share in (at_motor, 1.0 - at_motor))
        )
        assert right[:2].max() < most
        assert right[2:].max() < (0.65 if rubs and effect == "backlash" else 1.4) * most
        # Where it rubs makes a difference.
        assert not rubs or at_motor == 0.5 or wrong.max() > 2.5 * right.max()


@pytest.mark.parametrize("effect", GEARS)
def test_a_link_behind_its_gears_weighs_what_it_weighs_in_the_pose_of_the_robot(effect):
    # About its long axis the straight arm of the model's first pose has 0.0007 kg m^2 beside a rotor of 0.05, and the
    # bent one 0.013.
    spec = mujoco.MjSpec.from_string(rigs.ARM)
    shoulder = spec.joint("shoulder")
    shoulder.axis, shoulder.armature = [0.0, 0.0, 1.0], 0.05
    arm = rigs.Player(Rig(spec, rigs.ARM_JOINTS, 200.0))
    expected, segment = pushed(
        arm, of_two_bodies(effect, spec.copy(), 0.0, joint="shoulder"), effect, 5e-3, joint="shoulder", start=(0.4, 1.4)
    )
    gears = arm.vector(**{effect: {"shoulder": GEARS[effect]}})
    assert np.abs(arm.run(read_and_true, gears, segment) - expected).max() < 9e-3


@pytest.mark.parametrize("rotor", [0.005, 0.2])
def test_a_spring_with_a_damper_is_that_of_two_bodies(rotor):
    arm = rigs.Player(Rig(with_rotor(rotor), rigs.ARM_JOINTS, 200.0))
    expected, segment = pushed(arm, of_two_bodies("compliance", with_rotor(rotor), 0.0, 0.6), "compliance", 5e-3)
    right, wrong = (
        np.abs(arm.run(read_and_true, arm.vector(compliance={"elbow": spring}), segment) - expected).max()
        for spring in (GEARS["compliance"] | {"nm_s_per_rad": 0.6}, GEARS["compliance"])
    )
    assert right < 6e-3
    assert wrong > 4 * right


def test_bristles_of_a_link_behind_its_gears_rub_as_those_of_two_bodies():
    arm = rigs.Player(Rig(with_rotor(0.2, friction=1.0), rigs.ARM_JOINTS, 200.0))
    for effect in GEARS:
        model = of_two_bodies(effect, with_rotor(0.2), 0.0)
        expected, segment = pushed(arm, model, effect, 5e-3, rub=bristles(1.0, 0.05))
        effects = {effect: {"elbow": GEARS[effect]}, "presliding": {"elbow": {"travel_rad": 0.05}}}
        assert np.abs(arm.run(read_and_true, arm.vector(**effects), segment) - expected).max() < 5e-3


@pytest.mark.parametrize(("rotor", "damping", "period"), [(0.02, 0.3, 2e-3), (0.2, 0.5, 5e-3)])
def test_an_encoder_at_the_joint_sees_nothing_of_the_gears(rotor, damping, period):
    arm = rigs.Player(Rig(with_rotor(rotor, damping=damping), rigs.ARM_JOINTS, 1.0 / period))
    # A spring without a damper swings on and on, since the controller does not see the motor.
    for effect, damper in (("backlash", {}), ("compliance", {"nm_s_per_rad": 0.3})):
        model = of_two_bodies(effect, with_rotor(rotor, damping=damping), 1.0, *damper.values())
        expected, segment = pushed(arm, model, effect, period, at_joint=True)
        gears = {effect: {"elbow": GEARS[effect] | damper | {"at_motor": 1.0}}}
        right, wrong = (
            np.abs(arm.run(read_and_true, arm.vector(**gears, **encoder), segment) - expected).max(axis=0)
            for encoder in ({"joint_encoder": {"elbow": {"at_joint": 1.0}}}, {})
        )
        assert right.max() < 7e-3
        assert wrong[:2].max() > 10 * right.max()


@pytest.mark.parametrize("rotor", [0.02, 0.2])
def test_a_log_of_the_joint_beside_a_controller_of_the_motor(rotor):
    arm = rigs.Player(Rig(with_rotor(rotor), rigs.ARM_JOINTS, 200.0))
    for effect in GEARS:
        expected, segment = pushed(arm, of_two_bodies(effect, with_rotor(rotor), 0.0), effect, 5e-3, log_at_joint=True)
        links = np.hstack([expected[:, 2:], expected[:, 2:]])
        gears = {effect: {"elbow": GEARS[effect]}}
        right, wrong = (
            np.abs(arm.run(read_and_true, arm.vector(**gears, **log), segment) - links).max()
            for log in ({"joint_log": {"elbow": {"at_joint": 1.0}}}, {})
        )
        assert right < 9e-3
        assert wrong > 2 * right


def bristles(bound, travel):
    """Torque of bristles in Nm, step by step of 0.1 ms, of a speed in rad/s."""
    wound = 0.0

    def torque(speed):
        nonlocal wound
        wound = np.clip(wound + 1e-4 * speed / travel, -1.0, 1.0)
        return -bound * wound

    return torque


def pushed(
    arm,
    model,
    effect,
    period,
    rub=lambda speed: 0.0,
    at_joint=False,
    log_at_joint=False,
    joint="elbow",
    start=(0.4, -0.9),
):
    """Sends a link there and back.

    Args:
      arm: on the rig.
      model: of two bodies, for MuJoCo C.
      effect: of its gears.
      period: of the controller in s.
      rub: torque on the link in Nm at its speed in rad/s, beside the friction of the model.
      at_joint: whether the encoder is at the link, not on the motor.
      log_at_joint: whether that of the log alone is.
      joint: that has the gears.
      start: where the links rest.

    Returns:
      Encoders and links [steps, joints] in MuJoCo C, and the segment for the rig.
    """
    data, start = mujoco.MjData(model), np.array(start)
    at, gears = [model.joint(name).id for name in rigs.ARM_JOINTS], model.joint("gears").id
    behind = np.array([name == joint for name in rigs.ARM_JOINTS])
    data.qpos[at] = start
    mujoco.mj_forward(model, data)
    gravity = data.qfrc_bias[at].copy()
    # At rest, with the motor where the torque of gravity has brought it.
    ahead = behind * (np.sign(gravity) * 0.02 if effect == "backlash" else gravity / GEARS[effect]["nm_per_rad"])
    motor, kp, kd = start + ahead, np.array([60.0, 20.0]), np.array([2.0, 0.4])
    data.qpos[at], data.qpos[gears] = motor, -ahead.sum()
    if at_joint:
        motor = start
    target = np.tile(motor + np.where(behind, 0.4, 0.1), (rigs.STEPS, 1))
    target[0] = motor + gravity / kp
    target[70:] = motor - np.where(behind, 0.4, 0.1)
    linked = lambda joints: joints[at] + behind * joints[gears]  # noqa: E731
    read = linked if at_joint else lambda joints: joints[at]
    rubbing = np.zeros(model.nv)
    expected = []
    for step in range(10 * rigs.STEPS):
        if step % 10 == 0:
            expected.append([*read(data.qpos), *linked(data.qpos)])
        if step % round(period / model.opt.timestep) == 0:
            torque = kp * (target[step // 10] - read(data.qpos)) - kd * read(data.qvel)
        rubbing[[*np.array(at)[behind], gears]] = rub(behind @ linked(data.qvel))
        data.qfrc_applied[:] = rubbing
        data.qfrc_applied[at] += torque
        mujoco.mj_step(model, data)
    return np.array(expected), rigs.segment(arm.rig, start if log_at_joint else motor, target, kp, kd)


def test_links_need_the_torques_of_inverse_dynamics(arm, plain):
    state, speeding = np.array([START, [1.5, -0.8]]), np.array([3.0, -5.0])
    data = mujoco.MjData(plain)
    data.qpos[:], data.qvel[:], data.qacc[:] = *state, speeding
    mujoco.mj_inverse(plain, data)
    got = arm.run(needed_by, arm.vector(), state.astype(np.float32), speeding.astype(np.float32))
    np.testing.assert_allclose(got, data.qfrc_inverse - plain.dof_armature * speeding, rtol=1e-4)


def needed_by(rig, values, state, speeding):
    return history.needed(rig.chain, rig.model(values), rig._data, state, speeding)


PLAY = {"rad": 0.04}


@pytest.mark.parametrize("trend", [-1.0, 1.0])
def test_a_motor_that_is_off_carries_its_link_by_friction(arm, trend):
    """The link lies on the side of the play to which its weight drives it, whatever noise says of accelerations."""
    rubs = {"coulomb": {name: {"torque_nm": 3.0} for name in rigs.ARM_JOINTS}}
    off = rigs.segment(arm.rig, START, START, limit=0.0)
    begin = round((segments.HISTORY_S - beginning._GEARS_S) / arm.rig.dt)
    noise = np.zeros_like(off.measured)
    noise[begin : begin + 11, 1] = trend * arm.rig.dt * np.arange(-5, 6)[:, None]
    read = arm.play(off.replace(measured=off.measured + noise), **rubs, backlash={"elbow": PLAY | {"at_motor": 1.0}})
    # As without play: no link falls, and none meets its motor.
    np.testing.assert_allclose(read["q"], arm.play(off, **rubs)["q"], atol=2e-4)


def test_what_presses_on_gears_is_shared_as_friction_is(arm):
    torque, needed = np.tile(np.float32([1.0, -1.0]), (10, 1)), np.float32([-0.5, 3.0])

    def start(rig, values, torque, needed):
        return history.pressed(rig.chain, values, torque, needed)

    for at_motor, pressing in ((0.0, [1.0, -1.0]), (1.0, [-0.5, 3.0]), (0.5, [0.25, 1.0])):
        play = {name: PLAY | {"at_motor": at_motor} for name in rigs.ARM_JOINTS}
        spring = {name: {"nm_per_rad": 50.0, "at_motor": at_motor} for name in rigs.ARM_JOINTS}
        got = arm.run(start, arm.vector(backlash=play, compliance=spring), torque, needed)
        np.testing.assert_allclose(got["backlash"][0], 0.02 * np.sign(pressing), rtol=1e-5)
        np.testing.assert_allclose(got["compliance"][0], np.array(pressing) / 50.0, rtol=1e-4)


def test_rotors_without_inertia_and_motors_that_are_off_stay_with_their_links():
    spec = with_rotor(0.0)
    spec.joint("shoulder").armature = 0.0
    light = rigs.Player(Rig(spec, rigs.ARM_JOINTS, rigs.CONTROL_HZ))
    for gears in ({"backlash": {"elbow": {"rad": 0.04}}}, {"compliance": {"elbow": {"nm_per_rad": 60.0}}}):
        for drive in ({"kp": 20.0, "kd": 0.4}, {"limit": 0.0}, {"feed": [0.5, -0.2], "emf": 0.1}):
            read = light.play(rigs.segment(light.rig, START, START, **drive), **gears)
            assert all(np.isfinite(values).all() for values in read.values())
            without = light.play(rigs.segment(light.rig, START, START, **drive))["q"]
            assert np.abs(read["q"] - without).max() < 0.1


def test_robots_of_other_controllers_share_no_program(arm):
    other = Rig(mujoco.MjSpec.from_string(rigs.ARM), rigs.ARM_JOINTS, 5 * rigs.CONTROL_HZ)
    assert other.dt == arm.rig.dt
    assert other.layout != arm.rig.layout


@pytest.mark.parametrize("rotor", [0.01, 0.0005])
def test_what_is_read_is_what_the_next_step_reads(rotor):
    """Also where play and a sensor's lag are at one joint: in a walk the policy reads, and then the step does."""
    # The controller of the lighter rotor acts within the step.
    arm = rigs.Player(Rig(with_rotor(rotor), rigs.ARM_JOINTS, rigs.CONTROL_HZ))
    rig, vector = arm.rig, arm.vector(backlash={"elbow": {"rad": 0.04}}, sensor_lag={"elbow": {"seconds": 0.01}})
    values, segment = rig.values(rig.tree(vector)), rigs.segment(rig, START, START, kp=20.0, kd=0.4, speed=[1.0, -2.0])
    model, chain = jax.jit(rig.model)(values), rig.chain
    x = {name: getattr(segment, name)[0] for name in ("target", "between", "feed", "stiffness", "damping", "limit")}
    x |= {"emf": segment.emf[0], "sample": np.ones((), bool)}
    data = rig._data.replace(qpos=jnp.asarray(START, jnp.float32), qvel=jnp.array([1.0, -2.0]))
    data = jax.jit(stepping.placed)(model, data)
    memory, step = chain.start(values, chain.joints(data), x), jax.jit(chain.step)
    # Now the motor turns round, and crosses its play.
    x["target"], fast = START - 1.0, 0.0
    for _ in range(5):
        joint, before = chain.joints(data), memory
        read = chain.read(values, before, joint, x)
        data, memory, expected = step(model, data, before, values, x)
        np.testing.assert_allclose(read, [expected["q"], expected["dq"]], atol=1e-5)
        fast = max(fast, np.abs(chain.ahead(before)[1]).max())
    assert fast > 0.1


def test_the_imu_reads_the_models_gravity():
    spec = mujoco.MjSpec.from_string(rigs.ARM)
    spec.option.gravity = [9.81, 0.0, 0.0]
    hung = rigs.Player(Rig(spec, rigs.ARM_JOINTS, rigs.CONTROL_HZ))
    read = hung.play(rigs.segment(hung.rig, START, START))
    np.testing.assert_allclose(read["gravity"], [[1.0, 0.0, 0.0]] * rigs.STEPS, atol=1e-6)


def test_the_imu_reads_gravity_as_it_is_mounted(arm):
    segment = rigs.segment(arm.rig, START, START)
    np.testing.assert_allclose(arm.play(segment)["gravity"], [[0.0, 0.0, -1.0]] * rigs.STEPS, atol=1e-6)
    # Pitched by 0.02 rad it sees the ground ahead, 0.02 along its x; rolled by 0.01, to its right.
    tilted = arm.play(segment, imu_tilt={"robot": {"pitch_rad": 0.02, "roll_rad": 0.01}})
    np.testing.assert_allclose(tilted["gravity"][0], [0.02, -0.01, -1.0], atol=3e-4)


TURNED = {"roll_rad": 0.2, "pitch_rad": -0.1}


def test_a_base_that_is_not_level_moves_as_a_turned_one(arm):
    turned = rigs.ARM.replace("<worldbody>", '<worldbody><body name="base" quat="1 0 0 0">', 1)
    spec = mujoco.MjSpec.from_string(turned.replace("</worldbody>", "</body></worldbody>"))
    rolled, pitched, both = np.zeros(4), np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(rolled, np.array([1.0, 0.0, 0.0]), TURNED["roll_rad"])
    mujoco.mju_axisAngle2Quat(pitched, np.array([0.0, 1.0, 0.0]), TURNED["pitch_rad"])
    mujoco.mju_mulQuat(both, rolled, pitched)
    spec.body("base").quat = both
    model = spec.compile()
    model.opt.timestep = arm.rig.dt
    segment = rigs.segment(arm.rig, START, steps_of(START), kp=[60.0, 30.0], kd=[0.8, 0.4])
    read = arm.play(segment, ground_slope={"robot": TURNED})
    agrees(read, rigs.in_mujoco(arm.rig, model, segment))
    assert np.abs(read["q"] - arm.play(segment)["q"]).max() > 0.005
    # Its IMU turns with it.
    expected = sensing.projected_gravity(jnp.asarray(both, jnp.float32))
    np.testing.assert_allclose(read["gravity"], [expected] * rigs.STEPS, atol=1e-6)


# The model.

FIELDS = (*reference.FIELDS[:9], "body_inertia")
INERTIAL = {
    "link_mass": {"upper": {"ratio": 0.8}, "lower": {"ratio": 1.3}},
    "link_inertia": {"upper": {"ratio": 1.2}, "lower": {"ratio": 0.7}},
    "com_offset": {"upper": {"x_m": 0.01, "y_m": -0.02, "z_m": 0.03}, "lower": {"x_m": -0.02, "z_m": 0.05}},
    # At the end of an oblique arm, so that the principal axes turn.
    "payload": {"upper": {"kg": 0.3}, "lower": {"kg": 0.1, "x_m": 0.08, "y_m": -0.05, "z_m": 0.1, "gyration_m": 0.02}},
    "armature": {"shoulder": {"kg_m2": 0.004}, "elbow": {"kg_m2": 0.03}},
    "viscous": {"shoulder": {"nm_s_per_rad": 0.07}, "elbow": {"nm_s_per_rad": -0.02}},
}


@pytest.mark.parametrize("names", [*[(name,) for name in INERTIAL], tuple(INERTIAL)], ids="+".join)
def test_effects_of_the_model_are_the_model_recompiled(arm, names):
    wrong = {name: INERTIAL[name] for name in names}
    spec = mujoco.MjSpec.from_string(rigs.ARM)
    nominal = spec.compile()
    for name, places in wrong.items():
        for place, values in places.items():
            change(spec, nominal, name, place, values)
    expected, got = spec.compile(), arm.model(**wrong)
    np.testing.assert_allclose(tensors(got), tensors(expected), rtol=1e-5, atol=1e-5 * tensors(expected).max())
    # Principal axes have no order.
    for field in (field for field in FIELDS if field != "body_inertia"):
        own = getattr(expected, field)
        np.testing.assert_allclose(getattr(got, field), own, rtol=1e-5, atol=1e-7 * np.abs(own).max(), err_msg=field)
    np.testing.assert_allclose(got.stat.meaninertia, expected.stat.meaninertia, rtol=1e-5)
    assert any(np.abs(getattr(expected, field) - getattr(nominal, field)).max() > 1e-3 for field in FIELDS)


def change(spec, nominal, effect, place, values):
    """Writes an effect into an MJCF, by no means that the rig uses."""
    if effect in ("armature", "viscous"):
        joint = spec.joint(place)
        if effect == "armature":
            joint.armature += values["kg_m2"]
        else:
            joint.damping[0] += values["nm_s_per_rad"]
        return
    body, compiled = spec.body(place), nominal.body(place)
    if not body.explicitinertial:
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat = float(compiled.mass[0]), compiled.ipos, compiled.iquat
        body.inertia = compiled.inertia
    if effect in ("link_mass", "link_inertia"):
        body.mass *= values["ratio"] if effect == "link_mass" else 1.0
        body.inertia = body.inertia * values["ratio"]
    elif effect == "payload":
        # About the link's frame: mass, first and second moment of both.
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, body.iquat)
        turn = turn.reshape(3, 3)
        second = turn @ np.diag(body.inertia) @ turn.T + body.mass * about_origin(body.ipos)
        centre = body.ipos + [values.get(f"{axis}_m", 0.0) for axis in "xyz"]
        second += values["kg"] * (about_origin(centre) + values.get("gyration_m", 0.0) ** 2 * np.eye(3))
        whole = body.mass + values["kg"]
        body.ipos = (body.mass * body.ipos + values["kg"] * centre) / whole
        own = second - whole * about_origin(body.ipos)
        body.mass, body.iquat, body.inertia = whole, [1.0, 0.0, 0.0, 0.0], np.zeros(3)
        body.fullinertia = own[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    else:
        body.ipos = body.ipos + [values.get(f"{axis}_m", 0.0) for axis in "xyz"]


def about_origin(point):
    """Second moment of a unit mass at a point, [3, 3]."""
    return point @ point * np.eye(3) - np.outer(point, point)


def tensors(model):
    """Inertia of every body along the axes of its frame, [bodies, 3, 3]."""
    turns = np.zeros((model.nbody, 9))
    for turn, quat in zip(turns, np.asarray(model.body_iquat, float), strict=True):
        mujoco.mju_quat2Mat(turn, quat)
    turns = turns.reshape(-1, 3, 3)
    return (turns * np.asarray(model.body_inertia)[:, None]) @ turns.swapaxes(1, 2)


def test_without_effects_the_model_is_the_robots(arm):
    got, expected = arm.model(), arm.rig.mj_model
    for field in FIELDS:
        if field != "dof_frictionloss":
            np.testing.assert_allclose(getattr(got, field), getattr(expected, field), rtol=1e-5, atol=1e-7)


def test_a_pendulums_inertia_and_mass(pendulum):
    # 0.49 kg at 0.1 m, the sphere's 2/5 0.49 0.02^2, the arm's 3.3e-6, and the motor's 0.0019 kg m^2.
    mass, inertia = pendulum.inertias(np.array([0.7]))
    np.testing.assert_allclose(mass, [0.491], rtol=1e-6)
    np.testing.assert_allclose(inertia, [0.0049 + 7.84e-5 + 3.4e-6 + 0.0019], rtol=1e-4)


def test_a_bent_arm_has_less_inertia_at_its_shoulder(arm):
    def shoulder(elbow):
        return arm.rig.inertias(np.array([0.3, elbow]))[1][0]

    # The lower link's centre is 0.125 m from the elbow, that 0.3 m from the shoulder: 2 x 0.6 x 0.3 x 0.125 x cos.
    np.testing.assert_allclose(shoulder(0.0) - shoulder(np.pi / 2), 0.045, rtol=1e-6)


def test_levers_are_how_fast_joints_move_centres_of_mass(arm):
    straight, bent = (arm.rig.levers(np.array([0.3, elbow])) for elbow in (0.0, np.pi / 2))
    np.testing.assert_allclose(straight, [[0.15, 0.0], [0.425, 0.125]], atol=1e-6)
    np.testing.assert_allclose(bent[1], [np.hypot(0.3, 0.125), 0.125], rtol=1e-6)


# Parameters.


def prior_sd(rig):
    """Prior standard deviations of nominal parameters, by effect and place; each of them has one parameter."""
    nominal = [axis for axis in rig.axes if axis.prior_sd > 0]
    found = {(axis.effect, axis.place): axis.prior_sd for axis in nominal}
    assert len(found) == len(nominal)
    return found


def test_nominal_parameters_are_those_that_the_model_has(pendulum):
    # The pendulum's hinge has no viscous friction.
    expected = {
        ("coulomb", "hinge"): 0.0019,
        ("gain_error", "hinge"): 0.035,
        ("damping_gain", "hinge"): 0.05,
        ("armature", "hinge"): 0.00019,
        ("link_mass", "arm"): 0.1,
        ("link_inertia", "arm"): 0.1,
    }
    got = prior_sd(pendulum)
    assert got.keys() == expected.keys()
    for place, sd in expected.items():
        np.testing.assert_allclose(got[place], sd, rtol=1e-6)


def test_prior_standard_deviations_are_in_coordinates(arm):
    got = prior_sd(arm.rig)
    # A tenth of 0.01 kg m^2 and of 0.05 Nm s/rad, over what a coordinate stands for; the arm has no dry friction.
    np.testing.assert_allclose(got["armature", "shoulder"], 0.001 / 0.11, rtol=1e-6)
    np.testing.assert_allclose(got["armature", "elbow"], 0.001 / 0.03, rtol=1e-6)
    np.testing.assert_allclose(got["viscous", "elbow"], 0.005 / 0.3, rtol=1e-6)
    inertial = {"armature", "link_mass", "link_inertia"}
    assert {effect for effect, _ in got} == {"viscous", "gain_error", "damping_gain"} | inertial
    assert {place for _, place in got} == {"shoulder", "elbow", "upper", "lower"}


def test_a_hundredth_of_a_field_stays_when_an_effect_takes_from_it(arm):
    least = {(axis.effect, axis.place): axis.least for axis in arm.rig.axes}
    # The arm's armature is 0.01 kg m^2; a coordinate stands for 0.11 and 0.03 of them.
    np.testing.assert_allclose(least["armature", "shoulder"], -0.0099 / 0.11, rtol=1e-6)
    np.testing.assert_allclose(least["armature", "elbow"], -0.0099 / 0.03, rtol=1e-6)
    # It has no dry friction, of which nothing can be taken.
    assert least["coulomb", "elbow"] == 0.0


def test_dry_friction_of_the_model_can_be_taken_as_well():
    spec = mujoco.MjSpec.from_string(rigs.ARM)
    spec.joint("elbow").frictionloss = 0.05
    # A placeholder: more than any effect adds.
    spec.joint("shoulder").armature = 1.0
    rig = Rig(spec, rigs.ARM_JOINTS, rigs.CONTROL_HZ)
    least = {(axis.effect, axis.place): axis.least * axis.scale for axis in rig.axes if axis.takes}
    assert least["coulomb", "elbow"] == pytest.approx(-0.0495)
    assert least["armature", "shoulder"] == pytest.approx(-0.99)


def test_a_vector_has_its_axes_by_effect_parameter_and_place(arm):
    rig = arm.rig
    tree = rig.tree(np.arange(len(rig.axes)))
    for number, axis in enumerate(rig.axes):
        assert tree[axis.effect][axis.parameter][axis.index] == number
        assert rig.places[rig.effects[axis.effect].on][axis.index] == axis.place
    assert sum(len(places) for effect in tree.values() for places in effect.values()) == len(rig.axes)
    # Feet in the air show nothing of the ground.
    assert set(LIBRARY) - set(rig.effects) == {"ground_friction", "ground_compliance"}


def test_physics_reads_values_in_their_units(arm):
    values = arm.rig.values(arm.rig.tree(arm.vector(coulomb={"elbow": {"torque_nm": 0.3}})))
    np.testing.assert_allclose(values["coulomb"]["torque_nm"], [0.0, 0.3], rtol=1e-6)
    # What shapes an effect that is not there.
    np.testing.assert_allclose(values["stribeck"]["speed_rad_s"], rigs.ARM_SCALES["slow"], rtol=1e-6)


def test_links_show_in_the_joints_that_carry_them(arm):
    assert arm.rig.moves("body", "upper") == (0,)
    assert arm.rig.moves("body", "lower") == (1, 0)
    assert arm.rig.moves("joint", "elbow") == (1,)
    assert arm.rig.moves("robot", "robot") == ()


# Hanging.


def test_a_suspended_robot_has_its_joints_and_no_base():
    model = suspended(models.spec("biteno"))
    assert (model.nq, model.nv, model.nkey) == (6, 6, 0)
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    rig = Rig(models.spec("biteno"), constants.JOINTS, rigs.CONTROL_HZ)
    # The trunk hangs still.
    assert "trunk" not in rig.bodies
    assert len(rig.bodies) == 6


@pytest.mark.parametrize(("control_hz", "steps"), [(200.0, 5), (1000.0, 1), (60.0, 17), (2000.0, 1)])
def test_a_step_divides_the_controllers_period_and_is_no_longer_than_a_millisecond(control_hz, steps):
    rig = Rig(models.spec("pendulum"), ("hinge",), control_hz)
    np.testing.assert_allclose(rig.dt, 1.0 / control_hz / steps, rtol=1e-9)
    assert rig.mj_model.opt.timestep == rig.dt


GRIPPER = """<mujoco><worldbody>
  <body name="left"><joint name="l" type="slide" axis="0 1 0"/><geom size="0.01" mass="0.1"/></body>
  <body name="right"><joint name="r" type="slide" axis="0 -1 0"/><geom size="0.01" mass="0.1"/></body>
</worldbody>{coupling}</mujoco>"""


@pytest.mark.parametrize(
    ("coupling", "trees"),
    [
        ("", [0, 1]),
        ('<equality><joint joint1="l" joint2="r"/></equality>', [0, 0]),
        (
            '<tendon><fixed stiffness="200"><joint joint="l" coef="1"/><joint joint="r" coef="-1"/></fixed></tendon>',
            [0, 0],
        ),
    ],
    ids=["apart", "equality", "tendon"],
)
def test_joints_that_something_couples_are_of_one_tree(coupling, trees):
    rig = Rig(mujoco.MjSpec.from_string(GRIPPER.format(coupling=coupling)), ("l", "r"), rigs.CONTROL_HZ)
    np.testing.assert_array_equal(rig.trees, trees)


def test_neighbours_of_a_joint_are_along_its_own_arm():
    link = '<body><joint name="{}"/><geom size="0.1"/>'
    arms = [link.format(f"{side}_1") + link.format(f"{side}_2") + 2 * "</body>" for side in ("left", "right")]
    trunk = link.format("yaw") + link.format("lean") + "".join(arms) + 2 * "</body>"
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{trunk}</worldbody></mujoco>")
    joints = ("yaw", "lean", "right_1", "right_2", "left_1", "left_2")
    before, after = Rig(spec, joints, rigs.CONTROL_HZ).chain.beside
    assert before.tolist() == [6, 0, 1, 2, 1, 4]
    assert after.tolist() == [1, 6, 3, 6, 5, 6]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_neighbours_are_those_of_the_model_in_whatever_order_a_log_names_joints(order):
    names = [rigs.ARM_JOINTS[index] for index in order]
    rig = Rig(mujoco.MjSpec.from_string(rigs.ARM), names, rigs.CONTROL_HZ)
    before, after = rig.chain.beside
    # The shoulder has none before it, and the elbow none after it, which is an index past the last.
    assert [before[names.index("shoulder")], after[names.index("elbow")]] == [2, 2]
    assert names[before[names.index("elbow")]] == "shoulder"
    assert names[after[names.index("shoulder")]] == "elbow"


LIFTED = """<mujoco><worldbody>
  <body name="upper" gravcomp="1"><joint name="a" axis="0 1 0" armature="0.01"/>
    <inertial pos="0.15 0 0" mass="1" diaginertia="0.001 0.01 0.01"/>
    <body name="lower" pos="0.3 0 0" gravcomp="0.7"><joint name="b" axis="0 1 0" armature="0.01"/>
      <inertial pos="0.1 0 0" mass="0.7" diaginertia="0.001 0.004 0.004"/>
    </body></body>
</worldbody></mujoco>"""


def test_a_controller_that_carries_its_robots_weight_does_not_know_of_a_load():
    spec = mujoco.MjSpec.from_string(LIFTED)
    player = rigs.Player(Rig(spec, ("a", "b"), rigs.CONTROL_HZ))
    target = np.linspace(0.0, 0.3, rigs.STEPS)[:, None] * [1.0, -1.0]
    segment = rigs.segment(player.rig, np.zeros(2), target, kp=np.array([40.0, 10.0]), kd=np.array([3.0, 0.6]))
    load = spec.body("lower").add_body(name="load", pos=[0.15, 0.02, 0.0])
    load.explicitinertial, load.mass, load.inertia = True, 0.5, [1e-9] * 3
    load.ipos, load.iquat = [0.0] * 3, [1.0, 0.0, 0.0, 0.0]
    loaded = spec.compile()
    loaded.opt.timestep = player.rig.dt
    expected = rigs.in_mujoco(player.rig, loaded, segment)[:, 0]
    payload = {"lower": {"kg": 0.5, "x_m": 0.05, "y_m": 0.02}}
    np.testing.assert_allclose(player.play(segment, payload=payload)["q"], expected, atol=1e-6)
    # Its weight pulls: without, nothing does.
    assert np.abs(player.play(segment)["q"] - expected).max() > 0.01


def test_of_several_joints_in_one_body_the_last_is_nearest_to_it():
    body = '<body name="hip"><joint name="{}"/><joint name="{}" axis="1 0 0"/><joint name="{}" axis="0 1 0"/>'
    body += '<geom size="0.1"/><body name="leg" pos="0 0 -1"><joint name="knee"/><geom size="0.1"/></body></body>'
    xml = f"<mujoco><worldbody>{body.format('yaw', 'roll', 'pitch')}</worldbody></mujoco>"
    rig = Rig(mujoco.MjSpec.from_string(xml), ("knee", "roll", "yaw", "pitch"), rigs.CONTROL_HZ)
    assert rig.moves("body", "leg") == (0, 3, 1, 2)


def test_springs_of_the_model_are_known_no_better_than_its_dampers():
    joints = '<joint name="{}" stiffness="{}"/><geom size="0.1" pos="0.2 0 0"/>'
    lower = f'<body name="lower">{joints.format("b", 0)}</body>'
    xml = f'<mujoco><worldbody><body name="upper">{joints.format("a", 20)}{lower}</body></worldbody></mujoco>'
    rig = Rig(mujoco.MjSpec.from_string(xml), ("a", "b"), rigs.CONTROL_HZ)
    found = {axis.place: (axis.prior_sd, axis.least) for axis in rig.axes if axis.effect == "joint_spring"}
    np.testing.assert_allclose((found["a"], found["b"]), [(2.0, -19.8), (0.0, 0.0)], rtol=1e-6)
    drawn = Robot.drawn(mujoco.MjSpec.from_string(xml), ("a", "b"), np.random.default_rng(0)).model.jnt_stiffness
    assert drawn[0] != 20.0 and 16.0 < drawn[0] < 25.0 and drawn[1] == 0.0
