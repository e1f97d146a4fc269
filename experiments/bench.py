"""Measures speeds: `python -m experiments.bench speed`, or another of `Args.what`.

Speeds depend on the machine and on what else it does, so compare only ratios within one run. No test asserts them.
"""

import dataclasses
import itertools
import resource
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from mujoco import mjx
from rich.table import Table

from envs import models, stepping
from envs.biteno import constants
from envs.logs import Controller, Log, Run, read, write
from envs.logs.tables import WRITERS
from envs.rig import Rig
from experiments.common import checkpoint, compiler, files
from experiments.common.cli import bars, console, run
from experiments.common.config import Preset, preset
from experiments.walking import costs, estimates, foreign, memory
from experiments.walking.costs import Track
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from experiments.walking.robots import BITENO
from experiments.walking.targets import TARGETS
from jaxtune import devices, tuner
from jaxtune.mjx import parameters

_SIDE_BY_SIDE, _STEPS = 64, 200  # robots and steps of `rig`
_LINE_SEARCHES = 6  # of MJX's solver, the fewest with which dry friction comes out right


@dataclass(frozen=True, kw_only=True)
class Args:
    """Measures one thing, prints it as a table and writes it as JSON."""

    what: tyro.conf.Positional[
        Literal["speed", "devices", "profile", "estimates", "memory", "targets", "rig", "logs", "tuner"]
    ]
    """speed: training steps per second, with exact and fast physics. devices: steps per second of episodes and of
    training on one device, two, four and so on. profile: where the time of a tuning goes. estimates: errors of the
    regression, of a one-step model and of the search-parameter model, also of raw steps and of five models, on the
    same episodes.
    memory: resident memory of this process over 50 tunings with training. targets: simulation steps per second of
    every engine that is installed. rig: simulation steps per second of suspended robots, with the step of MJX and
    with that of discovery. logs: seconds to read ten minutes of 40 columns at 1 kHz. tuner: seconds to compile and
    to run a tuning, and four runs side by side, of the CheetahRun of MuJoCo Playground."""
    out: Path = Path("runs/bench")
    """Folder of the results, a JSON file for each measurement."""
    preset: str = "cpu"
    """Size of the run: smoke (seconds, to see that it works), cpu (two cores) or gpu (one GPU)."""
    envs: tuple[int, ...] = ()
    """Numbers of environments of speed; the preset's if not given."""
    physics: tuple[Literal["exact", "fast"], ...] = ("exact", "fast")
    """Physics of speed."""
    policy: str = "walk"
    """Policy that walks: walk (ships with the package), or a folder of experiments.train."""
    seeds: tuple[int, ...] = tuple(range(10))
    """Random seeds of estimates; each is a tuning with episodes and models of its own."""
    radius: float = 0.2
    """Radius (half width) of the distribution in estimates, in log space: 0.2 spans 0.82 to 1.22."""
    noise: float = 0.0
    """Factor of the uniform noise of biteno's simulated sensors in estimates; sim2real has 0.2."""


def speed(args: Args, track: Track) -> dict:
    """Measures environment steps per second of whole PPO updates (rollout and learning).

    The first call compiles and is listed separately. The speed is that of the fastest of three further calls, because
    other work on the machine can only slow a call down.

    Returns:
      `first_call_s` and `steps_per_second` by physics and number of environments.
    """
    rows, sizes = {}, preset(args.preset)
    for physics, envs in track(list(itertools.product(args.physics, args.envs or (sizes.ppo.num_envs,)))):
        sizes = dataclasses.replace(
            sizes,
            task=dataclasses.replace(sizes.task, physics=physics),
            ppo=dataclasses.replace(sizes.ppo, num_envs=envs),
        )
        learner = Learner(sizes, BITENO.chosen("legs6"))
        dist = learner.dist(parameters.nominal(learner.entries), sizes.policy_radius)
        memory.check(learner)
        train = devices.on_all(
            jax.jit(
                lambda key, policy, learner=learner, dist=dist: learner.train(key, policy, dist, learner.preset.chunk)
            )
        )
        policy, key = learner.init(jax.random.PRNGKey(0)), jax.random.PRNGKey(1)
        seconds = []
        for _ in range(4):
            begin = time.monotonic()
            policy, _ = jax.block_until_ready(train(key, policy))
            seconds.append(time.monotonic() - begin)
        steps = sizes.chunk * sizes.ppo.steps_per_update
        rows[f"{physics}, {envs} environments"] = {
            "first_call_s": seconds[0],
            "steps_per_second": steps / min(seconds[1:]),
        }
    return rows


def targets(args: Args, track: Track) -> dict:
    """Measures steps per second of whole episodes in every engine that is installed, at sub-steps of 1 ms.

    It plays a policy that walks, because a robot that falls at once makes an engine look fast.

    Returns:
      By engine: `first_call_s` (compilation included), policy and physics steps per second of the second call.
    """
    sizes = preset(args.preset)
    sizes = dataclasses.replace(sizes, task=dataclasses.replace(sizes.task, physics="exact"))
    learner = Learner(sizes, BITENO.chosen("foot_friction"))
    policy = starting_policy(args.policy, learner)
    rows = {}
    for name, make in track(TARGETS.items()):
        try:
            play = learner.play(make(learner.robot, parameters.nominal(learner.entries)))
        except ValueError as error:
            console.print(f"left out: {error}", markup=False)
            continue
        seconds = []
        for _ in range(2):
            begin = time.monotonic()
            jax.block_until_ready(play(jax.random.PRNGKey(0), policy, sizes.ppo.num_envs, sizes.episode_steps))
            seconds.append(time.monotonic() - begin)
        speed = sizes.ppo.num_envs * sizes.episode_steps / seconds[1]
        physics = speed * learner.robot.substeps
        rows[name] = {"first_call_s": seconds[0], "steps_per_second": speed, "physics_steps_per_second": physics}
    return rows


def rig(args: Args, track: Track) -> dict:
    """Measures simulation steps per second of suspended robots: 64 of each side by side, on one core.

    Returns:
      By robot: steps per second by MJX's own step and by that of the rig, and their ratio.
    """
    del args
    robots = {
        "pendulum": (models.spec("pendulum"), ("hinge",)),
        "arm": (mujoco.MjSpec.from_file(str(Path(__file__).parent / "arm.xml")), ("shoulder", "elbow")),
        "biteno": (models.spec("biteno"), constants.JOINTS),
    }
    rows = {}
    for name, (spec, joints) in track(robots.items()):
        model, start = jax.device_put(Rig(spec, joints, control_hz=200.0).system)
        model = model.tree_replace({"opt.ls_iterations": _LINE_SEARCHES})
        poses = start.qpos + np.random.default_rng(0).normal(scale=0.1, size=(_SIDE_BY_SIDE, model.nq))
        found = {}
        for key, step in (("mjx", mjx.step), ("rig", stepping.step)):

            def end(pose, model=model, start=start, step=step):
                data = start.replace(qpos=pose)
                return jax.lax.fori_loop(0, _STEPS, lambda _, data: step(model, data), data).qpos

            compiled, seconds = jax.jit(jax.vmap(end)), []
            for _ in range(4):
                begin = time.monotonic()
                jax.block_until_ready(compiled(jnp.asarray(poses, jnp.float32)))
                seconds.append(time.monotonic() - begin)
            found[key] = _SIDE_BY_SIDE * _STEPS / min(seconds[1:])
        rows[name] = {**found, "ratio": found["rig"] / found["mjx"]}
    return rows


def logs(args: Args, track: Track) -> dict:
    """Measures how long it takes to read a log of ten minutes, 40 columns and 1 kHz (a hundredth of it with `smoke`).

    Returns:
      `seconds`, `rows` and `columns` by file format.
    """
    rows, joints = 600_000 // (100 if args.preset == "smoke" else 1), constants.JOINTS
    rng = np.random.default_rng(0)
    signals = {name: rng.standard_normal((rows, len(joints))) for name in ("q", "dq", "target", "tau", "action")}
    signals |= {name: rng.standard_normal((rows, 3)) for name in ("gyro", "acc", "vel")}
    gains = {name: np.full(len(joints), 60.0) for name in ("kp", "kd", "torque_limit_nm")}
    run = Run(
        name="run_000",
        condition="any",
        split=None,
        controller=Controller(kind="pd", rate_hz=1000.0, gains=gains),
        time=1e-3 * np.arange(rows),
        signals=signals,
    )
    log = Log(robot="biteno", base="fixed", rate_hz=1000.0, joints=joints, policy=None, runs=(run,))
    found = {}
    for suffix in track(WRITERS):
        with tempfile.TemporaryDirectory() as folder:
            write(log, Path(folder) / "log", suffix)
            begin = time.monotonic()
            read(Path(folder) / "log")
            found[suffix] = {"seconds": time.monotonic() - begin, "rows": rows, "columns": 1 + 5 * len(joints) + 9}
    return found


def _noisy(sizes: Preset, args: Args) -> Preset:
    return dataclasses.replace(sizes, task=dataclasses.replace(sizes.task, noise=args.noise))


def tuner_programs(args: Args, track: Track) -> dict:
    """Measures compiling and running of `Tuner.tune`, and of `Tuner.run` vmapped over four seeds.

    The robot is `CheetahRun` with four parameters and a delay, and a policy that stays as it is. A tuning has the
    preset's sizes, and the runs have those of a sweep. Nothing comes from the cache of compiled programs.

    Returns:
      By program: seconds to trace, compile and run it, gate calls and tunings that ran.
    """
    foreign.check("cheetah")
    jax.config.update("jax_enable_compilation_cache", False)
    sizes, sim = preset(args.preset), foreign.cheetah()
    weights = 0.5 * np.random.default_rng(0).normal(size=(sim.action_size, sim.observation_size))
    act = lambda policy, obs, key: jnp.tanh(policy @ obs)  # noqa: E731
    truth = {"torso": 1.4, "damping": 0.75, "gear": 0.9, "friction": 1.2, "delay": 0.01}

    def machine(config):
        measure = sim.measure(act, truth, config.set_episodes)
        return tuner.Tuner(config=config, train_policy=tuner.keep, simulate=sim.simulate(act), measure=measure)

    one, several = machine(sizes.tuner), machine(sizes.sweep)
    state = one.init(jnp.asarray(weights, jnp.float32), sim.dist(0.4), tuner.knobs())
    measured = jax.jit(one.measure)(jax.random.key(1), state.policy)
    runs = jax.vmap(lambda key: several.run(key, state, sizes.sweep_tunings))
    programs = {
        "tune": (jax.jit(one.tune), (jax.random.key(0), state, measured)),
        "run, four seeds": (jax.jit(runs), (jax.random.split(jax.random.key(0), 4),)),
    }
    rows = {}
    for name, (program, inputs) in track(programs.items()):
        moments = [time.monotonic()]
        lowered = program.lower(*inputs)
        moments.append(time.monotonic())
        compiled = lowered.compile()
        moments.append(time.monotonic())
        _, info = jax.block_until_ready(compiled(*inputs))
        moments.append(time.monotonic())
        seconds = dict(zip(("trace_s", "compile_s", "run_s"), np.diff(moments).tolist(), strict=True))
        rows[name] = {**seconds, "gate_calls": int(info.calls.sum()), "tunings": info.calls.size}
    return rows


MEASURES = {
    "speed": speed,
    "devices": lambda args, track: costs.on_devices(preset(args.preset), args.policy, track),
    "profile": lambda args, track: costs.profile(preset(args.preset), args.policy, track),
    "estimates": lambda args, track: estimates.compare(
        _noisy(preset(args.preset), args), args.policy, args.radius, args.seeds, track
    ),
    "memory": lambda args, track: costs.memory(preset(args.preset), args.policy, track=track),
    "targets": targets,
    "rig": rig,
    "logs": logs,
    "tuner": tuner_programs,
}


def main(args: Args) -> None:
    """Measures one thing, prints a table, and writes it as JSON with the time and the memory that it took."""
    if args.what == "rig":
        compiler.set_up(compiler.for_simulation(), most=1)
    else:
        compiler.set_up(preset(args.preset).xla_flags)
    checkpoint.check_writable(args.out)
    begin = time.monotonic()
    with bars() as progress:
        rows = MEASURES[args.what](args, partial(progress.track, description=args.what))
    table = Table(title=args.what)
    for column in ("", *next(iter(rows.values()))):
        table.add_column(column)
    for name, row in rows.items():
        table.add_row(name, *(np.array2string(np.asarray(value), precision=2) for value in row.values()))
    console.print(table)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    result = {
        "args": args,
        "rows": rows,
        "seconds": time.monotonic() - begin,
        "peak_gib": peak,
        "versions": checkpoint.versions(),
    }
    files.write_json(args.out / f"{args.what}.json", result)


if __name__ == "__main__":
    run(main, Args)
