"""The tuner: Algorithm 1 of *Safe and Efficient Auto-tuning to Cross Sim-to-real Gap for Bipedal Robot* ("the paper").

It tunes the distribution that a simulator's parameters are drawn from, until simulated episodes agree with measured
ones, and trains a policy in it. One tuning is one `Tuner.step`:

    state: policy, dist, knobs
      |
      measure(policy)  ->  measured set                          the robot walks a few episodes
      |
      +-> simulate(policy, draws of dist)  ->  D_q, held-out sets  <----------------+
      |   verify(D_q, held-out sets, measured set)  ->  novelty, threshold          |
      |   verdict:                                                                  |
      |     widen               radius <- min(radius * widen_factor, bounds) -------+
      |     accept              dist <- update(D_q, held-out sets, measured set, dist), and again in the narrower dist
      |     unexplained         the centre stays where it is: the model lacks physics
      |     radius_exhausted    the centre stays: no wider distribution is allowed
      |     not_comparable      the centre stays: too little was measured or simulated
      |     not_finite          the centre stays: there was nothing to score
      |
      train_policy(policy, dist)
      |
    state of the next tuning, and Info for plots and reports

D_q holds the simulated episodes that gate and update learn from; the held-out sets imitate the measured set and
calibrate both. Novelty says how unlike the simulated episodes the measured set is, and the threshold is the largest
novelty that still counts as covered. The verdict is the first of these that holds:
`not_comparable` if the gate says so; `not_finite` if novelty or threshold is not a finite number; `accept` if novelty
<= threshold; `unexplained` if the distribution fills its bounds and p <= 0.01; `radius_exhausted` if it fills them or
was widened `max_widenings` times; else `widen`. A radius that was widened stays so, unless the update narrows it.

Departures from the paper, besides those of `jaxtune.gate` and `jaxtune.update`:

- An accepted set is read up to `refinements` times more, with episodes simulated in the distribution that the update
  narrowed. In a narrower distribution estimates are more exact, and the robot need not walk for it. If the set does
  not fit there (`UpdateInfo.p_value` <= 1 - level), the radius before is taken back. If it does not whatever the
  coordinates when it is read again for the first time (`p_misfit` <= 0.01), the verdict becomes `unexplained`: in a
  wide distribution, parameters can absorb what is missing.
- Physics does not depend on which policy walked, so estimates are joined with what the accepted sets of earlier tunings
  said (`jaxtune.pooling`). A set that contradicts them, or that the gate rejects, makes them count no longer.
- Where the robot's states are measured (`Tuner.replay`), the accepted set is read a last time, by simulating short
  pieces of it from measured states (`jaxtune.replay`). That estimate is taken if it errs less on simulated sets than
  the one before, and if the measured set fits it (`UpdateInfo.p_replay` > 1 - level).
- A tuning ends with training the policy, where the paper's begins with it. The last tuning therefore leaves a policy
  that was trained in the last distribution.
- The radius grows only after a failed check (in print it grows before each), is capped by the bounds, and the loop ends
  with a verdict.

Everything here is pure: a key and a state go in, a state and an info come out. A user hands in three functions; gate
and update are functions as well and have defaults:

    import jax
    import jax.numpy as jnp
    from jaxtune import dist
    from jaxtune.tuner import Tuner, TunerConfig, knobs
    from jaxtune.types import Trajectory

    def simulate(key, policy, coords):  # a cart; the policy is a constant push; the log of its friction is searched
        start = jax.random.normal(key, coords["friction"].shape)
        move = lambda speed, _: (speed + 0.1 * (policy - jnp.exp(coords["friction"]) * speed), speed)
        speed = jax.lax.scan(move, start, length=100)[1].T  # [episodes, time]
        alive, no = jnp.ones(speed.shape, bool), jnp.zeros(start.shape, bool)
        obs, action = speed[..., None], jnp.full((*speed.shape, 1), policy)
        return Trajectory(obs=obs, action=action, alive=alive, score=speed, fell=no, not_finite=no)

    train_policy = lambda key, policy, dist: (policy, {})  # any learner, on draws of dist
    measure = lambda key, policy: simulate(key, policy, {"friction": jnp.full(5, 0.8)})  # the robot: another cart
    tuner = Tuner(config=TunerConfig(), train_policy=train_policy, simulate=simulate, measure=measure)
    first = dist.make({"friction": 0.0}, 0.2, {"friction": -2.0}, {"friction": 2.0})
    state = tuner.init(1.0, first, knobs())

`tuner.run(key, state, num_tunings)` returns the state whose `dist.centre` is the estimate. With a target in JAX it is
one program that can be jitted and vmapped over seeds, starts and knobs. With any other target (another engine, a log on
disk, a robot), leave `measure` out, loop over `tuner.train` and `tuner.tune`, and fetch the measured set between them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax

from jaxtune import conformal, pooling, windows
from jaxtune import dist as dists
from jaxtune import replay as replays
from jaxtune.checks import check_measured, check_simulated, check_states
from jaxtune.explain import explain
from jaxtune.gate import GateInfo, Verify, calibrated_gate, no_gate_log
from jaxtune.misfits import Misfits, Phase, misfits, share_of_episode
from jaxtune.pooling import Past
from jaxtune.readings import Collected, examine
from jaxtune.replay import Replay
from jaxtune.settings import Knobs, TunerConfig, knobs
from jaxtune.types import Coords, ParamDist, Trajectory, Verdict
from jaxtune.update import Update, UpdateInfo, no_update, posterior_update, vote_update

__all__ = [
    "Collected",
    "GateInfo",
    "Info",
    "Knobs",
    "Tuner",
    "TunerConfig",
    "TunerState",
    "UpdateInfo",
    "calibrated_gate",
    "explain",
    "keep",
    "knobs",
    "posterior_update",
    "vote_update",
]

_CHANGED = 0.9  # of a radius: what is narrowed less than that, or moved by less than the rest, is as it was
_UNEXPLAINED = 0.01  # largest p-value; a conformal one needs 99 simulated sets to be so small

Policy = Any
"""Any pytree that the user's functions take as a policy; the tuner only passes it on."""
TrainPolicy = Callable[[jax.Array, Policy, ParamDist], tuple[Policy, dict]]
"""`(key, policy, dist) -> (policy, metrics)`: trains the policy on robots drawn from the distribution. Metrics are
scalars or arrays by name."""
Simulate = Callable[[jax.Array, Policy, Coords], Trajectory]
"""`(key, policy, coords [episodes]) -> Trajectory [episodes, time]`: one episode for every draw, traceable by JAX."""
Measure = Callable[[jax.Array, Policy], Trajectory]
"""`(key, policy) -> Trajectory [set_episodes, time]`: episodes of the target, with the same episode length, policy,
commands and observation noise as the simulated ones."""


def keep(key: jax.Array, policy: Policy, dist: ParamDist) -> tuple[Policy, dict]:
    """Leaves a policy as it is: the `train_policy` of a tuner whose policy is trained elsewhere, or not at all."""
    return policy, {}


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


def counted(carry: dict, collected: Collected) -> dict:
    """Counts a round of a tuning's loop, and its simulated episodes in which the simulation broke."""
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


@chex.dataclass(frozen=True)
class TunerState:
    """What the next tuning needs, and nothing else: save it to resume a run, stack it to vmap over runs.

    Everything is traced, so a tuner compiled once accepts any policy, distribution and knobs of the same shapes.
    """

    policy: Any
    dist: ParamDist
    knobs: Knobs
    past: Past  # what the sets of earlier tunings said of the coordinates


def _contradicts(found: UpdateInfo | replays.Replayed) -> jax.Array:
    """Tells whether a set contradicts earlier ones."""
    return ~jnp.asarray(found.pooled) & ~jnp.isnan(found.p_past)


def known_after(carry: dict) -> Past:
    """What all sets so far say after a tuning, from what its loop carried last."""
    return optax.tree.where(carry["verdict"] == Verdict.ACCEPT, carry["update"].learnt, carry["past"])


@dataclass(frozen=True, kw_only=True)
class Tuner:
    """Algorithm 1 over the functions that it is given; the module's docstring draws the schedule.

    A tuner is a frozen record without state of its own. To make a variant, such as a baseline, swap a function with
    `dataclasses.replace`.

    Attributes:
      config: sizes.
      train_policy: trains the policy in a distribution (`TrainPolicy`).
      simulate: simulates episodes of robots with given coordinates (`Simulate`).
      measure: measures episodes of the target (`Measure`). None where the target is not JAX; hand the measured set to
        `tune` then.
      verify: scores a measured set against simulated ones (`gate.Verify`).
      update: moves the distribution after an accepted set (`update.Update`).
      replay: simulates pieces of episodes from measured states (`jaxtune.replay`), for a last, more exact estimate.
        Simulated and measured episodes must hold states then (`Trajectory.state`).
      phase: where in its cycle a step is, such as a gait's clock says; the share of its episode if not given. Only
        `misfits` asks for it.
    """

    config: TunerConfig
    train_policy: TrainPolicy
    simulate: Simulate
    measure: Measure | None = None
    verify: Verify = calibrated_gate
    update: Update = posterior_update
    replay: Replay | None = None
    phase: Phase = share_of_episode

    def init(self, policy: Policy, dist: ParamDist, knobs: Knobs) -> TunerState:
        """Makes the state before the first tuning.

        A tuning measures before it trains, so `policy` should have been trained in `dist` already (`train` does that).
        """
        return TunerState(policy=policy, dist=dist, knobs=knobs, past=pooling.nothing(dist))

    def step(self, key: jax.Array, state: TunerState) -> tuple[TunerState, Info]:
        """Does one tuning: measures a set, tunes the distribution with it, and trains the policy in the result.

        Use it where the target is in JAX, so that `measure` can be traced.

        Raises:
          ValueError: the tuner has no `measure`.
        """
        if self.measure is None:
            raise ValueError("measure: got none, expected a function; or measure a set yourself, and call `tune`")
        key_measure, key_tune, key_train = jax.random.split(key, 3)
        state, info = self.tune(key_tune, state, self.measure(key_measure, state.policy))
        state, metrics = self.train(key_train, state)
        return state, info.replace(train=metrics)

    def run(self, key: jax.Array, state: TunerState, num_tunings: int) -> tuple[TunerState, Info]:
        """Does `num_tunings` tunings (the paper's K) in one `jax.lax.scan`.

        Returns the last state, and the infos of all tunings with every field stacked, [num_tunings, ...]. Jit it with
        `num_tunings` static.
        """
        return jax.lax.scan(lambda state, key: self.step(key, state), state, jax.random.split(key, num_tunings))

    def train(self, key: jax.Array, state: TunerState) -> tuple[TunerState, dict]:
        """Trains the policy in the state's distribution by the user's `train_policy`; returns state and metrics.

        Call it before the first tuning, and after every `tune` in a loop over a target that is not JAX.
        """
        policy, metrics = self.train_policy(key, state.policy, state.dist)
        return state.replace(policy=policy), metrics

    def tune(self, key: jax.Array, state: TunerState, measured: Trajectory) -> tuple[TunerState, Info]:
        """Verifies a measured set, widens the distribution until it covers the set, and then updates it.

        This is a tuning without measuring and training, for targets that are not JAX. The distribution is updated only
        if the last verdict is `accept`; otherwise its centre stays.

        Args:
          key: random key.
          state: the state whose policy produced the measured set.
          measured: the measured set, [set_episodes, time].

        Returns:
          The state with the new distribution, and the `Info`, with an empty `train`.

        Raises:
          ValueError: episodes, simulated or measured, do not have the shapes that they should (`jaxtune.checks`).
        """
        # Only shapes: nothing is simulated here.
        shapes = jax.eval_shape(self.collect, key, state.policy, state.dist)
        check_measured(measured, shapes.trajectory, self.config)
        if self.replay is not None:
            check_states(measured, shapes.held_out, self.config, self.replay.needs)

        def body(carry):
            # Every round simulates new robots and trains its models anew, because the distribution has changed.
            key_collect, key_verify, key_update = jax.random.split(jax.random.fold_in(key, carry["rounds"]), 3)
            collected = self.collect(key_collect, state.policy, carry["dist"])
            # Once for gate and update; left out of the program where neither reads it.
            collected = collected.replace(reading=examine(self.config, collected, measured), past=carry["past"])
            carry, last = counted(carry, collected), carry["left"] <= 0
            # Branches, so that (unless vmapped) no model is trained that is not needed.
            carry = jax.lax.cond(
                carry["verdict"] == Verdict.WIDEN,
                lambda: self.decide(
                    carry, self.verify(key_verify, self.config, collected, measured, state.knobs), state.knobs
                ),
                lambda: carry,
            )
            carry = jax.lax.cond(
                (carry["verdict"] == Verdict.ACCEPT) & ~last,
                lambda: self.refine(
                    carry,
                    *self.update(key_update, self.config, collected, measured, carry["dist"], state.knobs),
                    state.knobs,
                ),
                lambda: carry,
            )
            if self.replay is None:
                return carry
            return jax.lax.cond(
                last, lambda: self.sharpen(key_update, carry, collected, measured, state.knobs), lambda: carry
            )

        def goes_on(carry):
            return (carry["left"] > 0) | ((carry["verdict"] == Verdict.ACCEPT) & ~carry["sharpened"])

        carry = jax.lax.while_loop(goes_on, body, self.before(state))
        return state.replace(dist=carry["dist"], past=known_after(carry)), make_info(carry, measured)

    def before(self, state: TunerState) -> dict:
        """Makes what the loop of a tuning carries before its first round; it ends when no rounds are `left`."""
        dist = state.dist
        return {
            "rounds": jnp.zeros((), int),
            "left": jnp.asarray(1 + self.config.refinements, int),
            "calls": jnp.zeros((), int),
            "dist": dist,
            "tested": dist,
            "wider": dist.radius,
            "past": state.past,
            "update": no_update(dist),
            "verdict": jnp.asarray(Verdict.WIDEN, int),
            "not_finite": jnp.zeros((), int),
            "sharpened": jnp.asarray(self.replay is None),
            **no_gate_log(self.config),
        }

    def decide(self, carry: dict, gate: GateInfo, knobs: Knobs) -> dict:
        """Takes the verdict of one gate call, and widens the distribution if that is it.

        Args:
          carry: from `before`, or from the call before.
          gate: what it found.
          knobs: for the widening factor.

        Returns:
          What the loop carries on; the loop ends where the verdict is neither `widen` nor `accept`.
        """
        calls, dist = carry["calls"], carry["dist"]
        verdict = jnp.asarray(self._verdict(gate, dist, calls), int)
        goes_on = (verdict == Verdict.WIDEN) | (verdict == Verdict.ACCEPT)
        wider = dists.widen(dist, knobs.widen_factor)
        following = optax.tree.where(verdict == Verdict.WIDEN, wider, dist)
        # A set outside the distribution that earlier ones led to says that they misled.
        misled = gate.novelty > gate.threshold
        return carry | {
            "left": jnp.where(goes_on, carry["left"], 0),
            "calls": calls + 1,
            "tested": dist,
            "dist": following,
            "past": optax.tree.where(misled, pooling.nothing(following), carry["past"]),
            "verdict": verdict,
            "verdicts": carry["verdicts"].at[calls].set(verdict),
            "radius": carry["radius"].at[calls].set(dists.ravel(dist.radius).max()),
            "gate": jax.tree.map(lambda log, value: log.at[calls].set(value), carry["gate"], gate),
        }

    def refine(self, carry: dict, moved: ParamDist, update: UpdateInfo, knobs: Knobs) -> dict:
        """Takes an update of an accepted set, and decides whether the set is read again, in the narrower distribution.

        That needs no further measured episode. It ends after `TunerConfig.refinements`, where the distribution hardly
        changed, or where the set does not fit the distribution that the update before had narrowed.

        Args:
          carry: from `decide`, or from the refinement before.
          moved: what the update made of the distribution.
          update: what it did.
          knobs: for the level.

        Returns:
          What the loop carries on. All updates of the set count as one, in radii of the distribution that was tested.
        """
        dist, tested, before = carry["dist"], carry["tested"], carry["update"]
        # The gate has just tested the distribution of the first reading.
        again = carry["left"] < 1 + self.config.refinements
        misfits = again & conformal.rejects(update.p_value, knobs.level)
        # Tested once a tuning, so that its rate of false alarms is that of one test: at filled bounds by the gate.
        first = (carry["left"] == self.config.refinements) & ~dists.at_bounds(tested)
        unexplained = first & (update.p_misfit <= _UNEXPLAINED)
        radius, unit = dists.ravel(dist.radius), dists.ravel(tested.radius)
        changed = (dists.ravel(moved.radius) < _CHANGED * radius) | (jnp.abs(update.step) > 1.0 - _CHANGED)
        update = update.replace(
            step=(dists.ravel(moved.centre) - dists.ravel(tested.centre)) / unit,
            interval=update.interval * radius / unit,
            identifiable=before.identifiable | update.identifiable,
            errors=update.errors * jnp.outer(radius / unit, radius / unit),
            learnt=pooling.nothing(moved) if update.learnt is None else update.learnt,
            # One contradiction is enough: the readings after it join nothing.
            p_past=jnp.where(jnp.isnan(update.p_past), before.p_past, update.p_past),
        )
        # Taken back: what the reading before found remains, within the radius that it was found in.
        back = before.replace(
            interval=dists.ravel(carry["wider"]) / unit, p_value=update.p_value, p_misfit=update.p_misfit
        )
        nothing = no_update(tested).replace(p_value=update.p_value, p_misfit=update.p_misfit)
        verdict = jnp.where(unexplained, Verdict.UNEXPLAINED, carry["verdict"])
        return carry | {
            "left": jnp.where(changed.any() & ~misfits & ~unexplained, carry["left"] - 1, 0),
            "dist": optax.tree.where(
                unexplained, tested, optax.tree.where(misfits, dist.replace(radius=carry["wider"]), moved)
            ),
            "wider": dist.radius,
            "past": optax.tree.where(_contradicts(update), pooling.nothing(tested), carry["past"]),
            "update": optax.tree.where(unexplained, nothing, optax.tree.where(misfits, back, update)),
            "verdict": verdict,
            "verdicts": carry["verdicts"].at[carry["calls"] - 1].set(verdict),
        }

    def sharpen(self, key: jax.Array, carry: dict, collected: Collected, measured: Trajectory, knobs: Knobs) -> dict:
        """Estimates once more, from the states of an accepted set (`replay.estimate`).

        Args:
          key: random key.
          carry: from `refine`.
          collected: of the distribution that it left.
          measured: the measured set, with states.
          knobs: for the level that the measured set must fit at.

        Returns:
          What the loop carries on; it ends. The centre is the new estimate if, on simulated sets, its errors (rms, in
          radii) are smaller than those of the estimate before, and if the measured set fits it. Radii only narrow.
        """
        dist, tested, before = carry["dist"], carry["tested"], carry["update"]
        sizes, held_out = self.config.replay, (collected.held_out, collected.held_out_coords)
        # The last ones are others than the first where there are twice as many.
        first, last = (jax.tree.map(lambda leaf, part=part: leaf[part], held_out) for part in sizes.parts)
        pool = partial(pooling.joined, key, carry["past"], dist)
        found = replays.estimate(sizes, self.replay, *first, measured, dist, self.config.coverage, *last, pool)
        radius, unit = dists.ravel(dist.radius), dists.ravel(tested.radius)
        errors = found.errors * jnp.outer(radius / unit, radius / unit)
        # An update that gives no errors gives no reason to keep its estimate.
        closer = jnp.isnan(before.errors).any() | (jnp.trace(errors) < jnp.trace(before.errors))
        # What the estimate before errs by is what earlier sets err by, if it is joined with them; these misled.
        closer |= _contradicts(found)
        fits = ~conformal.rejects(found.p_value, knobs.level)
        known = (found.estimate, found.interval, errors, found.p_value)
        taken = closer & fits & jnp.stack([jnp.isfinite(values).all() for values in known]).all()
        moved = dists.narrow(dists.move(dist, found.estimate), found.interval, self.config.min_radius)
        update = before.replace(
            step=(dists.ravel(moved.centre) - dists.ravel(tested.centre)) / unit,
            interval=found.interval * radius / unit,
            identifiable=before.identifiable | (found.interval < 1.0),
            errors=errors,
            replayed=jnp.asarray(True),
            pooled=found.pooled,
            p_past=found.p_past,
            learnt=pooling.learnt(carry["past"], found.pooled, dist, found.estimate, found.errors),
        )
        update = optax.tree.where(taken, update, before).replace(p_replay=found.p_value)
        return carry | {
            "dist": optax.tree.where(taken, moved, dist),
            "update": update,
            "sharpened": jnp.asarray(True),
        }

    def collect(self, key: jax.Array, policy: Policy, dist: ParamDist) -> Collected:
        """Simulates D_q and the held-out sets under one policy, with coordinates drawn from one distribution.

        All `episodes + held_out_sets * set_episodes` episodes are simulated in one batch. `tune` calls this before
        every gate call; call it yourself to study gate or update alone.
        """
        key_train, key_held_out, key_simulate = jax.random.split(key, 3)
        sets, each = self.config.held_out_sets, self.config.set_episodes
        coords = dists.sample(key_train, dist, self.config.episodes)
        held_out_coords = dists.sample(key_held_out, dist, sets)
        # One call of the simulator for both, so that it is compiled once and the device is full.
        every = jax.tree.map(lambda a, b: jnp.concatenate([a, jnp.repeat(b, each)]), coords, held_out_coords)
        trajectory = self.simulate(key_simulate, policy, every)
        check_simulated(trajectory, self.config.episodes + sets * each, self.config)
        trajectory = windows.without_broken(trajectory)
        return Collected(
            trajectory=jax.tree.map(lambda leaf: leaf[: self.config.episodes], trajectory.replace(state=None)),
            sampled_coords=coords,
            held_out=jax.tree.map(
                lambda leaf: leaf[self.config.episodes :].reshape(sets, each, *leaf.shape[1:]), trajectory
            ),
            held_out_coords=held_out_coords,
            dist=dist,
        )

    def misfits(self, key: jax.Array, state: TunerState, measured: Trajectory) -> Misfits:
        """Says which observations and actions no parameters explain, and in which phase, after a set was rejected.

        It simulates anew, in the state's distribution.
        """
        return misfits(self.config, self.collect(key, state.policy, state.dist), measured, self.phase)

    def _verdict(self, gate: GateInfo, dist: ParamDist, calls: jax.Array) -> jax.Array:
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
                full & (gate.p_value <= _UNEXPLAINED),
                full | (calls >= self.config.max_widenings),
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
