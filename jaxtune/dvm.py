"""The data verification model (DVM): do simulated episodes cover a measured window? (Sections III-B.2 and IV-A.3.)

It is a variational autoencoder of windows of 50 consecutive (observation, action) tuples: four strided convolutions
down to a latent, a symmetric decoder, and a learned noise level s_c per channel. With x the scaled window, the
encoder's posterior N(m, exp(l)^2) and a latent z drawn from it, it maximises Eq. 1,

    ELBO(x) = sum over steps and channels of log N(x_tc; decode(z)_tc, exp(s_c)^2) - KL(N(m, exp(l)^2) || N(0, 1)),
    KL      = sum over the latent of (m^2 + exp(2 l) - 1) / 2 - l.

A window that the simulator could not have produced is reconstructed badly, so its ELBO is low. But some windows are
hard to reconstruct wherever they come from. Eq. 2 therefore compares a window with the simulated windows Q that are
nearest to it in latent space and within a given distance:

    novelty(x) = mean over q in Q of ELBO(q) - ELBO(x).

High means not covered. The sign departs from Eq. 2, which as printed falls where the text says that it rises. A
window with an empty Q has no novelty of its own; the gate ranks it above all windows that have one.
"""

import math
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from jaxtune import devices, windows
from jaxtune.descent import descend
from jaxtune.types import Trajectory

_STRIDE = 2
_LAYERS = 4  # they shorten a window of 50 steps to 25, 13, 7 and 4
_AWAY = 1e4  # where references lie that there are no windows for: within no reach
# A channel without noise (the gait clock) would otherwise raise the ELBO without limit as its learned noise shrinks.
_MIN_LOG_STD = -3.0


@dataclass(frozen=True, kw_only=True)
class DVMConfig:
    """Sizes of the verification model and of its training.

    The defaults are for walking episodes on two CPU cores. `TunerConfig` holds one.
    """

    window: int = 50
    """Steps in a window."""
    stride: int = 10
    """Steps from the start of one window to the next, where a set of episodes is scored."""
    latent: int = 16
    """Dimensions of the latent space."""
    channels: int = 64
    """Channels of every hidden convolution."""
    train_steps: int = 800
    """Gradient steps."""
    batch: int = 32
    """Windows in a gradient step."""
    learning_rate: float = 4e-3
    """Peak of a one-cycle cosine schedule."""
    references: int = 2048
    """Simulated windows that are kept as candidates for Q."""
    neighbours: int = 10
    """Largest size of Q (the paper's N)."""
    reach: float = 0.95
    """Quantile that sets how far away a neighbour may lie in latent space. Every reference has a distance to its
    `neighbours`-th nearest reference; the limit is this quantile of these distances."""


def _halve(x: Float[Array, "batch time channels"]) -> Float[Array, "batch half patch"]:
    """Lays out patches of four steps at every second step, edges padded: a strided convolution's input as a matrix.

    A dense layer on it is the convolution.
    """
    batch, time, channels = x.shape
    odd = time % _STRIDE
    pairs = jnp.pad(x, ((0, 0), (1, 1 + odd), (0, 0))).reshape(batch, -1, _STRIDE * channels)
    return jnp.concatenate([pairs[:, :-1], pairs[:, 1:]], axis=-1)


def _double(x: Float[Array, "batch half patch"], time: int) -> Float[Array, "batch time channels"]:
    """Adds up overlapping patches and cuts off the padding: the transpose of `_halve`."""
    batch, _, patch = x.shape
    first, second = jnp.split(x, 2, axis=-1)
    pairs = jnp.pad(first, ((0, 0), (0, 1), (0, 0))) + jnp.pad(second, ((0, 0), (1, 0), (0, 0)))
    return pairs.reshape(batch, -1, patch // (2 * _STRIDE))[:, 1 : 1 + time]


class _VAE(nn.Module):
    """The autoencoder, on scaled windows [batch, window, num_channels]."""

    config: DVMConfig
    num_channels: int

    def setup(self):
        width = self.config.channels
        self.down = [nn.Dense(width) for _ in range(_LAYERS)]
        self.to_latent = nn.Dense(2 * self.config.latent)
        self.lengths = [math.ceil(self.config.window / _STRIDE**layer) for layer in range(_LAYERS + 1)]
        self.from_latent = nn.Dense(self.lengths[-1] * width)
        outputs = [width] * (_LAYERS - 1) + [self.num_channels]
        self.up = [nn.Dense(2 * _STRIDE * channels) for channels in outputs]
        self.log_std = self.param("log_std", nn.initializers.zeros, (self.num_channels,))

    def encode(self, x):
        for layer in self.down:
            x = nn.elu(layer(_halve(x)))
        mean, log_std = jnp.split(self.to_latent(x.reshape(x.shape[0], -1)), 2, axis=-1)
        return mean, jnp.clip(log_std, -6.0, 2.0)

    def decode(self, z):
        x = nn.elu(self.from_latent(z)).reshape(z.shape[0], self.lengths[-1], -1)
        for layer, length in zip(self.up, reversed(self.lengths[:-1]), strict=True):
            x = _double(layer(x), length)
            # The last layer gives the means of the channels, which may have any size and sign.
            x = x if layer is self.up[-1] else nn.elu(x)
        return x

    def __call__(self, x, noise):
        """Computes ELBO [batch] and latent mean [batch, latent]; the latent is mean + std * noise [batch, latent]."""
        mean, log_std = self.encode(x)
        error = x - self.decode(mean + jnp.exp(log_std) * noise)
        channel = jnp.maximum(self.log_std, _MIN_LOG_STD)
        likelihood = -0.5 * (error * jnp.exp(-channel)) ** 2 - channel - 0.5 * math.log(2 * math.pi)
        divergence = 0.5 * (mean**2 + jnp.exp(2 * log_std) - 1.0) - log_std
        return likelihood.sum(axis=(1, 2)) - divergence.sum(axis=1), mean


@chex.dataclass(frozen=True)
class DVM:
    """A trained verification model with the simulated windows (references) that measured ones are compared with.

    `train` returns it; hand it to `novelty` with the config that it was trained with.
    """

    variables: dict
    scaler: windows.Scaler  # scales channels by the simulated episodes' mean and standard deviation
    latent: jax.Array  # [references, latent], where the references lie
    elbo: jax.Array  # [references], nats per window
    reach: jax.Array  # largest latent distance of a neighbour


def train(key: jax.Array, config: DVMConfig, trajectory: Trajectory) -> tuple[DVM, jax.Array]:
    """Trains a verification model on simulated episodes [episodes, time].

    Maximises the ELBO (Eq. 1) on random windows by Adam, then draws the reference windows and measures how far apart
    they lie, which sets the reach of a neighbour. The gate calls this for every distribution that it tests.

    Returns:
      The model, and its ELBO in nats per window, as the mean over the last tenth of the steps.
    """
    key_init, key_train, key_reference = jax.random.split(key, 3)
    trajectory = devices.gather(trajectory)
    scaler = windows.fit_scaler(trajectory)
    network = _VAE(config, scaler.mean.size)
    variables = network.init(key_init, jnp.zeros((1, config.window, scaler.mean.size)), jnp.zeros((1, config.latent)))
    schedule = optax.cosine_onecycle_schedule(config.train_steps, config.learning_rate)
    optimizer = optax.chain(optax.clip_by_global_norm(100.0), optax.adam(schedule))
    # The loss is a mean over steps and channels; what is reported is per window again.
    scale = 1.0 / (config.window * scaler.mean.size)

    def loss(variables, key):
        key_window, key_noise = jax.random.split(key)
        window, _ = devices.share(windows.draw(key_window, trajectory, config.batch, config.window))
        noise = jax.random.normal(key_noise, (config.batch, config.latent))
        elbo, _ = network.apply(variables, scaler(window), noise)
        return -scale * elbo.mean()

    variables, last = descend(key_train, loss, variables, optimizer, config.train_steps)
    # Not one of them twice, or copies would be each other's neighbours.
    window, valid = windows.choose(key_reference, trajectory, config.references, config.window)
    elbo, latent = _evaluate(config, variables, scaler, window)
    latent = jnp.where(valid[:, None], latent, _AWAY)
    # The first neighbour of a reference is itself.
    own, _ = jax.lax.top_k(-_distances(latent, latent), config.neighbours + 1)
    reach = jnp.nanquantile(jnp.where(valid, -own[:, -1], jnp.nan), config.reach)
    dvm = DVM(variables=variables, scaler=scaler, latent=latent, elbo=elbo, reach=reach)
    return dvm, -last / scale


def novelty(
    config: DVMConfig, dvm: DVM, trajectory: Trajectory
) -> tuple[Float[Array, " windows"], Bool[Array, " windows"], Bool[Array, " windows"]]:
    """Computes the novelty of every window of a set of episodes [episodes, time]: Eq. 2, sign mended, before averaging.

        novelty(x) = mean over q in Q of ELBO(q) - ELBO(x)

    Q holds those of the `neighbours` nearest references that lie within reach. The ELBO is evaluated at the latent's
    mean, so the score of a set is repeatable. Windows are not averaged here; the gate ranks them first.

    Returns:
      Novelty in nats per window, nan where a step is not finite, and everywhere if no simulated observation ever
      changes; whether the window is valid; and whether it is covered, that is, has a neighbour within reach. The
      novelty of a window that is not covered is zero and means nothing.
    """
    cut, valid = windows.grid(trajectory, config.window, config.stride)
    elbo, latent = _evaluate(config, dvm.variables, dvm.scaler, cut.reshape(-1, *cut.shape[2:]))
    closeness, index = jax.lax.top_k(-_distances(latent, dvm.latent), config.neighbours)
    near = -closeness <= dvm.reach
    mean = jnp.sum(jnp.where(near, dvm.elbo[index], 0.0), axis=-1) / jnp.maximum(near.sum(axis=-1), 1)
    # Observations that never change in simulation say nothing of a robot, so there is no novelty to compute.
    elbo = jnp.where(dvm.scaler.varies[: trajectory.obs.shape[-1]].any(), elbo, jnp.nan)
    # A window that is not finite must stay nan for the gate to see it, not pass for one without a neighbour.
    covered = near.any(axis=-1) | jnp.isnan(elbo)
    return jnp.where(covered, mean - elbo, 0.0), valid.reshape(-1), covered


def _evaluate(config, variables, scaler, window):
    """Computes ELBO [n] and latent mean [n, latent] of windows, decoded at that mean so that a score is repeatable."""
    network = _VAE(config, window.shape[-1])
    return network.apply(variables, scaler(window), jnp.zeros((window.shape[0], config.latent)))


def _distances(a: Float[Array, "n latent"], b: Float[Array, "m latent"]) -> Float[Array, "n m"]:
    """Computes all Euclidean distances."""
    return jnp.sqrt(windows.square_distances(a, b))
