"""Simulated null logs: what a measured log would look like if the model lacked nothing.

Discovery accepts an effect only if it improves the measured log by more than effects improve null logs. Among many
effects one always improves the fit a little, because it imitates differences that are not physics: an engine's step,
its integrator, the moment at which a controller reads the joint. A null log therefore has such differences too:

- MuJoCo C simulates the nominal model with half the step, another integrator and a controller whose ticks jitter;
- its masses, armatures, dampings and frictions are drawn from the prior, its controller's gains
  are those of the log;
- if it is unknown whether targets are held between rows, or move on in straight lines, one of them is drawn;
- the readings get the noise, the rounding, the times and the repetitions that are found in the measured log, column by
  column.
"""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from envs import sensing
from envs.logs import Log, Run
from envs.models import suspended
from envs.readings import noise_of, read_later, rounding_of, stale
from envs.smoothing import smoothed

_STEP_S = 0.0005  # half the step of `Rig`
_SPREAD = 0.1  # standard deviation of the logarithm of every drawn parameter, as in `Axis.prior_sd`


def simulate_null_log(log: Log, spec: mujoco.MjSpec, seed: int) -> Log:
    """Simulates a log in which no effect is missing, with the targets and conditions of a measured one.

    Args:
      log: the measured log; its targets are played again and its noise is imitated.
      spec: MJCF of the nominal robot.
      seed: of the drawn parameters, the controller's jitter and the noise. Other seeds give other null logs.

    Returns:
      A log of the same runs, joints and signals. Signals of the controller (targets, supply, enabling) are copied,
      signals of sensors are simulated.
    """
    rng = np.random.default_rng(seed)
    model = _drawn(spec, rng)
    linear = {"hold": False, "linear": True, "unknown": bool(rng.integers(0, 2))}
    runs = tuple(replay(run, model, log.joints, linear[run.controller.between_rows], rng) for run in log.runs)
    return replace(log, runs=runs)


def _drawn(spec: mujoco.MjSpec, rng: np.random.Generator) -> mujoco.MjModel:
    """Compiles the nominal model with its parameters drawn from the prior, suspended and without actuators."""
    model = suspended(spec)
    model.opt.timestep = _STEP_S
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The controller's torque is applied to the joints directly, so the model's own actuators are switched off.
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    # A heavier link of the same shape: its inertia grows in proportion.
    masses = _factors(rng, model.nbody)
    model.body_mass[:] *= masses
    model.body_inertia[:] *= masses[:, None]
    for name in ("dof_armature", "dof_damping", "dof_frictionloss"):
        getattr(model, name)[:] *= _factors(rng, model.nv)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _factors(rng: np.random.Generator, count: int) -> np.ndarray:
    # Cut at two standard deviations: a null log should be a plausible robot.
    return np.exp(_SPREAD * rng.standard_normal(count).clip(-2.0, 2.0))


def replay(run: Run, model: mujoco.MjModel, joints: Sequence[str], linear: bool, rng: np.random.Generator) -> Run:
    """Plays a run's targets (or its torques, where it has no targets) on a model in MuJoCo C.

    The controller's law is `envs.logs.Controller`'s. It reads the joint at its own rate, each time up to one step of
    the physics early or late, because a robot's ticks and a simulation's steps never coincide.

    Args:
      run: the measured run; it gives targets, controller, time stamps and the first state.
      model: what is moved, without actuators.
      joints: names of the joints, in the log's order.
      linear: whether targets move to the next row in a straight line; else they are held.
      rng: of jitter and noise.

    Returns:
      The same run with `q`, `dq`, `tau`, `abs_tau` and `gravity` simulated, those of them that it has.
    """
    data = mujoco.MjData(model)
    qpos = np.array([model.joint(name).qposadr[0] for name in joints])
    dof = np.array([model.joint(name).dofadr[0] for name in joints])
    damping = model.dof_damping[dof].copy()
    # Smoothed, so that noise in the first row does not become an error of the start.
    data.qpos[qpos], data.qvel[dof] = smoothed(run)[0]
    controller, driven = run.impedance(), "target" in run.signals
    steps = int(np.ceil(1.0 / run.controller.rate_hz / _STEP_S - 1e-9))
    model.opt.timestep = 1.0 / run.controller.rate_hz / steps
    count = int(np.ceil((run.time[-1] - run.time[0]) * run.controller.rate_hz)) + 2
    # Jitter does not add up: a tick that comes early is followed by a longer interval.
    looks = np.cumsum(np.append(rng.integers(0, steps), steps + np.diff(rng.integers(0, 2, count))))
    times = run.time[0] + model.opt.timestep * looks
    last = np.clip(np.searchsorted(run.time, times + 1e-9, side="right") - 1, 0, len(run.time) - 1)
    targets = _targets(run, times, last, linear) if driven else None
    # States are recorded where the controller reads them and interpolated at the rows' times below.
    states, torques = np.empty((len(looks), 2, len(joints))), np.empty((len(looks), len(joints)))
    if looks[0]:
        mujoco.mj_step(model, data, int(looks[0]))
    law, row_of_law = controller[last[0]], last[0]
    for look, row in enumerate(last):
        if row != row_of_law:
            law, row_of_law = controller[row], row
        q, dq = data.qpos[qpos], data.qvel[dof]
        torque = law.torque(targets[look], q, dq) if driven else run.signals["tau"][row]
        # As damping, back electromotive force acts continuously between two ticks.
        model.dof_damping[dof] = damping + law.back_emf
        # A sensor of torque or current sees what the back electromotive force leaves.
        states[look, 0], states[look, 1], torques[look] = q, dq, torque - law.back_emf * dq
        data.qfrc_applied[dof] = torque
        if look + 1 < len(looks):
            mujoco.mj_step(model, data, int(looks[look + 1] - looks[look]))
    model.dof_damping[dof] = damping
    level = np.asarray(sensing.projected_gravity(model.body_quat[1]))
    exact = {"q": states[:, 0], "dq": states[:, 1], "tau": torques, "abs_tau": torques}
    exact["gravity"] = np.tile(level, (len(times), 1))
    # Without targets the torques are what was sent, not what was measured.
    sensed = [name for name in exact if name in run.signals and (driven or name != "tau")]
    read = {name: _as_read(run, name, times, exact[name], rng) for name in sensed}
    return replace(run, signals={**run.signals, **read})


def _targets(run: Run, times: np.ndarray, last: np.ndarray, linear: bool) -> np.ndarray:
    """Returns what the controller is told at other times than the rows', [times, joints] rad."""
    target = run.signals["target"]
    if not linear:
        return target[last]
    return np.stack([np.interp(times, run.time, column) for column in target.T], axis=1)


def _as_read(run: Run, signal: str, times: np.ndarray, values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Reads exact values as the run's sensors would: at their times, with their noise, rounding and repetitions.

    Args:
      run: the measured run.
      signal: name of the signal.
      times: [n] s, of the exact values.
      values: [n, columns], exact.
      rng: of the noise.

    Returns:
      [rows, columns].
    """
    at = run.time[:, None] + read_later(run, signal)
    read = np.stack([np.interp(own, times, exact) for own, exact in zip(at.T, values.T, strict=True)], axis=1)
    quantum = rounding_of(run, signal)
    # Rounding brings a variance of quantum^2 / 12 of its own, which the noise contains as well.
    extra = np.sqrt(np.maximum(noise_of(run, signal) ** 2 - quantum**2 / 12.0, 0.0))
    read = read + extra * rng.standard_normal(read.shape)
    read = np.where(quantum > 0, np.round(read / np.where(quantum > 0, quantum, 1.0)) * quantum, read)
    fresh = np.where(stale(run, signal), 0, np.arange(len(read))[:, None])
    read = np.take_along_axis(read, np.maximum.accumulate(fresh, axis=0), axis=0)
    return np.abs(read) if signal == "abs_tau" else read
