"""Simulated null logs: what a measured log would look like if the model lacked nothing.

Discovery accepts an effect only if it improves the measured log by more than effects improve null logs. Among many
effects one always improves the fit a little, because it imitates differences that are not physics: an engine's step,
its integrator, the moment at which a controller reads the joint. A null log therefore has such differences too:

- MuJoCo C simulates the nominal model with half the step, another integrator and a controller whose ticks jitter;
- its masses, inertias, armatures, dampings, frictions and springs are drawn from the prior, its controller's gains
  are those of the log;
- if it is unknown whether targets are held between rows, or move on in straight lines, one of them is drawn;
- half of all controllers act on readings with the noise and the rounding of the logged ones, as those robots' do whose
  logs hold what their controllers read;
- the readings get the noise, the rounding, the times and the repetitions that are found in the measured log, column by
  column.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from mujoco import rollout

from envs import sensing
from envs.axes import loose
from envs.logs import Log, Run
from envs.logs.controller import Impedance
from envs.models import suspended
from envs.readings import hermite, noise_of, read_later, rounding_of, stale
from envs.smoothing import smoothed

_STEP_S = 0.0005  # half the step of `Rig`
_HOLDS = 0.999  # impedance of friction that holds (MuJoCo's `solimpfriction`)
_SPREAD = 0.1  # standard deviation of the logarithm of every drawn parameter, as in `Axis.prior_sd`


def simulate_null_logs(log: Log, spec: mujoco.MjSpec, count: int, seed: int) -> list[Log]:
    """Simulates logs in which no effect is missing, with the targets and conditions of a measured one.

    All runs of all logs are simulated side by side.

    Args:
      log: the measured log; its targets are played again and its noise is imitated.
      spec: MJCF of the nominal robot.
      count: number of logs.
      seed: of the drawn parameters, the controller's jitter and the noise. Other seeds give other null logs.

    Returns:
      Logs of the same runs, joints and signals. Signals of the controller (targets, supply, enabling) are copied,
      signals of sensors are simulated.
    """
    robots = [Robot.drawn(spec, log.joints, np.random.default_rng(seed + number)) for number in range(count)]
    pairs = [(robot, run) for robot in robots for run in log.runs]
    played = play(pairs, log.joints) if pairs else []
    runs = [as_recorded(robot, run, motion) for (robot, run), motion in zip(pairs, played, strict=True)]
    each = len(log.runs)
    return [replace(log, runs=tuple(runs[start : start + each])) for start in range(0, len(runs), each)]


@dataclass(frozen=True)
class Robot:
    """One robot that lacks nothing: its model, how its targets go on between rows, its random numbers, and whether its
    controller acts on noisy readings."""

    model: mujoco.MjModel
    linear: bool
    rng: np.random.Generator
    noisy: bool = False

    @staticmethod
    def drawn(spec: mujoco.MjSpec, joints: Sequence[str], rng: np.random.Generator) -> "Robot":
        """Draws a robot from the prior. Where a log does not say how targets go on, half of all robots go straight."""
        model = _drawn(spec, joints, rng)
        linear, noisy = rng.integers(0, 2, 2).astype(bool)
        return Robot(model, bool(linear), rng, bool(noisy))

    def goes_straight(self, run: Run) -> bool:
        """Whether targets, or torques that were sent, move to the next row in a straight line; else they are held."""
        unknown = self.linear and "target" in run.signals
        return {"hold": False, "linear": True, "unknown": unknown}[run.controller.between_rows]


@dataclass(frozen=True)
class Motion:
    """A simulated run where its controller looked: times [n], states [n, 2, joints], torques [n, joints]."""

    times: np.ndarray
    states: np.ndarray
    torques: np.ndarray


def _drawn(spec: mujoco.MjSpec, joints: Sequence[str], rng: np.random.Generator) -> mujoco.MjModel:
    """Compiles the nominal model with its parameters drawn from the prior, suspended and without actuators."""
    model = suspended(spec, joints)
    model.opt.timestep = _STEP_S
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The controller's torque is applied to the joints directly, so the model's own actuators are switched off.
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    # A heavier link of the same shape has an inertia that grows in proportion, but its shape is not known better.
    masses = _factors(rng, model.nbody)
    model.body_mass[:] *= masses
    # A controller that carries the links' weight carries that of the nominal ones.
    model.body_gravcomp[:] /= masses
    model.body_inertia[:] *= (masses * _factors(rng, model.nbody))[:, None]
    for name in ("dof_armature", "dof_damping", "dof_frictionloss"):
        getattr(model, name)[:] *= _factors(rng, model.nv)
    shifts = rng.standard_normal((model.nbody, 3)).clip(-2.0, 2.0)
    model.body_ipos[:] += loose(model.body_mass, model.body_inertia)[:, None] * shifts
    if model.jnt_stiffness.any():
        model.jnt_stiffness[:] *= _factors(rng, model.njnt)
    # Half of all robots have friction that holds, and half the engine's, which creeps under a load.
    if rng.integers(0, 2):
        model.dof_solimp[:, :2] = np.maximum(model.dof_solimp[:, :2], _HOLDS)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _factors(rng: np.random.Generator, count: int) -> np.ndarray:
    # Cut at two standard deviations: a null log should be a plausible robot.
    return np.exp(_SPREAD * rng.standard_normal(count).clip(-2.0, 2.0))


def play(pairs: Sequence[tuple[Robot, Run]], joints: Sequence[str]) -> list[Motion]:
    """Plays runs' targets (or their torques, where they have no targets) on models in MuJoCo C, all side by side.

    The controller's law is `envs.logs.Controller`'s. It reads the joint at its own rate, each time up to one step of
    the physics early or late, because a robot's ticks and a simulation's steps never coincide.

    Args:
      pairs: what is moved, and the measured run that gives targets, controller, time stamps and the first state. All
        runs have one controller rate.
      joints: names of the joints, in the log's order.

    Returns:
      The motion of every pair.
    """
    models, first = [robot.model for robot, _ in pairs], pairs[0][0].model
    qpos = np.array([first.joint(name).qposadr[0] for name in joints])
    dof = np.array([first.joint(name).dofadr[0] for name in joints])
    rate = pairs[0][1].controller.rate_hz
    steps = int(np.ceil(1.0 / rate / _STEP_S - 1e-9))
    for model in models:
        model.opt.timestep = 1.0 / rate / steps
    longest = max(run.time[-1] - run.time[0] for _, run in pairs)
    rng = pairs[0][0].rng
    # Jitter does not add up: a tick that comes early is followed by a longer interval.
    gaps = steps + np.diff(rng.integers(0, min(steps, 2), int(np.ceil(longest * rate)) + 3))
    looks = first.opt.timestep * np.concatenate([[0], np.cumsum(gaps)])
    # When a controller ticks is its own matter, but the same in all runs of a robot.
    phases = {id(robot): robot.rng.uniform(0.0, 1.0 / rate) for robot, _ in pairs}
    times = np.array([run.time[0] + phases[id(robot)] + looks for robot, run in pairs])
    drive = _Drive([run for _, run in pairs], times, [robot.goes_straight(run) for robot, run in pairs])
    reads = {name: _Sensors(pairs, name, len(joints)) for name in ("q", "dq")}
    size = mujoco.mj_stateSize(first, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    # Many robots begin a run alike; smoothed, so that noise there does not become an error of the start.
    begins = {number: smoothed(run)[0] for number, run in {id(run): run for _, run in pairs}.items()}
    state = np.stack([_state_of(robot.model, *begins[id(run)], qpos, dof) for robot, run in pairs])
    found = np.empty((len(looks), len(pairs), 2, len(joints)))
    torques = np.empty((len(looks), len(pairs), len(joints)))
    held, control = np.zeros((len(pairs), len(joints))), np.zeros((len(pairs), steps + 1, first.nv))
    data = [mujoco.MjData(first) for _ in range(os.cpu_count() or 1)]
    # The state is time, positions, velocities.
    at_q, at_v = 1 + qpos, 1 + first.nq + dof
    with rollout.Rollout(nthread=len(data)) as pool:
        for look in range(len(looks)):
            # Positions of a semi-implicit step are half a step ahead of velocities, as on the rig (`Chain.lead_s`).
            q, dq = state[:, at_q] - 0.5 * first.opt.timestep * state[:, at_v], state[:, at_v]
            held = drive.torque(look, reads["q"](q, rng), reads["dq"](dq, rng))
            brake = drive.back_emf(look) * dq
            found[look, :, 0], found[look, :, 1], torques[look] = q, dq, held - brake
            if look == len(gaps):
                break
            count = int(gaps[look])
            control[..., dof] = (held - brake)[:, None]
            after = np.empty((len(pairs), count, size))
            pool.rollout(
                models,
                data,
                state,
                np.ascontiguousarray(control[:, :count]),
                control_spec=mujoco.mjtState.mjSTATE_QFRC_APPLIED,
                nstep=count,
                state=after,
                skip_checks=True,
            )
            state = np.ascontiguousarray(after[:, -1])
    return [Motion(times[index], found[:, index], torques[:, index]) for index in range(len(pairs))]


def _state_of(
    model: mujoco.MjModel, position: np.ndarray, velocity: np.ndarray, qpos: np.ndarray, dof: np.ndarray
) -> np.ndarray:
    """The state of a model whose joints have these positions and velocities."""
    data = mujoco.MjData(model)
    data.qpos[qpos], data.qvel[dof] = position + 0.5 * model.opt.timestep * velocity, velocity
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state


class _Drive:
    """What the controllers of many runs command at each of their ticks.

    Args:
      runs: one for every simulation.
      times: [runs, ticks] s.
      straight: whether each run's targets move on between rows.
    """

    def __init__(self, runs: Sequence[Run], times: np.ndarray, straight: Sequence[bool]):
        rows = [_last_row(run, own) for run, own in zip(runs, times, strict=True)]
        laws = [run.impedance()[row] for run, row in zip(runs, rows, strict=True)]
        # Of the others, torques were sent.
        self._driven = np.array(["target" in run.signals for run in runs])[:, None]
        by_tick = lambda values: np.stack(values, axis=1)  # noqa: E731
        self._law = Impedance(
            stiffness=by_tick([law.stiffness for law in laws]),
            damping=by_tick([law.damping for law in laws]),
            limit=by_tick([law.limit for law in laws]),
            back_emf=by_tick([law.back_emf for law in laws]),
        )
        each = zip(runs, times, rows, straight, strict=True)
        self._wanted = by_tick([_sent(*one) for one in each])

    def torque(self, look: int, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Torques [runs, joints] that are commanded at a tick, of positions and velocities as they are read."""
        wanted = self._wanted[look]
        return np.where(self._driven, self._law[look].torque(wanted, q, dq), wanted)

    def back_emf(self, look: int) -> np.ndarray:
        """By how much each motor brakes with its velocity, [runs, joints] Nm s/rad."""
        return self._law[look].back_emf


class _Sensors:
    """What the controllers of many robots read: the joints' exact states, or with the log's noise and rounding.

    Args:
      pairs: robots, and the runs that they play.
      signal: `q` or `dq`.
      joints: their number.
    """

    def __init__(self, pairs: Sequence[tuple[Robot, Run]], signal: str, joints: int):
        self._white, self._quantum = np.zeros((2, len(pairs), joints))
        for index, (robot, run) in enumerate(pairs):
            # Whatever takes the place of an unknown controller follows measured motion, which has its noise already.
            if robot.noisy and signal in run.signals and run.controller.kind != "unknown":
                self._white[index], self._quantum[index] = _white(run, signal), rounding_of(run, signal)

    def __call__(self, exact: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Reads exact values [robots, joints]."""
        return _sensed(exact, self._white, self._quantum, rng)


def as_recorded(robot: Robot, run: Run, motion: Motion) -> Run:
    """Makes a run of a motion, with the signals that the measured one has, read by sensors like its own."""
    level = np.asarray(sensing.resting_gravity(robot.model))
    exact = {
        "q": motion.states[:, 0],
        "dq": motion.states[:, 1],
        "tau": motion.torques,
        "abs_tau": motion.torques,
        "gravity": np.tile(level, (len(motion.times), 1)),
    }
    # Without targets the torques are what was sent, not what was measured.
    sensed = [name for name in exact if name in run.signals and ("target" in run.signals or name != "tau")]
    read = {name: _as_read(run, name, motion, exact[name], robot.rng) for name in sensed}
    return replace(run, signals={**run.signals, **read})


def _last_row(run: Run, times: np.ndarray) -> np.ndarray:
    """The last row at or before each time."""
    return np.clip(np.searchsorted(run.time, times + 1e-9, side="right") - 1, 0, len(run.time) - 1)


def _sent(run: Run, times: np.ndarray, last: np.ndarray, linear: bool) -> np.ndarray:
    """Returns what is sent at other times than the rows', [times, joints]: targets in rad, without these torques."""
    sent = run.signals["target"] if "target" in run.signals else run.sent_torque()
    if not linear:
        return sent[last]
    return np.stack([np.interp(times, run.time, column) for column in sent.T], axis=1)


def _as_read(run: Run, signal: str, motion: Motion, values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Reads exact values as the run's sensors would: at their times, with their noise, rounding and repetitions.

    A slow controller ticks 20 ms apart, and holds its torque meanwhile: the joint moves in a curve.

    Args:
      run: the measured run.
      signal: name of the signal.
      motion: of the simulated robot.
      values: [n, columns], exact, at the times of the motion.
      rng: of the noise.

    Returns:
      [rows, columns].
    """
    at = run.time[:, None] + read_later(run, signal)
    if signal in ("q", "dq"):
        pair = motion.states[:, 0], motion.states[:, 1]
        curves = [hermite(motion.times, *(each[:, joint] for each in pair), own) for joint, own in enumerate(at.T)]
        read = np.stack([curve[("q", "dq").index(signal)] for curve in curves], axis=1)
    else:
        last = np.clip(np.searchsorted(motion.times, at, side="right") - 1, 0, len(motion.times) - 1)
        read = np.take_along_axis(values, last, axis=0)
    read = _sensed(read, _white(run, signal), rounding_of(run, signal), rng)
    fresh = np.where(stale(run, signal), 0, np.arange(len(read))[:, None])
    read = np.take_along_axis(read, np.maximum.accumulate(fresh, axis=0), axis=0)
    return np.abs(read) if signal == "abs_tau" else read


def _white(run: Run, signal: str) -> np.ndarray:
    """The noise of a signal's columns without that of their rounding, a variance of quantum^2 / 12, [columns]."""
    return np.sqrt(np.maximum(noise_of(run, signal) ** 2 - rounding_of(run, signal) ** 2 / 12.0, 0.0))


def _sensed(exact: np.ndarray, white: np.ndarray, quantum: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Adds white noise to exact values and rounds them; a quantum of zero does not round."""
    read = exact + white * rng.standard_normal(exact.shape)
    return np.where(quantum > 0, np.round(read / np.where(quantum > 0, quantum, 1.0)) * quantum, read)
