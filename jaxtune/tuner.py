"""Algorithm 1: measure, verify, widen or update, train the policy, again.

    for each tuning
      measured <- measure(policy)
      do
        D_q, held-out sets <- simulate(policy, draws of dist)
        verdict <- verify(D_q, held-out sets, measured)
        if the verdict is `widen`: radius <- radius * widen_factor
      while the verdict is `widen`
      if the verdict is `accept`: dist <- update(D_q, measured, dist)
      policy <- train_policy(policy, dist)

Departures from the paper: a tuning ends, not starts, with training the policy, so that the first one finds the policy
that was trained in the first distribution, and the last one leaves a policy that knows the last; the radius grows
only where the check fails (in print it grows before the test), is capped by the bounds, and the loop ends with a
verdict; a set's novelty is the mean rank, not the mean, of Eq. 2 over its windows, and the threshold is not set by hand
but is a quantile of the novelty of held-out simulated sets of as many episodes, which makes the gate a conformal test;
the update is signed.

Everything here is pure. How a policy is trained, how episodes are simulated and measured, how a set is verified and
how the distribution is updated are functions handed in; with a target in JAX, `Tuner.run` is one program that can be
vmapped.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxtune import dist as dists
from jaxtune.rules import (
    Collected,
    GateInfo,
    Knobs,
    TunerConfig,
    Update,
    UpdateInfo,
    Verify,
    calibrated_gate,
    knobs,
    no_gate_log,
    no_update,
    posterior_update,
    vote_update,
)
from jaxtune.types import Coords, ParamDist, Trajectory, Verdict

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
    "knobs",
    "posterior_update",
    "vote_update",
]

Policy = Any
TrainPolicy = Callable[[jax.Array, Policy, ParamDist], tuple[Policy, dict]]
Simulate = Callable[[jax.Array, Policy, Coords], Trajectory]
Measure = Callable[[jax.Array, Policy], Trajectory]


@chex.dataclass(frozen=True)
class Info:
    """One tuning, for plots and reports; gate calls that were not made hold nan and -1."""

    train: dict  # what the policy's training reported
    calls: jax.Array  # number of gate calls
    verdicts: jax.Array  # [calls], -1 where none was made
    radius: jax.Array  # [calls], the largest of the parameters' radii
    gate: GateInfo  # [calls]
    update: UpdateInfo
    dist: ParamDist  # the distribution the last episodes were drawn from
    measured_falls: jax.Array  # measured episodes that ended early
    not_finite: jax.Array  # episodes, simulated or measured, that broke


@chex.dataclass(frozen=True)
class TunerState:
    """What the next tuning needs."""

    policy: Any
    dist: ParamDist
    knobs: Knobs


@dataclass(frozen=True, kw_only=True)
class Tuner:
    """Algorithm 1 over the functions it is given.

    Attributes:
      config: sizes.
      train_policy: `(key, policy, dist) -> (policy, metrics)`.
      simulate: `(key, policy, coords [episodes]) -> Trajectory [episodes, time]`.
      measure: `(key, policy) -> Trajectory [set_episodes, time]`, of the same length, policy and commands; None where
        the target is not JAX, and the measured set is handed to `tune`.
      verify: scores a measured set.
      update: moves the distribution after an accepted set.
    """

    config: TunerConfig
    train_policy: TrainPolicy
    simulate: Simulate
    measure: Measure | None = None
    verify: Verify = calibrated_gate
    update: Update = posterior_update

    def init(self, policy: Policy, dist: ParamDist, knobs: Knobs) -> TunerState:
        """The state before the first tuning."""
        return TunerState(policy=policy, dist=dist, knobs=knobs)

    def step(self, key: jax.Array, state: TunerState) -> tuple[TunerState, Info]:
        """One tuning: measure, tune, train."""
        key_measure, key_tune, key_train = jax.random.split(key, 3)
        state, info = self.tune(key_tune, state, self.measure(key_measure, state.policy))
        state, metrics = self.train(key_train, state)
        return state, info.replace(train=metrics)

    def run(self, key: jax.Array, state: TunerState, num_tunings: int) -> tuple[TunerState, Info]:
        """All tunings; every field of the info is stacked, [num_tunings, ...]."""
        return jax.lax.scan(lambda state, key: self.step(key, state), state, jax.random.split(key, num_tunings))

    def train(self, key: jax.Array, state: TunerState) -> tuple[TunerState, dict]:
        """Trains the policy in the current distribution."""
        policy, metrics = self.train_policy(key, state.policy, state.dist)
        return state.replace(policy=policy), metrics

    def tune(self, key: jax.Array, state: TunerState, measured: Trajectory) -> tuple[TunerState, Info]:
        """Verifies a measured set, widens until it is covered, and updates the distribution if it is."""
        key_gate, key_update = jax.random.split(key)
        carry = self._gate_loop(key_gate, state, measured)
        moved, update = jax.lax.cond(
            carry["verdict"] == Verdict.ACCEPT,
            lambda: self.update(key_update, self.config, carry["collected"], measured, carry["dist"], state.knobs),
            lambda: (carry["dist"], no_update(carry["dist"])),
        )
        info = Info(
            train={},
            calls=carry["calls"],
            verdicts=carry["verdicts"],
            radius=carry["radius"],
            gate=carry["gate"],
            update=update,
            dist=carry["dist"],
            measured_falls=measured.fell.sum(),
            not_finite=carry["not_finite"] + measured.not_finite.sum(),
        )
        return state.replace(dist=moved), info

    def _gate_loop(self, key, state, measured):
        """The do-while of Algorithm 1."""

        def body(carry):
            calls = carry["calls"]
            key_collect, key_verify = jax.random.split(jax.random.fold_in(key, calls))
            dist = carry["dist"]
            collected = self.collect(key_collect, state.policy, dist)
            gate = self.verify(key_verify, self.config, collected, measured, state.knobs)
            closer = gate.novelty < carry["closest"] - self.config.least_fall
            stalled = jnp.where(closer, 0, carry["stalled"] + 1)
            verdict = self._verdict(gate, dist, calls, stalled)
            broken = collected.trajectory.not_finite.sum() + collected.held_out.not_finite.sum()
            wider = dists.widen(dist, state.knobs.widen_factor)
            return {
                "calls": calls + 1,
                "dist": jax.tree.map(lambda new, old: jnp.where(verdict == Verdict.WIDEN, new, old), wider, dist),
                "collected": collected,
                "verdict": verdict,
                # Many small falls may add up to one that counts.
                "closest": jnp.where(closer, gate.novelty, carry["closest"]),
                "stalled": stalled,
                "verdicts": carry["verdicts"].at[calls].set(verdict),
                "radius": carry["radius"].at[calls].set(dists.ravel(dist.radius).max()),
                "gate": jax.tree.map(lambda log, value: log.at[calls].set(value), carry["gate"], gate),
                "not_finite": carry["not_finite"] + broken,
            }

        return jax.lax.while_loop(lambda carry: carry["verdict"] == Verdict.WIDEN, body, self._before_gate(key, state))

    def _before_gate(self, key, state):
        shapes = jax.eval_shape(self.collect, key, state.policy, state.dist)
        return {
            "calls": jnp.zeros((), int),
            "dist": state.dist,
            "collected": jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
            "verdict": jnp.asarray(Verdict.WIDEN, int),
            "closest": jnp.asarray(jnp.inf),
            "stalled": jnp.zeros((), int),
            "not_finite": jnp.zeros((), int),
            **no_gate_log(self.config),
        }

    def collect(self, key, policy, dist) -> Collected:
        """Episodes for training and held-out sets, simulated in one batch."""
        key_train, key_held_out, key_simulate = jax.random.split(key, 3)
        sets, each = self.config.held_out_sets, self.config.set_episodes
        coords = dists.sample(key_train, dist, self.config.episodes)
        held_out_coords = dists.sample(key_held_out, dist, sets)
        every = jax.tree.map(lambda a, b: jnp.concatenate([a, jnp.repeat(b, each)]), coords, held_out_coords)
        trajectory = self.simulate(key_simulate, policy, every)
        return Collected(
            trajectory=jax.tree.map(lambda leaf: leaf[: self.config.episodes], trajectory),
            coords=coords,
            held_out=jax.tree.map(
                lambda leaf: leaf[self.config.episodes :].reshape(sets, each, *leaf.shape[1:]), trajectory
            ),
            held_out_coords=held_out_coords,
        )

    def _verdict(self, gate: GateInfo, dist: ParamDist, calls: jax.Array, stalled: jax.Array) -> jax.Array:
        exhausted = dists.at_bounds(dist) | (calls >= self.config.max_widenings)
        return jnp.select(
            [
                ~(jnp.isfinite(gate.novelty) & jnp.isfinite(gate.threshold)),
                gate.novelty <= gate.threshold,
                stalled >= self.config.patience,
                exhausted,
            ],
            [Verdict.NOT_FINITE, Verdict.ACCEPT, Verdict.UNEXPLAINED, Verdict.RADIUS_EXHAUSTED],
            Verdict.WIDEN,
        )
