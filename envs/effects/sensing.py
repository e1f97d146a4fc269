"""Between the joint and what is read of it, by the controller and by the log alike.

The signal is [2, joints], positions in rad and velocities in rad/s. `undo` takes what was read back to what was there,
so that a simulation can start where the robot was.
"""

import jax
import jax.numpy as jnp

from envs.effects.memory import as_it_is, delay_line, delayed, lagged
from jaxtune.types import Effect, Parameter

_SENSING = {"family": "sensing"}


def _encoder_bias(values, readings, now, memory):
    del now
    return readings.at[0].add(values["rad"]), memory


def _undo_bias(values, readings, dt):
    del dt
    return readings.at[:, 0].add(-values["rad"])


def _sensor_delay(values, readings, now, memory):
    return delayed(memory, readings, values["seconds"], now.dt)


def _undo_delay(values, readings, dt):
    """What will be read one delay later; past the end, the last that was."""
    count = len(readings)
    at = jnp.clip(jnp.arange(count)[:, None] + values["seconds"] / dt, 0, count - 1)
    interpolate = jax.vmap(jnp.interp, in_axes=(1, None, 1), out_axes=1)
    steps = jnp.arange(count, dtype=readings.dtype)
    return jnp.stack([interpolate(at, steps, readings[:, kind]) for kind in range(2)], axis=1)


def _sensor_lag(values, readings, now, memory):
    return lagged(memory, readings, values["seconds"], now.dt)


def _undo_lag(values, readings, dt):
    return readings + values["seconds"] * jnp.gradient(readings, dt, axis=0)


def _imu_tilt(values, gravity, now, memory):
    """Turns the IMU by small angles about the body's x and y axes."""
    del now
    roll, pitch = values["roll_rad"][0], values["pitch_rad"][0]
    turn = jnp.array([[0.0, 0.0, -pitch], [0.0, 0.0, roll], [pitch, -roll, 0.0]])
    return gravity + turn @ gravity, memory


_SECONDS = Parameter(name="seconds", bounds=(0.0, 0.04), prior=0.01)

ROWS = (
    Effect(
        name="encoder_bias",
        on="joint",
        enters="sensor",
        parameters=(Parameter(name="rad", bounds=(-0.3, 0.3), prior=0.02),),
        sizes=(0.004,),
        act=_encoder_bias,
        undo=_undo_bias,
        sentence="The encoder's zero is not the joint's.",
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
        sentence="Positions are read later than they were.",
        excited_by="a chirp to 10 Hz at two controller gains",
        **_SENSING,
    ),
    Effect(
        name="sensor_lag",
        on="joint",
        enters="sensor",
        parameters=(_SECONDS,),
        sizes=(0.001, 0.008),
        act=_sensor_lag,
        start=as_it_is,
        undo=_undo_lag,
        sentence="Positions are read through a filter.",
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
