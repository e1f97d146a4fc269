"""The search-parameter model: does the truth lie above a guess? (Section III-B.1 and IV-A.4.)

A window of 50 steps and a guess of all parameters are encoded by a three-layer MLP each; a two-layer head for every
parameter reads both and answers with a logit, trained by logistic regression on `truth > guess`. Departures from the
paper: a window enters as its moments (BayesSim, Ramos et al., RSS 2019, likewise reads covariances of states and
actions), since a network that sees the raw steps of a few hundred episodes learns them by heart; the answer is used
with its sign (its rule `mu + alpha q` with q in (0, 1) can only grow); guesses are drawn over the query box
independently of the truth, the centre among them, so that the answers over a sweep of guesses are one minus a
distribution function; a window's encoding serves several guesses.
"""

from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from jaxtune import dist as dists
from jaxtune import windows
from jaxtune.types import Coords, ParamDist, Trajectory

_SCALED = 2048  # windows that the scale of the moments is read from
_FAR = 10.0  # standard deviations; a moment that hardly varied in training must not drown all others later


@dataclass(frozen=True, kw_only=True)
class SPMConfig:
    """Sizes of the search-parameter model and its training."""

    window: int = 50
    """Steps in a window."""
    stride: int = 10
    """Steps between the windows of a measured episode."""
    hidden: tuple[int, int, int] = (256, 128, 128)
    """Layers of the trajectory encoder; the guess encoder has a quarter of their width."""
    head: int = 64
    """Hidden width of every parameter's head."""
    train_steps: int = 1200
    """Gradient steps."""
    batch: int = 256
    """Windows in a gradient step."""
    guesses: int = 4
    """Guesses judged for every window of a batch, the centre among them."""
    learning_rate: float = 5e-4
    """Peak of a one-cycle cosine schedule."""
    weight_decay: float = 1e-3
    """Decoupled weight decay."""
    sweep: int = 33
    """Guesses in a sweep over the box."""


class _Network(nn.Module):
    config: SPMConfig
    num_coords: int

    def setup(self):
        self.window_layers = [nn.Dense(width) for width in self.config.hidden]
        self.guess_layers = [nn.Dense(width // 4) for width in self.config.hidden]
        self.head_hidden = nn.Dense(self.num_coords * self.config.head)
        self.head_out = self.param("head_out", nn.initializers.lecun_normal(), (self.config.head, self.num_coords))

    def __call__(self, features, guesses):
        """Logits [batch, guesses, coords] for moments [batch, moments] and guesses [batch, guesses, coords]."""
        for layer in self.window_layers:
            features = nn.elu(layer(features))
        for layer in self.guess_layers:
            guesses = nn.elu(layer(guesses))
        features = jnp.broadcast_to(features[:, None], (*guesses.shape[:2], features.shape[-1]))
        hidden = nn.elu(self.head_hidden(jnp.concatenate([features, guesses], axis=-1)))
        hidden = hidden.reshape(*hidden.shape[:-1], self.num_coords, self.config.head)
        return jnp.einsum("...ph,hp->...p", hidden, self.head_out)


@chex.dataclass(frozen=True)
class SPM:
    """A trained search-parameter model and the distribution it was trained on."""

    variables: dict
    steps: windows.Scaler  # of channels
    moments: windows.Scaler  # of a window's moments
    dist: ParamDist


def _read(steps: windows.Scaler, moments: windows.Scaler, window: Float[Array, "batch time channels"]):
    """What the network sees of a window [batch, moments]."""
    return jnp.clip(moments(_moments(steps(window))), -_FAR, _FAR)


def _moments(window: Float[Array, "batch time channels"]) -> Float[Array, "batch moments"]:
    """Mean of every channel, spread of its first and second differences, covariances at lag zero and one.

    The gait clock is among the channels, so covariances tell phases.
    """
    batch, time, channels = window.shape
    mean = window.mean(axis=1)
    centred = window - mean[:, None]
    step = jnp.diff(window, axis=1)
    upper = jnp.triu_indices(channels)
    at_once = jnp.einsum("bti,btj->bij", centred, centred)[:, *upper] / time
    ahead = jnp.einsum("bti,btj->bij", step, centred[:, :-1]).reshape(batch, -1) / time
    return jnp.concatenate([mean, step.std(axis=1), jnp.diff(step, axis=1).std(axis=1), at_once, ahead], axis=-1)


def train(
    key: jax.Array, config: SPMConfig, trajectory: Trajectory, coords: Coords, dist: ParamDist
) -> tuple[SPM, jax.Array]:
    """Trains on simulated episodes.

    Args:
      key: random key.
      config: sizes.
      trajectory: [episodes, time].
      coords: the true coordinates of every episode, [episodes] by name.
      dist: the distribution they were drawn from; its support is the query box.

    Returns:
      The model, and its logistic loss per parameter in nats, the mean over the last tenth of the steps. Ignorance costs
      log 2 at the centre and 1/2, on average over the box, elsewhere.
    """
    key_init, key_moments, key_train = jax.random.split(key, 3)
    truth = dists.normalise(dist, coords)
    low, high = dists.normalised_box(dist)
    steps = windows.fit_scaler(trajectory)
    window, _ = windows.draw(key_moments, trajectory, _SCALED, config.window)
    moments = windows.scaler(_moments(steps(window)))
    network = _Network(config, truth.shape[-1])
    variables = network.init(key_init, moments.mean[None], jnp.zeros((1, 1, truth.shape[-1])))
    schedule = optax.cosine_onecycle_schedule(config.train_steps, config.learning_rate)
    optimizer = optax.adamw(schedule, weight_decay=config.weight_decay)

    def loss(variables, key):
        key_window, key_guess = jax.random.split(key)
        window, episode = windows.draw(key_window, trajectory, config.batch, config.window)
        shape = (config.batch, config.guesses, truth.shape[-1])
        guesses = jax.random.uniform(key_guess, shape, minval=low, maxval=high).at[:, 0].set(0.0)
        logits = network.apply(variables, _read(steps, moments, window), guesses)
        label = truth[episode][:, None] > guesses
        return optax.sigmoid_binary_cross_entropy(logits, label).mean(axis=(0, 1)).sum()

    def descend(carry, key):
        variables, opt_state = carry
        value, grads = jax.value_and_grad(loss)(variables, key)
        updates, opt_state = optimizer.update(grads, opt_state, variables)
        return (optax.apply_updates(variables, updates), opt_state), value

    (variables, _), losses = jax.lax.scan(
        descend, (variables, optimizer.init(variables)), jax.random.split(key_train, config.train_steps)
    )
    tail = losses[-max(config.train_steps // 10, 1) :].mean() / truth.shape[-1]
    return SPM(variables=variables, steps=steps, moments=moments, dist=dist), tail


def logits(
    config: SPMConfig, spm: SPM, trajectory: Trajectory, guesses: Float[Array, "guesses coords"]
) -> Float[Array, "guesses coords"]:
    """Evidence of a set of episodes, for each guess: the mean logit over the set's windows.

    Args:
      trajectory: [episodes, time], one set.
      guesses: in units of the radius around the centre.
    """
    cut, valid = windows.grid(trajectory, config.window, config.stride)
    cut, valid = cut.reshape(-1, *cut.shape[2:]), valid.reshape(-1)
    cut = jnp.where(valid[:, None, None], cut, spm.steps.mean)
    network = _Network(config, guesses.shape[-1])
    moments = _read(spm.steps, spm.moments, cut)
    answers = network.apply(spm.variables, moments, jnp.broadcast_to(guesses, (len(cut), *guesses.shape)))
    return _masked_mean(answers, valid)


def vote(config: SPMConfig, spm: SPM, trajectory: Trajectory) -> Float[Array, " coords"]:
    """Which way each parameter must move from the centre, in [-1, 1]; positive raises it."""
    centre = jnp.zeros((1, len(spm.dist.centre)))
    return 2.0 * jax.nn.sigmoid(logits(config, spm, trajectory, centre)[0]) - 1.0


def estimate(config: SPMConfig, spm: SPM, trajectory: Trajectory) -> Float[Array, " coords"]:
    """Where the sweep's logit crosses zero, for each parameter, in units of the radius around the centre.

    Guesses of different parameters are independent in training, so one sweep along the box's diagonal serves them all.
    The crossing is found as the length of the part of the box where the logit is positive, which is the same where the
    curve falls and stays inside the box where it never crosses.
    """
    low, high = dists.normalised_box(spm.dist)
    share = jnp.linspace(0.0, 1.0, config.sweep)[:, None]
    curve = logits(config, spm, trajectory, low + share * (high - low))
    left, right = curve[:-1], curve[1:]
    rise = jnp.where(left == right, 1.0, left - right)
    crossing = jnp.clip(left / rise, 0.0, 1.0)
    positive = jnp.where((left > 0) & (right > 0), 1.0, 0.0)
    positive = jnp.where((left > 0) & (right <= 0), crossing, positive)
    positive = jnp.where((left <= 0) & (right > 0), 1.0 - crossing, positive)
    # No evidence at all (a set without a valid window) leaves the estimate in the middle.
    positive = jnp.where((left == 0) & (right == 0), 0.5, positive)
    return low + (high - low) * positive.mean(axis=0)


def _masked_mean(values: Float[Array, "windows ..."], valid: Bool[Array, " windows"]) -> Float[Array, "..."]:
    weight = valid / jnp.maximum(valid.sum(), 1)
    return jnp.tensordot(weight, values, axes=1)
