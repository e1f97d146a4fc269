"""The second decision of a tuning: where does the distribution move, and how far does it narrow?

A `Tuner` is given a function for it, `update`, which estimates the coordinates of an accepted set. Its default is
`posterior_update`, by regression (`jaxtune.regression`). `vote_update` is the paper's, by a search-parameter model
(`jaxtune.spm`). To change it, write a function of the type `Update` and hand it to the tuner.

Departures from the paper:

- Its vote can only raise a parameter; here it has a sign.
- The search-parameter model is trained anew for every distribution, never continued.
- `posterior_update` is not in the paper. It gives an estimate and intervals at once, so it may replace several tunings.
  It estimates by regression, since a sweep of guesses through the search-parameter model had nearly twice the error
  on the same episodes of a walking robot, and took thirty times as long (`experiments.bench estimates`).
"""

import math
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import optax

from jaxtune import conformal, pooling, spm
from jaxtune import dist as dists
from jaxtune.pooling import Past
from jaxtune.readings import LEAST_ERROR, Collected, excess, misses, reading_of
from jaxtune.settings import Knobs, TunerConfig
from jaxtune.types import ParamDist, Trajectory

_MOST = 5  # readings of one set that are allowed for


@chex.dataclass(frozen=True)
class UpdateInfo:
    """What one update did, [coords] each in the order of `dist.names`, but for what is said at the end.

    Step and interval are in radii of the distribution before the update. For an identifiable coordinate the new
    estimate is `centre + radius * step`, give or take `radius * interval`. For any other one `step` is zero, and
    `interval` says nothing about the centre.
    """

    step: jax.Array  # movement of the centre, before it is clipped to the bounds
    interval: jax.Array  # half width of the interval around the new centre; nan where the rule gives none
    identifiable: jax.Array  # False where the sets so far say no more than the distribution did
    loss: jax.Array  # scalar: `vote_update`'s logistic loss in nats, `posterior_update`'s error of episodes left out
    p_value: jax.Array = math.nan  # scalar: as the gate's, of misfit and beyond alone
    p_misfit: jax.Array = math.nan  # scalar: of misfit alone
    errors: jax.Array = math.nan  # [coords, coords] mean product of the errors of held-out estimates, in radii
    p_replay: jax.Array = math.nan  # scalar: of what the simulator misses from measured states at the estimate
    replayed: jax.Array = False  # scalar: whether the estimate is that from measured states (`jaxtune.replay`)
    pooled: jax.Array = False  # scalar: whether the sets of earlier tunings count in the estimate (`jaxtune.pooling`)
    p_past: jax.Array = math.nan  # scalar: of what contradicts them; nan where they said nothing
    learnt: Past | None = None  # what this set and they say, for the next tuning; None where an update does not tell
    held: jax.Array = False  # scalar: whether radii stayed only since the interval reaches past the distribution


Update = Callable[[jax.Array, TunerConfig, Collected, Trajectory, ParamDist, Knobs], tuple[ParamDist, UpdateInfo]]
"""Type of an update, `(key, config, collected, measured, dist, knobs) -> (ParamDist, UpdateInfo)`; pure, traceable."""


def posterior_update(
    key: jax.Array, config: TunerConfig, collected: Collected, measured: Trajectory, dist: ParamDist, knobs: Knobs
) -> tuple[ParamDist, UpdateInfo]:
    """Moves the centre to the posterior's median and narrows the radius to its interval: the default update.

    A regression on D_q gives each coordinate's estimate (`jaxtune.regression`), which is joined with what the sets of
    earlier tunings said (`jaxtune.pooling`). Held-out sets, whose coordinates are known, calibrate it. With Q the
    conformal quantile `coverage` over held-out sets, e the regression's error of an episode that it leaves out, and all
    values in radii,

        interval     = e Q(max over coordinates of |estimate - truth| / e), with less of e where earlier sets know more
        wide         = the same with a quantile of 1 - (1 - coverage) / 10
        ignorant     = Q(|middle of the box - truth|)
        identifiable = Q(|estimate - truth|) < 0.9 ignorant
        step         = estimate(measured)                           where identifiable, else 0
        radius      <- max(radius * wide, min_radius)               where identifiable, if all are inside; never larger

    The intervals hold together: all truths at once lie in them with probability `coverage`, if the measured set is a
    draw like the held-out ones. It no longer is where a narrower box than the truth's was drawn from, and every
    refinement draws from a narrower one. So the box is narrowed to `wide`, which misses a tenth as often, and the
    quantile of `interval` is by as much higher as the refinements (five at most) may miss:
    `1 - (1 - coverage) (1 - refinements / 10)`. Nor is it where parameters trade against each other, so the box is at
    least as wide as `pooling.half_widths`.

    Held-out sets without a window are left out of all quantiles. A measured set without one, or with a living step that
    is not finite, leaves the distribution as it is.

    A coordinate that is not identifiable keeps centre and radius. Where the interval of one that is reaches past the
    box, and not merely past a bound, all keep their radii, and centres move. What the next set is joined with then says
    of such a coordinate no more than the box, since held-out sets say nothing of errors beyond it.

    Args:
      key: random key, for what earlier sets would have said of the held-out ones' robots.
      config: sizes, with `coverage` and `min_radius`.
      collected: D_q and held-out sets, drawn from `dist`, and what earlier sets said.
      measured: the accepted measured set, [set_episodes, time].
      dist: the distribution that the episodes were drawn from.
      knobs: not used.
    """
    reading = reading_of(config, collected, measured)
    model, (low, high) = reading.model, dists.normalised_box(dist)
    # The errors on robots with known coordinates stand for the error on the measured one. A set without a window is
    # answered blindly.
    truth, known = dists.normalise(dist, collected.held_out_coords), ~jnp.isnan(reading.misfit[:-1, None])
    past = pooling.nothing(dist) if collected.past is None else collected.past
    answers = jnp.clip(reading.answers, low, high)
    joined, pooled, p_past = pooling.joined(key, past, dist, answers, truth, known[:, 0])
    estimates = jnp.clip(joined, low, high)
    off = jnp.where(known, estimates[:-1] - truth, 0.0)
    ignorant = jnp.where(known, jnp.abs((low + high) / 2 - truth), jnp.nan)
    # What scales the errors must not come from the sets that calibrate them.
    scale = pooling.joined_error(past, pooled, dist, jnp.maximum(model.error, LEAST_ERROR))
    interval, wide, identifiable = _calibrate(config, scale, jnp.where(known, jnp.abs(off), jnp.nan), ignorant)
    # A measured set without a window, or with a number that is not finite, says nothing.
    unread = jnp.isnan(reading.misfit[-1])
    identifiable &= ~unread
    step = jnp.where(identifiable, estimates[-1], 0.0)
    # Held-out truths all lie in the box, so their errors say nothing of truths beyond it. One that is outside in one
    # coordinate may bend the estimates of all, and narrowing could exclude it for good.
    # No truth lies beyond a physical bound.
    ends = (dists.normalise(dist, end) for end in (dist.lower, dist.upper))
    below, above = (jnp.isclose(*pair, atol=1e-4) for pair in zip((low, high), ends, strict=True))
    inside = ((step - interval >= low) | below) & ((step + interval <= high) | above)
    inside |= ~identifiable
    errors = off.T @ off / jnp.maximum(known.sum(), 1)
    wide = jnp.maximum(wide, pooling.half_widths(errors, known.sum()))
    centred = dists.move(dist, step)
    narrowed = dists.narrow(centred, jnp.where(identifiable, wide, 1.0), config.min_radius)
    moved = optax.tree.where(inside.all(), narrowed, centred)
    found = {name: excess(name, values) for name, values in misses(reading).items()}
    # Of what may lie beyond the box no more is known than the box is wide.
    reliable = jnp.where(jnp.outer(inside, inside), errors, jnp.diag(dists.ignorance(dist) ** 2))
    learnt = pooling.learnt(past, pooled, dist, estimates[-1], reliable, known.sum())
    return moved, UpdateInfo(
        step=step,
        interval=interval,
        identifiable=identifiable,
        loss=model.error.mean(),
        p_value=conformal.p_value(jnp.fmax(found["misfit"], found["beyond"])),
        p_misfit=conformal.p_value(found["misfit"]),
        errors=errors,
        pooled=pooled,
        p_past=p_past,
        held=~inside.all() & dists.narrowed(dist, narrowed, config.min_radius),
        learnt=optax.tree.where(unread | ~known.any(), past, learnt),
    )


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


def no_update(dist: ParamDist) -> UpdateInfo:
    """Reports that no update was made: steps of zero, no coordinate identifiable, intervals and loss nan.

    It has the shapes of a real update's report, so the two can be the branches of one `jax.lax.cond`.
    """
    zeros = jnp.zeros(len(dist.centre))
    unknown = jnp.full_like(zeros, jnp.nan)
    nan = jnp.asarray(jnp.nan)
    none = jnp.zeros_like(zeros, bool)
    return UpdateInfo(
        step=zeros,
        interval=unknown,
        identifiable=none,
        loss=nan,
        p_value=nan,
        p_misfit=nan,
        errors=jnp.full((len(zeros), len(zeros)), jnp.nan),
        p_replay=nan,
        replayed=jnp.asarray(False),
        pooled=jnp.asarray(False),
        p_past=nan,
        held=jnp.asarray(False),
        learnt=pooling.nothing(dist),
    )


def _calibrate(
    config: TunerConfig, scale: jax.Array, error: jax.Array, ignorant: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Calibrates the interval, the radius to narrow to and what is identifiable, [coords] each.

    Args:
      config: for `coverage` and `refinements`.
      scale: [coords] by which the errors of all coordinates are made comparable.
      error: [sets, coords] of held-out sets' estimates, in radii; nan for a set that is left out.
      ignorant: [sets, coords] the same of the middle of the box.
    """
    missed = 1.0 - config.coverage
    interval, wide = (
        scale * conformal.quantile((error / scale).max(axis=-1), 1.0 - share * missed)
        for share in (1.0 - conformal.EACH * min(config.refinements, _MOST), conformal.EACH)
    )
    sure, unsure = (conformal.quantile(values, config.coverage) for values in (error, ignorant))
    return interval, wide, sure < conformal.IDENTIFIABLE * unsure
