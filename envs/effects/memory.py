"""What effects remember: lines of delayed signals, and first-order lags."""

import jax
import jax.numpy as jnp

LONGEST_S = 0.04


def as_it_is(values, signal: jax.Array, dt: float) -> jax.Array:
    """The memory of a filter that has always been given this signal."""
    del values, dt
    return signal


def delay_line(values, signal: jax.Array, dt: float) -> jax.Array:
    """A line [steps, ...] that has always held this signal, newest first."""
    del values
    return jnp.broadcast_to(signal, (round(LONGEST_S / dt) + 1, *signal.shape))


def delayed(line: jax.Array, signal: jax.Array, seconds: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """The signal [..., joints] as it was `seconds` [joints] ago, between samples in proportion; and the line."""
    line = jnp.concatenate([signal[None], line[:-1]])
    steps = jnp.clip(seconds / dt, 0.0, len(line) - 1)
    age = jnp.arange(len(line), dtype=signal.dtype)[:, None]
    # A triangle about the delay: the two samples beside it, in proportion.
    weight = jnp.maximum(1.0 - jnp.abs(age - steps), 0.0)
    weight = weight.reshape(len(line), *(1,) * (signal.ndim - 1), -1)
    return (weight * line).sum(axis=0), line


def lagged(memory: jax.Array, signal: jax.Array, seconds: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """A first-order lag, exact for a signal that is held; none where the time constant is zero."""
    stays = jnp.where(seconds > 0, jnp.exp(-dt / jnp.maximum(seconds, 1e-9)), 0.0)
    memory = signal + stays * (memory - signal)
    return memory, memory
