"""Robots whose controller nobody knows: one of our own follows their measured motion, and needs torques as they did.

Where the torques at the joints were measured, no controller has to be known. What the model needs for the measured
motion is compared with them, as in the identification of robots by inverse dynamics (Siciliano et al., *Robotics*,
2009, section 7.3). Playing the measured torques without a controller would not do: a light joint with a little friction
too much runs away, and the model that ignores the torques most, one of heavy rotors, then fits best.
"""

from dataclasses import replace

import mujoco
import numpy as np

from envs.logs import Controller, Log, Run
from envs.models import suspended
from envs.readings import noise_of
from envs.smoothing import smoothed
from jaxtune.types import Effect

_FASTEST_RAD_S, _SLOWEST_RAD_S = 150.0, 15.0  # the fastest settles in some 20 ms, and is stable with steps of 1 ms
_SHAKEN = 0.05  # share of a joint's rms torque that noise of its position may ask for
_POSES = 20

OF_SENSORS = ("torque_scale", "constant_push")
"""Effects that are alike to an error of a torque sensor, its scale and its offset, and stand for it."""

_OF_CONTROLLER = ("command", "error", "speed", "torque")


def tells(effect: Effect) -> bool:
    """Whether a log of an unknown controller can tell of an effect.

    It cannot of those that stand between targets and torques, nor of those that are as a torque sensor's own error.
    """
    return effect.enters not in _OF_CONTROLLER and effect.name not in OF_SENSORS


def follower(log: Log, spec: mujoco.MjSpec) -> Controller | None:
    """Makes the controller that follows the motion of a log whose own one is unknown; None where that is known.

    Critically damped for every joint alone, in the pose of its least inertia, it has, with smoothed measurements,

        torque = kp (target - q) - kd dq,   target = q_measured + kd / kp dq_measured + tau_measured / kp

    so while the model moves as measured, it asks for the measured torque. What else it needs shows in that, and in how
    far the motion is off. It is as fast as noise allows, which makes it ask for torques too. With the standard
    deviations that white noise of the sensors leaves in smoothed positions and velocities, but no slower than 15 rad/s,

        inertia (pace^2 sd(q) + 2 pace sd(dq)) <= 0.05 rms(tau)

    Args:
      log: without sealed runs, with the noise of its signals (`readings.with_noise`).
      spec: the nominal model.

    Raises:
      ValueError: the controller is unknown in some runs only.
    """
    unknown = [run.controller.kind == "unknown" for run in log.runs]
    if not any(unknown):
        return None
    if not all(unknown):
        name = log.runs[unknown.index(False)].name
        raise ValueError(f"{name}: controller.type: got a known one, expected 'unknown' as in others, or in none")
    inertia, (far, fast) = _least_inertia(log, spec), _noise_left(log.runs[0])
    torque = np.sqrt((np.concatenate([run.signals["tau"] for run in log.runs]) ** 2).mean(axis=0))
    pace = (np.sqrt(fast**2 + far * _SHAKEN * torque / inertia) - fast) / far
    pace = np.clip(pace, _SLOWEST_RAD_S, _FASTEST_RAD_S)
    gains = {
        "kp": inertia * pace**2,
        "kd": 2.0 * inertia * pace,
        "torque_limit_nm": np.full(len(inertia), np.inf),
    }
    return replace(log.runs[0].controller, gains=gains, between_rows="linear")


def followed(log: Log, controller: Controller | None) -> Log:
    """Gives the runs of an unknown controller the one that follows them, and targets from their own readings.

    Args:
      log: as it was read, or followed before.
      controller: of `follower`; the log is unchanged where there is none.
    """
    if controller is None:
        return log
    return replace(log, runs=tuple(_followed(run, controller) for run in log.runs))


def _followed(run: Run, controller: Controller) -> Run:
    states, gains = smoothed(run), controller.gains
    # Noise of the torques would shake the model.
    torque = smoothed(replace(run, signals={"q": run.signals["tau"]}, known={"q": run.known.get("tau", {})}))[:, 0]
    target = states[:, 0] + (gains["kd"] * states[:, 1] + torque) / gains["kp"]
    return replace(run, controller=controller, signals={**run.signals, "target": target})


def _noise_left(run: Run) -> np.ndarray:
    """Standard deviations that smoothing leaves of noise, of positions and velocities, [2, joints]."""
    rng, signals = np.random.default_rng(0), {name: run.signals[name] for name in ("q", "dq") if name in run.signals}
    noise = {name: noise_of(run, name) * rng.standard_normal(values.shape) for name, values in signals.items()}
    return smoothed(replace(run, signals=noise)).std(axis=0)


def _least_inertia(log: Log, spec: mujoco.MjSpec) -> np.ndarray:
    """The least inertia of every joint in poses of the log while the other joints are free, [joints] kg m^2.

    With more, a joint that others carry would be controlled too hard for the step of the simulation.
    """
    model = suspended(spec, log.joints)
    data, dense = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    found = [model.joint(name) for name in log.joints]
    qpos, dof = (np.array([getattr(one, field)[0] for one in found]) for field in ("qposadr", "dofadr"))
    positions = np.concatenate([run.signals["q"] for run in log.runs])
    least = np.full(len(dof), np.inf)
    for row in np.linspace(0, len(positions) - 1, _POSES).astype(int):
        data.qpos[qpos] = positions[row]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, dense)
        least = np.minimum(least, 1.0 / np.diag(np.linalg.inv(dense))[dof])
    return least
