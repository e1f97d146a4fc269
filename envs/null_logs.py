"""What a log would look like if nothing were missing: the nominal model in another engine, with the log's own noise.

Something always mimics an engine's step, its integrator or the moment at which a controller looks. So the nominal
model is moved by MuJoCo C with half the step, another integrator and a controller whose ticks wander, its masses,
armatures and dampings drawn as the prior has them, and read with the noise and the rounding found in the log.
"""

from dataclasses import replace

import mujoco
import numpy as np

from envs import sensing
from envs.logs import Log, Run
from envs.rig import suspended
from envs.segments import noise, quantum_of, smoothed

_STEP_S = 0.0005
_SPREAD = 0.1


def simulate_null_log(log: Log, spec: mujoco.MjSpec, seed: int) -> Log:
    """Draws a log without a missing effect, its targets and conditions those of a measured one."""
    rng = np.random.default_rng(seed)
    model = _drawn(spec, rng)
    return replace(log, runs=tuple(replay(run, model, log.joints, rng) for run in log.runs))


def _drawn(spec: mujoco.MjSpec, rng: np.random.Generator) -> mujoco.MjModel:
    """The nominal model, every parameter off as the prior has it."""
    model = suspended(spec)
    model.opt.timestep = _STEP_S
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    masses = _factors(rng, model.nbody)
    model.body_mass[:] *= masses
    model.body_inertia[:] *= masses[:, None]
    for name in ("dof_armature", "dof_damping", "dof_frictionloss"):
        getattr(model, name)[:] *= _factors(rng, model.nv)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _factors(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.exp(_SPREAD * rng.standard_normal(count).clip(-2.0, 2.0))


def replay(run: Run, model: mujoco.MjModel, joints, rng: np.random.Generator) -> Run:
    """Plays a run's targets through a controller whose ticks wander by up to a step of the physics."""
    data = mujoco.MjData(model)
    qpos = np.array([model.joint(name).qposadr[0] for name in joints])
    dof = np.array([model.joint(name).dofadr[0] for name in joints])
    damping = model.dof_damping[dof].copy()
    data.qpos[qpos], data.qvel[dof] = smoothed(run)[0]
    controller, driven = run.impedance(), "target" in run.signals
    steps = int(np.ceil(1.0 / run.controller.rate_hz / _STEP_S - 1e-9))
    model.opt.timestep = 1.0 / run.controller.rate_hz / steps
    count = int(np.ceil((run.time[-1] - run.time[0]) * run.controller.rate_hz)) + 2
    # An early look one time is a late one the next.
    looks = np.cumsum(np.append(rng.integers(0, steps), steps + np.diff(rng.integers(0, 2, count))))
    times = run.time[0] + model.opt.timestep * looks
    last = np.clip(np.searchsorted(run.time, times + 1e-9, side="right") - 1, 0, len(run.time) - 1)
    states, torques = np.empty((len(looks), 2, len(joints))), np.empty((len(looks), len(joints)))
    if looks[0]:
        mujoco.mj_step(model, data, int(looks[0]))
    for look, row in enumerate(last):
        q, dq = data.qpos[qpos], data.qvel[dof]
        torque = controller[row].torque(run.signals["target"][row], q, dq) if driven else run.signals["tau"][row]
        model.dof_damping[dof] = damping + controller.back_emf[row]
        states[look, 0], states[look, 1], torques[look] = q, dq, torque
        data.qfrc_applied[dof] = torque
        if look + 1 < len(looks):
            mujoco.mj_step(model, data, int(looks[look + 1] - looks[look]))
    model.dof_damping[dof] = damping
    signals = dict(run.signals)
    for name, values in {"q": states[:, 0], "dq": states[:, 1], "tau": torques}.items():
        if name in signals and (driven or name != "tau"):
            read = np.stack([np.interp(run.time, times, column) for column in values.T], axis=1)
            signals[name] = _as_read(read, run.signals[name], rng)
    if "gravity" in signals:
        level = np.asarray(sensing.projected_gravity(model.body_quat[1]))
        signals["gravity"] = _as_read(np.tile(level, (len(run.time), 1)), run.signals["gravity"], rng)
    return replace(run, signals=signals)


def _as_read(values: np.ndarray, like: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Values with the noise and the rounding of others."""
    quantum = quantum_of(like)
    extra = max(noise(like) ** 2 - quantum**2 / 12.0, 0.0) ** 0.5
    values = values + extra * rng.standard_normal(values.shape)
    return np.round(values / quantum) * quantum if quantum else values
