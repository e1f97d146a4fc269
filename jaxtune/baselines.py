"""The methods that the paper compares with (section IV-B), each a variant of the same `Tuner`.

- `spm` is the original search-parameter method: Algorithm 1 without its gate. It applies the paper's update to whatever
  was measured, within a radius that never changes.
- `Untuned` trains the policy and never moves the distribution. With a wide distribution (radius 0.4 in the paper) it is
  domain randomisation; around the target's true parameters it is the oracle that the paper calls pseudo-real.

Both have the interface of a `Tuner`, and their `Info` has the same fields and shapes, so one experiment runs them all.
"""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxtune import windows
from jaxtune.gate import GateInfo, no_gate_log
from jaxtune.readings import Collected
from jaxtune.settings import Knobs, TunerConfig
from jaxtune.tuner import Info, Policy, Tuner, TunerState
from jaxtune.types import ParamDist, Trajectory
from jaxtune.update import no_update, vote_update


def open_gate(
    key: jax.Array, config: TunerConfig, collected: Collected, measured: Trajectory, knobs: Knobs
) -> GateInfo:
    """Accepts every measured set that holds living steps, all of them finite, without comparing it with anything.

    It takes the place of `gate.calibrated_gate` in the ungated baseline. Its `GateInfo` has novelty 0 at threshold 0,
    or novelty nan for any other set, which the tuner reports as `not_finite`. No verification model is trained.

    Args:
      key: not used.
      config: not used.
      collected: not used.
      measured: the measured set, [set_episodes, time].
      knobs: not used.
    """
    # Such a set must not move the centre; a novelty of nan ends the tuning as `not_finite`.
    finite = jnp.isfinite(windows.steps(measured)).all(axis=-1) | ~measured.alive
    usable = jnp.where(measured.alive.any() & finite.all(), 0.0, jnp.nan)
    return GateInfo(novelty=usable, threshold=jnp.zeros(()))


def voting(tuner: Tuner) -> Tuner:
    """Gives a tuner the paper's update, whose steps are meant for one measured set each."""
    config = dataclasses.replace(tuner.config, refinements=0)
    return dataclasses.replace(tuner, config=config, update=vote_update, replay=None)


def spm(tuner: Tuner) -> Tuner:
    """Makes the paper's ungated baseline from a tuner.

    The result keeps the tuner's settings and its functions for training, simulating and measuring. It replaces the gate
    by `open_gate` and the update by `vote_update`, so a comparison shows what gate and posterior add.
    """
    return dataclasses.replace(voting(tuner), verify=open_gate)


@dataclass(frozen=True, kw_only=True)
class Untuned:
    """Trains the policy in a distribution that never changes.

    Use it for domain randomisation or for the oracle; the distribution given to `init` decides which. One step trains
    for as long as a tuning of the wrapped tuner does, so its return can be compared with the tuner's after the same
    number of steps. It measures nothing, so the tuner's `measure` may be None.
    """

    tuner: Tuner

    def init(self, policy: Policy, dist: ParamDist, knobs: Knobs) -> TunerState:
        """Makes the state before the first step, as `Tuner.init` does.

        `dist` is the distribution that all training happens in. The knobs are carried along, so that states of all
        methods have one structure, but not used.
        """
        return self.tuner.init(policy, dist, knobs)

    def step(self, key: jax.Array, state: TunerState) -> tuple[TunerState, Info]:
        """Trains the policy for as long as one tuning of the wrapped tuner does.

        Returns the state with the new policy, and an `Info` in which no gate call and no update were made.
        """
        state, metrics = self.tuner.train(key, state)
        state, info = self.tune(key, state)
        return state, info.replace(train=metrics)

    def tune(self, key: jax.Array, state: TunerState, measured: Trajectory | None = None) -> tuple[TunerState, Info]:
        """Returns the state as it is, whatever was measured.

        It stands where `Tuner.tune` does in a loop over a target that is not JAX. The `Info` reports no gate call
        (`calls` is 0, verdicts are -1) and no update.
        """
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
