"""What a robot's effects remember of motion that was measured before it is simulated (`envs.beginning`)."""

import jax
import jax.numpy as jnp
from mujoco import mjx

from envs import stepping
from envs.chain import LIGHTEST, MIN_FRICTION_NM, Chain, Wrench

_LIGHT = 0.05  # share of a joint's inertia under which its rotor is a light one
_HOLD_RAD_S = 200.0  # pace of the controller that holds rotors to their measured motion: 5 ms, some steps


def remember(chain: Chain, values, memory: dict, motor: jax.Array, x) -> tuple[dict, jax.Array]:
    """Fills the memories of sensors, controller and friction by a step of measured motion.

    Args:
      chain: of the robot, with all effects.
      values: of the effects.
      memory: before the step.
      motor: true positions and velocities of the motors, seen at the joints, [2, joints].
      x: the controller's inputs.

    Returns:
      The memories after the step, those of the transmission unchanged, and the motors' torques, [joints] Nm.
    """
    memory, torque, _ = chain.control(values, memory, motor, x)
    torque = torque - x["emf"] * motor[1]
    # Measured motion winds up the bristles as simulated motion does.
    _, memory = chain.stage("bristle", values, jnp.zeros_like(motor), chain.now_of(x, motor), memory)
    return memory | {"passed": torque}, torque


def follow(
    chain: Chain, model: mjx.Model, data: mjx.Data, memory: dict, values, motor, torque, x
) -> tuple[mjx.Data, dict]:
    """Simulates one step of links whose motors moved as measured: what gears that give way make of that motion.

    Each rotor is held to its measured motion by a controller of its own, in addition to the motor's torque. It is
    no stiffer than the rotor is heavy, or a twentieth of the joint where it is lighter, so where the rotor meets
    its link again, both feel it. Sensors remember the motors as the controller would have seen them (`Chain.within`).
    Where the log has an encoder at the joint, its link is held instead, and the rotor follows the motor's torque.

    Args:
      chain: of the robot, with all effects.
      model: of the robot, effects on its fields included.
      data: the robot before the step.
      memory: before the step.
      values: of the effects.
      motor: measured positions and velocities where the encoders are, sensors' errors undone, [2, joints].
      torque: of the motors, as `remember` returns it, [joints] Nm.
      x: the controller's inputs.

    Returns:
      The robot and the memories after the step.
    """
    joint, within = chain.joints(data), chain.within(model, x)
    far, fast = chain.at_log(values, chain.ahead(memory))
    unlogged = chain.unlogged(values, memory)
    # What the log has not seen, the controller has; it acts within the step, as rotors may be light.
    torque = torque - x["stiffness"] * unlogged[0]
    seen = (motor + unlogged).at[1].add(-within * (fast + unlogged[1]))
    _, memory = chain.stage("sensor", values, seen, chain.now_of(x, seen), memory | {"within": within})
    rotor, inertia = model.dof_armature[chain.dof], 1.0 / stepping.mobility(model, data)[chain.dof]
    at_motor = chain.at_log(values, jnp.ones_like(torque))
    held = at_motor * jnp.maximum(rotor, _LIGHT * inertia)
    acts = chain.at_encoders(values, jnp.ones_like(torque)) - at_motor
    hold = {
        "stiffness": held * _HOLD_RAD_S**2 + acts * x["stiffness"],
        "damping": 2.0 * held * _HOLD_RAD_S + acts * x["damping"],
        "emf": jnp.zeros_like(torque),
    }
    # How fast a rotor runs ahead acts within the step (`envs.effects.transmission`).
    position, speed = motor - joint.at[0].add(far)
    pull = _HOLD_RAD_S**2 * position + 2.0 * _HOLD_RAD_S * speed
    on_links = (1.0 - at_motor) * jnp.maximum(inertia - rotor, LIGHTEST * inertia) * pull
    return chain.move(model, data, memory, values, torque + held * pull, x | hold, on_links)[:2]


def bristles(chain: Chain, model: mjx.Model, data: mjx.Data, values, memory: dict, torque, x, past) -> dict:
    """Makes the memories of bristles from past positions.

    Args:
      chain: of the robot, with all effects.
      model: of the robot, effects on its fields included.
      data: the robot at the first of these positions. It rests there: bristles balance motors, gravity and outside
        torques.
      values: of the effects.
      memory: of the robot there.
      torque: of the motors there, [joints] Nm.
      x: the controller's inputs there.
      past: positions [past, joints] rad.

    Returns:
      By effect, how far its bristles are wound: [joints] from -1 to 1, where they slide.
    """
    still = stepping.placed(model, data.replace(qvel=jnp.zeros_like(data.qvel)))
    gravity, position = still.qfrc_bias[chain.dof], still.qpos[chain.qpos]
    load = jnp.maximum(jnp.abs(torque), jnp.abs(gravity))
    now = chain.now_of(x, jnp.stack([position, jnp.zeros_like(position)])).replace(load=load)
    calm = Wrench(torque=torque, force=jnp.zeros_like(now.body_velocity))
    pulled = chain.stage("wrench", values, calm, now, memory)[0].torque - gravity
    pulled += (still.qfrc_passive + chain.lifted(model, still))[chain.dof]
    friction, _ = chain.stage("friction", values, model.dof_frictionloss[chain.dof], now, memory)
    carried = jnp.clip(pulled / jnp.maximum(friction, MIN_FRICTION_NM), -1.0, 1.0)
    return {row.name: row.start(values[row.name], (carried, past), chain.dt) for row in chain.entering("bristle")}


def needed(chain: Chain, model: mjx.Model, data: mjx.Data, joint: jax.Array, speeding: jax.Array) -> jax.Array:
    """Computes the torques with which links move as they were measured, without friction, [joints] Nm.

    Rotors are left out.

    Args:
      chain: of the robot.
      model: of the robot, effects on its fields included.
      data: of the robot, in any state.
      joint: positions and velocities, [2, joints].
      speeding: accelerations, [joints].
    """
    qpos, qvel = data.qpos.at[chain.qpos].set(joint[0]), data.qvel.at[chain.dof].set(joint[1])
    there = stepping.placed(model, data.replace(qpos=qpos, qvel=qvel))
    inertia = mjx.full_m(model, there)[chain.dof][:, chain.dof]
    moves = inertia @ speeding - model.dof_armature[chain.dof] * speeding
    return moves + (there.qfrc_bias - there.qfrc_passive - chain.lifted(model, there))[chain.dof]


def pressed(chain: Chain, values, torque: jax.Array, needed: jax.Array) -> dict:
    """Makes the memories of the transmission from what presses on the gears.

    That is what the motor gives less what rubs there, and also what the link needs and what rubs there. The two differ
    by all that rubs, of which `at_motor` is the share before the gears. A motor that is off gives nothing; its friction
    may carry the link all the same, which then lies on the side of the play to which its weight drives it.

    Args:
      chain: of the robot.
      values: of the effects.
      torque: of the motors, less what accelerates the rotors, [steps, joints] Nm, one step after another.
      needed: of the links, [joints] Nm (`needed`).
    """
    found = {}
    for row in chain.entering("transmission"):
        mine = values[row.name]
        found[row.name] = row.start(mine, torque + mine["at_motor"] * (needed - torque), chain.dt)
    return found


def light(chain: Chain, model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Says how light rotors are: 1 without inertia, 0 from a twentieth of the joint's on, [joints]."""
    share = model.dof_armature[chain.dof] * stepping.mobility(model, data)[chain.dof]
    return jnp.clip(1.0 - share / _LIGHT, 0.0, 1.0)
