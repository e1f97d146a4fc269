"""A learned one-step model of a robot whose coordinates are inputs: a rival of the estimates of `jaxtune`.

A network is told what the robot was and did in the last few steps, and its coordinates in radii. It predicts how the
observation changes in the next step. The estimate of a set is the coordinates under which its steps are likeliest:

    c* = argmax over c in the box of  sum over steps of log N(o_t+1 - o_t; f(o_t, a_t, ..., o_t-h, a_t-h, c), s^2),

found by Gauss-Newton. Like the regression it needs observations and actions alone. It is measured beside the others in
`experiments.walking.estimates.compare`; no update uses it.
"""

from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from jaxtune import devices, windows
from jaxtune import dist as dists
from jaxtune.descent import descend
from jaxtune.types import Coords, ParamDist, Trajectory

_MIN_LOG_STD = -5.0  # of a channel that is known from its past, such as the gait's clock
_DAMPED = 1e-3  # of the trace of Gauss-Newton's matrix, beside its diagonal: coordinates that no step shows stay


@dataclass(frozen=True, kw_only=True)
class OneStepConfig:
    """Sizes of the model, of its training and of the search."""

    past: int = 2
    """Steps that the network is told of, the last one among them."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of its layers."""
    train_steps: int = 4000
    """Gradient steps."""
    batch: int = 512
    """Steps of episodes in a gradient step."""
    learning_rate: float = 2e-3
    """Peak of a one-cycle cosine schedule."""
    rounds: int = 8
    """Of Gauss-Newton."""


class _Network(nn.Module):
    config: OneStepConfig
    outputs: int

    @nn.compact
    def __call__(self, told, coords):
        hidden = jnp.concatenate([told, coords], axis=-1)
        for width in self.config.hidden:
            hidden = nn.elu(nn.Dense(width)(hidden))
        log_std = self.param("log_std", nn.initializers.zeros, (self.outputs,))
        return nn.Dense(self.outputs)(hidden), jnp.maximum(log_std, _MIN_LOG_STD)


@chex.dataclass(frozen=True)
class OneStep:
    """A trained model, as `train` returns it."""

    variables: dict
    steps: windows.Scaler  # scales the channels of each step
    change: windows.Scaler  # scales the changes of the observation
    dist: ParamDist  # that it was trained on


def _pairs(
    config: OneStepConfig, scale: windows.Scaler, trajectory: Trajectory
) -> tuple[Float[Array, "episodes starts told"], Float[Array, "episodes starts obs"], Bool[Array, "episodes starts"]]:
    """What the network is told before every step that can be predicted, and how the observation changes in it."""
    alive = trajectory.alive[..., None]
    told = jnp.where(alive, scale.clipped(windows.steps(trajectory)), 0.0)
    count = told.shape[1] - config.past
    past = jnp.concatenate([told[:, at : at + count] for at in range(config.past)], axis=-1)
    change = jnp.diff(jnp.where(alive, trajectory.obs, 0.0), axis=1)[:, config.past - 1 :]
    return past, change, windows.valid_starts(trajectory.alive, config.past + 1)


def train(key: jax.Array, config: OneStepConfig, trajectory: Trajectory, coords: Coords, dist: ParamDist) -> OneStep:
    """Trains the model on simulated episodes [episodes, time] of known coordinates [episodes] by name."""
    key_init, key_train = jax.random.split(key)
    trajectory, coords = devices.gather((trajectory, coords))
    truth = dists.normalise(dist, coords)
    scale = windows.fit_scaler(trajectory)
    told, change, valid = _pairs(config, scale, trajectory)
    weight = valid[..., None] / jnp.maximum(valid.sum(), 1)
    spread = windows.scaler(jnp.where(valid[..., None], change, 0.0), weight)
    network = _Network(config, change.shape[-1])
    variables = network.init(key_init, told[:1, 0], truth[:1])
    optimizer = optax.adam(optax.cosine_onecycle_schedule(config.train_steps, config.learning_rate))
    every = jnp.cumsum(valid.reshape(-1))

    def loss(variables, key):
        rank = jax.random.randint(key, (config.batch,), 0, jnp.maximum(every[-1], 1))
        flat = jnp.minimum(jnp.searchsorted(every, rank, side="right"), every.size - 1)
        episode, start = devices.share(jnp.divmod(flat, valid.shape[1]))
        found, log_std = network.apply(variables, told[episode, start], truth[episode])
        error = (spread(change[episode, start]) - found) * jnp.exp(-log_std)
        return (0.5 * error**2 + log_std).mean()

    variables, _ = descend(key_train, loss, variables, optimizer, config.train_steps)
    return OneStep(variables=variables, steps=scale, change=spread, dist=dist)


def estimate(config: OneStepConfig, model: OneStep, trajectory: Trajectory) -> Float[Array, " coords"]:
    """Estimates each coordinate from a set of episodes [episodes, time], in radii; the centre if no step is known."""
    told, change, valid = _pairs(config, model.steps, trajectory)
    # Of a broken simulation anything may be left.
    wanted = jnp.where(valid[..., None], model.change(change), 0.0)
    network = _Network(config, change.shape[-1])
    low, high = dists.normalised_box(model.dist)

    def errors(coords):
        found, log_std = network.apply(model.variables, told, jnp.broadcast_to(coords, (*told.shape[:2], len(low))))
        return (valid[..., None] * (wanted - found) * jnp.exp(-log_std)).reshape(-1)

    def improve(_, coords):
        error, slopes = errors(coords), jax.jacfwd(errors)(coords)
        matrix = slopes.T @ slopes
        matrix += (_DAMPED * jnp.trace(matrix) / len(low) + 1e-9) * jnp.eye(len(low))
        return jnp.clip(coords - jnp.linalg.solve(matrix, slopes.T @ error), low, high)

    return jax.lax.fori_loop(0, config.rounds, improve, jnp.clip(jnp.zeros_like(low), low, high))
