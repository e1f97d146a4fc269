"""Kernel ridge regression: which coordinates does a set of episodes come from?

The plain method that the search-parameter model is measured against, and the one that the default update uses. An
episode is read as the moments of its windows (`windows.moments`), averaged. Coordinates are a smooth function of them,

    estimate(x) = b + sum over episodes i of D_q of  k(x, x_i) a_i,    k(x, y) = exp(-|x - y|^2 / width),
    a = (K + lambda I)^-1 (coordinates - mean),    K centred

(section 5.8 of Hastie, Tibshirani and Friedman, The Elements of Statistical Learning). The error of an episode that is
left out is known without another fit, a_i / ([(K + lambda I)^-1]_ii - 1 / (n lambda)) for n episodes. Width and lambda
are those of a grid for which it is smallest, lambda for every coordinate alone.

The estimate of a set is the mean over its episodes, weighted by their windows.
"""

from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtune import devices, windows
from jaxtune import dist as dists
from jaxtune.types import Coords, ParamDist, Trajectory

_BREADTHS = (2.0, 4.0, 8.0, 16.0)  # widths of the kernel, in median squared distances: the larger, the more linear
# Least and largest lambda, in units of K's largest eigenvalue; less would magnify the rounding of single precision.
_PENALTIES = (3e-6, 0.3)
_CONSTANT = 1e-2  # largest standardised value of a moment that does not vary: rounding
_NOTHING = 1e-6  # an eigenvalue where all episodes are alike
_EPISODES = {"cpu": 4, "other": 256}  # read side by side on a device


@dataclass(frozen=True, kw_only=True)
class RegressionConfig:
    """Sizes of the regression; `TunerConfig` holds one."""

    window: int = 50
    """Steps in a window."""
    stride: int = 10
    """Steps from the start of one window to the next."""


@chex.dataclass(frozen=True)
class Regression:
    """A fitted regression, as `train` returns it; it answers in radii of the distribution that it was fitted on."""

    steps: windows.Scaler  # scales the channels of each step
    moments: windows.Scaler  # scales the moments of each episode
    varies: jax.Array  # [moments] 1 where a moment varies over D_q, else 0
    read: jax.Array  # [episodes, moments] of D_q, standardised; zero for an episode without a window
    known: jax.Array  # [episodes] 1 where an episode of D_q has a window, else 0
    truth: jax.Array  # [episodes, coords] of D_q, in radii
    weights: jax.Array  # a, [episodes, coords]
    mean: jax.Array  # b, [coords]
    width: jax.Array  # of the kernel, in squared distance
    error: jax.Array  # [coords] root mean squared error of an episode that is left out, in radii
    low: jax.Array  # [coords], the box
    high: jax.Array  # [coords]


@devices.precisely
def train(config: RegressionConfig, trajectory: Trajectory, coords: Coords, dist: ParamDist) -> Regression:
    """Fits a regression to simulated episodes of known coordinates.

    Args:
      config: sizes.
      trajectory: the episodes (D_q), [episodes, time].
      coords: true coordinates of every episode, [episodes] by name.
      dist: the distribution that they were drawn from.
    """
    steps = windows.fit_scaler(trajectory)
    coords, moments, count = devices.gather((coords, *_read(config, steps, trajectory)))
    # An episode that ended within its first window says nothing: it has no weight, here and below.
    known = (count > 0).astype(moments.dtype)
    scaler = windows.scaler(moments, known[:, None] / jnp.maximum(known.sum(), 1.0))
    read = known[:, None] * _standardised(scaler, moments)
    # What never varies, such as an action that follows the clock alone, says nothing of the parameters, but changes if
    # an episode ends early.
    varies = (jnp.abs(read).max(axis=0) > _CONSTANT / jnp.sqrt(read.shape[1])).astype(read.dtype)
    read = read * varies
    distance = windows.square_distances(read, read)
    truth = dists.normalise(dist, coords)
    share = known / jnp.maximum(known.sum(), 1.0)
    mean = share @ truth
    wanted = known[:, None] * (truth - mean)

    def fit(width):
        """The best weights [episodes, coords] for a width, the means of what they answer, and mean squared errors."""
        kernel = known[:, None] * known * jnp.exp(-distance / width)
        # Centred: the eigenvalue of what all episodes have in common is so large that its rounding would drown others.
        rows = kernel @ share
        centred = known[:, None] * known * (kernel - rows[:, None] - rows + share @ rows)
        values, vectors = jnp.linalg.eigh(centred)
        turned = vectors.T @ wanted

        def left_out(penalty):
            penalty = penalty * jnp.maximum(values[-1], _NOTHING)
            shrunk = vectors / (jnp.maximum(values, 0.0) + penalty)
            weights = shrunk @ turned
            # The mean is fitted too, without a penalty: centring has made it a direction of eigenvalue zero.
            free = jnp.sum(shrunk * vectors, axis=1) - share / penalty
            errors = known[:, None] * weights / jnp.where(known > 0, jnp.maximum(free, _NOTHING), 1.0)[:, None]
            return weights, share @ errors**2

        every, errors = jax.lax.map(left_out, jnp.geomspace(*_PENALTIES, 25))
        weights = jnp.take_along_axis(every, errors.argmin(axis=0)[None, None], axis=0)[0]
        weights = known[:, None] * (weights - share @ weights)
        return weights, share @ (kernel @ weights), errors.min(axis=0)

    typical = jnp.nanmedian(jnp.where(known[:, None] * known > 0, distance, jnp.nan))
    widths = jnp.nan_to_num(typical, nan=1.0) * jnp.array(_BREADTHS)
    weights, answers, errors = jax.lax.map(fit, widths)
    best = errors.sum(axis=1).argmin()
    low, high = dists.normalised_box(dist)
    return Regression(
        steps=steps,
        moments=scaler,
        varies=varies,
        read=read,
        known=known,
        truth=truth,
        weights=weights[best],
        mean=mean - answers[best],
        width=widths[best],
        error=jnp.sqrt(errors[best]),
        low=low,
        high=high,
    )


def estimate(config: RegressionConfig, model: Regression, trajectory: Trajectory) -> Float[Array, " coords"]:
    """Estimates the coordinates of a set of episodes [episodes, time], in radii.

    An estimate stays inside the box. A set without a valid window is answered with the middle of the box.
    """
    answer, _, _ = answers(config, model, trajectory)
    return jnp.clip(answer, model.low, model.high)


@devices.precisely
def answers(
    config: RegressionConfig, model: Regression, trajectory: Trajectory
) -> tuple[Float[Array, " coords"], Float[Array, " moments"], Float[Array, ""]]:
    """Reads a set of episodes [episodes, time].

    Returns:
      Its coordinates in radii, which may lie beyond the box; its standardised moments, averaged over episodes with
      their windows as weights; and the number of its valid windows. A set without any gets the middle of the box.
    """
    moments, count = _read(config, model.steps, trajectory)
    read = model.varies * _standardised(model.moments, moments)
    each = model.mean + jnp.exp(-windows.square_distances(read, model.read) / model.width) @ model.weights
    share = count / jnp.maximum(count.sum(), 1)
    return jnp.where(count.sum() > 0, share @ each, (model.low + model.high) / 2), share @ read, count.sum()


def _read(config, steps, trajectory) -> tuple[Float[Array, "episodes moments"], Float[Array, " episodes"]]:
    """Averages the moments of every episode's valid windows, and counts these windows."""

    def one(steps, episode):
        cut, valid = windows.grid(episode, config.window, config.stride)
        # A broken simulation may leave nan behind, which a weight of zero would not remove.
        moments = windows.moments(steps(jnp.where(valid[:, None, None], cut, steps.mean)))
        return valid @ moments / jnp.maximum(valid.sum(), 1), valid.sum().astype(moments.dtype)

    return devices.in_chunks(one, (trajectory,), _EPISODES, shared=(steps,))


def _standardised(scaler: windows.Scaler, moments: Float[Array, "n moments"]) -> Float[Array, "n moments"]:
    # Distances must not grow with the number of moments.
    return scaler.clipped(moments) / jnp.sqrt(moments.shape[-1])
