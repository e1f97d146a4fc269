"""The step of a robot on a rig against MuJoCo C with a solver that has converged."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from envs.stepping import step, stopped

_ARM = """
<mujoco>
  <option timestep="0.001"/>
  <default><geom type="capsule" size="0.03" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.01" frictionloss="0.6" limited="true" range="-1 1"/>
      <geom fromto="0 0 0 0 0 -0.3" mass="1.2"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" armature="0.005" frictionloss="0.2"/>
        <geom fromto="0 0 0 0 0 -0.25" mass="0.6"/>
        <body name="hand" pos="0 0 -0.25">
          <joint name="wrist" axis="1 0 0" armature="0.001" limited="true" range="-1 1"/>
          <geom fromto="0 0 0 0.1 0 -0.1" mass="0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
  {more}
</mujoco>
"""
_COUPLED = '<equality><joint joint1="elbow" joint2="wrist" polycoef="0 0.5 0 0 0"/></equality>'


def converged(text):
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 200, 100, 1e-14
    return model


@pytest.mark.parametrize("more", ["", _COUPLED], ids=["alone", "coupled"])
def test_a_step_is_that_of_a_solver_that_has_converged(more):
    model = converged(_ARM.format(more=more))
    rng, count = np.random.default_rng(0), 200
    # Joints at rest and moving, some beyond their ranges; torques below and above their frictions.
    pose = rng.uniform(-1.1, 1.1, (count, model.nv))
    speed = rng.normal(size=pose.shape) * np.where(rng.uniform(size=pose.shape) < 0.5, 1e-3, 1.0)
    torque = rng.normal(size=pose.shape) * 3.0
    expected, data = [], mujoco.MjData(model)
    for q, v, force in zip(pose, speed, torque, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel, data.qfrc_applied = q, v, force
        mujoco.mj_step(model, data)
        expected.append(data.qvel - v)
    model.opt.iterations = 6
    device = mjx.put_model(model)
    start = mjx.make_data(device)

    def found(q, v, force):
        return step(device, start.replace(qpos=q, qvel=v, qfrc_applied=force)).qvel - v

    inputs = (jnp.asarray(x, jnp.float32) for x in (pose, speed, torque))
    changes, expected = np.asarray(jax.jit(jax.vmap(found))(*inputs)), np.array(expected)
    size = np.abs(expected).max(axis=1, keepdims=True)
    assert np.abs((changes - expected) / size).max() < 1e-3


def test_a_robot_without_constraints_falls_freely():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint type="slide" axis="0 0 1"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    device = mjx.put_model(model)
    assert float(step(device, mjx.make_data(device)).qvel[0]) == pytest.approx(-9.81 * model.opt.timestep)


@pytest.mark.parametrize("torque", [0.4, 1.2], ids=["held by friction", "pushed"])
def test_half_a_second_is_that_of_a_solver_that_has_converged(torque):
    model = converged(_ARM.format(more=""))
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = torque
    mujoco.mj_step(model, data, 500)
    model.opt.iterations = 4
    device = mjx.put_model(model)
    start = mjx.make_data(device).replace(qfrc_applied=jnp.array([torque, 0.0, 0.0]))
    end = jax.jit(lambda one: jax.lax.fori_loop(0, 500, lambda _, one: step(device, one), one))(start)
    np.testing.assert_allclose(end.qpos, data.qpos, atol=2e-4)
    assert (abs(data.qpos[0]) > 0.01) == (torque > 1)


def test_friction_stops_joints_at_the_pace_that_is_foretold():
    # Thrown against its friction, which holds it against gravity: first it brakes, at last it creeps.
    model = converged("""
    <mujoco>
      <option timestep="0.001"/>
      <worldbody>
        <body>
          <joint axis="0 1 0" armature="0.01" frictionloss="9"/>
          <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1.2"/>
        </body>
      </worldbody>
    </mujoco>
    """)
    model.opt.iterations = 6
    device = mjx.put_model(model)
    data = mjx.make_data(device).replace(qpos=jnp.array([0.9]), qvel=jnp.array([0.1]))
    advance, accelerations = jax.jit(step), []
    for _ in range(300):
        before = stopped(device, data)
        data = advance(device, data)
        accelerations.append((before[0], data.qacc[0]))
    foretold, found = np.array(accelerations)[1:].T  # the first step has no load of one before
    np.testing.assert_allclose(foretold, found, rtol=0.02, atol=0.02)
    assert found[0] < -5.0
    assert abs(found[-1]) < 1e-2 < 100.0 * abs(data.qvel[0])
