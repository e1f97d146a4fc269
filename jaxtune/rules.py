"""The two decisions of a tuning: is a measured set covered, and where does the distribution move.

Each is a function that a `Tuner` is given: `calibrated_gate` is the default check; `posterior_update` is the default
update, and `vote_update` the paper's.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import chex
import jax
import jax.numpy as jnp

from jaxtune import dist as dists
from jaxtune import dvm, spm
from jaxtune.dvm import DVMConfig
from jaxtune.spm import SPMConfig
from jaxtune.types import ParamDist, Trajectory

_IDENTIFIABLE = 0.9  # an interval this much narrower than one that ignores the data tells something


@dataclass(frozen=True, kw_only=True)
class TunerConfig:
    """Sizes of a tuning."""

    episodes: int = 600
    """Simulated episodes in D_q, each with its own parameters."""
    set_episodes: int = 5
    """Episodes in a measured set, and in every held-out set that it is compared with."""
    held_out_sets: int = 39
    """Simulated sets that calibrate gate and interval, each with its own parameters."""
    max_widenings: int = 6
    """Widenings within one tuning."""
    patience: int = 3
    """Calls in a row that came no closer after which the verdict is `unexplained`."""
    least_fall: float = 0.01
    """Fall of the novelty, a mean rank, since the last call that came closer, above which another one does. Chosen; a
    first call's score differs by 0.01 to 0.04 from seed to seed (`experiments.bench alarm`).
    """
    coverage: float = 0.9
    """Share of held-out sets whose truth lies within the interval of the posterior update."""
    min_radius: float = 0.1
    """The posterior update narrows no radius below this, in search coordinates."""
    spm: SPMConfig = field(default_factory=SPMConfig)
    dvm: DVMConfig = field(default_factory=DVMConfig)


@chex.dataclass(frozen=True)
class Knobs:
    """What a sweep varies: scalars that change no shape."""

    step_size: jax.Array  # radii per unit vote (the paper's alpha)
    widen_factor: jax.Array  # the paper's c
    level: jax.Array  # quantile of the held-out novelty that is the threshold
    threshold: jax.Array  # a fixed mean rank in its stead (the paper's sigma'); nan where there is none


def knobs(
    *, step_size: float = 0.5, widen_factor: float = 1.5, level: float = 0.95, threshold: float | None = None
) -> Knobs:
    """Knobs, checked.

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
    """Simulated episodes of one distribution."""

    trajectory: Trajectory  # D_q, [episodes, time]
    coords: dict  # their parameters, [episodes]
    held_out: Trajectory  # [sets, set_episodes, time]
    held_out_coords: dict  # [sets]


@chex.dataclass(frozen=True)
class GateInfo:
    """One call of the gate."""

    novelty: jax.Array  # mean rank of the measured windows among those of all sets; 1/2 where it is like them
    threshold: jax.Array
    p_value: jax.Array  # (1 + number of held-out sets at least as novel) / (sets + 1)
    uncovered: jax.Array  # share of measured windows without a simulated neighbour
    elbo: jax.Array  # of the trained model, nats per window


@chex.dataclass(frozen=True)
class UpdateInfo:
    """One update, [coords] each in the order of `dist.names`; of the radius where a step is meant."""

    step: jax.Array  # taken by the centre
    interval: jax.Array  # half width of the interval around it
    identifiable: jax.Array  # False where the set says no more than the distribution did
    loss: jax.Array  # of the search-parameter model, nats


Verify = Callable[[jax.Array, TunerConfig, Collected, Trajectory, Knobs], GateInfo]
Update = Callable[[jax.Array, TunerConfig, Collected, Trajectory, ParamDist, Knobs], tuple[ParamDist, UpdateInfo]]


def calibrated_gate(
    key: jax.Array, config: TunerConfig, collected: Collected, measured: Trajectory, knobs: Knobs
) -> GateInfo:
    """Novelty of a measured set against that of held-out simulated sets (Eq. 2, sign mended).

    A set's score is the mean rank of its valid windows among the valid windows of all sets, measured and held out: the
    novelty of single windows is heavy-tailed, and one held-out fall in the mean of nats hides a measured set that is a
    little novel everywhere. A window without a neighbour ranks highest. The threshold is the conformal quantile: a set
    drawn like the held-out ones exceeds it with probability at most `1 - level`.
    """
    model, elbo = dvm.train(key, config.dvm, collected.trajectory)
    held_out = jax.lax.map(lambda episodes: dvm.novelty(config.dvm, model, episodes), collected.held_out)
    scored = dvm.novelty(config.dvm, model, measured)
    novelty, valid, covered = jax.tree.map(lambda sets, one: jnp.concatenate([sets, one[None]]), held_out, scored)
    novelty = jnp.where(covered, novelty, jnp.inf)
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
    """What one more draw like `values` [n, ...] exceeds with probability at most `1 - level`.

    That takes n of at least `level / (1 - level)`; of fewer, it is the largest.
    """
    rank = jnp.ceil((len(values) + 1) * level).astype(int) - 1
    return jnp.sort(values, axis=0)[jnp.minimum(rank, len(values) - 1)]


def vote_update(key, config, collected, measured, dist, knobs) -> tuple[ParamDist, UpdateInfo]:
    """The paper's rule, signed: centre += step_size * radius * vote."""
    model, loss = spm.train(key, config.spm, collected.trajectory, collected.coords, dist)
    step = knobs.step_size * spm.vote(config.spm, model, measured)
    unknown = jnp.full_like(step, jnp.nan)
    info = UpdateInfo(step=step, interval=unknown, identifiable=jnp.ones_like(step, bool), loss=loss)
    return dists.move(dist, step), info


def posterior_update(key, config, collected, measured, dist, knobs) -> tuple[ParamDist, UpdateInfo]:
    """Moves the centre to where the sweep's logit crosses zero, and narrows the radius to what is still open.

    Held-out sets of known parameters calibrate it: the half width of the interval is the conformal quantile `coverage`
    of their errors. A parameter whose interval is as wide as one that ignores the data is not identifiable and left
    as it was. A parameter whose interval reaches past the box moves but keeps its radius.
    """
    model, loss = spm.train(key, config.spm, collected.trajectory, collected.coords, dist)
    held_out = jax.lax.map(lambda episodes: spm.estimate(config.spm, model, episodes), collected.held_out)
    truth = dists.normalise(dist, collected.held_out_coords)
    low, high = dists.normalised_box(dist)
    interval = _conformal_quantile(jnp.abs(held_out - truth), config.coverage)
    ignorant = _conformal_quantile(jnp.abs((low + high) / 2 - truth), config.coverage)
    identifiable = interval < _IDENTIFIABLE * ignorant
    step = jnp.where(identifiable, spm.estimate(config.spm, model, measured), 0.0)
    moved = dists.move(dist, step)
    radius = dists.ravel(dist.radius)
    narrowed = jnp.clip(radius * interval, jnp.minimum(config.min_radius, radius), radius)
    # Held-out truths all lie in the box; where the interval reaches past it, their errors do not bound the measured
    # one.
    inside = (step - interval >= low) & (step + interval <= high)
    radius = jnp.where(identifiable & inside, narrowed, radius)
    moved = moved.replace(radius=dists.unravel(dists.names(dist), radius))
    return moved, UpdateInfo(step=step, interval=interval, identifiable=identifiable, loss=loss)


def no_gate_log(config: TunerConfig) -> dict:
    """The gate's part of an `Info` before any call was made."""
    log = jnp.full(config.max_widenings + 1, jnp.nan)
    gate = GateInfo(novelty=log, threshold=log, p_value=log, uncovered=log, elbo=log)
    return {"verdicts": jnp.full(log.shape, -1), "radius": log, "gate": gate}


def no_update(dist: ParamDist) -> UpdateInfo:
    """What an update that did not happen reports."""
    zeros = jnp.zeros(len(dist.centre))
    unknown = jnp.full_like(zeros, jnp.nan)
    return UpdateInfo(step=zeros, interval=unknown, identifiable=jnp.zeros_like(zeros, bool), loss=jnp.asarray(jnp.nan))
