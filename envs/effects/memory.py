"""Memories that effects share: delay lines and first-order lags.

Each has a function that starts it in steady state and one that advances it by a step of the simulation.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtune.types import Parameter

LONGEST_S = 0.1
"""Longest delay that a line can hold, in s. Simulations start with at least as much history (`envs.segments`)."""

PAST_STEP_S = 0.01
"""Time in s between the positions that lead to the history of a segment (`envs.segments`)."""

PAST_TARGET_S = np.concatenate([np.arange(-1000, 0) * 0.01, np.arange(1001) * 0.002]) - 2.0
"""[past targets] times of past targets in s, seen from the start of a segment's history. Targets may jump, so the last
ones are close. A slow limit of their slew may be behind them for many seconds."""


def delay_line(values, signal: jax.Array, dt: float) -> jax.Array:
    """Starts a delay line [steps, ...], newest first, whose input has always been this signal.

    It holds `LONGEST_S` whatever the delay is, so that its shape does not depend on a value that is searched.
    """
    del values
    return jnp.broadcast_to(signal, (round(LONGEST_S / dt) + 1, *signal.shape))


def delayed(line: jax.Array, signal: jax.Array, seconds: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """Delays a signal: signal(t - seconds), interpolated linearly between samples.

    It is differentiable with respect to the delay, which a line read at a whole number of steps would not be.

    Args:
      line: [steps, ..., joints], newest first.
      signal: [..., joints], of this step.
      seconds: [joints], from 0 to `LONGEST_S`.
      dt: step of the simulation in s.

    Returns:
      The delayed signal, and the line with this step's signal in front.
    """
    line = jnp.concatenate([signal[None], line[:-1]])
    steps = jnp.clip(seconds / dt, 0.0, len(line) - 1)
    after = jnp.clip(jnp.floor(steps), 0, len(line) - 2)
    # Reading only the two samples beside the delay, not a weighted sum of all, halves a robot's time on a rig.
    index = jnp.broadcast_to(after.astype(int), (1, *signal.shape))
    newer, older = (jnp.take_along_axis(line, index + step, axis=0)[0] for step in (0, 1))
    return newer + (steps - after) * (older - newer), line


def lagged(memory: jax.Array, signal: jax.Array, seconds: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """Filters a signal that is held over each step by a first-order lag, seconds dy/dt = signal - y, exactly.

    Args:
      memory: y after the step before, [..., joints].
      signal: [..., joints], of this step.
      seconds: time constant [joints]; the signal passes unchanged where it is zero.
      dt: step of the simulation in s.

    Returns:
      The mean of y over this step, and y after it, which is the memory.
    """
    stays, share = _decay(seconds, dt)
    return signal + share * (memory - signal), signal + stays * (memory - signal)


def filtered(memory: jax.Array, signal: jax.Array, seconds: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """Filters a signal that is linear between its samples by a first-order lag, seconds dy/dt = signal - y, exactly.

    Args:
      memory: y and the signal at the sample before, [2, ..., joints].
      signal: [..., joints], at this sample.
      seconds: time constant, [joints] or as the signal; the signal passes unchanged where it is zero.
      dt: time between samples in s.

    Returns:
      y at this sample, and the memory.
    """
    stays, share = _decay(seconds, dt)
    before, sample = memory
    after = signal - share * (signal - sample) + stays * (before - sample)
    return after, jnp.stack([after, signal])


SECOND_STAGE = Parameter(name="second_stage", bounds=(0.0, 1.0), prior=3.0, shape=True)
"""How slow the second lag of a filter is, for `two_stages`."""


def two_stages(seconds: jax.Array, second_stage: jax.Array) -> jax.Array:
    """Divides the time of a filter among two first-order lags, one behind the other.

    Args:
      seconds: the sum of both time constants, any shape.
      second_stage: from 0 (a single lag) to 1 (two equal ones), broadcasts against it.

    Returns:
      Both time constants, the longer one first, [2, ...].
    """
    second = 0.5 * second_stage
    return jnp.stack([(1.0 - second) * seconds, second * seconds])


def _decay(seconds: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """What remains of a deviation at the end of a step, and in its mean."""
    # Exactly zero without a lag; the inner maximum keeps the derivative finite in the branch that is not taken.
    constant = jnp.maximum(seconds, 1e-9)
    stays = jnp.where(seconds > 0, jnp.exp(-dt / constant), 0.0)
    return stays, jnp.where(seconds > 0, constant / dt * (1.0 - stays), 0.0)
