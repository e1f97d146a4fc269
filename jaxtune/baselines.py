"""The paper's baselines, each a variant of the same `Tuner` (section IV-B).

`spm` is Algorithm 1 without its gate: the paper's rule on whatever was measured, in a radius that never changes.
`Untuned` trains on and never moves the distribution: wide, it is domain randomisation; around the target's
parameters, the oracle that the paper calls pseudo-real.
"""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxtune.rules import GateInfo, no_gate_log, no_update, vote_update
from jaxtune.tuner import Info, Tuner, TunerState
from jaxtune.types import Trajectory


def open_gate(key, config, collected, measured, knobs) -> GateInfo:
    """Accepts every measured set that has a step in it, unread."""
    nothing = jnp.asarray(jnp.nan)
    usable = jnp.where(measured.alive.any(), 0.0, jnp.nan)
    return GateInfo(novelty=usable, threshold=jnp.zeros(()), p_value=nothing, uncovered=nothing, elbo=nothing)


def spm(tuner: Tuner) -> Tuner:
    """The original search-parameter method over the same functions."""
    return dataclasses.replace(tuner, verify=open_gate, update=vote_update)


@dataclass(frozen=True, kw_only=True)
class Untuned:
    """Trains in a distribution that stays what it is; steps like a `Tuner`, and measures nothing."""

    tuner: Tuner

    def init(self, policy, dist, knobs) -> TunerState:
        """The state before the first step."""
        return self.tuner.init(policy, dist, knobs)

    def step(self, key: jax.Array, state: TunerState) -> tuple[TunerState, Info]:
        """Trains the policy for as long as a tuning does."""
        state, metrics = self.tuner.train(key, state)
        state, info = self.tune(key, state)
        return state, info.replace(train=metrics)

    def tune(self, key: jax.Array, state: TunerState, measured: Trajectory | None = None) -> tuple[TunerState, Info]:
        """Nothing, whatever was measured."""
        del key, measured
        return state, Info(
            train={},
            calls=jnp.zeros((), int),
            **no_gate_log(self.tuner.config),
            update=no_update(state.dist),
            dist=state.dist,
            measured_falls=jnp.zeros((), int),
            not_finite=jnp.zeros((), int),
        )
