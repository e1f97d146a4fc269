"""The tuner for simulators that are not JAX: Gymnasium environments, MuJoCo C, Isaac Lab, or a program of one's own.

Gate and update are the same compiled functions; only the loop runs in Python, so that `simulate` may do anything:

    def simulate(key, policy, coords):  # coords: NumPy arrays by name, [episodes] each
        seeds = jax.random.randint(key, (len(coords["mass"]),), 0, 2**31 - 1)
        played = [play(int(seed), mass) for seed, mass in zip(seeds, np.exp(coords["mass"]))]
        return Trajectory.from_episodes(played, steps=200)

    machine = HostTuner(config=TunerConfig(), simulate=simulate)
    state = TunerState(policy=policy, dist=first, knobs=knobs())
    state, info = machine.tune(jax.random.key(0), state, measured)

A distribution that changes compiles nothing anew.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np

from jaxtune.checks import check_measured
from jaxtune.rules import TunerConfig, Update, Verify, calibrated_gate, no_update, posterior_update
from jaxtune.tuner import Info, Tuner, TunerState, keep, make_info
from jaxtune.types import Trajectory, Verdict

HostSimulate = Callable[[jax.Array, Any, dict[str, np.ndarray]], Trajectory]
"""`(key, policy, coords [episodes] by name) -> Trajectory [episodes, time]`, in NumPy or JAX; any Python."""


@dataclass(frozen=True, kw_only=True)
class HostTuner:
    """Tunes the distribution of a simulator that JAX cannot trace; `jaxtune.tuner` has the algorithm.

    Attributes:
      config: sizes.
      simulate: simulates episodes of robots with given coordinates (`HostSimulate`).
      verify, update: as in `Tuner`.
    """

    config: TunerConfig
    simulate: HostSimulate
    verify: Verify = calibrated_gate
    update: Update = posterior_update

    def tune(self, key: jax.Array, state: TunerState, measured: Trajectory) -> tuple[TunerState, Info]:
        """Does what `Tuner.tune` does, with the same keys, so that the same simulator gives the same answer.

        Raises:
          ValueError: episodes, simulated or measured, do not have the shapes that they should.
        """
        key_gate, key_update = jax.random.split(key)
        carry = self._tuner.before(state.dist)
        while carry["verdict"] == Verdict.WIDEN:
            key_collect, key_verify = jax.random.split(jax.random.fold_in(key_gate, carry["calls"]))
            collected = self._tuner.collect(key_collect, state.policy, carry["dist"])
            check_measured(measured, collected.trajectory, self.config)
            gate = self._verify(key_verify, collected, measured, state.knobs)
            carry = self._decide(carry, collected, gate, state.knobs)
        moved, update = carry["dist"], no_update(carry["dist"])
        if carry["verdict"] == Verdict.ACCEPT:
            moved, update = self._update(key_update, collected, measured, carry["dist"], state.knobs)
        return state.replace(dist=moved), make_info(carry, update, measured)

    @cached_property
    def _tuner(self) -> Tuner:
        def simulate(key, policy, coords):
            return self.simulate(key, policy, {name: np.asarray(values) for name, values in coords.items()})

        return Tuner(config=self.config, train_policy=keep, simulate=simulate)

    @cached_property
    def _verify(self):
        return jax.jit(lambda key, *args: self.verify(key, self.config, *args))

    @cached_property
    def _update(self):
        return jax.jit(lambda key, *args: self.update(key, self.config, *args))

    @cached_property
    def _decide(self):
        return jax.jit(self._tuner.decide)
