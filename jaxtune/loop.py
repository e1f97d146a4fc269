"""The rounds of one tuning, as pure functions of what its loop carries; `jaxtune.tuner` draws their order.

A round simulates in the distribution as it is, and then calls the gate (`decide`), reads the accepted set (`refine`),
or reads it a last time from measured states (`sharpen`). `Tuner` loops in JAX and `HostTuner` in Python.
"""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import optax

from jaxtune import conformal, pooling
from jaxtune import dist as dists
from jaxtune import replay as replays
from jaxtune.gate import GateInfo, no_gate_log
from jaxtune.pooling import Past
from jaxtune.readings import Collected
from jaxtune.settings import UNEXPLAINED, Knobs, TunerConfig
from jaxtune.shooting import Replay
from jaxtune.types import ParamDist, Trajectory, Verdict
from jaxtune.update import UpdateInfo, no_update

_MOVED = 0.5  # radii; less than that does not count


@chex.dataclass(frozen=True)
class Info:
    """What happened in one tuning: everything that a plot or a report needs and the next tuning does not.

    Arrays marked [calls] have `max_widenings + 1` entries, one per possible gate call. Entries of calls that were not
    made hold nan, or -1 as a verdict; the tuning's outcome is `verdicts[calls - 1]`. `Tuner.run` stacks all fields to
    [num_tunings, ...].
    """

    train: dict  # metrics that `train_policy` reported; empty after `Tuner.tune`
    calls: jax.Array  # number of gate calls made
    verdicts: jax.Array  # [calls], see `jaxtune.types.Verdict`
    radius: jax.Array  # [calls], the largest radius of the distribution that was tested, in coordinates
    gate: GateInfo  # [calls]
    update: UpdateInfo  # steps of zero where no update was made
    dist: ParamDist  # the distribution that the last gate call tested, before the update
    measured_falls: jax.Array  # number of measured episodes that ended early
    not_finite: jax.Array  # number of episodes, simulated or measured, whose simulation broke


def before(config: TunerConfig, dist: ParamDist, past: Past, replayed: bool) -> dict:
    """Makes what the loop carries before its first round; it ends when no rounds are `left`.

    Args:
      config: sizes.
      dist: the distribution that the tuning begins with.
      past: what earlier sets said.
      replayed: whether an accepted set is read a last time, from measured states.
    """
    return {
        "rounds": jnp.zeros((), int),
        "left": jnp.asarray(1 + config.refinements, int),
        "calls": jnp.zeros((), int),
        "dist": dist,
        "tested": dist,
        "wider": dist.radius,
        "past": past,
        "update": no_update(dist),
        "verdict": jnp.asarray(Verdict.WIDEN, int),
        "not_finite": jnp.zeros((), int),
        "sharpened": jnp.asarray(not replayed),
        **no_gate_log(config),
    }


def counted(carry: dict, collected: Collected) -> dict:
    """Counts a round of the loop, and its simulated episodes in which the simulation broke."""
    broken = collected.trajectory.not_finite.sum() + collected.held_out.not_finite.sum()
    return carry | {"rounds": carry["rounds"] + 1, "not_finite": carry["not_finite"] + broken}


def make_info(carry: dict, measured: Trajectory) -> Info:
    """Puts together what happened in one tuning, from what its loop carried last; `train` is empty."""
    return Info(
        train={},
        calls=carry["calls"],
        verdicts=carry["verdicts"],
        radius=carry["radius"],
        gate=carry["gate"],
        update=carry["update"],
        dist=carry["tested"],
        measured_falls=measured.fell.sum(),
        not_finite=carry["not_finite"] + measured.not_finite.sum(),
    )


def decide(config: TunerConfig, carry: dict, gate: GateInfo, knobs: Knobs) -> dict:
    """Takes the verdict of one gate call, and widens the distribution if that is it.

    Args:
      config: sizes.
      carry: from `before`, or from the call before.
      gate: what it found.
      knobs: for the widening factor.

    Returns:
      What the loop carries on; the loop ends where the verdict is neither `widen` nor `accept`.
    """
    calls, dist = carry["calls"], carry["dist"]
    verdict = jnp.asarray(_verdict(config, gate, dist, calls), int)
    goes_on = (verdict == Verdict.WIDEN) | (verdict == Verdict.ACCEPT)
    following = optax.tree.where(verdict == Verdict.WIDEN, _wider(dist, gate, knobs), dist)
    # A set outside the distribution that earlier ones led to says that they misled.
    outside = (Verdict.WIDEN, Verdict.UNEXPLAINED, Verdict.RADIUS_EXHAUSTED)
    misled = jnp.isin(verdict, jnp.array(outside))
    return carry | {
        "left": jnp.where(goes_on, carry["left"], 0),
        "calls": calls + 1,
        "tested": dist,
        "dist": following,
        "past": optax.tree.where(misled, pooling.nothing(following), carry["past"]),
        "verdict": verdict,
        "verdicts": carry["verdicts"].at[calls].set(verdict),
        "radius": carry["radius"].at[calls].set(dists.ravel(dist.radius).max()),
        "gate": jax.tree.map(lambda log, value: log.at[calls].set(value), carry["gate"], gate.replace(towards=None)),
    }


def refine(config: TunerConfig, carry: dict, moved: ParamDist, update: UpdateInfo, knobs: Knobs) -> dict:
    """Takes an update of an accepted set, and decides whether the set is read again, in the narrower distribution.

    That needs no further measured episode. It ends after `TunerConfig.refinements`, where the distribution hardly
    narrowed and moved by less than half a radius (unless it was `held`), or where the set does not fit the distribution
    that the update before had narrowed. That reading is taken back then, and what earlier sets said is forgotten, since
    it may have misled.

    Args:
      config: sizes.
      carry: from `decide`, or from the refinement before.
      moved: what the update made of the distribution.
      update: what it did.
      knobs: for the level.

    Returns:
      What the loop carries on. All updates of the set count as one, in radii of the distribution that was tested.
    """
    dist, tested, before = carry["dist"], carry["tested"], carry["update"]
    # The gate has just tested the distribution of the first reading.
    again = carry["left"] < 1 + config.refinements
    misfits = again & conformal.rejects(update.p_value, knobs.level)
    # Tested once for an accepted set: from states, where they are measured, by `sharpen`.
    first = (carry["left"] == config.refinements) & carry["sharpened"]
    unexplained = first & (update.p_misfit <= UNEXPLAINED)
    radius, unit = dists.ravel(dist.radius), dists.ravel(tested.radius)
    changed = dists.narrowed(dist, moved, config.min_radius) | update.held | (jnp.abs(update.step) > _MOVED).any()
    contradicts = _contradicts(update)
    update = update.replace(
        step=(dists.ravel(moved.centre) - dists.ravel(tested.centre)) / unit,
        interval=update.interval * radius / unit,
        identifiable=before.identifiable | update.identifiable,
        errors=update.errors * jnp.outer(radius / unit, radius / unit),
        learnt=carry["past"] if update.learnt is None else update.learnt,
        # One contradiction is enough: the readings after it join nothing.
        p_past=jnp.where(jnp.isnan(update.p_past), before.p_past, update.p_past),
    )
    # Taken back: what the reading before found remains, within the radius that it was found in.
    wider = dist.replace(radius=carry["wider"])
    back = before.replace(
        interval=dists.ravel(carry["wider"]) / unit,
        p_value=update.p_value,
        p_misfit=update.p_misfit,
        learnt=pooling.nothing(wider),
    )
    read = carry | {
        "left": jnp.where(changed & ~misfits, carry["left"] - 1, 0),
        "dist": optax.tree.where(misfits, wider, moved),
        "wider": dist.radius,
        "past": optax.tree.where(contradicts & ~misfits, pooling.nothing(tested), carry["past"]),
        "update": optax.tree.where(misfits, back, update),
    }
    return optax.tree.where(unexplained, _given_up(read), read)


def sharpen(
    config: TunerConfig,
    replay: Replay,
    key: jax.Array,
    carry: dict,
    collected: Collected,
    measured: Trajectory,
    knobs: Knobs,
) -> dict:
    """Estimates once more, from the states of an accepted set (`replay.estimate`).

    Args:
      config: sizes.
      replay: simulates pieces.
      key: random key.
      carry: from `refine`.
      collected: of the distribution that it left.
      measured: the measured set, with states.
      knobs: for the level that the measured set must fit at.

    Returns:
      What the loop carries on; it ends. The centre is the new estimate if, on simulated sets, its errors (rms over
      coordinates that one of both identifies, in radii) are smaller than those of the estimate before, and if the
      measured set fits it. Coordinates that it does not identify stay. Radii only narrow. The verdict is `unexplained`
      where the set fits worse than 99 simulated ones, each fitted within the bounds.
    """
    dist, tested, before = carry["dist"], carry["tested"], carry["update"]
    held_out = collected.held_out, collected.held_out_coords
    last = jax.tree.map(lambda leaf: leaf[-config.replay.sets :], held_out)
    pool = partial(pooling.joined, key, carry["past"], dist)
    found = replays.estimate(config.replay, replay, *held_out, measured, dist, config.coverage, *last, pool)
    radius, unit = dists.ravel(dist.radius), dists.ravel(tested.radius)
    errors = found.errors * jnp.outer(radius / unit, radius / unit)
    # What no estimate tells errs by as much in both, and would drown the others.
    identifiable = before.identifiable | found.identifiable
    left, was = (jnp.where(identifiable, jnp.diag(one), 0.0).sum() for one in (errors, before.errors))
    # An update that gives no errors gives no reason to keep its estimate.
    closer = jnp.isnan(before.errors).any() | (left < was)
    # What the estimate before errs by is what earlier sets err by, if it is joined with them; these misled.
    closer |= _contradicts(found)
    fits = ~conformal.rejects(found.p_value, knobs.level)
    known = (found.estimate, found.interval, errors, found.p_value)
    taken = closer & fits & jnp.stack([jnp.isfinite(values).all() for values in known]).all()
    step = jnp.where(found.identifiable, found.estimate, 0.0)
    wide = jnp.maximum(found.wide, pooling.half_widths(found.errors, found.sets))
    narrower = jnp.where(found.identifiable, wide, 1.0)
    moved = dists.narrow(dists.move(dist, step), narrower, config.min_radius)
    update = before.replace(
        step=(dists.ravel(moved.centre) - dists.ravel(tested.centre)) / unit,
        interval=found.interval * radius / unit,
        identifiable=identifiable,
        errors=errors,
        replayed=jnp.asarray(True),
        pooled=found.pooled,
        p_past=jnp.where(jnp.isnan(found.p_past), before.p_past, found.p_past),
        learnt=pooling.learnt(carry["past"], found.pooled, dist, found.estimate, found.errors, found.sets),
    )
    update = optax.tree.where(taken, update, before).replace(p_replay=found.p_value)
    read = carry | {
        "dist": optax.tree.where(taken, moved, dist),
        "update": update,
        "sharpened": jnp.asarray(True),
    }
    return optax.tree.where(found.p_value <= UNEXPLAINED, _given_up(read), read)


def dist_after(carry: dict, first: ParamDist) -> ParamDist:
    """The distribution after a tuning that began with `first`, from what its loop carried last.

    What was widened towards a set that was then not accepted has its centre back: the set may have misled.
    """
    last = carry["dist"]
    return optax.tree.where(carry["verdict"] == Verdict.ACCEPT, last, last.replace(centre=first.centre))


def known_after(carry: dict) -> Past:
    """What all sets so far say after a tuning, from what its loop carried last."""
    return optax.tree.where(carry["verdict"] == Verdict.ACCEPT, carry["update"].learnt, carry["past"])


def _wider(dist: ParamDist, gate: GateInfo, knobs: Knobs) -> ParamDist:
    """Widens a distribution towards where the robot seems to be, and once more if it seems to be farther than that.

    A call of the gate is saved then: what is as far away would be rejected again.
    """
    factor = knobs.widen_factor
    if gate.towards is None:
        return dists.widen(dist, factor)
    towards = jnp.nan_to_num(gate.towards)
    once = dists.widen(dist, factor, towards)
    left = dists.normalise(once, dists.move(dist, towards).centre)
    return optax.tree.where((jnp.abs(left) > 1.0).any(), dists.widen(once, factor, left), once)


def _given_up(carry: dict) -> dict:
    """What the loop carries on where no parameters explain the set: as before its first reading, and nothing learnt."""
    tested, update, verdict = carry["tested"], carry["update"], jnp.asarray(Verdict.UNEXPLAINED, int)
    told = {name: getattr(update, name) for name in ("p_value", "p_misfit", "p_replay")}
    return carry | {
        "left": jnp.zeros_like(carry["left"]),
        "dist": tested,
        "past": pooling.nothing(tested),
        "update": no_update(tested).replace(**told),
        "verdict": verdict,
        "verdicts": carry["verdicts"].at[carry["calls"] - 1].set(verdict),
    }


def _contradicts(found: UpdateInfo | replays.Replayed) -> jax.Array:
    """Tells whether a set contradicts earlier ones."""
    return ~jnp.asarray(found.pooled) & ~jnp.isnan(found.p_past)


def _verdict(config: TunerConfig, gate: GateInfo, dist: ParamDist, calls: jax.Array) -> jax.Array:
    """Chooses the verdict of one gate call; the first condition that holds wins.

    `calls` counts earlier calls of this tuning.
    """
    full = dists.at_bounds(dist)
    return jnp.select(
        [
            # First: where nothing lives as long as a window, nothing of it is finite either.
            ~jnp.asarray(gate.comparable),
            ~(jnp.isfinite(gate.novelty) & jnp.isfinite(gate.threshold)),
            gate.novelty <= gate.threshold,
            full & (gate.p_value <= UNEXPLAINED),
            full | (calls >= config.max_widenings),
        ],
        [
            Verdict.NOT_COMPARABLE,
            Verdict.NOT_FINITE,
            Verdict.ACCEPT,
            Verdict.UNEXPLAINED,
            Verdict.RADIUS_EXHAUSTED,
        ],
        Verdict.WIDEN,
    )
