"""Windows of consecutive (observation, action) tuples, cut from episodes when they are drawn.

All windows of 600 episodes would fill gigabytes, so none is kept. A window that reaches past a fall is dropped, not
padded: it would tell the networks when the robot fell instead of how it moves.
"""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtune.types import Trajectory

_MIN_STD = 1e-3


def steps(trajectory: Trajectory) -> Float[Array, "... time channels"]:
    """Observation and action of every step side by side."""
    return jnp.concatenate([trajectory.obs, trajectory.action], axis=-1)


def valid_starts(alive: Bool[Array, "*episodes time"], length: int) -> Bool[Array, "*episodes starts"]:
    """True where a window of `length` steps from here lies within the episode."""
    ended = jnp.cumsum(~alive, axis=-1)
    return ended[..., length - 1 :] == 0


def draw(
    key: jax.Array, trajectory: Trajectory, count: int, length: int
) -> tuple[Float[Array, "count length channels"], Int[Array, " count"]]:
    """Draws windows, all valid ones being equally likely, with replacement.

    Returns:
      The windows, and the index of the episode that each was cut from.
    """
    valid = valid_starts(trajectory.alive, length)
    cumulative = jnp.cumsum(valid.reshape(-1))
    rank = jax.random.randint(key, (count,), 0, jnp.maximum(cumulative[-1], 1))
    flat = jnp.searchsorted(cumulative, rank, side="right")
    episode, start = jnp.divmod(jnp.minimum(flat, cumulative.size - 1), valid.shape[1])
    within = start[:, None] + jnp.arange(length)
    return steps(trajectory)[episode[:, None], within], episode


def grid(
    trajectory: Trajectory, length: int, stride: int
) -> tuple[Float[Array, "*episodes starts length channels"], Bool[Array, "*episodes starts"]]:
    """Windows at every `stride`-th step of every episode, and which of them are valid."""
    starts = jnp.arange(0, trajectory.alive.shape[-1] - length + 1, stride)
    within = starts[:, None] + jnp.arange(length)
    return steps(trajectory)[..., within, :], valid_starts(trajectory.alive, length)[..., starts]


@chex.dataclass(frozen=True)
class Scaler:
    """Mean and standard deviation of every channel."""

    mean: jax.Array  # [channels]
    std: jax.Array  # [channels]

    def __call__(self, windows: Float[Array, "... channels"]) -> Float[Array, "... channels"]:
        return (windows - self.mean) / self.std


def scaler(values: Float[Array, "... channels"], weight: Float[Array, "... 1"] | None = None) -> Scaler:
    """The scaler of values, weighted where a weight that sums to one is given."""
    axes = tuple(range(values.ndim - 1))
    weight = values.shape[-1] / values.size if weight is None else weight
    mean = jnp.sum(weight * values, axis=axes)
    variance = jnp.sum(weight * (values - mean) ** 2, axis=axes)
    return Scaler(mean=mean, std=jnp.maximum(jnp.sqrt(variance), _MIN_STD))


def fit_scaler(trajectory: Trajectory) -> Scaler:
    """The scaler of the steps that belong to an episode."""
    # What follows an end may be anything, and zero times nan is nan.
    channels = jnp.where(trajectory.alive[..., None], steps(trajectory), 0.0)
    return scaler(channels, trajectory.alive[..., None] / jnp.maximum(trajectory.alive.sum(), 1))
