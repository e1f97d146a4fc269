"""The tuner for simulators that are not JAX: Gymnasium environments, MuJoCo C, Isaac Lab, or a program of one's own.

Gate and update are the same compiled functions; only the loop runs in Python, so that `simulate` may do anything. It is
given all robots at once, as a vector environment wants them; `one_by_one` makes it of a function that plays a single
episode:

    def play(seed, policy, coords):  # coords: numbers by name
        ...
        return {"observation": ..., "action": ..., "reward": ..., "terminated": ...}

    machine = HostTuner(config=TunerConfig(), simulate=one_by_one(play))
    state = machine.init(policy, first, knobs())
    state, info = machine.tune(jax.random.key(0), state, measured)

A distribution that changes compiles nothing anew. Where the robot's states are measured, `pieces_one_by_one` makes the
tuner's `replay` of a function that goes on from a given state.
"""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtune import loop
from jaxtune.checks import check_measured, check_set, check_states
from jaxtune.gate import Verify, calibrated_gate
from jaxtune.loop import Info
from jaxtune.misfits import Misfits, Phase, misfits, share_of_episode
from jaxtune.readings import cut_alike, examine
from jaxtune.settings import TunerConfig
from jaxtune.shooting import Replay
from jaxtune.tuner import Measure, TrainPolicy, Tuner, TunerState, keep
from jaxtune.types import Trajectory, Verdict
from jaxtune.update import Update, posterior_update

HostSimulate = Callable[[jax.Array, Any, dict[str, np.ndarray]], Trajectory]
"""`(key, policy, coords [episodes] by name) -> Trajectory [episodes, time]`, in NumPy or JAX; any Python."""


def one_by_one(
    play: Callable[[int, Any, dict[str, float]], Mapping[str, Any]], *, steps: int | None = None
) -> HostSimulate:
    """Makes a `simulate` that plays its episodes one after the other.

    Args:
      play: plays one episode, `(seed, policy, coords by name) -> episode`, as `Trajectory.from_episodes` reads them.
      steps: length of the episodes. That of the longest where None, which must then be the measured one too.
    """

    def simulate(key: jax.Array, policy: Any, coords: dict[str, np.ndarray]) -> Trajectory:
        robots = [dict(zip(coords, map(float, values), strict=True)) for values in zip(*coords.values(), strict=True)]
        seeds = np.asarray(jax.random.randint(key, (len(robots),), 0, 2**31 - 1))
        played = [play(int(seed), policy, robot) for seed, robot in zip(seeds, robots, strict=True)]
        return Trajectory.from_episodes(played, steps=steps)

    return simulate


def pieces_one_by_one(
    go_on: Callable[[dict[str, np.ndarray], np.ndarray, dict[str, float]], Mapping[str, Any]],
    read: Callable[[Mapping[str, jax.Array]], jax.Array] | None = None,
) -> Replay:
    """Makes a `replay` that simulates its pieces one after the other, in any Python.

    At least 20 times 8 (1 + coordinates) pieces are simulated for every piece that a measured set is cut into, and five
    times as many where the set fits badly (`jaxtune.replay`). Each has `ReplayConfig.window` control steps.

    Args:
      go_on: `(state by name, actions [steps, act], coords by name) -> state` after these control steps. States have the
        names and shapes of `Trajectory.state`.
      read: `state -> features` by which states are compared, traceable by JAX. All of their numbers where None.
    """
    read = read or _every_number
    # Devices of a mesh ask at once, and a simulator may have one state alone.
    lock = threading.Lock()

    def play_one(state, action, coords):
        ended = go_on(state, action, {name: float(value) for name, value in coords.items()})
        # Copied, as a simulator may return what it goes on to change.
        found = {name: np.array(ended[name], values.dtype) for name, values in state.items() if name in ended}
        for name, values in state.items():
            if name not in found or found[name].shape != values.shape:
                got = f"shape {found[name].shape}" if name in found else ", ".join(ended)
                raise ValueError(f"go_on, {name}: got {got}, expected shape {values.shape}, as of the state before")
        return found

    def play_batch(*batch):
        batch = jax.tree.map(np.asarray, batch)
        _, actions, _ = batch
        sizes = actions.shape[:-2]
        with lock:
            ended = [play_one(*jax.tree.map(lambda leaf, at=at: np.array(leaf[at]), batch)) for at in np.ndindex(sizes)]
        return jax.tree.map(lambda *leaves: np.stack(leaves).reshape(*sizes, *leaves[0].shape), *ended)

    def play(state, actions, coords):
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), state)
        return read(jax.pure_callback(play_batch, shapes, state, actions, coords, vmap_method="broadcast_all"))

    return Replay(play=play, read=read)


def _every_number(state: Mapping[str, jax.Array]) -> jax.Array:
    return jnp.concatenate([jnp.ravel(values) for values in jax.tree.leaves(state)])


@dataclass(frozen=True, kw_only=True)
class HostTuner:
    """Tunes the distribution of a simulator that JAX cannot trace; `jaxtune.tuner` has the algorithm.

    Attributes:
      config: sizes.
      simulate: simulates episodes of robots with given coordinates (`HostSimulate`).
      train_policy, measure, verify, update, phase: as in `Tuner`; the first two may be any Python as well.
      replay: as in `Tuner`; `pieces_one_by_one` makes one.
    """

    config: TunerConfig
    simulate: HostSimulate
    train_policy: TrainPolicy = keep
    measure: Measure | None = None
    verify: Verify = calibrated_gate
    update: Update = posterior_update
    replay: Replay | None = None
    phase: Phase = share_of_episode

    # The tuner's own functions; `step` calls the `tune` of this class.
    init, train, step = Tuner.init, Tuner.train, Tuner.step

    def run(self, key: jax.Array, state: TunerState, num_tunings: int) -> tuple[TunerState, Info]:
        """Does several tunings, as `Tuner.run` does, with their infos stacked."""
        infos = []
        for key_step in jax.random.split(key, num_tunings):
            state, info = self.step(key_step, state)
            infos.append(info)
        return state, jax.tree.map(lambda *leaves: np.stack(leaves), *infos)

    def tune(self, key: jax.Array, state: TunerState, measured: Trajectory) -> tuple[TunerState, Info]:
        """Does what `Tuner.tune` does, with the same keys, so that the same simulator gives the same answer.

        Raises:
          ValueError: episodes, simulated or measured, do not have the shapes that they should.
        """
        check_set(measured, self.config)
        if self.replay is not None:
            # Simulated states are looked at once there are some; what is known before should not take minutes.
            check_states(measured, measured, self.config, self.replay.needs)
        carry = loop.before(self.config, state.dist, state.past, self.replay is not None)

        def collect(carry):
            key_collect, *keys = jax.random.split(jax.random.fold_in(key, carry["rounds"]), 3)
            collected = self._tuner.collect(key_collect, state.policy, carry["dist"])
            check_measured(measured, collected.trajectory, self.config)
            if self.replay is not None:
                check_states(measured, collected.held_out, self.config, self.replay.needs)
            return *keys, cut_alike(collected, measured), loop.counted(carry, collected)

        while carry["left"] > 0:
            key_verify, key_update, collected, carry = collect(carry)
            # Once for gate and update.
            collected = collected.replace(reading=self._examine(collected, measured), past=carry["past"])
            if carry["verdict"] == Verdict.WIDEN:
                gate = self._verify(key_verify, collected, measured, state.knobs)
                carry = self._decide(carry, gate, state.knobs)
            if carry["verdict"] == Verdict.ACCEPT:
                updated = self._update(key_update, collected, measured, carry["dist"], state.knobs)
                carry = self._refine(carry, *updated, state.knobs)
        if carry["verdict"] == Verdict.ACCEPT and not carry["sharpened"]:
            _, key_update, collected, carry = collect(carry)
            carry = self._sharpen(key_update, carry, collected, measured, state.knobs)
        dist = loop.dist_after(carry, state.dist)
        return state.replace(dist=dist, past=loop.known_after(carry)), loop.make_info(carry, measured)

    def misfits(self, key: jax.Array, state: TunerState, measured: Trajectory) -> Misfits:
        """Says which observations and actions no parameters explain, and in which phase, as `Tuner.misfits` does."""
        collected = self._tuner.collect(key, state.policy, state.dist)
        return self._misfits(cut_alike(collected, measured), measured)

    @cached_property
    def _tuner(self) -> Tuner:
        def simulate(key, policy, coords):
            return self.simulate(key, policy, {name: np.asarray(values) for name, values in coords.items()})

        return Tuner(config=self.config, train_policy=self.train_policy, simulate=simulate, measure=self.measure)

    @cached_property
    def _examine(self):
        return jax.jit(partial(examine, self.config))

    @cached_property
    def _verify(self):
        return jax.jit(lambda key, *args: self.verify(key, self.config, *args))

    @cached_property
    def _update(self):
        return jax.jit(lambda key, *args: self.update(key, self.config, *args))

    @cached_property
    def _misfits(self):
        return jax.jit(partial(misfits, self.config, phase=self.phase))

    @cached_property
    def _refine(self):
        return jax.jit(partial(loop.refine, self.config))

    @cached_property
    def _sharpen(self):
        return jax.jit(partial(loop.sharpen, self.config, self.replay))

    @cached_property
    def _decide(self):
        return jax.jit(partial(loop.decide, self.config))
