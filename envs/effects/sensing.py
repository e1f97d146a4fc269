"""Effects between the joint and its reading: errors that both the controller and the log see.

The signal is [2, joints], positions in rad and velocities in rad/s; for `imu_tilt` it is the gravity vector [3] in the
body frame. `undo` recovers the true motion from recorded readings, so that a simulation can start where the robot
really was. These are [time, 4, joints]: position and velocity, and slopes with less noise, rad/s and rad/s^2.
"""

import jax
import jax.numpy as jnp
import numpy as np

from envs.effects.memory import LONGEST_S, SECOND_STAGE, delay_line, delayed, filtered, two_stages
from jaxtune.types import Effect, Form, Parameter

_SENSING = {"family": "sensing"}
_HALF_SLOPE_S = 0.01  # half of the window over which slopes of readings are taken


def _encoder_bias(values, readings, now, memory):
    """q' = q + bias; velocities are as they were."""
    del now
    return readings.at[0].add(values["rad"]), memory


def _undo_bias(values, readings, dt):
    """q = q' - bias."""
    del dt
    return readings.at[:, 0].add(-values["rad"])


def _sensor_delay(values, readings, now, memory):
    """readings'(t) = readings(t - seconds)."""
    return delayed(memory, readings, values["seconds"], now.dt)


def _undo_delay(values, readings, dt):
    """truth(t) = readings(t + seconds), interpolated; past the end, the last reading."""
    count = len(readings)
    # Every joint has a delay of its own, hence an interpolation of its own.
    at = jnp.clip(jnp.arange(count)[:, None] + values["seconds"] / dt, 0, count - 1)
    interpolate = jax.vmap(jnp.interp, in_axes=(1, None, 1), out_axes=1)
    steps = jnp.arange(count, dtype=readings.dtype)
    return jnp.stack([interpolate(at, steps, readings[:, kind]) for kind in range(readings.shape[1])], axis=1)


def _sensor_lag(values, readings, now, memory):
    """seconds d readings' / dt = readings - readings', or two such stages whose times add up to `seconds`.

    Velocities may have shorter times than positions.
    """
    first, second = _stages(values)
    between, memory_1 = filtered(memory[0], readings, first, now.dt)
    readings, memory_2 = filtered(memory[1], between, second, now.dt)
    return readings, jnp.stack([memory_1, memory_2])


def _stages(values):
    """Time constants of both stages, of positions and velocities, [2, 2, joints] s; both are equal at the most."""
    of_both = jnp.stack([jnp.ones_like(values["seconds"]), 1.0 - values["velocity_faster"]])
    return two_stages(values["seconds"] * of_both, values["second_stage"])


def _behind(values, readings, dt):
    """Starts a lag one step before the readings of a joint that has always moved at one speed."""
    before = readings.at[0].add(-dt * readings[1])
    first, second = _stages(values)[:, 0] * readings[1]
    between = before.at[0].add(-first)
    return jnp.stack([jnp.stack([between, before]), jnp.stack([between.at[0].add(-second), between])])


def _undo_lag(values, readings, dt):
    """readings = readings' + (t1 + t2) d readings' / dt + t1 t2 d2 readings' / dt2, with both stages' time constants.

    Of all alike: recorded velocities that do not agree with positions are not used, and those of a state follow from
    its positions. With the state's own slopes the start of a segment would have more noise under this hypothesis than
    under a delay.
    """
    first, second = two_stages(values["seconds"], values["second_stage"])
    speed, acceleration = readings[:, 2], readings[:, 3]
    jerk = _slope(acceleration, dt)
    slope = jnp.stack([speed, acceleration, acceleration, jerk], axis=1)
    bend = jnp.stack([acceleration, jerk, jerk, jnp.zeros_like(jerk)], axis=1)
    return readings + values["seconds"] * slope + first * second * bend


def _slope(readings, dt):
    """Slopes of readings [steps, joints] over 20 ms, or what there is of that at the ends."""
    count, half = len(readings), round(_HALF_SLOPE_S / dt)
    at = np.arange(count)
    after, before = np.minimum(at + half, count - 1), np.maximum(at - half, 0)
    return (readings[after] - readings[before]) / ((after - before) * dt)[:, None]


def _velocity_lag(values, readings, now, memory):
    """seconds dv' / dt = v - v'; positions are as they were."""
    velocity, memory = filtered(memory, readings[1], values["seconds"], now.dt)
    return readings.at[1].set(velocity), memory


def _steady(values, readings, dt):
    """Starts the lag of a velocity that has always been the same."""
    del values, dt
    return jnp.stack([readings[1], readings[1]])


def _imu_tilt(values, gravity, now, memory):
    """gravity' = gravity + turn gravity, for small angles about the body's x and y axes; the IMU is turned."""
    del now
    roll, pitch = values["roll_rad"][0], values["pitch_rad"][0]
    turn = jnp.array([[0.0, 0.0, -pitch], [0.0, 0.0, roll], [pitch, -roll, 0.0]])
    return gravity + turn @ gravity, memory


_SECONDS = Parameter(name="seconds", bounds=(0.0, LONGEST_S), prior=0.01)

ROWS = (
    Effect(
        name="encoder_bias",
        on="joint",
        enters="sensor",
        parameters=(Parameter(name="rad", scale="angle", bounds=(-0.3, 0.3), prior=0.02),),
        sizes=(0.004,),
        act=_encoder_bias,
        undo=_undo_bias,
        differs=True,
        sentence="The encoder's zero differs from the joint's.",
        excited_by="postures on both sides of the vertical at two controller gains",
        **_SENSING,
    ),
    Effect(
        name="sensor_delay",
        on="joint",
        enters="sensor",
        parameters=(_SECONDS,),
        sizes=(0.001, 0.008),
        act=_sensor_delay,
        start=delay_line,
        undo=_undo_delay,
        forms=(Form("filtered", "sensor_lag", ("seconds", "second_stage")),),
        # The readings of the one are those of the other, whatever the robot.
        sentence="Positions and velocities are read late, or motors do late what the controller asks for: readings "
        "are the same.",
        excited_by="a chirp to 10 Hz at two controller gains",
        **_SENSING,
    ),
    Effect(
        name="sensor_lag",
        on="joint",
        enters="sensor",
        parameters=(
            _SECONDS,
            Parameter(name="velocity_faster", bounds=(0.0, 1.0), prior=1.0),
            SECOND_STAGE,
        ),
        sizes=(0.001, 0.008),
        act=_sensor_lag,
        start=_behind,
        undo=_undo_lag,
        forms=(
            Form("delayed", "sensor_delay", ("seconds",)),
            Form("fast_velocity", "sensor_lag", ("velocity_faster",)),
        ),
        sentence="Positions and velocities are read through a low-pass filter of one or two stages.",
        excited_by="a chirp to 10 Hz at two controller gains",
        **_SENSING,
    ),
    Effect(
        name="velocity_lag",
        on="joint",
        enters="sensor",
        parameters=(_SECONDS,),
        sizes=(0.001, 0.008),
        act=_velocity_lag,
        start=_steady,
        sentence="Velocities are read through a low-pass filter, and positions are not.",
        excited_by="a chirp to 10 Hz at two controller gains",
        **_SENSING,
    ),
    Effect(
        name="imu_tilt",
        on="robot",
        enters="gravity",
        parameters=tuple(Parameter(name=f"{axis}_rad", bounds=(-0.3, 0.3), prior=0.03) for axis in ("roll", "pitch")),
        sizes=(0.01,),
        act=_imu_tilt,
        needs="gravity",
        sentence="The IMU is mounted at an angle.",
        excited_by="standing still in two headings",
        **_SENSING,
    ),
)
