import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import reference

from envs.biteno import constants

pybullet = pytest.importorskip("pybullet", reason="PyBullet is an extra")

from envs.targets import bullet  # noqa: E402
from envs.targets.bullet import Bullet  # noqa: E402


@pytest.fixture(scope="module")
def drawn():
    """Masses, centre of mass and friction of a robot that is not nominal."""
    names = [name for name in constants.ENTRIES if name.endswith("mass") or name in ("foot_friction", "trunk_com_x_m")]
    return reference.draw(np.random.default_rng(0), names, share=0.5)


@pytest.fixture(scope="module")
def engine(robot, drawn):
    return Bullet(robot, drawn)


@pytest.fixture(scope="module")
def world(engine):
    return engine._world()


@pytest.fixture(scope="module")
def model(drawn):
    return reference.recompiled(drawn)


def links(world):
    """PyBullet's index of every link by the name of its body."""
    client, body, *_ = world
    named = {client.getJointInfo(body, link)[12].decode(): link for link in range(client.getNumJoints(body))}
    return {"trunk": -1, **named}


def test_links_have_the_masses_and_inertias_of_the_compiled_model(world, model):
    client, body, *_ = world
    found = links(world)
    assert len(found) == model.nbody - 1
    for name, link in found.items():
        info = client.getDynamicsInfo(body, link)
        expected = model.body(name)
        np.testing.assert_allclose(info[0], expected.mass[0], rtol=1e-6)
        # MuJoCo sorts principal axes; PyBullet keeps the body's own.
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, expected.iquat)
        inertia = turn.reshape(3, 3) @ np.diag(expected.inertia) @ turn.reshape(3, 3).T
        np.testing.assert_allclose(info[2], np.diag(inertia), rtol=1e-5)
        np.testing.assert_allclose(info[3], expected.ipos, atol=1e-6)


def test_joints_have_the_axes_and_limits_of_the_compiled_model(world, model):
    client, body, joints, _ = world
    for name, joint in zip(constants.JOINTS, joints, strict=True):
        info = client.getJointInfo(body, joint)
        assert info[1].decode() == name
        np.testing.assert_allclose(info[8:10], model.joint(name).range)
        np.testing.assert_allclose(info[13], model.joint(name).axis)


def test_feet_have_the_friction_of_the_model(world, model):
    client, body, _, feet = world
    for name, foot in zip(constants.FEET, feet, strict=True):
        np.testing.assert_allclose(client.getDynamicsInfo(body, foot)[1], model.geom(name).friction[0], rtol=1e-6)


def states(fresh, model, count, clearance):
    """Robots tilted and in motion, each lower foot this far above the floor."""
    rng = np.random.default_rng(1)
    qpos, qvel = map(np.stack, zip(*(reference.random_state(rng, model, clearance) for _ in range(count)), strict=True))
    state = jax.tree.map(lambda leaf: leaf[:count], fresh)
    return state.replace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))


def test_a_state_that_is_set_is_the_state_that_is_read(engine, fresh, model):
    # The trunk's centre of mass lies off its origin, and it turns: each of both moves would show if it were left out.
    state = states(fresh, model, 3, 0.5)
    engine.start(state)
    for row, world in enumerate(engine._worlds):
        qpos, qvel = engine._read(world)
        np.testing.assert_allclose(qpos * np.sign(qpos[3] * state.qpos[row, 3]), state.qpos[row] * 1.0, atol=1e-5)
        np.testing.assert_allclose(qvel, state.qvel[row], atol=1e-5)


def hanging(model, world, angles, steps):
    """Joint angles after a swing without torque, the trunk held: PyBullet's and MuJoCo's."""
    client, body, joints, _ = world
    spec = mujoco.MjSpec.from_file(str(constants.MODEL_PATH))
    spec.delete(spec.joint("base"))
    spec.delete(spec.keys[0])
    held = spec.compile()
    held.body_mass[:], held.body_inertia[:] = model.body_mass, model.body_inertia
    # PyBullet has no rotor inertia.
    held.dof_armature[:] = 0.0
    held.actuator_gainprm[:], held.actuator_biasprm[:] = 0.0, 0.0
    held.opt.timestep = model.opt.timestep
    mujoco.mj_setConst(held, mujoco.MjData(held))
    data = mujoco.MjData(held)
    data.qpos[:] = angles
    for _ in range(steps):
        mujoco.mj_step(held, data)
    for joint, angle in zip(joints, angles, strict=True):
        client.resetJointState(body, joint, angle, 0.0)
    fixed = client.createConstraint(
        body, -1, -1, -1, pybullet.JOINT_FIXED, [0, 0, 0], [0, 0, 0], client.getBasePositionAndOrientation(body)[0]
    )
    client.changeConstraint(fixed, maxForce=1e6)
    for _ in range(steps):
        client.stepSimulation()
    client.removeConstraint(fixed)
    return np.array([state[0] for state in client.getJointStates(body, joints)]), data.qpos


def test_legs_swing_as_in_mujoco(robot):
    nominal = Bullet(robot, reference.params())
    world = nominal._world()
    client, body, *_ = world
    client.resetBasePositionAndOrientation(body, [0.0, 0.0, 3.0], [0, 0, 0, 1])
    start = np.array([0.3, -0.9, 1.2, 0.1, 0.2, 0.6])
    got, expected = hanging(reference.recompiled(reference.params()), world, start, 150)
    # They fall by tenths of a radian in 0.15 s.
    assert np.abs(expected - start).max() > 0.2
    np.testing.assert_allclose(got, expected, atol=5e-3)


def test_a_robot_in_the_air_falls_as_fast(robot, fresh):
    engine = Bullet(robot, reference.params())
    state = states(fresh, robot.mj_model, 2, 0.5)
    engine.start(state)
    drive = jax.vmap(lambda state: robot.drive({}, state, jnp.zeros(6)))(state)
    com, speed = zip(
        *(centre_of_mass(robot.mj_model, *row) for row in zip(state.qpos, state.qvel, strict=True)), strict=True
    )
    motion = engine.move(state, drive)
    # 10 ms of free fall whatever the joints do: PyBullet and MuJoCo step alike, velocity first, by ten steps of 1 ms.
    for row in range(2):
        after, speed_after = centre_of_mass(robot.mj_model, motion.qpos[row], motion.qvel[row])
        np.testing.assert_allclose(speed_after - speed[row], [0, 0, -0.0981], atol=2e-3)
        np.testing.assert_allclose(after - com[row] - 0.01 * speed[row], [0, 0, -0.00054], atol=1e-4)


def centre_of_mass(model, qpos, qvel):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return data.subtree_com[1].copy(), data.subtree_linvel[1].copy()


def test_a_standing_robot_weighs_what_it_weighs(robot, start):
    engine = Bullet(robot, reference.params())
    home = robot.mj_model.keyframe("home").qpos
    state = jax.tree.map(lambda leaf: leaf[None], start)
    state = state.replace(qpos=jnp.asarray(home, jnp.float32)[None], qvel=jnp.zeros((1, 12)))
    engine.start(state)
    drive = jax.vmap(lambda state: robot.drive({}, state, jnp.zeros(6)))(state)
    forces = []
    for _ in range(40):
        motion = engine.move(state, drive)
        state = state.replace(qpos=motion.qpos, qvel=motion.qvel)
        forces.append(np.asarray(motion.foot_force[0]))
    # Two feet carry 15.5 kg, to within what swings.
    np.testing.assert_allclose(np.mean(forces[10:], axis=0)[:, 2].sum(), 15.5 * 9.81, rtol=0.05)


@pytest.mark.parametrize("name", ["joint_armature", "contact_time_constant"])
def test_what_pybullet_does_not_have_is_named(robot, name):
    with pytest.raises(ValueError, match=rf"params\['{name}'\]: got 2.0"):
        bullet.target(robot, {name: 2.0})
