"""Cuts windows of consecutive (observation, action) tuples from episodes, and scales them.

Both models of the tuner read windows, of 50 steps by default as in the paper (section IV-A.3). Windows are cut when
they are drawn and never stored: all windows of 600 episodes would take gigabytes. A window that reaches past an
episode's end is dropped, not padded, because padding would show the networks when the robot fell instead of how it
moves.

`draw` gives random windows for training; `grid` gives evenly spaced ones for scoring a measured set.
"""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtune import devices
from jaxtune.types import Trajectory

FAR = 10.0  # standard deviations, at which values are clipped
_APART, _CHANNELS = 1e3, 0.25  # how many times as far as usual a share of the channels of a robot goes that flies apart

_LEAST = 1e-3  # smallest standard deviation by which values are divided, of values whose typical size is one
_CONSTANT = 1e-5  # of a channel's largest value: a standard deviation that rounding may give


def steps(trajectory: Trajectory) -> Float[Array, "... time channels"]:
    """Puts observation and action of every step side by side, observation first.

    These `obs + act` numbers are the channels of every window.
    """
    return jnp.concatenate([trajectory.obs, trajectory.action], axis=-1)


def without_broken(simulated: Trajectory) -> Trajectory:
    """Masks whole episodes in which the simulation broke, and marks those that flew apart with finite numbers.

    A robot whose simulation breaks moves a million times as far as others before it does. A few such steps among many
    thousands would set the scale of every channel, and a gate would not see anything any more.

    Args:
      simulated: [episodes, time].

    Returns:
      The same with `alive` False in these episodes, and `not_finite` True.
    """
    alive, values = simulated.alive[..., None], steps(simulated)
    values = jnp.where(alive & jnp.isfinite(values), values, 0.0)
    centre = jnp.median(values.sum(axis=1) / jnp.maximum(alive.sum(axis=1), 1), axis=0)
    farthest = jnp.where(alive, jnp.abs(values - centre), 0.0).max(axis=1)
    usual = jnp.median(farthest, axis=0)
    times = jnp.where(usual > 0.0, farthest / jnp.where(usual > 0.0, usual, 1.0), 0.0)
    # Or a single channel, but not one in which others have nothing but rounding.
    apart = (jnp.quantile(times, 1.0 - _CHANNELS, axis=1) > _APART) | (farthest.max(axis=1) > _APART * usual.max())
    # Where nothing usually moves, nothing can be said of what does.
    broken = simulated.not_finite | (apart & (usual.max() > 0.0))
    return simulated.replace(alive=simulated.alive & ~broken[:, None], not_finite=broken)


def valid_starts(alive: Bool[Array, "*episodes time"], length: int) -> Bool[Array, "*episodes starts"]:
    """Marks the steps at which a window of `length` steps lies wholly within its episode.

    There are `time - length + 1` possible starts. A start is valid if all steps of the episode up to the window's last
    one are alive.
    """
    # A running count, not the window alone: nothing after an episode's end counts, even if `alive` is true again there.
    ended = jnp.cumsum(~alive, axis=-1)
    return ended[..., length - 1 :] == 0


def draw(
    key: jax.Array, trajectory: Trajectory, count: int, length: int
) -> tuple[Float[Array, "count length channels"], Int[Array, " count"]]:
    """Draws random windows for training, with replacement and all valid ones equally likely.

    An episode that ended early has fewer valid windows and is drawn less often. The set must hold at least one valid
    window: without one, an invalid window is returned, since nothing can be raised inside a jitted program.

    Args:
      key: random key.
      trajectory: the episodes, [episodes, time].
      count: number of windows.
      length: steps in a window.

    Returns:
      The windows, and the index of the episode that each was cut from.
    """
    valid = valid_starts(trajectory.alive, length)
    # The n-th valid start is where the running count first exceeds n.
    cumulative = jnp.cumsum(valid.reshape(-1))
    rank = jax.random.randint(key, (count,), 0, jnp.maximum(cumulative[-1], 1))
    flat = jnp.searchsorted(cumulative, rank, side="right")
    return _at(trajectory, jnp.minimum(flat, cumulative.size - 1), length)


def choose(
    key: jax.Array, trajectory: Trajectory, count: int, length: int
) -> tuple[Float[Array, "count length channels"], Bool[Array, " count"]]:
    """Chooses different windows, all valid ones equally likely; arguments are those of `draw`.

    Returns:
      The windows, and which of them are valid: fewer than `count` where there are no more.
    """
    valid = valid_starts(trajectory.alive, length).reshape(-1)
    order = jnp.where(valid, jax.random.uniform(key, valid.shape), 2.0)
    _, flat = jax.lax.top_k(-order, min(count, valid.size))
    flat = jnp.resize(flat, count)
    window, _ = _at(trajectory, flat, length)
    return window, valid[flat] & (jnp.arange(count) < valid.size)


def _at(trajectory: Trajectory, flat: jax.Array, length: int):
    """The windows at some starts, numbered over all episodes, and their episodes."""
    episode, start = jnp.divmod(flat, trajectory.alive.shape[1] - length + 1)
    within = start[:, None] + jnp.arange(length)
    return steps(trajectory)[episode[:, None], within], episode


def grid(
    trajectory: Trajectory, length: int, stride: int
) -> tuple[Float[Array, "*episodes starts length channels"], Bool[Array, "*episodes starts"]]:
    """Cuts a window of `length` steps at every `stride`-th step of every episode.

    Use it to score a set of episodes: the same set always gives the same windows. Windows overlap where `stride` is
    below `length`.

    Returns:
      The windows, and which of them are valid. The others hold steps after an end and must be masked.
    """
    starts = jnp.arange(0, trajectory.alive.shape[-1] - length + 1, stride)
    within = starts[:, None] + jnp.arange(length)
    return steps(trajectory)[..., within, :], valid_starts(trajectory.alive, length)[..., starts]


@chex.dataclass(frozen=True)
class Scaler:
    """Mean and standard deviation of every channel, used to standardise what a network reads.

    Fit it on simulated episodes with `fit_scaler`, or on any values with `scaler`, and call it on arrays whose last
    axis is the channel. Measured episodes are scaled by the simulation's scaler, so that a shift between the two stays
    visible.
    """

    mean: jax.Array  # [channels]
    std: jax.Array  # [channels], never zero
    varies: jax.Array  # [channels] whether the values differed by more than rounding

    def __call__(self, windows: Float[Array, "... channels"]) -> Float[Array, "... channels"]:
        """Standardises values channel by channel: `(windows - mean) / std`, of any leading shape."""
        return (windows - self.mean) / self.std

    def clipped(self, values: Float[Array, "... channels"]) -> Float[Array, "... channels"]:
        """Standardises values, and clips them at ten deviations: one that hardly varied must not drown all others."""
        return jnp.clip(self(values), -FAR, FAR)


def scaler(values: Float[Array, "... channels"], weight: Float[Array, "... 1"] | None = None) -> Scaler:
    """Fits a scaler to values of a size near one, over all axes but the last. No deviation is smaller than 0.001.

    `weight` counts some values more than others, or not at all; it broadcasts against the values and must sum to one
    over a channel. All values count alike where it is None. Values of weight zero must still be finite.
    """
    mean, std = _spread(values, values.shape[-1] / values.size if weight is None else weight)
    return Scaler(mean=mean, std=jnp.maximum(std, _LEAST), varies=std > _LEAST)


def _spread(values: Float[Array, "... channels"], weight) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation, [channels] each."""
    axes = tuple(range(values.ndim - 1))
    mean = jnp.sum(weight * values, axis=axes)
    return mean, jnp.sqrt(jnp.sum(weight * (values - mean) ** 2, axis=axes))


def fit_scaler(trajectory: Trajectory) -> Scaler:
    """Fits a scaler to observations and actions of all steps that are alive, in whatever units.

    Steps after an episode's end count for nothing, whatever they hold. A channel that never changes is divided by a
    thousandth of its value.
    """
    # What follows an end may be anything, and zero times nan is nan.
    channels = jnp.where(trajectory.alive[..., None], steps(trajectory), 0.0)
    mean, std = _spread(channels, trajectory.alive[..., None] / jnp.maximum(trajectory.alive.sum(), 1))
    size = jnp.abs(channels).max(axis=tuple(range(channels.ndim - 1)))
    varies = std > _CONSTANT * size
    return Scaler(mean=mean, std=jnp.where(varies, std, _LEAST * jnp.where(size > 0, size, 1.0)), varies=varies)


def moments(window: Float[Array, "batch time channels"]) -> Float[Array, "batch moments"]:
    """Computes a window's moments: each channel's mean and spread of first and second differences, and covariances.

    Covariances are taken between all channels, within a step and between the deviation at one step and the change to
    the next. The gait clock is among the channels of a walking robot, so these covariances hold phases.
    """
    batch, time, channels = window.shape
    mean = window.mean(axis=1)
    centred = window - mean[:, None]
    step = jnp.diff(window, axis=1)
    upper = jnp.triu_indices(channels)  # covariances within a step are symmetric; those across steps are not
    at_once = jnp.einsum("bti,btj->bij", centred, centred)[:, *upper] / time
    ahead = jnp.einsum("bti,btj->bij", step, centred[:, :-1]).reshape(batch, -1) / time
    return jnp.concatenate([mean, step.std(axis=1), jnp.diff(step, axis=1).std(axis=1), at_once, ahead], axis=-1)


def involved(channels: int) -> Float[Array, "channels moments"]:
    """Marks with 1 which moments involve a channel, in the order of `moments`; a covariance involves two."""
    one = jnp.eye(channels)
    first, second = jnp.triu_indices(channels)
    ahead = jnp.maximum(one[:, :, None], one[:, None, :]).reshape(channels, -1)
    return jnp.concatenate([one, one, one, jnp.maximum(one[:, first], one[:, second]), ahead], axis=1)


@devices.precisely
def square_distances(a: Float[Array, "n moments"], b: Float[Array, "m moments"]) -> Float[Array, "n m"]:
    """Computes all squared distances, from |a|^2 + |b|^2 - 2 a b, which needs no array [n, m, moments]."""
    square = jnp.sum(a**2, axis=-1)[:, None] + jnp.sum(b**2, axis=-1) - 2.0 * a @ b.T
    return jnp.maximum(square, 0.0)
