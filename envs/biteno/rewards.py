"""Table I of the paper, term by term, unweighted, and what shapes learning beside it.

Two slips in print are mended: orientation is the horizontal part of projected gravity (|g|^2 is always one, and a
policy that pays for it learns to fall), and joint acceleration is squared (the square is missing). As in legged_gym,
whose form this is, acceleration is a finite difference over a policy step and every term is multiplied by that step's
length.

Table I's weights score a walk; they do not make one. What is trained differs in four things, each with a weight or a
size of its own: Raibert's term weighs more and the action rate less (`constants.WALKING`), actions are added to
Raibert's reference (`TaskConfig.base`), feet that leave the clock cost (`shaping`, `constants.SHAPING`), and the robot
is pushed (`TaskConfig.push_mps`). With the clock's term a walk lands once a step, where without it it lands one and a
half times; what is trained with pushes hardly falls under them.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from envs.biteno import constants

_SHARPNESS = 4.0
_FIRM_N = 30.0  # a fifth of the robot's weight


def terms(
    *,
    velocity: jax.Array,
    command: jax.Array,
    gyro: jax.Array,
    gravity: jax.Array,
    joint: jax.Array,
    joint_velocity: jax.Array,
    last_joint_velocity: jax.Array,
    torque: jax.Array,
    action: jax.Array,
    last_action: jax.Array,
    joint_reference: jax.Array,
) -> dict[str, jax.Array]:
    """The ten terms of Table I, each a scalar without weight or time step.

    Args:
      velocity, gyro, gravity: [3] body frame, as in `sensing.observe` but without noise.
      command: [3] m/s, m/s, rad/s.
      joint, joint_velocity, last_joint_velocity: [6] rad, rad/s; the last one a policy step ago.
      torque: [6] Nm.
      action, last_action: [6].
      joint_reference: [6] rad, Raibert's q*.
    """
    acceleration = (joint_velocity - last_joint_velocity) / constants.POLICY_DT_S
    return {
        "linear_tracking": jnp.exp(-_SHARPNESS * _square(command[:2] - velocity[:2])),
        "angular_tracking": jnp.exp(-_SHARPNESS * (command[2] - gyro[2]) ** 2),
        "linear_velocity_z": velocity[2] ** 2,
        "angular_velocity_xy": _square(gyro[:2]),
        "torque": _square(torque),
        "orientation": _square(gravity[:2]),
        "joint_acceleration": _square(acceleration),
        "action_rate": _square(action - last_action),
        "joint_default": _square(joint - constants.STAND_RAD),
        "raibert": _square(joint - joint_reference),
    }


def shaping(*, foot_force: jax.Array, phase: jax.Array) -> dict[str, jax.Array]:
    """Terms beside Table I that shape learning and are never scored, each a scalar without weight or time step.

    `clock_contact` is the share by which floor and clock disagree, summed over the feet: a foot that touches in its
    swing, or hangs or bounces in its stance. Without it a walk that bounces when it lands earns as much.

    Args:
      foot_force: [2, 3] N, of the floor on each foot.
      phase: [2] cycles.
    """
    touches = jnp.clip(foot_force[:, 2] / _FIRM_N, 0.0, 1.0)
    return {"clock_contact": jnp.sum(jnp.abs(touches - (phase < constants.DUTY)))}


def weigh(values: Mapping[str, jax.Array], weights: Mapping[str, float]) -> jax.Array:
    """Weighted sum of the terms, times the policy's time step."""
    return constants.POLICY_DT_S * sum(weight * values[name] for name, weight in weights.items())


def _square(vector: jax.Array) -> jax.Array:
    return jnp.sum(vector**2)
