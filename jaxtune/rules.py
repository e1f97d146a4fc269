"""The two decisions of a tuning: is the measured set covered, and where does the distribution move?

A `Tuner` is given one function for each; `jaxtune.tuner` draws where they are called. `verify` trains a verification
model (`jaxtune.dvm`) and scores the measured set; its default is `calibrated_gate`. `update` estimates the coordinates
of the measured set and moves the distribution; its default is `posterior_update`, by regression (`jaxtune.regression`).
`vote_update` is the paper's, by a search-parameter model (`jaxtune.spm`).
To change a decision, write a function with the same arguments (`Verify`, `Update`) and hand it to the tuner.

Departures from the paper:

- Its threshold sigma' is set by hand. Here held-out simulated sets calibrate it, so the gate is a conformal test with a
  known rate of false alarms. Sets are scored by mean ranks, not by the mean of Eq. 2.
- Its verification model alone decides. Here falls count as well, and so do the regression's answer and the response
  surface (`jaxtune.surface`). One radius outside the box, the verification model alone finds hardly anything.
- Its vote can only raise a parameter; here it has a sign.
- Both models are trained anew for every distribution, never continued.
- `posterior_update` is not in the paper. It gives an estimate and intervals at once, so it may replace several tunings.
  It estimates by regression, since a sweep of guesses through the search-parameter model had nearly twice the error
  on the same episodes of a walking robot, and took thirty times as long (`experiments.bench estimates`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxtune import conformal, devices, dvm, regression, spm, surface, windows
from jaxtune import dist as dists
from jaxtune.dvm import DVMConfig
from jaxtune.regression import RegressionConfig
from jaxtune.replay import ReplayConfig
from jaxtune.spm import SPMConfig
from jaxtune.types import ParamDist, Trajectory

# An interval counts as informative if it is narrower than this share of the interval that ignores the data. The share
# is below 1 because both are quantiles over a few dozen sets and differ by chance.
_IDENTIFIABLE = 0.9
# Least distance of median and 0.9-quantile of each statistic, where all simulated sets are alike.
_LEAST_SPREAD = {"cover": 0.02, "lost": 0.1, "misfit": 0.05, "beyond": 0.1}
_EACH, _MOST = 0.1, 5  # share of all misses that one reading's box may have, and readings that are allowed for
_SAME = 1e-6  # of an observation's size and usual spread: it does not change
LEAST_ERROR = 1e-4
"""Radii; without noise a regression may be exact."""

SETS = {"cpu": 1, "other": 64}
"""Held-out sets that are scored side by side on a device (`devices.in_chunks`)."""


@dataclass(frozen=True, kw_only=True)
class TunerConfig:
    """Sizes of a tuning: whatever fixes array shapes and loop lengths, so a change compiles the tuner anew.

    The defaults are for walking robots on two CPU cores. More `episodes` sharpen both models and take longer.
    For scalars that may vary within one compiled program, see `Knobs`.

    Raises:
      ValueError: a count is too small, `coverage` is not between 0 and 1, or `min_radius` is not positive.
    """

    episodes: int = 600
    """Simulated episodes in D_q, the set that both models are trained on. Each has coordinates of its own."""
    set_episodes: int = 5
    """Episodes in a measured set, and in every held-out set that it is compared with."""
    held_out_sets: int = 99
    """Simulated sets that calibrate the gate's threshold and the update's interval. Each set is one robot, with
    coordinates of its own. With 99 sets, p-values are multiples of 1/100. A level of 0.95 needs 19 sets at least, and
    the verdict `unexplained` needs 99."""
    max_widenings: int = 6
    """Largest number of widenings within one tuning; the gate is called at most once more than that."""
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
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    """Sizes of the estimate from measured states, of a tuner that has a `replay`."""

    def __post_init__(self):
        least = {"episodes": 1, "set_episodes": 1, "held_out_sets": 1, "max_widenings": 0, "refinements": 0}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ValueError(f"{name}: got {getattr(self, name)}, expected {value} or more")
        if not 0 < self.coverage < 1:
            raise ValueError(f"coverage: got {self.coverage}, expected a number between 0 and 1")
        if not self.min_radius > 0:
            raise ValueError(f"min_radius: got {self.min_radius}, expected a positive number")

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
    threshold: jax.Array  # the paper's sigma': a fixed mean rank of windows instead; nan where there is none


def knobs(
    *, step_size: float = 0.5, widen_factor: float = 2.0, level: float = 0.95, threshold: float | None = None
) -> Knobs:
    """Makes knobs from plain numbers, and checks them.

    Args:
      step_size: radii that the centre moves per unit of vote; `posterior_update` does not use it.
      widen_factor: what every radius is multiplied by after a failed check.
      level: share of covered sets that the gate lets pass. At 0.95 it rejects a set that came from the distribution
        with a probability of at most 0.05.
      threshold: a fixed mean rank of windows, in (0, 1). The verification model alone then decides. The paper sets its
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
    dist: ParamDist  # what all coordinates were drawn from
    # What `examine` reads of these and the measured set; gate and update read it themselves where it is None.
    reading: Any = None


@chex.dataclass(frozen=True)
class Reading:
    """What regression and response surface say of all held-out sets and, last, of the measured one."""

    model: regression.Regression
    answers: jax.Array  # [sets + 1, coords] estimates in radii, which may lie beyond the box
    misfit: jax.Array  # [sets + 1] of the four statistics of `calibrated_gate`; nan for a set without a valid window
    beyond: jax.Array  # [sets + 1] likewise


@chex.dataclass(frozen=True)
class GateInfo:
    """What one call of the gate found, scalars each.

    The tuner decides by `novelty`, `threshold` and `comparable`: the set is covered where novelty <= threshold, and a
    value that is not finite ends the tuning. A p-value of at most 0.01 decides whether a set that fills the bounds is
    `unexplained`. The rest is for plots and reports; a gate that does not compute it leaves it out.
    """

    novelty: jax.Array  # how unlike the simulated sets the measured one is: the largest of the four excesses below
    threshold: jax.Array  # largest novelty of a covered set
    p_value: jax.Array = math.nan  # (1 + #{held-out sets at least as novel}) / (held-out sets + 1)
    comparable: jax.Array = True  # False where there is too little to compare, see `calibrated_gate`
    cover: jax.Array = math.nan  # excess of the measured windows' novelty under the verification model
    lost: jax.Array = math.nan  # excess of the difference in the share of steps that are alive
    misfit: jax.Array = math.nan  # excess of what no coordinates explain
    beyond: jax.Array = math.nan  # excess of the estimate's distance from inside the box
    uncovered: jax.Array = math.nan  # share of the measured windows that have no simulated neighbour within reach
    elbo: jax.Array = math.nan  # evidence lower bound that the verification model reached, nats per window


@chex.dataclass(frozen=True)
class UpdateInfo:
    """What one update did, [coords] each in the order of `dist.names`, but for what is said at the end.

    Step and interval are in radii of the distribution before the update. For an identifiable coordinate the new
    estimate is `centre + radius * step`, give or take `radius * interval`. For any other one `step` is zero, and
    `interval` says nothing about the centre.
    """

    step: jax.Array  # movement of the centre, before it is clipped to the bounds
    interval: jax.Array  # half width of the interval around the new centre; nan where the rule gives none
    identifiable: jax.Array  # False where the measured set says no more than the distribution did
    loss: jax.Array  # scalar: `vote_update`'s logistic loss in nats, `posterior_update`'s error of episodes left out
    p_value: jax.Array = math.nan  # scalar: as the gate's, of misfit and beyond alone
    p_misfit: jax.Array = math.nan  # scalar: of misfit alone
    errors: jax.Array = math.nan  # [coords, coords] mean product of the errors of held-out estimates, in radii
    p_replay: jax.Array = math.nan  # scalar: of what the simulator misses from measured states at the estimate
    replayed: jax.Array = False  # scalar: whether the estimate is that from measured states (`jaxtune.replay`)


Verify = Callable[[jax.Array, TunerConfig, Collected, Trajectory, Knobs], GateInfo]
"""Type of a gate: `(key, config, collected, measured, knobs) -> GateInfo`, pure and traceable."""
Update = Callable[[jax.Array, TunerConfig, Collected, Trajectory, ParamDist, Knobs], tuple[ParamDist, UpdateInfo]]
"""Type of an update: `(key, config, collected, measured, dist, knobs) -> (ParamDist, UpdateInfo)`, likewise."""


def calibrated_gate(
    key: jax.Array, config: TunerConfig, collected: Collected, measured: Trajectory, knobs: Knobs
) -> GateInfo:
    """Tests whether a measured set is like simulated ones: the default gate.

    Four statistics are computed of the measured set and of every held-out set alike:

        cover   mean rank of its windows' novelty (Eq. 2 with its sign mended, see `dvm.novelty`) among the windows of
                all sets, each of which weighs the same; a window without a neighbour ranks highest
        lost    |share of its steps in which the robot is up - that of D_q|, steps after an end that was no fall unknown
        misfit  logarithm of how far it lies from what robots of its estimate show (`surface.misfit`)
        beyond  largest distance of its estimate from the inside of the box, in errors of the regression

    They are made comparable by quantiles over all sets, and the largest counts. `p` and `threshold` are conformal:

        excess    = (statistic - median) / (0.9-quantile - median)
        novelty   = largest of the four excesses
        p         = (1 + #{held-out sets: novelty >= novelty(measured)}) / (held_out_sets + 1)
        threshold = the ceil((held_out_sets + 1) level)-th smallest novelty of the held-out sets.

    A measured set drawn like the held-out ones exceeds the threshold with probability at most `1 - level`, since all
    sets are treated alike. The test is calibrated per set, because windows and episodes of one robot depend on each
    other. A set of which no window is known has `lost` alone.

    The set is not comparable if it has no valid window of both models, if its observations never change, if its
    episodes are copies of each other though simulated ones differ, or if fewer held-out sets have a window than the
    level needs (level / (1 - level), which is 19 at 0.95).

    Args:
      key: random key, for training the verification model.
      config: sizes.
      collected: D_q and held-out sets of the distribution that is tested.
      measured: the measured set, [set_episodes, time].
      knobs: `level`, or a fixed `threshold` of the mean rank alone.

    Returns:
      What was found. The novelty is nan where the set holds a living step that is not finite, and where no simulated
      observation ever changes.
    """
    model, elbo = dvm.train(key, config.dvm, collected.trajectory)
    novelty, valid, covered = of_all_sets(partial(dvm.novelty, config.dvm), (model,), collected, measured)
    sane = jnp.isfinite(jnp.where(valid, novelty, 0.0)).all(axis=-1)
    cover = _mean_ranks(jnp.where(covered, novelty, jnp.inf), valid)
    up = jnp.append(_share_up(collected.held_out), _share_up(measured))
    statistics = {"cover": cover, "lost": jnp.abs(up - _share_up(collected.trajectory))}
    statistics |= _misses(_reading(config, collected, measured))
    excess = {name: _excess(name, values) for name, values in statistics.items()}
    fixed = ~jnp.isnan(knobs.threshold)
    every = jnp.where(fixed, cover, jnp.nanmax(jnp.stack([*excess.values()]), axis=0))
    calibration, value = every[:-1], jnp.where(sane[-1], every[-1], jnp.nan)
    lived = jnp.append(_lives(collected.held_out, config), _lives(measured, config))
    usable, needed = valid.any(axis=-1) & (fixed | lived), knobs.level / (1.0 - knobs.level)
    enough = fixed | (usable[:-1].sum() >= jnp.floor(needed + 0.5))
    return GateInfo(
        novelty=value,
        threshold=jnp.where(fixed, knobs.threshold, conformal.quantile(calibration, knobs.level)),
        p_value=conformal.p_value(every),
        comparable=usable[-1] & enough & _moves(measured, model.scaler) & ~_copied(measured, collected),
        uncovered=jnp.sum(valid[-1] & ~covered[-1]) / jnp.maximum(valid[-1].sum(), 1),
        elbo=elbo,
        **{name: values[-1] for name, values in excess.items()},
    )


def _share_up(episodes: Trajectory) -> jax.Array:
    """The share of steps in which robots are up, [...] of episodes [..., episodes, time].

    What follows an episode's end counts as down if it fell or broke, and is unknown if it was cut short.
    """
    up, ended = episodes.alive.sum(axis=-1), episodes.fell | episodes.not_finite
    known = jnp.where(ended, episodes.alive.shape[-1], up)
    return up.sum(axis=-1) / jnp.maximum(known.sum(axis=-1), 1)


def of_all_sets(function: Callable, shared: tuple, collected: Collected, measured: Trajectory):
    """What a function `(*shared, set)` returns for every held-out set and, last, for the measured one.

    Under `vmap` over measured sets alone, held-out sets are scored once for all. The function closes over constants
    only (`devices.spread`), and cannot be differentiated backwards.
    """
    held_out, measured = (episodes.replace(state=None) for episodes in (collected.held_out, measured))
    of = lambda shared, sets: devices.in_chunks(function, (sets,), SETS, shared=shared)  # noqa: E731

    def every(shared, held_out, measured):
        # Put together first, so that the function is compiled once.
        return of(shared, jax.tree.map(lambda sets, one: jnp.concatenate([sets, one[None]]), held_out, measured))

    @jax.custom_batching.custom_vmap
    def scored(shared, held_out, measured):
        return every(shared, held_out, measured)

    @scored.def_vmap
    def of_many(size, batched, shared, held_out, measured):
        if any(jax.tree.leaves(batched[:2])):
            # Lanes of a sweep have sets of their own.
            axes = jax.tree.map(lambda own: 0 if own else None, tuple(batched))
            found = jax.vmap(every, in_axes=axes, axis_size=size)(shared, held_out, measured)
        else:
            wide = lambda leaf, own: leaf if own else jnp.broadcast_to(leaf, (size, *leaf.shape))  # noqa: E731
            once, each = of(shared, held_out), of(shared, jax.tree.map(wide, measured, batched[2]))
            row = lambda sets, one: jnp.concatenate([sets, one[None]])  # noqa: E731
            found = jax.tree.map(lambda sets, ones: jax.vmap(row, (None, 0))(sets, ones), once, each)
        return found, jax.tree.map(lambda _: True, found)

    return scored(shared, held_out, measured)


def fit(config: TunerConfig, collected: Collected) -> tuple[regression.Regression, surface.Surface]:
    """Fits the regression to D_q, and the way back."""
    model = regression.train(config.regression, collected.trajectory, collected.sampled_coords, collected.dist)
    return model, surface.train(model)


def _mean_ranks(novelty: jax.Array, valid: jax.Array) -> jax.Array:
    """The mean rank [sets] of each set's valid windows [sets, windows] among all, every set weighing the same."""
    share = valid / jnp.maximum(valid.sum(axis=-1, keepdims=True), 1)
    pool = jnp.where(valid, novelty, jnp.inf).reshape(-1)
    order = jnp.argsort(pool)
    weight = jnp.cumsum(share.reshape(-1)[order]) / jnp.maximum(valid.any(axis=-1).sum(), 1)
    rank = weight[jnp.searchsorted(pool[order], jnp.nan_to_num(novelty, posinf=jnp.inf), side="right") - 1]
    return jnp.where(valid.any(axis=-1), jnp.sum(share * jnp.where(valid, rank, 0.0), axis=-1), jnp.nan)


def examine(config: TunerConfig, collected: Collected, measured: Trajectory) -> Reading:
    """Estimates all sets by regression, and computes how well they fit."""
    model, ways = fit(config, collected)
    scale = jnp.maximum(model.error, LEAST_ERROR)

    def one(model, ways, scale, episodes):
        answer, moments, count = regression.answers(config.regression, model, episodes)
        off = surface.misfit(ways, moments, jnp.clip(answer, model.low, model.high))
        beyond = (jnp.maximum(model.low - answer, answer - model.high) / scale).max()
        known = count > 0
        return answer, jnp.where(known, jnp.log(jnp.maximum(off, 1e-9)), jnp.nan), jnp.where(known, beyond, jnp.nan)

    answers, misfit, beyond = of_all_sets(one, (model, ways, scale), collected, measured)
    return Reading(model=model, answers=answers, misfit=misfit, beyond=beyond)


def _reading(config: TunerConfig, collected: Collected, measured: Trajectory) -> Reading:
    return examine(config, collected, measured) if collected.reading is None else collected.reading


def _misses(reading: Reading) -> dict[str, jax.Array]:
    return {"misfit": reading.misfit, "beyond": reading.beyond}


def _excess(name: str, values: jax.Array) -> jax.Array:
    """A statistic [sets] in units of what simulated sets scatter; nan for a set that has none."""
    median, high = jnp.nanquantile(values, 0.5), jnp.nanquantile(values, 0.9)
    return (values - median) / jnp.maximum(high - median, _LEAST_SPREAD[name])


def _lives(episodes: Trajectory, config: TunerConfig) -> jax.Array:
    """Tells which sets [..., episodes, time] hold a window that the regression can read, [...]."""
    return windows.valid_starts(episodes.alive, config.regression.window).any(axis=(-2, -1))


def _moves(measured: Trajectory, scaler: windows.Scaler) -> jax.Array:
    """Tells whether any observation changes within the living steps of a measured episode, in whatever units."""
    first, usual = measured.obs[:, :1], scaler.std[: measured.obs.shape[-1]]
    changes = jnp.abs(measured.obs - first) > _SAME * (usual + jnp.abs(first))
    return (changes & measured.alive[..., None]).any()


def _copied(measured: Trajectory, collected: Collected) -> jax.Array:
    """Tells whether measured episodes are copies of one, where simulated episodes of one robot differ."""
    same = lambda obs: (obs == obs[:1]).all()  # noqa: E731
    return (len(measured.obs) > 1) & same(measured.obs) & ~jax.vmap(same)(collected.held_out.obs).any()


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
        wide         = the same with a quantile of 1 - (1 - coverage) / 10
        ignorant     = Q(|middle of the box - truth|)
        identifiable = Q(|estimate - truth|) < 0.9 ignorant
        step         = estimate(measured)                           where identifiable, else 0
        radius      <- max(radius * wide, min_radius)               where identifiable, if all are inside; never larger

    The intervals hold together: all truths at once lie in them with probability `coverage`, if the measured set is a
    draw like the held-out ones. It no longer is where a narrower box than the truth's was drawn from, and every
    refinement draws from a narrower one. So the box is narrowed to `wide`, which misses a tenth as often, and the
    quantile of `interval` is by as much higher as the refinements (five at most) may miss:
    `1 - (1 - coverage) (1 - refinements / 10)`.

    Held-out sets without a window are left out of all quantiles. A measured set without one, or with a living step that
    is not finite, leaves the distribution as it is.

    A coordinate that is not identifiable keeps centre and radius. Where the interval of one that is reaches past the
    box, and not merely past a bound, all keep their radii, and centres move.

    Args:
      key: not used.
      config: sizes, with `coverage` and `min_radius`.
      collected: D_q and held-out sets, drawn from `dist`.
      measured: the accepted measured set, [set_episodes, time].
      dist: the distribution that the episodes were drawn from.
      knobs: not used.
    """
    reading = _reading(config, collected, measured)
    model, (low, high) = reading.model, dists.normalised_box(dist)
    estimates = jnp.clip(reading.answers, low, high)
    # The errors on robots with known coordinates stand for the error on the measured one. A set without a window is
    # answered blindly.
    truth, known = dists.normalise(dist, collected.held_out_coords), ~jnp.isnan(reading.misfit[:-1, None])
    off = jnp.where(known, estimates[:-1] - truth, 0.0)
    ignorant = jnp.where(known, jnp.abs((low + high) / 2 - truth), jnp.nan)
    interval, wide, identifiable = _calibrate(config, model, jnp.where(known, jnp.abs(off), jnp.nan), ignorant)
    # A measured set without a window, or with a number that is not finite, says nothing.
    identifiable &= ~jnp.isnan(reading.misfit[-1])
    step = jnp.where(identifiable, estimates[-1], 0.0)
    # Held-out truths all lie in the box, so their errors say nothing of truths beyond it. One that is outside in one
    # coordinate may bend the estimates of all, and narrowing could exclude it for good.
    # No truth lies beyond a physical bound.
    ends = (dists.normalise(dist, end) for end in (dist.lower, dist.upper))
    below, above = (jnp.isclose(*pair, atol=1e-4) for pair in zip((low, high), ends, strict=True))
    inside = ((step - interval >= low) | below) & ((step + interval <= high) | above)
    inside = (inside | ~identifiable).all()
    moved = dists.narrow(dists.move(dist, step), jnp.where(identifiable & inside, wide, 1.0), config.min_radius)
    excess = {name: _excess(name, values) for name, values in _misses(reading).items()}
    return moved, UpdateInfo(
        step=step,
        interval=interval,
        identifiable=identifiable,
        loss=model.error.mean(),
        p_value=conformal.p_value(jnp.fmax(excess["misfit"], excess["beyond"])),
        p_misfit=conformal.p_value(excess["misfit"]),
        errors=off.T @ off / jnp.maximum(known.sum(), 1),
    )


def _calibrate(
    config: TunerConfig, model: regression.Regression, error: jax.Array, ignorant: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Calibrates the interval, the radius to narrow to and what is identifiable, [coords] each.

    Args:
      config: for `coverage` and `refinements`.
      model: the regression, whose error scales those of all coordinates.
      error: [sets, coords] of held-out sets' estimates, in radii; nan for a set that is left out.
      ignorant: [sets, coords] the same of the middle of the box.
    """
    # What scales the errors must not come from the sets that calibrate them.
    scale = jnp.maximum(model.error, LEAST_ERROR)
    missed = 1.0 - config.coverage
    interval, wide = (
        scale * conformal.quantile((error / scale).max(axis=-1), 1.0 - share * missed)
        for share in (1.0 - _EACH * min(config.refinements, _MOST), _EACH)
    )
    sure, unsure = (conformal.quantile(values, config.coverage) for values in (error, ignorant))
    return interval, wide, sure < _IDENTIFIABLE * unsure


def no_gate_log(config: TunerConfig) -> dict:
    """Makes the gate's part of a `tuner.Info` before any gate call: -1 for verdicts, nan for everything else.

    Every array has `max_widenings + 1` entries, one per possible call, so its shape does not depend on how many calls a
    tuning needs.
    """
    log = jnp.full(config.max_widenings + 1, jnp.nan)
    gate = GateInfo(novelty=log, threshold=log)
    gate = jax.tree.map(lambda _: log, gate).replace(comparable=jnp.ones(log.shape, bool))
    return {"verdicts": jnp.full(log.shape, -1), "radius": log, "gate": gate}


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
    )
