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
from dataclasses import dataclass, field
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxtune import dist as dists
from jaxtune import dvm, spm
from jaxtune.dvm import DVMConfig
from jaxtune.spm import SPMConfig
from jaxtune.types import Named, ParamDist, Trajectory, Verdict

_IDENTIFIABLE = 0.9  # an interval this much narrower than one that ignores the data tells something

Policy = Any
TrainPolicy = Callable[[jax.Array, Policy, ParamDist], tuple[Policy, dict]]
Simulate = Callable[[jax.Array, Policy, Named], Trajectory]
Measure = Callable[[jax.Array, Policy], Trajectory]


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
    """Calls in a row without a new least novelty after which the verdict is `unexplained`."""
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
    params: dict  # their parameters, [episodes]
    held_out: Trajectory  # [sets, set_episodes, time]
    held_out_params: dict  # [sets]


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
    """One update, [params] each in the order of `dist.names`; of the radius where a step is meant."""

    step: jax.Array  # taken by the centre
    interval: jax.Array  # half width of the interval around it
    identifiable: jax.Array  # False where the set says no more than the distribution did
    loss: jax.Array  # of the search-parameter model, nats


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
    model, loss = spm.train(key, config.spm, collected.trajectory, collected.params, dist)
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
    model, loss = spm.train(key, config.spm, collected.trajectory, collected.params, dist)
    held_out = jax.lax.map(lambda episodes: spm.estimate(config.spm, model, episodes), collected.held_out)
    truth = dists.normalise(dist, collected.held_out_params)
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


@dataclass(frozen=True, kw_only=True)
class Tuner:
    """Algorithm 1 over the functions it is given.

    Attributes:
      config: sizes.
      train_policy: `(key, policy, dist) -> (policy, metrics)`.
      simulate: `(key, policy, params [episodes]) -> Trajectory [episodes, time]`.
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
            better = gate.novelty < carry["least"]
            stalled = jnp.where(better, 0, carry["stalled"] + 1)
            verdict = self._judge(gate, dist, calls, stalled)
            broken = collected.trajectory.not_finite.sum() + collected.held_out.not_finite.sum()
            wider = dists.widen(dist, state.knobs.widen_factor)
            return {
                "calls": calls + 1,
                "dist": jax.tree.map(lambda new, old: jnp.where(verdict == Verdict.WIDEN, new, old), wider, dist),
                "collected": collected,
                "verdict": verdict,
                "least": jnp.fmin(gate.novelty, carry["least"]),
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
            "least": jnp.asarray(jnp.inf),
            "stalled": jnp.zeros((), int),
            "not_finite": jnp.zeros((), int),
            **no_gate_log(self.config),
        }

    def collect(self, key, policy, dist) -> Collected:
        """Episodes for training and held-out sets, simulated in one batch."""
        key_train, key_held_out, key_simulate = jax.random.split(key, 3)
        sets, each = self.config.held_out_sets, self.config.set_episodes
        params = dists.sample(key_train, dist, self.config.episodes)
        held_out_params = dists.sample(key_held_out, dist, sets)
        every = jax.tree.map(lambda a, b: jnp.concatenate([a, jnp.repeat(b, each)]), params, held_out_params)
        trajectory = self.simulate(key_simulate, policy, every)
        return Collected(
            trajectory=jax.tree.map(lambda leaf: leaf[: self.config.episodes], trajectory),
            params=params,
            held_out=jax.tree.map(
                lambda leaf: leaf[self.config.episodes :].reshape(sets, each, *leaf.shape[1:]), trajectory
            ),
            held_out_params=held_out_params,
        )

    def _judge(self, gate: GateInfo, dist: ParamDist, calls: jax.Array, stalled: jax.Array) -> jax.Array:
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
