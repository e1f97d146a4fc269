"""The reward: terms of the paper's Table I, unweighted, and terms that shape learning beside it.

Two slips in print are corrected. Orientation is the horizontal part of projected gravity, g_xy. In print it is |g|^2,
which is always one: a constant cost per step, under which a policy learns to fall. Joint acceleration is squared; the
square is missing in print. The form is that of legged_gym: acceleration is a finite difference over a policy step, and
every term is multiplied by the length of that step.

Table I's weights score a walk, but training with them alone does not produce one. Training therefore differs in four
things, each with a weight or a size of its own: Raibert's term weighs more and the action rate less
(`constants.WALKING`), actions are added to Raibert's reference (`TaskConfig.base`), contact outside the clock's stance
costs (`shaping`, `constants.SHAPING`), and the robot is pushed (`TaskConfig.push_mps`). With the term for contact a
foot touches down once a step, without it one and a half times. Policies that were trained with pushes hardly ever fall
when they are pushed.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from envs.biteno import constants

_SHARPNESS = 4.0  # of the tracking terms, in s^2/m^2 and s^2/rad^2
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
    """Computes the ten terms of Table I, each a scalar without weight or time step.

    With velocity v, command c, angular velocity w, projected gravity g, joints q, torque tau and action a:

        linear_tracking      exp(-4 |c_xy - v_xy|^2)
        angular_tracking     exp(-4 (c_yaw - w_z)^2)
        linear_velocity_z    v_z^2
        angular_velocity_xy  |w_xy|^2
        torque               |tau|^2
        orientation          |g_xy|^2
        joint_acceleration   |dq - last dq|^2 / dt^2
        action_rate          |a - last a|^2
        joint_default        |q - stand|^2
        raibert              |q - q*|^2

    Args:
      velocity: [3] m/s, body frame, without noise.
      command: [3] m/s, m/s, rad/s.
      gyro: [3] rad/s, body frame, without noise.
      gravity: [3] projected gravity, without noise.
      joint: [6] rad.
      joint_velocity: [6] rad/s.
      last_joint_velocity: [6] rad/s, a policy step ago.
      torque: [6] Nm.
      action: [6].
      last_action: [6], of the policy step before.
      joint_reference: [6] rad, Raibert's q*.

    Returns:
      Scalars by name, in the order of Table I.
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
    """Computes terms beside Table I that shape learning and are never scored, without weight or time step.

    `clock_contact` is how far contact and clock disagree, summed over the feet:

        |clip(normal force / 30 N, 0, 1) - (phase < duty)|

    It charges a foot that touches in its swing, or is lifted or bounces in its stance. Without it a walk that bounces
    when it lands earns as much.

    Args:
      foot_force: [2, 3] N, of the floor on each foot.
      phase: [2] cycles.

    Returns:
      Scalars by name.
    """
    touches = jnp.clip(foot_force[:, 2] / _FIRM_N, 0.0, 1.0)
    return {"clock_contact": jnp.sum(jnp.abs(touches - (phase < constants.DUTY)))}


def weigh(values: Mapping[str, jax.Array], weights: Mapping[str, float]) -> jax.Array:
    """Sums the terms with their weights, times the policy's time step of 10 ms: the reward of one step.

    Args:
      values: terms by name.
      weights: by name; only terms with a weight count.
    """
    return constants.POLICY_DT_S * sum(weight * values[name] for name, weight in weights.items())


def _square(vector: jax.Array) -> jax.Array:
    return jnp.sum(vector**2)
