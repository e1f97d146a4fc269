"""The policy's observation: one function, whatever engine moves the robot, and the noise on its readings."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

LAYOUT = {
    "velocity": np.full(3, 2.0, np.float32),
    "command": np.array([2.0, 2.0, 0.25], np.float32),
    "gyro": np.full(3, 0.25, np.float32),
    "gravity": np.ones(3, np.float32),
    "joint": np.ones(6, np.float32),
    "joint_velocity": np.full(6, 0.05, np.float32),
    "last_action": np.ones(6, np.float32),
    "joint_error": np.ones(6, np.float32),
    "clock": np.ones(4, np.float32),
}
"""Parts of the observation, in the order of the paper (section IV-A.2), and what each component is multiplied by."""

NOISE = {"velocity": 0.1, "gyro": 0.2, "gravity": 0.05, "joint": 0.01, "joint_velocity": 1.5}
"""Half width of the uniform noise, before scaling: m/s, rad/s, 1, rad, rad/s."""


def rotate(quat: jax.Array, vector: jax.Array) -> jax.Array:
    """Rotates a vector [3] from the frame of a body into the world's, by its orientation `quat` [4] (w, x, y, z)."""
    w, axis = quat[0], quat[1:]
    cross = jnp.cross(axis, vector)
    return vector + 2.0 * (w * cross + jnp.cross(axis, cross))


def rotate_inverse(quat: jax.Array, vector: jax.Array) -> jax.Array:
    """Rotates a world vector [3] into the frame of a body with orientation `quat` [4] (w, x, y, z)."""
    return rotate(quat * jnp.array([1.0, -1.0, -1.0, -1.0]), vector)


def projected_gravity(quat: jax.Array, down: Sequence[float] = (0.0, 0.0, -1.0)) -> jax.Array:
    """Computes the direction of gravity in the body frame, a unit vector [3]; (0, 0, -1) of an upright body.

    It is the part of the orientation that an accelerometer at rest can measure: roll and pitch, without heading.

    Args:
      quat: orientation of the body, [4] (w, x, y, z).
      down: direction of gravity in the world, a unit vector [3].
    """
    return rotate_inverse(quat, jnp.array(down))


def resting_gravity(model: mujoco.MjModel | mjx.Model) -> jax.Array:
    """Computes what an IMU on the first body of a robot on a rig reads, a unit vector [3], by the model's gravity."""
    gravity = jnp.asarray(model.opt.gravity, jnp.float32)
    # Without gravity, that of a level ground.
    gravity = jnp.where((gravity != 0).any(), gravity, jnp.array([0.0, 0.0, -1.0]))
    return projected_gravity(jnp.asarray(model.body_quat[1], jnp.float32), gravity / jnp.linalg.norm(gravity))


def clock(phase: jax.Array) -> jax.Array:
    """Encodes each foot's phase, [2] cycles, as sine and cosine, [4]: left sine, left cosine, right sine, right cosine.

    The phase itself jumps from one to zero once a stride. A network would see two neighbouring moments as far apart.
    """
    angle = 2.0 * jnp.pi * phase
    # Stacked along the last axis, so that sine and cosine of one foot stand side by side.
    return jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=-1).reshape(-1)


def phase(obs: jax.Array) -> jax.Array:
    """Reads the left foot's phase from observations [..., 40]: cycles, from 0 to 1."""
    sine, cosine = obs[..., 36], obs[..., 37]
    return jnp.mod(jnp.arctan2(sine, cosine) / (2.0 * jnp.pi), 1.0)


def observe(
    *,
    velocity: jax.Array,
    command: jax.Array,
    gyro: jax.Array,
    gravity: jax.Array,
    joint: jax.Array,
    joint_velocity: jax.Array,
    last_action: jax.Array,
    joint_error: jax.Array,
    phase: jax.Array,
    stand: jax.Array,
) -> jax.Array:
    """Builds the policy's observation, laid out and scaled as `LAYOUT` says (section IV-A.2 of the paper).

    Args:
      velocity: [3] m/s, of the trunk's origin, body frame.
      command: [3] m/s, m/s, rad/s.
      gyro: [3] rad/s, body frame.
      gravity: [3] projected gravity.
      joint: [6] rad.
      joint_velocity: [6] rad/s.
      last_action: [6].
      joint_error: [6] rad, last target less position.
      phase: [2] cycles, of each foot.
      stand: [6] rad, joints in the standing pose.

    Returns:
      [40]: velocity 0:3, command 3:6, gyro 6:9, gravity 9:12, joint 12:18, joint velocity 18:24, last action 24:30,
      joint error 30:36, clock 36:40.
    """
    parts = {
        "velocity": velocity,
        "command": command,
        "gyro": gyro,
        "gravity": gravity,
        "joint": joint - stand,
        "joint_velocity": joint_velocity,
        "last_action": last_action,
        "joint_error": joint_error,
        "clock": clock(phase),
    }
    return jnp.concatenate([parts[name] * scale for name, scale in LAYOUT.items()])


def with_command(obs: jax.Array, command: jax.Array, phase: jax.Array) -> jax.Array:
    """Replaces command and gait clock in an observation [40], as if the robot had had them from the start.

    Args:
      obs: [40], as `observe` builds it.
      command: [3] m/s, m/s, rad/s.
      phase: [2] cycles.
    """
    return obs.at[3:6].set(command * LAYOUT["command"]).at[36:40].set(clock(phase) * LAYOUT["clock"])


def disturb(key: jax.Array, readings: dict[str, jax.Array], scale: float) -> dict[str, jax.Array]:
    """Adds uniform sensor noise to the readings that `NOISE` names.

    Args:
      key: random key.
      readings: by name, before they are scaled into an observation.
      scale: multiplies the widths of `NOISE`; zero is no noise.

    Returns:
      All readings, those named in `NOISE` with noise.
    """
    noisy = dict(readings)
    for (name, width), key_channel in zip(NOISE.items(), jax.random.split(key, len(NOISE)), strict=True):
        reading = readings[name]
        noisy[name] = reading + scale * width * jax.random.uniform(key_channel, reading.shape, minval=-1.0)
    return noisy
