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
      |     widen               dist <- wider, towards where the robot seems to be -+
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
was widened by `max_widenings` calls; else `widen`. A radius that was widened stays so, unless the update narrows it.

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
  the one before, and if the measured set fits it (`UpdateInfo.p_replay` > 1 - level). If no coordinates within the
  bounds fit (`p_replay` <= 0.01), the verdict becomes `unexplained`; `p_misfit` does not count then.
- A tuning ends with training the policy, where the paper's begins with it. The last tuning therefore leaves a policy
  that was trained in the last distribution.
- The radius grows only after a failed check (in print it grows before each), is capped by the bounds, and the loop ends
  with a verdict. The centre moves towards the regression's estimate then, as far as the wider distribution still holds
  the narrower one (`dist.widen`). It widens twice at once if the estimate is farther away than that. Widened about its
  centre, a distribution has the robot near its edge when it is accepted at last, and is twice as wide.

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
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxtune import dist as dists
from jaxtune import loop, pooling, windows
from jaxtune.checks import check_measured, check_simulated, check_states
from jaxtune.explain import explain
from jaxtune.gate import GateInfo, Verify, calibrated_gate
from jaxtune.loop import Info
from jaxtune.misfits import Misfits, Phase, misfits, share_of_episode
from jaxtune.pooling import Past
from jaxtune.readings import Collected, cut_alike, examine
from jaxtune.settings import Knobs, TunerConfig, knobs
from jaxtune.shooting import Replay
from jaxtune.types import Coords, ParamDist, Trajectory, Verdict
from jaxtune.update import Update, UpdateInfo, posterior_update, vote_update

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
class TunerState:
    """What the next tuning needs, and nothing else: save it to resume a run, stack it to vmap over runs.

    Everything is traced, so a tuner compiled once accepts any policy, distribution and knobs of the same shapes.
    """

    policy: Any
    dist: ParamDist
    knobs: Knobs
    past: Past  # what the sets of earlier tunings said of the coordinates


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
            carry, last = loop.counted(carry, collected), carry["left"] <= 0
            collected = cut_alike(collected, measured)
            # Once for gate and update; left out of the program where neither reads it.
            collected = collected.replace(reading=examine(self.config, collected, measured), past=carry["past"])
            # Branches, so that (unless vmapped) no model is trained that is not needed.
            carry = jax.lax.cond(
                carry["verdict"] == Verdict.WIDEN,
                lambda: loop.decide(
                    self.config,
                    carry,
                    self.verify(key_verify, self.config, collected, measured, state.knobs),
                    state.knobs,
                ),
                lambda: carry,
            )
            carry = jax.lax.cond(
                (carry["verdict"] == Verdict.ACCEPT) & ~last,
                lambda: loop.refine(
                    self.config,
                    carry,
                    *self.update(key_update, self.config, collected, measured, carry["dist"], state.knobs),
                    state.knobs,
                ),
                lambda: carry,
            )
            if self.replay is None:
                return carry
            return jax.lax.cond(
                last,
                lambda: loop.sharpen(self.config, self.replay, key_update, carry, collected, measured, state.knobs),
                lambda: carry,
            )

        def goes_on(carry):
            return (carry["left"] > 0) | ((carry["verdict"] == Verdict.ACCEPT) & ~carry["sharpened"])

        first = loop.before(self.config, state.dist, state.past, self.replay is not None)
        carry = jax.lax.while_loop(goes_on, body, first)
        dist = loop.dist_after(carry, state.dist)
        return state.replace(dist=dist, past=loop.known_after(carry)), loop.make_info(carry, measured)

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
        collected = cut_alike(self.collect(key, state.policy, state.dist), measured)
        return misfits(self.config, collected, measured, self.phase)
