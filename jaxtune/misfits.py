"""What no coordinates explain in a measured set: which observations and actions, and in which phase of the motion.

The response surface (`jaxtune.surface`) predicts what a robot of the set's own estimate shows. What is left of the set
is compared with what is left of held-out simulated sets, each beside its own estimate. Two things are predicted: the
moments of windows, which say which channel is off, and the mean of every channel in each phase, which says when.
"""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp

from jaxtune import devices, regression, surface, windows
from jaxtune.readings import LEAST_ERROR, Collected, fit, of_all_sets
from jaxtune.settings import TunerConfig
from jaxtune.types import Trajectory

PHASES = 8
"""Parts of a cycle that are told apart."""

_EPISODES = {"cpu": 4, "other": 256}  # read side by side on a device

Phase = Callable[[Trajectory], jax.Array]
"""`(episodes [..., time]) -> [..., time]`: where in its cycle every step is, from 0 to 1; traceable by JAX."""


@chex.dataclass(frozen=True)
class Misfits:
    """How much of a measured set no coordinates explain, in multiples of the median over held-out sets: 1 is usual."""

    channels: jax.Array  # [obs + act], the rms of what is left of the moments that involve a channel
    phases: jax.Array  # [PHASES, obs + act], what is left of a channel's mean in a phase


def share_of_episode(episodes: Trajectory) -> jax.Array:
    """The phase of a robot without a clock: the share of its episode that is over."""
    steps = episodes.alive.shape[-1]
    return jnp.broadcast_to(jnp.arange(steps) / steps, episodes.alive.shape)


def misfits(
    config: TunerConfig, collected: Collected, measured: Trajectory, phase: Phase = share_of_episode
) -> Misfits:
    """Says which observations and actions no coordinates explain, and in which phase.

    Args:
      config: sizes.
      collected: D_q and held-out sets of one distribution.
      measured: the measured set, [set_episodes, time].
      phase: where in its cycle every step is.
    """
    model, ways = fit(config, collected)
    means, lived = _means(model.steps, collected.trajectory, phase)
    # An episode that ended before a phase says nothing of it: there it stands where the others are.
    means = jnp.where(lived > 0, means, _pooled(means, lived)).reshape(len(means), -1)
    in_phases = surface.train(model.replace(read=model.known[:, None] * means))
    involved = windows.involved(measured.obs.shape[-1] + measured.action.shape[-1]) * model.varies
    scatter = jnp.sqrt(jnp.mean(ways.residual**2, axis=0))
    weight = jnp.where(model.varies > 0, 1.0 / jnp.maximum(scatter, LEAST_ERROR), 0.0)

    def one(model, ways, in_phases, involved, weight, episodes):
        answer, moments, _ = regression.answers(config.regression, model, episodes)
        answer = jnp.clip(answer, model.low, model.high)
        rest = weight * surface.unexplained(ways, moments, answer)
        channels = jnp.sqrt(involved @ rest**2 / jnp.maximum(involved.sum(axis=1), 1.0))
        means, lived = _means(model.steps, episodes, phase)
        mean = _pooled(means, lived)
        left = surface.unexplained(in_phases, mean.reshape(-1), answer).reshape(mean.shape)
        return channels, jnp.where(lived.any(axis=0), jnp.abs(left), jnp.nan)

    shared = (model, ways, in_phases, involved, weight)
    channels, phases = of_all_sets(one, shared, collected, measured)
    phases = _in_medians(phases)
    # No moment of a channel that never varies is read: that it is off shows in its mean alone.
    channels = jnp.where(involved.any(axis=1), _in_medians(channels), jnp.nanmax(phases, axis=0))
    return Misfits(channels=channels, phases=phases)


def _means(steps: windows.Scaler, episodes: Trajectory, phase: Phase) -> tuple[jax.Array, jax.Array]:
    """Averages every channel in each phase of every episode.

    Returns:
      Standardised means [episodes, PHASES, channels], and how many living steps they are of, [episodes, PHASES, 1].
    """

    def one(steps, episode):
        within = jnp.clip(jnp.floor(PHASES * phase(episode)), 0, PHASES - 1)
        lives = windows.valid_starts(episode.alive, 1)
        counted = (within[:, None] == jnp.arange(PHASES)) & lives[:, None]
        values = jnp.where(lives[:, None], steps.clipped(windows.steps(episode)), 0.0)
        count = counted.sum(axis=0)[:, None].astype(values.dtype)
        return counted.T @ values / jnp.maximum(count, 1.0), count

    return devices.in_chunks(one, (episodes,), _EPISODES, shared=(steps,))


def _pooled(means: jax.Array, lived: jax.Array) -> jax.Array:
    """Averages the means of episodes, as `_means` returns them, every living step weighing the same."""
    return jnp.sum(means * lived, axis=0) / jnp.maximum(lived.sum(axis=0), 1.0)


def _in_medians(left: jax.Array) -> jax.Array:
    """What is left of the last set, in multiples of the median over the others."""
    return left[-1] / jnp.maximum(jnp.nanmedian(left[:-1], axis=0), LEAST_ERROR)
