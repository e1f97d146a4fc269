"""The search-parameter model (SPM): does the true coordinate lie above a guess? (Sections III-B.1 and IV-A.4.)

It turns identification into a yes-no question, coordinate by coordinate. A window of 50 steps and a guess of all
coordinates are encoded by a three-layer MLP each. A two-layer head per coordinate reads both encodings and answers with
a logit, trained by logistic regression:

    loss = mean over windows and guesses of  softplus(logit) - label * logit,    label = 1[truth > guess]
    sigmoid(logit) = p(truth > guess | window).

`train` fits the model to D_q. `vote` asks about the centre alone and gives a direction, as in the paper. `estimate`
sweeps the guess and gives a value. Everything is in radii of the distribution that the model was trained on.

Departures from the paper:

- A window enters as its moments (means, spreads, covariances), since a network that sees the raw steps of a few hundred
  episodes overfits to them. BayesSim (Ramos et al., RSS 2019) likewise reads covariances of states and actions.
  `SPMConfig.reads` has the raw steps, to compare with.
- The answer has a sign. The paper's rule `mu + alpha q` with q in (0, 1) can only raise a parameter.
- Guesses are drawn over the whole query box independently of the truth, the centre among them. Only then is
  p(truth > guess), as a function of the guess, one minus a distribution function, so that a sweep is a posterior.
- Each window's encoding serves several guesses, which is cheaper than encoding it for each.
"""

from dataclasses import dataclass
from typing import Literal

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

_SCALED = 2048  # windows from which mean and standard deviation of the inputs are computed


@dataclass(frozen=True, kw_only=True)
class SPMConfig:
    """Sizes of the search-parameter model and of its training.

    The defaults suit the seven coordinates of the paper on two CPU cores. `TunerConfig` holds one.
    """

    window: int = 50
    """Steps in a window."""
    stride: int = 10
    """Steps from the start of one window to the next, where a set of episodes is scored."""
    reads: Literal["moments", "steps"] = "moments"
    """What the encoder sees of a window: its moments, or its raw steps as in the paper."""
    hidden: tuple[int, int, int] = (256, 128, 128)
    """Layer widths of the window's encoder; the guess's encoder has a quarter of them."""
    head: int = 64
    """Hidden width of each coordinate's head."""
    train_steps: int = 1200
    """Gradient steps."""
    batch: int = 256
    """Windows in a gradient step."""
    guesses: int = 4
    """Guesses per window of a batch, the centre among them."""
    learning_rate: float = 5e-4
    """Peak of a one-cycle cosine schedule."""
    weight_decay: float = 1e-3
    """Decoupled weight decay of AdamW."""
    sweep: int = 33
    """Guesses in the sweep over the box that `estimate` makes."""

    def __post_init__(self):
        if self.reads not in ("moments", "steps"):
            raise ValueError(f"reads: got '{self.reads}', expected moments or steps")


class _Network(nn.Module):
    """Encoders of window and guess, and the heads of all coordinates.

    All heads are computed at once: their hidden layers are one dense layer, their outputs one contraction.
    """

    config: SPMConfig
    num_coords: int

    def setup(self):
        self.window_layers = [nn.Dense(width) for width in self.config.hidden]
        self.guess_layers = [nn.Dense(width // 4) for width in self.config.hidden]
        self.head_hidden = nn.Dense(self.num_coords * self.config.head)
        self.head_out = self.param("head_out", nn.initializers.lecun_normal(), (self.config.head, self.num_coords))

    def __call__(self, features, guesses):
        """Logits [batch, guesses, coords] for inputs [batch, inputs] and guesses [batch, guesses, coords]."""
        for layer in self.window_layers:
            features = nn.elu(layer(features))
        for layer in self.guess_layers:
            guesses = nn.elu(layer(guesses))
        # A window is encoded once and combined with each of its guesses.
        features = jnp.broadcast_to(features[:, None], (*guesses.shape[:2], features.shape[-1]))
        hidden = nn.elu(self.head_hidden(jnp.concatenate([features, guesses], axis=-1)))
        hidden = hidden.reshape(*hidden.shape[:-1], self.num_coords, self.config.head)
        return jnp.einsum("...ph,hp->...p", hidden, self.head_out)


@chex.dataclass(frozen=True)
class SPM:
    """A trained search-parameter model, as `train` returns it.

    It answers only within the distribution that it was trained on, in that distribution's radii. Hand it to `logits`,
    `vote` or `estimate` with the config that it was trained with.
    """

    variables: dict
    steps: windows.Scaler  # scales the channels of each step
    inputs: windows.Scaler  # scales what the encoder sees of each window
    dist: ParamDist  # the distribution it was trained on


def _read(config: SPMConfig, steps: windows.Scaler, window: Float[Array, "batch time channels"]):
    """Computes what the encoder sees of each window, [batch, inputs], before it is standardised."""
    standardised = steps(window)
    return windows.moments(standardised) if config.reads == "moments" else standardised.reshape(len(window), -1)


def train(
    key: jax.Array, config: SPMConfig, trajectory: Trajectory, coords: Coords, dist: ParamDist
) -> tuple[SPM, jax.Array]:
    """Trains a search-parameter model on simulated episodes of known coordinates.

    Each gradient step draws windows, and for each window the centre and `guesses - 1` uniform guesses from the query
    box. Steps, inputs and coordinates are standardised first. An update calls this once per tuning.

    Args:
      key: random key.
      config: sizes.
      trajectory: the episodes (D_q), [episodes, time].
      coords: true coordinates of every episode, [episodes] by name.
      dist: the distribution that they were drawn from; its support is the query box.

    Returns:
      The model, and its logistic loss per coordinate in nats, as the mean over the last tenth of the steps. A model
      that learned nothing knows only where a guess lies in the box. Its loss is log 2 = 0.69 at the centre and 0.5 on
      average over the box, so 0.55 with four guesses. A loss near that says that the episodes do not show the
      coordinates.
    """
    key_init, key_inputs, key_train = jax.random.split(key, 3)
    trajectory, coords = devices.gather((trajectory, coords))
    truth = dists.normalise(dist, coords)
    low, high = dists.normalised_box(dist)
    steps = windows.fit_scaler(trajectory)
    window, _ = windows.draw(key_inputs, trajectory, _SCALED, config.window)
    inputs = windows.scaler(_read(config, steps, window))
    network = _Network(config, truth.shape[-1])
    variables = network.init(key_init, inputs.mean[None], jnp.zeros((1, 1, truth.shape[-1])))
    schedule = optax.cosine_onecycle_schedule(config.train_steps, config.learning_rate)
    optimizer = optax.adamw(schedule, weight_decay=config.weight_decay)

    def loss(variables, key):
        key_window, key_guess = jax.random.split(key)
        window, episode = devices.share(windows.draw(key_window, trajectory, config.batch, config.window))
        shape = (config.batch, config.guesses, truth.shape[-1])
        # `vote` asks about the centre, so the centre is among the guesses of every window.
        guesses = jax.random.uniform(key_guess, shape, minval=low, maxval=high).at[:, 0].set(0.0)
        logits = network.apply(variables, inputs.clipped(_read(config, steps, window)), guesses)
        label = truth[episode][:, None] > guesses
        # The mean over windows and guesses, summed over coordinates; what is reported is per coordinate again.
        return optax.sigmoid_binary_cross_entropy(logits, label).mean(axis=(0, 1)).sum()

    variables, last = descend(key_train, loss, variables, optimizer, config.train_steps)
    return SPM(variables=variables, steps=steps, inputs=inputs, dist=dist), last / truth.shape[-1]


def logits(
    config: SPMConfig, spm: SPM, trajectory: Trajectory, guesses: Float[Array, "guesses coords"]
) -> Float[Array, "guesses coords"]:
    """Computes how strongly a set of episodes says that the truth lies above each guess.

    This is the mean logit over the set's valid windows: the evidence of one typical window. The windows of a set are
    not independent, so a sum would be far too certain; updates calibrate their intervals per set instead.

    Args:
      config: the sizes that the model was trained with.
      spm: the model.
      trajectory: one set, [episodes, time].
      guesses: guesses of all coordinates, in radii.

    Returns:
      Logits of p(truth > guess), each coordinate by itself. They are zero where the set has no valid window.
    """
    cut, valid = windows.grid(trajectory, config.window, config.stride)
    cut, valid = cut.reshape(-1, *cut.shape[2:]), valid.reshape(-1)
    # A broken simulation may leave nan behind, which a weight of zero would not remove.
    cut = jnp.where(valid[:, None, None], cut, spm.steps.mean)
    network = _Network(config, guesses.shape[-1])
    inputs = spm.inputs.clipped(_read(config, spm.steps, cut))
    answers = network.apply(spm.variables, inputs, jnp.broadcast_to(guesses, (len(cut), *guesses.shape)))
    return _masked_mean(answers, valid)


def vote(config: SPMConfig, spm: SPM, trajectory: Trajectory) -> Float[Array, " coords"]:
    """Says for each coordinate which way it must move from the centre, in [-1, 1]; positive means up.

        vote = 2 sigmoid(logit at the centre) - 1 = 2 p(truth > centre) - 1

    It is the signed form of the paper's q, zero where the set says nothing. `update.vote_update` turns it into a step.
    """
    centre = jnp.zeros((1, len(spm.dist.centre)))
    return 2.0 * jax.nn.sigmoid(logits(config, spm, trajectory, centre)[0]) - 1.0


def estimate(config: SPMConfig, spm: SPM, trajectory: Trajectory) -> Float[Array, " coords"]:
    """Estimates each coordinate from a set of episodes, in radii.

    The estimate is the median of the posterior: the guess at which p(truth > guess) is one half, so that its logit
    crosses zero. It is found by sweeping the guess across the box, as

        low + (high - low) * (share of the box where the logit, interpolated linearly, is positive),

    which is the crossing if the curve falls, and stays inside the box if it never crosses. Guesses of different
    coordinates are independent in training, so one sweep along the box's diagonal serves them all. A truth outside the
    box is estimated at its edge; a set that says nothing is answered with the middle of the box.

    Args:
      config: the sizes that the model was trained with.
      spm: the model.
      trajectory: one set, [episodes, time].
    """
    low, high = dists.normalised_box(spm.dist)
    share = jnp.linspace(0.0, 1.0, config.sweep)[:, None]
    curve = logits(config, spm, trajectory, low + share * (high - low))
    left, right = curve[:-1], curve[1:]
    # A flat part has no crossing; this only avoids a division by zero.
    rise = jnp.where(left == right, 1.0, left - right)
    # Share of each part of the sweep, between two neighbouring guesses, in which the logit is positive.
    crossing = jnp.clip(left / rise, 0.0, 1.0)
    positive = jnp.where((left > 0) & (right > 0), 1.0, 0.0)
    positive = jnp.where((left > 0) & (right <= 0), crossing, positive)
    # Nothing forces the curve to fall everywhere. Where it rises through zero, the part after the crossing counts.
    positive = jnp.where((left <= 0) & (right > 0), 1.0 - crossing, positive)
    # No evidence at all (a set without a valid window) leaves the estimate in the middle.
    positive = jnp.where((left == 0) & (right == 0), 0.5, positive)
    return low + (high - low) * positive.mean(axis=0)


def _masked_mean(values: Float[Array, "windows ..."], valid: Bool[Array, " windows"]) -> Float[Array, "..."]:
    """Averages over the valid windows; zero where there are none."""
    weight = valid / jnp.maximum(valid.sum(), 1)
    return jnp.tensordot(weight, values, axes=1)
