"""The first decision of a tuning: is the measured set covered by simulated ones?

A `Tuner` is given a function for it, `verify`. Its default, `calibrated_gate`, trains a verification model
(`jaxtune.dvm`) and scores the measured set. To change it, write a function of the type `Verify`
and hand it to the tuner; `jaxtune.tuner` draws where it is called.

Departures from the paper:

- Its threshold sigma' is set by hand. Here held-out simulated sets calibrate it, so the gate is a conformal test with a
  known rate of false alarms. Sets are scored by mean ranks, not by the mean of Eq. 2.
- Its verification model alone decides. Here falls count as well, and so do the regression's answer and the response
  surface (`jaxtune.surface`). One radius outside the box, the verification model alone finds hardly anything.
- The verification model is trained anew for every distribution, never continued.
"""

import math
from collections.abc import Callable
from functools import partial

import chex
import jax
import jax.numpy as jnp

from jaxtune import conformal, dvm, windows
from jaxtune import dist as dists
from jaxtune.readings import Collected, excess, misses, of_all_sets, reading_of
from jaxtune.settings import Knobs, TunerConfig
from jaxtune.types import Trajectory

_SAME = 1e-6  # of an observation's size and usual spread: it does not change
_ROUNDED = 2e-4  # of one, by which a level near one may be off in single precision
# Share by which a regression must err less than a blind one to show that it sees something. Of coordinates that show
# nowhere one among twenty seems to be told by 4 % in 600 episodes, and by 11 % in 120.
_SEEN, _SEEN_EPISODES, _ENOUGH = 0.05, 15.0, 150


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
    # Where the measured robot seems to be, [coords] in radii; a distribution that widens moves that way. It widens
    # about its centre where a gate does not tell. Logs of calls leave it out.
    towards: jax.Array | None = None


Verify = Callable[[jax.Array, TunerConfig, Collected, Trajectory, Knobs], GateInfo]
"""Type of a gate: `(key, config, collected, measured, knobs) -> GateInfo`, pure and traceable."""


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

    The set is not comparable if it has no valid window of both models, if its observations never change, if one that
    never changes in simulation has another value, if two of its episodes are copies though no simulated ones are, or if
    fewer held-out sets have a window than the level needs
    (level / (1 - level), which is 19 at 0.95). A set that would be covered is not comparable either if simulated
    episodes show none of the coordinates, such as those of a robot at rest with noise or a clock: the regression errs
    as much as if it had not seen them. That is asked where no earlier set said anything, of 150 episodes or more.

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
    reading = reading_of(config, collected, measured)
    statistics |= misses(reading)
    found = {name: excess(name, values) for name, values in statistics.items()}
    fixed = ~jnp.isnan(knobs.threshold)
    every = jnp.where(fixed, cover, jnp.nanmax(jnp.stack([*found.values()]), axis=0))
    calibration, value = every[:-1], jnp.where(sane[-1], every[-1], jnp.nan)
    lived = jnp.append(_lives(collected.held_out, config), _lives(measured, config))
    usable = valid.any(axis=-1) & (fixed | lived)
    enough = fixed | ((usable[:-1].sum() + 1) * (1.0 - knobs.level) >= 1.0 - _ROUNDED)
    threshold = jnp.where(fixed, knobs.threshold, conformal.quantile(calibration, knobs.level))
    told = fixed | (value > threshold) | _shows(config, collected, reading.model.error)
    return GateInfo(
        novelty=value,
        threshold=threshold,
        p_value=conformal.p_value(every),
        comparable=usable[-1]
        & enough
        & told
        & _moves(measured, model.scaler)
        & _as_constant(measured, model.scaler)
        & ~_copied(measured, collected),
        uncovered=jnp.sum(valid[-1] & ~covered[-1]) / jnp.maximum(valid[-1].sum(), 1),
        elbo=elbo,
        # What the regression hardly tells stays where it is.
        towards=reading.answers[-1] * jnp.clip(1.0 - (reading.model.error / dists.ignorance(collected.dist)) ** 2, 0.0),
        **{name: values[-1] for name, values in found.items()},
    )


def no_gate_log(config: TunerConfig) -> dict:
    """Makes the gate's part of a `tuner.Info` before any gate call: -1 for verdicts, nan for everything else.

    Every array has `max_widenings + 1` entries, one per possible call, so its shape does not depend on how many calls a
    tuning needs.
    """
    log = jnp.full(config.max_widenings + 1, jnp.nan)
    gate = GateInfo(novelty=log, threshold=log)
    gate = jax.tree.map(lambda _: log, gate).replace(comparable=jnp.ones(log.shape, bool))
    return {"verdicts": jnp.full(log.shape, -1), "radius": log, "gate": gate}


def _share_up(episodes: Trajectory) -> jax.Array:
    """The share of steps in which robots are up, [...] of episodes [..., episodes, time].

    What follows an episode's end counts as down if it fell or broke, and is unknown if it was cut short.
    """
    up, ended = episodes.alive.sum(axis=-1), episodes.fell | episodes.not_finite
    known = jnp.where(ended, episodes.alive.shape[-1], up)
    return up.sum(axis=-1) / jnp.maximum(known.sum(axis=-1), 1)


def _mean_ranks(novelty: jax.Array, valid: jax.Array) -> jax.Array:
    """The mean rank [sets] of each set's valid windows [sets, windows] among all, every set weighing the same."""
    share = valid / jnp.maximum(valid.sum(axis=-1, keepdims=True), 1)
    pool = jnp.where(valid, novelty, jnp.inf).reshape(-1)
    order = jnp.argsort(pool)
    weight = jnp.cumsum(share.reshape(-1)[order]) / jnp.maximum(valid.any(axis=-1).sum(), 1)
    rank = weight[jnp.searchsorted(pool[order], jnp.nan_to_num(novelty, posinf=jnp.inf), side="right") - 1]
    return jnp.where(valid.any(axis=-1), jnp.sum(share * jnp.where(valid, rank, 0.0), axis=-1), jnp.nan)


def _lives(episodes: Trajectory, config: TunerConfig) -> jax.Array:
    """Tells which sets [..., episodes, time] hold a window that the regression can read, [...]."""
    return windows.valid_starts(episodes.alive, config.regression.window).any(axis=(-2, -1))


def _shows(config: TunerConfig, collected: Collected, error: jax.Array) -> jax.Array:
    """Tells whether simulated episodes show any coordinate, by the regression's errors [coords] in radii.

    A box that earlier sets narrowed may be as narrow as sets can tell.
    """
    if config.episodes < _ENOUGH:
        return jnp.asarray(True)
    shown = (error < (1.0 - max(_SEEN, _SEEN_EPISODES / config.episodes)) * dists.ignorance(collected.dist)).any()
    return shown if collected.past is None else shown | (collected.past.tunings > 0)


def _moves(measured: Trajectory, scaler: windows.Scaler) -> jax.Array:
    """Tells whether any observation changes within the living steps of a measured episode, in whatever units."""
    first, usual = measured.obs[:, :1], scaler.std[: measured.obs.shape[-1]]
    changes = jnp.abs(measured.obs - first) > _SAME * (usual + jnp.abs(first))
    return (changes & measured.alive[..., None]).any()


def _as_constant(measured: Trajectory, scaler: windows.Scaler) -> jax.Array:
    """Tells whether channels that never change in simulation are where they are there: ranks hardly tell how far off.

    Within a hundredth of their value, or of one where it is zero.
    """
    alive = measured.alive[..., None]
    steps = jnp.where(alive, scaler.clipped(windows.steps(measured)), 0.0)
    off = jnp.abs(steps.sum(axis=(0, 1))) / jnp.maximum(alive.sum(), 1)
    return (scaler.varies | (off < 0.99 * windows.FAR)).all()


def _copied(measured: Trajectory, collected: Collected) -> jax.Array:
    """Tells whether some measured episode is the copy of another, where simulated episodes of one robot differ."""
    pairs = jnp.triu_indices(len(measured.obs), 1)

    def copied(episodes):
        def same(one, other):
            both = episodes.alive[one] & episodes.alive[other]
            return both.any() & ((episodes.obs[one] == episodes.obs[other]).all(axis=-1) | ~both).all()

        # In turn, or a large set would be compared with itself in memory.
        return jax.lax.map(lambda pair: same(*pair), pairs).any()

    if not len(pairs[0]):
        return jnp.asarray(False)
    return copied(measured) & ~jax.lax.map(copied, collected.held_out.replace(state=None)).any()
