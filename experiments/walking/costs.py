"""Where the time of a tuning goes, what more devices save of it, and its memory; `experiments.bench` prints them."""

import gc
import os
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import numpy as np

from envs.biteno import Drive, Motion, State
from envs.targets import mujoco_c
from envs.targets.host import Engine, HostTarget
from envs.targets.mjx import MjxTarget
from experiments.common import compiler
from experiments.common.config import Preset
from experiments.walking.learner import Learner, Policy
from experiments.walking.policies import starting_policy
from experiments.walking.robots import BITENO
from experiments.walking.work import peaks, work
from jaxtune import devices, dvm, readings, regression, tuner
from jaxtune import dist as dists
from jaxtune.mjx import parameters

_STEPS = 50  # in which the speed of MuJoCo C is measured
_SETTLED = 5  # tunings after which memory should be flat
_TIMES = 3  # runs of a program, of which the fastest counts
_ROLLOUTS, _UPDATES = "policy: rollouts", "policy: whole updates"

Track = Callable[[Collection], Iterable]
"""Goes through what is to be measured, and shows how far it is; `iter` shows nothing."""


def profile(sizes: Preset, policy: str, track: Track = iter) -> dict[str, dict]:
    """Times every part of a tuning of BITeno by itself, as one program each, on all devices.

    Args:
      sizes: of everything.
      policy: what walks, as `experiments.walking.policies.starting_policy` takes it.
      track: shows which part is timed.

    Returns:
      By part: `calls` in a tuning whose set is accepted at once, `compile_s` of its program where none is kept on disk,
      `run_s` of a call, `share` of the tuning's time without compilation, and limits: `limit_s`, what MuJoCo C takes
      for the same control steps on all cores (nan for parts that simulate nothing), and `flops_s` and `bytes_s`, what
      one device needs for the operations of a call, and for the data that they must read and write (`work`).
    """
    jax.config.update("jax_enable_compilation_cache", False)
    learner = Learner(sizes, BITENO.chosen("legs6"))
    start = starting_policy(policy, learner)
    rate, most = _physics_rate(learner, start), peaks()
    rows = {}
    for name, part in track(_parts(learner, start).items()):
        compile_s, run_s = _seconds(part.program, part.inputs)
        limit = np.nan if part.simulates is None else part.simulates / rate
        least = work(part.program, *part.inputs)
        limits = {"limit_s": limit, "flops_s": least.flops / most.flops, "bytes_s": least.moved / most.moved}
        rows[name] = {"calls": part.calls, "compile_s": compile_s, "run_s": run_s, **limits}
    learning = rows.pop(_UPDATES)
    for column in ("run_s", "flops_s", "bytes_s"):
        learning[column] -= rows[_ROLLOUTS][column]
    rows["policy: learning"] = learning
    whole = sum(row["calls"] * row["run_s"] for row in rows.values())
    return {name: row | {"share": row["calls"] * row["run_s"] / whole} for name, row in rows.items()}


@dataclass(frozen=True)
class _Part:
    """A part of a tuning that is timed by itself."""

    program: Callable
    inputs: tuple
    calls: int = 1
    """In a tuning whose set is accepted at once."""
    simulates: int | None = None
    """Control steps of a call."""


def _parts(learner: Learner, start: Policy) -> dict[str, _Part]:
    """All parts of a tuning of BITeno, by name."""
    sizes, key = learner.preset, jax.random.PRNGKey(0)
    machine, config = learner.tuner(), sizes.tuner
    dist = learner.dist(parameters.nominal(learner.entries), 0.2)
    target = MjxTarget(robot=learner.robot, params=parameters.nominal(learner.entries))
    keys = jax.random.split(key, sizes.ppo.num_envs)

    def sets(score):
        """Scores all held-out sets, and the measured one."""
        return lambda model, collected, measured: (
            devices.in_chunks(score, (collected.held_out,), readings.SETS, shared=(model,)),
            score(model, measured),
        )

    def episodes(count, steps):
        return lambda policy: target.episodes(key, learner.act(policy), count, steps)

    def train_dvm(data):
        return dvm.train(key, config.dvm, data.trajectory)[0]

    def regress(data):
        return regression.train(config.regression, data.trajectory, data.sampled_coords, dist)

    steps, count = sizes.episode_steps, config.episodes + config.held_out_sets * config.set_episodes
    measure, simulate = episodes(config.set_episodes, steps), lambda policy: machine.collect(key, policy, dist)
    measured, collected = compiled(measure)(start), compiled(simulate)(start)
    gate, model = (compiled(program)(collected) for program in (train_dvm, regress))
    novelty, estimate = partial(dvm.novelty, config.dvm), partial(regression.estimate, config.regression)
    return {
        "measured episodes": _Part(measure, (start,), simulates=config.set_episodes * steps),
        "simulated episodes": _Part(simulate, (start,), simulates=count * steps),
        "verification model": _Part(train_dvm, (collected,)),
        "its scores": _Part(sets(novelty), (gate, collected, measured)),
        "regression": _Part(regress, (collected,)),
        "its estimates": _Part(sets(estimate), (model, collected, measured)),
        _ROLLOUTS: _Part(learner.collect, (keys, start), sizes.epochs, sizes.ppo.steps_per_update),
        _UPDATES: _Part(lambda policy: learner.train(key, policy, dist, 1), (start,), sizes.epochs),
        "evaluation": _Part(
            episodes(sizes.evaluation_episodes, learner.longest),
            (start,),
            simulates=sizes.evaluation_episodes * learner.longest,
        ),
    }


def on_devices(sizes: Preset, policy: str, track: Track = iter) -> dict[str, dict]:
    """Measures steps per second of episodes and of training on one device, two, four and so on, up to all.

    Numbers of devices take turns, and the fastest of three calls counts.

    Args:
      sizes: of everything.
      policy: what walks, as `experiments.walking.policies.starting_policy` takes it.
      track: shows which round it is.

    Returns:
      By number of devices: steps per second of both, and how many times as many as on one device.
    """
    key = jax.random.PRNGKey(0)
    learner = Learner(sizes, BITENO.chosen("legs6"))
    dist = learner.dist(parameters.nominal(learner.entries), sizes.policy_radius)
    draws = dists.sample(key, dist, sizes.tuner.episodes)
    programs = {
        "episodes": jax.jit(lambda policy: learner.simulate(key, policy, draws)),
        "training": jax.jit(lambda policy: learner.train(key, policy, dist, sizes.chunk)),
    }
    start, seconds = starting_policy(policy, learner), {}
    for count in (2**n for n in range(len(jax.devices()).bit_length())):
        seconds[count] = {name: [] for name in programs}
    for _ in track(range(4)):
        for count, found in seconds.items():
            for name, program in programs.items():
                with jax.set_mesh(devices.mesh(count)):
                    begin = time.monotonic()
                    jax.block_until_ready(program(start))
                found[name].append(time.monotonic() - begin)
    steps = {
        "episodes": sizes.tuner.episodes * learner.preset.episode_steps,
        "training": sizes.chunk * sizes.ppo.steps_per_update,
    }
    rows = {}
    for count, found in seconds.items():
        best = {name: min(values[1:]) for name, values in found.items()}
        rows[str(count)] = {f"{name}_per_second": steps[name] / best[name] for name in steps}
        rows[str(count)] |= {f"{name}_gain": min(seconds[1][name][1:]) / best[name] for name in steps}
    return rows


def memory(sizes: Preset, policy: str, tunings: int = 50, track: Track = iter) -> dict[str, dict]:
    """Measures the resident memory of this process over many tunings, each with its training.

    Args:
      sizes: of everything.
      policy: what walks first.
      tunings: number of them.
      track: shows which tuning it is.

    Returns:
      By number of the tuning, from 1: `resident_mib`, and `growth`, that since the fifth tuning as a share of it. By
      then everything is compiled and allocated.
    """
    learner = Learner(sizes, BITENO.chosen("legs6"))
    play = learner.play(MjxTarget(robot=learner.robot, params=parameters.nominal(learner.entries)))
    machine = learner.tuner()
    step = learner.step(machine, play)
    dist = learner.dist(parameters.nominal(learner.entries), 0.2)
    state, resident = machine.init(starting_policy(policy, learner), dist, tuner.knobs()), []
    for number in track(range(tunings)):
        state, _ = step(jax.random.PRNGKey(number), state)
        jax.block_until_ready(state)
        gc.collect()
        resident.append(_resident())
    settled = resident[min(_SETTLED, tunings) - 1]
    return {
        str(number + 1): {"resident_mib": size / 2**20, "growth": size / settled - 1.0}
        for number, size in enumerate(resident)
        if number % 5 == 4 or number == 0
    }


def _resident() -> int:
    """Bytes of this process in memory (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def compiled(program: Callable) -> Callable:
    """Compiles a program for all devices."""
    return devices.on_all(jax.jit(program))


def _seconds(program: Callable, inputs: tuple) -> tuple[float, float]:
    """Seconds to trace and compile a program, and the fewest in which it runs."""
    # A function of its own: JAX keeps what it compiled for another.
    fresh = jax.jit(lambda *args: program(*args))
    begin = time.monotonic()
    built = compiler.ahead(fresh)(*inputs)
    moments, run = [time.monotonic()], devices.on_all(built)
    for _ in range(_TIMES):
        jax.block_until_ready(run(*inputs))
        moments.append(time.monotonic())
    return moments[0] - begin, float(np.diff(moments).min())


def _physics_rate(learner: Learner, policy: Policy) -> float:
    """Control steps a second of MuJoCo C on all cores, its physics alone, while a policy walks."""
    nominal = parameters.nominal(learner.entries)
    engine = _Timed(mujoco_c.MujocoC(learner.robot, nominal))
    HostTarget(learner.robot, nominal, engine).episodes(
        jax.random.PRNGKey(0), learner.act(policy), learner.preset.ppo.num_envs, _STEPS
    )
    return learner.preset.ppo.num_envs / float(np.median(engine.seconds))


class _Timed:
    """An engine that notes how long every step takes."""

    def __init__(self, engine: Engine):
        self._engine, self.start, self.seconds = engine, engine.start, []

    def move(self, state: State, drive: Drive) -> Motion:
        begin = time.monotonic()
        motion = jax.block_until_ready(self._engine.move(state, drive))
        self.seconds.append(time.monotonic() - begin)
        return motion
