"""The gait clock, Raibert's reference for feet and joints, leg kinematics, and measures of a gait's quality."""

import jax
import jax.numpy as jnp
import numpy as np

from envs import sensing
from envs.biteno import constants

_TOUCH_N = 1.0  # normal force from which on a foot is in contact
_PRESS_N = 10.0  # normal force from which on the ratio of tangential to normal force is meaningful


def advance(phase: jax.Array, steps: int = 1) -> jax.Array:
    """Advances phases [...] in cycles by a number of policy steps, which may be negative.

    Each foot's phase is in stance below 0.5 and in swing above; it runs at 1.75 cycles a second. The clock never stops,
    not even for a command of zero, because a robot on point feet cannot stand still.
    """
    return jnp.mod(phase + steps * constants.CLOCK_HZ * constants.POLICY_DT_S, 1.0)


def foot_reference(phase: jax.Array, command: jax.Array) -> jax.Array:
    """Computes Raibert's reference: where each foot's centre should be relative to its hip.

    In stance (phase below the duty of one half) the foot sweeps back at the commanded speed, half a stride before to
    half a stride behind the hip; in swing it returns and lifts. With phase p, stance time T = duty / clock rate and
    command (vx, vy, w):

        r = |1 - 2 p| - 0.5
        x = r (vx - w y_hip) T
        y = r vy T
        z = -0.582 m + 0.08 m sin(pi (2 p - 1)) in swing

    Without the lift the reference would have the robot stand still.

    Args:
      phase: [2] cycles, left and right.
      command: [3] forward m/s, sideways m/s, turning rad/s.

    Returns:
      [2, 3] m, in the trunk's axes, from each hip.
    """
    # 0.5 at touchdown and -0.5 at lift-off, in strides of one stance.
    reach = jnp.abs(1.0 - 2.0 * phase) - 0.5
    stance_s = constants.DUTY / constants.CLOCK_HZ
    x = reach * (command[0] - command[2] * constants.HIP_Y_M) * stance_s
    y = reach * command[1] * stance_s
    swing = jnp.sin(jnp.pi * (2.0 * phase - 1.0))
    lift = constants.SWING_HEIGHT_M * jnp.where(phase > constants.DUTY, swing, 0.0)
    return jnp.stack([x, y, lift - constants.STANCE_DEPTH_M], axis=-1)


def leg_angles(foot: jax.Array) -> jax.Array:
    """Solves the inverse kinematics of a leg in closed form.

    Both links have length l = 0.31 m. With d the distance from hip to foot, the knee is 2 arccos(d / 2 l), and the hip
    turns back by half of it. Points out of reach are answered with a straight leg.

    Args:
      foot: centre of the foot from the hip, [..., 3] m.

    Returns:
      (abduction, hip, knee), [..., 3] rad.
    """
    x, y, z = foot[..., 0], foot[..., 1], foot[..., 2]
    depth = jnp.hypot(y, z)
    length = jnp.hypot(x, depth)
    # The two links are equally long, so the knee folds by twice the angle between a link and the line hip to foot.
    knee = 2.0 * jnp.arccos(jnp.clip(length / (2.0 * constants.LINK_M), 0.0, 1.0))
    # The thigh points away from that line by half the knee's angle.
    hip = -jnp.arctan2(x, depth) - knee / 2.0
    return jnp.stack([jnp.arctan2(y, -z), hip, knee], axis=-1)


def joint_reference(phase: jax.Array, command: jax.Array) -> jax.Array:
    """Computes Raibert's joint reference q*, [6] rad: `leg_angles` of `foot_reference`.

    The reward compares joints with it, and with `TaskConfig.base` = raibert actions are added to it.

    Args:
      phase: [2] cycles.
      command: [3] m/s, m/s, rad/s.
    """
    return leg_angles(foot_reference(phase, command)).reshape(-1)


def foot_motion(qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes where the feet are, and how fast the lowest point of each moves over the ground.

    Slip is the velocity of the lowest point: the centre moves even where a foot rolls without slipping.

    Args:
      qpos: [13], as in `Motion`.
      qvel: [12], as in `Motion`.

    Returns:
      Centres [2, 3] m and velocities of the lowest points [2, 3] m/s, both in the world.
    """
    joint, joint_velocity = (values.reshape(2, 3) for values in (qpos[7:], qvel[6:]))
    turn = jax.vmap(lambda axis: sensing.rotate(qpos[3:7], axis), out_axes=1)(jnp.eye(3))
    centre, centre_velocity = jax.jvp(_foot_in_trunk, (joint,), (joint_velocity,))
    # MuJoCo gives a free joint's angular velocity in the body's frame, its linear velocity in the world's.
    spin = turn @ qvel[3:6]
    abduction, knee = turn[:, 0], jax.vmap(lambda angle: turn @ _about_x(angle)[:, 1])(joint[:, 0])
    shank_spin = spin + joint_velocity[:, :1] * abduction + joint_velocity[:, 1:].sum(axis=1, keepdims=True) * knee
    # The foot is a sphere fixed to the shank, so its lowest point moves with the shank's rotation too.
    lowest = jnp.array([0.0, 0.0, -constants.FOOT_RADIUS_M])
    offset = centre @ turn.T
    velocity = qvel[:3] + jnp.cross(spin, offset) + centre_velocity @ turn.T + jnp.cross(shank_spin, lowest)
    return qpos[:3] + offset, velocity


def trunk_height(gravity: jax.Array, joint: jax.Array) -> jax.Array:
    """Estimates the height of the hip axis above flat ground in m, from the legs alone.

    It assumes that the lower foot stands on the ground; in flight the estimate is too low. Logs without motion capture
    have no other measure of whether the trunk has sunk.

    Args:
      gravity: [3] projected gravity.
      joint: [6] rad.
    """
    return constants.FOOT_RADIUS_M + (_foot_in_trunk(joint.reshape(2, 3)) @ gravity).max()


def _foot_in_trunk(joint: jax.Array) -> jax.Array:
    """Forward kinematics: centres of both feet [2, 3] m in the trunk's frame, for joints [2, 3] rad."""
    hips = jnp.stack([jnp.zeros(2), jnp.asarray(constants.HIP_Y_M), jnp.zeros(2)], axis=-1)
    thigh, shank = joint[:, 1], joint[:, 1] + joint[:, 2]
    flat = -constants.LINK_M * jnp.stack(
        [jnp.sin(thigh) + jnp.sin(shank), jnp.zeros(2), jnp.cos(thigh) + jnp.cos(shank)], axis=-1
    )
    return hips + jax.vmap(lambda angle, foot: _about_x(angle) @ foot)(joint[:, 0], flat)


def _about_x(angle: jax.Array) -> jax.Array:
    """Rotation matrix [3, 3] about the forward axis, which abduction turns about."""
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    return jnp.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


def quality(
    *,
    qpos: np.ndarray,
    qvel: np.ndarray,
    torque: np.ndarray,
    foot_force: np.ndarray,
    command: np.ndarray,
    phase: np.ndarray,
    alive: np.ndarray,
    fell: np.ndarray,
) -> dict[str, float]:
    """Measures a gait in numbers that distinguish a walk from a buzz of the feet.

    A buzz (many short steps that hardly lift the feet) earns nearly the same return, so the return alone shows too
    little.

    Args:
      qpos: [episodes, time, 13], as in `Motion`; a recording (`envs.targets.protocol.Recording`), as are the next five.
      qvel: [episodes, time, 12].
      torque: [episodes, time, 6] Nm.
      foot_force: [episodes, time, 2, 3] N.
      command: [episodes, time, 3] m/s, m/s, rad/s.
      phase: [episodes, time, 2] cycles.
      alive: [episodes, time], of the same episodes; steps that are not alive do not count.
      fell: [episodes].

    Returns:
      By name: touchdowns a second and foot; swing clearance in m, the mean over swings of the foot's highest point
      above the floor; share of time in which contact and clock agree; errors of the mean velocity in m/s and of the
      mean turning rate in rad/s, over episodes after their first second (nan where none lasts longer); slip of the feet
      on the floor in m a second; torque (root mean square, Nm); mechanical power in W, braking not regained; falls in
      20 s; friction use, the 99th percentile of tangential over normal force.
    """
    centre, velocity = (np.asarray(values) for values in _foot_motions(qpos, qvel))
    seconds = alive.sum() * constants.POLICY_DT_S
    height = centre[..., 2] - constants.FOOT_RADIUS_M
    normal = foot_force[..., 2]
    contact = normal > _TOUCH_N
    living = alive[..., None]
    landed = contact[:, 1:] & ~contact[:, :-1] & living[:, 1:]
    pressed = living & (normal > _PRESS_N)
    use = np.hypot(foot_force[..., 0], foot_force[..., 1])[pressed] / normal[pressed]
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    trunk = np.asarray(_trunk_velocities(qpos, qvel))
    # In its first second a robot is still speeding up.
    late = alive & (np.arange(alive.shape[1]) >= 1.0 / constants.POLICY_DT_S)
    weight = late / np.maximum(late.sum(axis=1, keepdims=True), 1)
    walked = late.any(axis=1)
    error = np.einsum("et,etk->ek", weight, trunk - command)[walked]
    return {
        "touchdowns_per_s": landed.sum() / 2 / seconds,
        "swing_clearance_m": _clearance(height, contact, living),
        "clock_agreement": (contact == (phase < constants.DUTY))[alive].mean(),
        "speed_error_mps": np.hypot(error[:, 0], error[:, 1]).mean() if len(error) else np.nan,
        "turn_error_radps": np.abs(error[:, 2]).mean() if len(error) else np.nan,
        "slip_mps": (speed * (contact & living)).sum() * constants.POLICY_DT_S / seconds,
        "torque_nm": np.sqrt((torque[alive] ** 2).mean()),
        "power_w": power(torque, qvel[..., 6:])[alive].mean(),
        "falls_per_20s": fell.sum() / seconds * 20.0,
        "friction_use_p99": np.quantile(use, 0.99) if use.size else np.nan,
    }


def power(torque: jax.Array, joint_velocity: jax.Array) -> jax.Array:
    """Computes the mechanical power that the motors spend, in W.

        sum over joints of max(torque velocity, 0)

    Braking is not regained.

    Args:
      torque: [..., 6] Nm.
      joint_velocity: [..., 6] rad/s.
    """
    return jnp.maximum(torque * joint_velocity, 0.0).sum(axis=-1)


def _clearance(height: np.ndarray, contact: np.ndarray, living: np.ndarray) -> float:
    """Mean over swings, from lift-off to touchdown, of the foot's highest point, in m."""
    highest = []
    for episode, foot in np.ndindex(height.shape[0], height.shape[2]):
        touching = contact[episode, living[episode, :, 0], foot]
        edges = np.flatnonzero(np.diff(touching.astype(int)))
        # A swing lies between two edges, the first of which is a lift-off.
        starts = edges[:-1][touching[edges[:-1]]] + 1
        ends = edges[1:][touching[edges[:-1]]] + 1
        highest += [height[episode, a:b, foot].max() for a, b in zip(starts, ends, strict=True)]
    return float(np.mean(highest)) if highest else 0.0


@jax.jit
def _foot_motions(qpos, qvel):
    return jax.vmap(jax.vmap(foot_motion))(qpos, qvel)


@jax.jit
def _trunk_velocities(qpos, qvel):
    """Velocities forward, sideways and of turning, in the body frame, [episodes, time, 3]."""

    def one(qpos, qvel):
        return jnp.append(sensing.rotate_inverse(qpos[3:7], qvel[:3])[:2], qvel[5])

    return jax.vmap(jax.vmap(one))(qpos, qvel)
