"""The two decisions of a tuning: is the measured set covered, and where does the distribution move?

A `Tuner` is given one function for each; `jaxtune.tuner` draws where they are called. `verify` trains a verification
model (`jaxtune.dvm`) and scores the measured set; its default is `calibrated_gate`. `update` estimates the coordinates
of the measured set and moves the distribution; its default is `posterior_update`, by regression (`jaxtune.regression`).
`vote_update` is the paper's, by a search-parameter model (`jaxtune.spm`).
To change a decision, write a function with the same arguments (`Verify`, `Update`) and hand it to the tuner.

Departures from the paper:

- Its threshold sigma' is set by hand. Here held-out simulated sets calibrate it, so the gate is a conformal test with a
  known rate of false alarms. Sets are scored by mean ranks, not by the mean of Eq. 2.
- Its vote can only raise a parameter; here it has a sign.
- Both models are trained anew for every distribution, never continued.
- `posterior_update` is not in the paper. It gives an estimate and intervals at once, so it may replace several tunings.
  It estimates by regression, since a sweep of guesses through the search-parameter model had nearly twice the error
  on the same episodes of a walking robot, and took thirty times as long (`experiments.bench estimates`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import chex
import jax
import jax.numpy as jnp

from jaxtune import devices, dvm, regression, spm
from jaxtune import dist as dists
from jaxtune.dvm import DVMConfig
from jaxtune.regression import RegressionConfig
from jaxtune.spm import SPMConfig
from jaxtune.types import ParamDist, Trajectory

# An interval counts as informative if it is narrower than this share of the interval that ignores the data. The share
# is below 1 because both are quantiles over a few dozen sets and differ by chance.
_IDENTIFIABLE = 0.9
_LEAST_ERROR = 1e-4  # radii; without noise a regression may be exact
SETS = {"cpu": 1, "other": 64}
"""Held-out sets that are scored side by side on a device (`devices.in_chunks`)."""


@dataclass(frozen=True, kw_only=True)
class TunerConfig:
    """Sizes of a tuning: whatever fixes array shapes and loop lengths, so a change compiles the tuner anew.

    The defaults are for walking robots on two CPU cores. More `episodes` sharpen both models and take longer.
    For scalars that may vary within one compiled program, see `Knobs`.
    """

    episodes: int = 600
    """Simulated episodes in D_q, the set that both models are trained on. Each has coordinates of its own."""
    set_episodes: int = 5
    """Episodes in a measured set, and in every held-out set that it is compared with."""
    held_out_sets: int = 39
    """Simulated sets that calibrate the gate's threshold and the update's interval. Each set is one robot, with
    coordinates of its own. With 39 sets, p-values are multiples of 1/40."""
    max_widenings: int = 6
    """Largest number of widenings within one tuning; the gate is called at most once more than that."""
    patience: int = 3
    """Gate calls in a row without progress after which the verdict is `unexplained`."""
    least_fall: float = 0.01
    """Smallest novelty decrease that counts as progress, measured from the last call that made some. The novelty is a
    mean rank between 0 and 1. The value was chosen, not calibrated: the novelty of a first call varies by 0.01 to 0.04
    between seeds (`experiments.bench alarm`)."""
    refinements: int = 3
    """Times that an accepted set is read again, in the distribution that the update narrowed. Use 0 with `vote_update`,
    whose steps are meant for one set each."""
    coverage: float = 0.9
    """Share of held-out sets whose true coordinates the interval of the posterior update must contain."""
    min_radius: float = 0.1
    """Smallest radius, in coordinates, that the posterior update narrows to."""
    regression: RegressionConfig = field(default_factory=RegressionConfig)
    """Sizes of the regression that the posterior update estimates with."""
    spm: SPMConfig = field(default_factory=SPMConfig)
    """Sizes of the search-parameter model, which the vote update trains."""
    dvm: DVMConfig = field(default_factory=DVMConfig)
    """Sizes of the verification model."""

    @property
    def longest_window(self) -> int:
        """Steps that an episode must have at least."""
        return max(self.regression.window, self.spm.window, self.dvm.window)


@chex.dataclass(frozen=True)
class Knobs:
    """Scalars of a tuning that change no array's shape, so a sweep can vmap over them in one compiled program.

    They travel in the tuner's state. Make them with `knobs`, which has defaults and checks them.
    """

    step_size: jax.Array  # the paper's alpha: radii that `vote_update` moves per unit of vote
    widen_factor: jax.Array  # the paper's c: factor on the radius after a failed check
    level: jax.Array  # quantile of the held-out sets' novelty that is the threshold
    threshold: jax.Array  # the paper's sigma': a fixed mean rank instead of that quantile; nan where there is none


def knobs(
    *, step_size: float = 0.5, widen_factor: float = 1.5, level: float = 0.95, threshold: float | None = None
) -> Knobs:
    """Makes knobs from plain numbers, and checks them.

    Args:
      step_size: radii that the centre moves per unit of vote; `posterior_update` does not use it.
      widen_factor: what every radius is multiplied by after a failed check.
      level: share of covered sets that the gate lets pass. At 0.95 it rejects a set that came from the distribution
        with a probability of at most 0.05.
      threshold: a fixed novelty, as a mean rank in (0, 1), that replaces the calibrated threshold. The paper sets its
        threshold by hand like this.

    Raises:
      ValueError: step size not positive, widening factor not above 1, level or threshold not in (0, 1).
    """
    if not step_size > 0:
        raise ValueError(f"step_size: got {step_size}, expected a positive number")
    if not widen_factor > 1:
        raise ValueError(f"widen_factor: got {widen_factor}, expected a number above 1")
    if not 0 < level < 1:
        raise ValueError(f"level: got {level}, expected a number between 0 and 1")
    if threshold is not None and not 0 < threshold < 1:
        raise ValueError(f"threshold: got {threshold}, expected a number between 0 and 1")
    values = {"step_size": step_size, "widen_factor": widen_factor, "level": level}
    values["threshold"] = jnp.nan if threshold is None else threshold
    return Knobs(**{name: jnp.asarray(value, jnp.float32) for name, value in values.items()})


@chex.dataclass(frozen=True)
class Collected:
    """Simulated episodes drawn from one distribution: what `verify` and `update` learn from and are calibrated on.

    The paper's D_q trains both models. The held-out sets imitate a measured set: one draw of the coordinates per set,
    repeated in `set_episodes` episodes. No network is trained on them.
    """

    trajectory: Trajectory  # D_q, [episodes, time]
    sampled_coords: dict  # true coordinates of the episodes of D_q, [episodes] by name
    held_out: Trajectory  # [sets, set_episodes, time]
    held_out_coords: dict  # true coordinates of the held-out sets, [sets] by name


@chex.dataclass(frozen=True)
class GateInfo:
    """What one call of the gate found, scalars each.

    The tuner decides by `novelty` and `threshold` alone: the set is covered where novelty <= threshold, and a value
    that is not finite ends the tuning. The rest is for plots and reports; a gate that does not compute it answers nan.
    """

    novelty: jax.Array  # mean rank of the measured windows among those of all sets, in (0, 1]; 1/2 where they are alike
    threshold: jax.Array  # largest novelty of a covered set
    p_value: jax.Array  # (1 + #{held-out sets at least as novel}) / (held-out sets + 1)
    uncovered: jax.Array  # share of the measured windows that have no simulated neighbour within reach
    elbo: jax.Array  # evidence lower bound that the verification model reached in training, nats per window


@chex.dataclass(frozen=True)
class UpdateInfo:
    """What one update did, [coords] each in the order of `dist.names`, but for `loss`.

    Step and interval are in radii of the distribution before the update. For an identifiable coordinate the new
    estimate is `centre + radius * step`, give or take `radius * interval`. For any other one `step` is zero, and
    `interval` says nothing about the centre.
    """

    step: jax.Array  # movement of the centre, before it is clipped to the bounds
    interval: jax.Array  # half width of the interval around the new centre; nan where the rule gives none
    identifiable: jax.Array  # False where the measured set says no more than the distribution did
    loss: jax.Array  # scalar: `vote_update`'s logistic loss in nats, `posterior_update`'s error of episodes left out


Verify = Callable[[jax.Array, TunerConfig, Collected, Trajectory, Knobs], GateInfo]
"""Type of a gate: `(key, config, collected, measured, knobs) -> GateInfo`, pure and traceable."""
Update = Callable[[jax.Array, TunerConfig, Collected, Trajectory, ParamDist, Knobs], tuple[ParamDist, UpdateInfo]]
"""Type of an update: `(key, config, collected, measured, dist, knobs) -> (ParamDist, UpdateInfo)`, likewise."""


def calibrated_gate(
    key: jax.Array, config: TunerConfig, collected: Collected, measured: Trajectory, knobs: Knobs
) -> GateInfo:
    """Tests whether simulated episodes cover a measured set: the default gate.

    It trains a verification model on D_q and computes the novelty of every window (Eq. 2 with its sign mended, see
    `dvm.novelty`), for the measured set and for each held-out set. With W the valid windows of all these sets,

        rank(x)    = #{w in W: novelty(w) <= novelty(x)} / #W
        score(set) = mean of rank(x) over the valid windows of the set
        p          = (1 + #{held-out sets: score >= score(measured)}) / (held_out_sets + 1)
        threshold  = the ceil((held_out_sets + 1) level)-th smallest score of the held-out sets.

    A measured set drawn like the held-out ones exceeds the threshold with probability at most `1 - level`. The test is
    calibrated per set, since the windows of one episode depend on each other. Ranks replace nats because the novelty of
    single windows is heavy-tailed: one held-out fall raises a mean in nats so far that a measured set which is a little
    novel everywhere would pass. A window without a neighbour ranks highest.

    Args:
      key: random key, for training the verification model.
      config: sizes.
      collected: D_q and held-out sets of the distribution that is tested.
      measured: the measured set, [set_episodes, time].
      knobs: `level`, or a fixed `threshold`.

    Returns:
      Score (`novelty`), threshold and p-value. The score is nan where the set has no valid window or holds a living
      step that is not finite, and where no simulated observation ever changes.
    """
    model, elbo = dvm.train(key, config.dvm, collected.trajectory)
    held_out = devices.in_chunks(partial(dvm.novelty, config.dvm), (collected.held_out,), SETS, shared=(model,))
    scored = dvm.novelty(config.dvm, model, measured)
    novelty, valid, covered = jax.tree.map(lambda sets, one: jnp.concatenate([sets, one[None]]), held_out, scored)
    novelty = jnp.where(covered, novelty, jnp.inf)
    # Invalid windows sort to the end of the pool as infinite. A window without a neighbour is infinite too and would
    # count them, so its rank is capped at 1 below.
    pool = jnp.sort(jnp.where(valid, novelty, jnp.inf), axis=None)
    rank = jnp.searchsorted(pool, novelty, side="right") / valid.sum()
    rank = jnp.where(jnp.isnan(novelty), jnp.nan, jnp.minimum(rank, 1.0))
    score = jnp.sum(jnp.where(valid, rank, 0.0), axis=-1) / valid.sum(axis=-1)
    # A held-out set that fell before its first window ended has no score; it counts as the most novel.
    calibration, value = jnp.nan_to_num(score[:-1], nan=1.0), score[-1]
    return GateInfo(
        novelty=value,
        threshold=jnp.where(jnp.isnan(knobs.threshold), _conformal_quantile(calibration, knobs.level), knobs.threshold),
        p_value=(1 + jnp.sum(calibration >= value)) / (config.held_out_sets + 1),
        uncovered=jnp.sum(valid[-1] & ~covered[-1]) / jnp.maximum(valid[-1].sum(), 1),
        elbo=elbo,
    )


def _conformal_quantile(values: jax.Array, level: jax.Array | float) -> jax.Array:
    """Computes a bound that one more draw like `values` [n, ...] exceeds with probability at most `1 - level`.

    It is the ceil((n + 1) level)-th smallest value. The guarantee needs n of at least `level / (1 - level)`; with
    fewer, the largest value is returned.
    """
    rank = jnp.ceil((len(values) + 1) * level).astype(int) - 1
    return jnp.sort(values, axis=0)[jnp.minimum(rank, len(values) - 1)]


def vote_update(
    key: jax.Array, config: TunerConfig, collected: Collected, measured: Trajectory, dist: ParamDist, knobs: Knobs
) -> tuple[ParamDist, UpdateInfo]:
    """Moves the centre by the vote of a search-parameter model: the paper's update, with a sign.

        centre <- centre + step_size * radius * vote,    vote = 2 p(truth > centre) - 1, in [-1, 1]

    (the last line of Algorithm 1). The radius stays, no interval is given, and every coordinate counts as identifiable.
    Use it for the baseline, or to compare with the paper.

    Args:
      key: random key, for training the search-parameter model.
      config: sizes.
      collected: simulated episodes; only D_q and its coordinates are read.
      measured: the accepted measured set, [set_episodes, time].
      dist: the distribution that the episodes were drawn from.
      knobs: `step_size`, in radii per unit of vote.
    """
    model, loss = spm.train(key, config.spm, collected.trajectory, collected.sampled_coords, dist)
    step = knobs.step_size * spm.vote(config.spm, model, measured)
    unknown = jnp.full_like(step, jnp.nan)
    info = UpdateInfo(step=step, interval=unknown, identifiable=jnp.ones_like(step, bool), loss=loss)
    return dists.move(dist, step), info


def posterior_update(
    key: jax.Array, config: TunerConfig, collected: Collected, measured: Trajectory, dist: ParamDist, knobs: Knobs
) -> tuple[ParamDist, UpdateInfo]:
    """Moves the centre to the posterior's median and narrows the radius to its interval: the default update.

    A regression on D_q gives each coordinate's estimate (`jaxtune.regression`). Held-out sets, whose coordinates are
    known, calibrate it. With Q the conformal quantile `coverage` over held-out sets, e the regression's error of an
    episode that it leaves out, and all values in radii,

        interval     = e Q(max over coordinates of |estimate - truth| / e)
        ignorant     = Q(|middle of the box - truth|)
        identifiable = Q(|estimate - truth|) < 0.9 ignorant
        step         = estimate(measured)                           where identifiable, else 0
        radius      <- max(radius * interval, min_radius)           where identifiable, if all are inside; never larger

    The intervals hold together: all truths at once lie in them with probability `coverage`, if the measured set is a
    draw like the held-out ones. A coordinate that is not identifiable keeps centre and radius. Where the interval of
    one that is reaches past the box, all keep their radii, and centres move.

    Args:
      key: not used.
      config: sizes, with `coverage` and `min_radius`.
      collected: D_q and held-out sets, drawn from `dist`.
      measured: the accepted measured set, [set_episodes, time].
      dist: the distribution that the episodes were drawn from.
      knobs: not used.
    """
    model = regression.train(config.regression, collected.trajectory, collected.sampled_coords, dist)
    estimate = partial(regression.estimate, config.regression)
    held_out = devices.in_chunks(estimate, (collected.held_out,), SETS, shared=(model,))
    # The errors on robots with known coordinates stand for the error on the measured one.
    truth = dists.normalise(dist, collected.held_out_coords)
    low, high = dists.normalised_box(dist)
    error = jnp.abs(held_out - truth)
    # What scales the errors must not come from the sets that calibrate them.
    scale = jnp.maximum(model.error, _LEAST_ERROR)
    interval = scale * _conformal_quantile((error / scale).max(axis=-1), config.coverage)
    ignorant = _conformal_quantile(jnp.abs((low + high) / 2 - truth), config.coverage)
    identifiable = _conformal_quantile(error, config.coverage) < _IDENTIFIABLE * ignorant
    step = jnp.where(identifiable, estimate(model, measured), 0.0)
    moved = dists.move(dist, step)
    radius = dists.ravel(dist.radius)
    narrowed = jnp.clip(radius * interval, jnp.minimum(config.min_radius, radius), radius)
    # Held-out truths all lie in the box, so their errors say nothing of truths beyond it. One that is outside in one
    # coordinate may bend the estimates of all, and narrowing could exclude it for good.
    inside = (((step - interval >= low) & (step + interval <= high)) | ~identifiable).all()
    radius = jnp.where(identifiable & inside, narrowed, radius)
    moved = moved.replace(radius=dists.unravel(dists.names(dist), radius))
    return moved, UpdateInfo(step=step, interval=interval, identifiable=identifiable, loss=model.error.mean())


def no_gate_log(config: TunerConfig) -> dict:
    """Makes the gate's part of a `tuner.Info` before any gate call: -1 for verdicts, nan for everything else.

    Every array has `max_widenings + 1` entries, one per possible call, so its shape does not depend on how many calls a
    tuning needs.
    """
    log = jnp.full(config.max_widenings + 1, jnp.nan)
    gate = GateInfo(novelty=log, threshold=log, p_value=log, uncovered=log, elbo=log)
    return {"verdicts": jnp.full(log.shape, -1), "radius": log, "gate": gate}


def no_update(dist: ParamDist) -> UpdateInfo:
    """Reports that no update was made: steps of zero, no coordinate identifiable, intervals and loss nan.

    It has the shapes of a real update's report, so the two can be the branches of one `jax.lax.cond`.
    """
    zeros = jnp.zeros(len(dist.centre))
    unknown = jnp.full_like(zeros, jnp.nan)
    return UpdateInfo(step=zeros, interval=unknown, identifiable=jnp.zeros_like(zeros, bool), loss=jnp.asarray(jnp.nan))
