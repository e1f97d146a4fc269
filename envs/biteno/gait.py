"""The gait clock, and the joint angles that a foot following it would have (Raibert's heuristic)."""

import jax
import jax.numpy as jnp

from envs.biteno import constants


def advance(phase: jax.Array) -> jax.Array:
    """Moves the phases on by one policy step, in cycles."""
    return jnp.mod(phase + constants.CLOCK_HZ * constants.POLICY_DT_S, 1.0)


def foot_reference(phase: jax.Array, command: jax.Array) -> jax.Array:
    """Where each foot's centre should be below its hip.

    In stance (phase below the duty of one half) the foot sweeps back at the commanded speed, half a stride before to
    half a stride behind the hip; in swing it returns and lifts. A reference without the lift would ask the robot to
    stand still.

    Args:
      phase: [2] cycles.
      command: [3] m/s, m/s, rad/s.

    Returns:
      [2, 3] m, in the trunk's axes, from each hip.
    """
    reach = jnp.abs(1.0 - 2.0 * phase) - 0.5
    stance_s = constants.DUTY / constants.CLOCK_HZ
    x = reach * (command[0] - command[2] * constants.HIP_Y_M) * stance_s
    y = reach * command[1] * stance_s
    swing = jnp.sin(jnp.pi * (2.0 * phase - 1.0))
    lift = constants.SWING_HEIGHT_M * jnp.where(phase > constants.DUTY, swing, 0.0)
    return jnp.stack([x, y, lift - constants.STANCE_DEPTH_M], axis=-1)


def leg_angles(foot: jax.Array) -> jax.Array:
    """Inverse kinematics of one leg: foot centre [..., 3] m from the hip to (abduction, hip, knee) [..., 3] rad."""
    x, y, z = foot[..., 0], foot[..., 1], foot[..., 2]
    depth = jnp.hypot(y, z)
    length = jnp.hypot(x, depth)
    # The two links are equally long, so the knee folds by twice the angle between a link and the line hip to foot.
    knee = 2.0 * jnp.arccos(jnp.clip(length / (2.0 * constants.LINK_M), 0.0, 1.0))
    hip = -jnp.arctan2(x, depth) - knee / 2.0
    return jnp.stack([jnp.arctan2(y, -z), hip, knee], axis=-1)


def joint_reference(phase: jax.Array, command: jax.Array) -> jax.Array:
    """Raibert's joint angles q* [6] rad for phases [2] and a command [3]."""
    return leg_angles(foot_reference(phase, command)).reshape(-1)
