"""Plays logs back in MuJoCo C, with the log's controller written as MuJoCo's own actuators.

A second simulator beside `envs.rig`, without any effect of the library: what a general identification tool can fit.
Pieces of logs, their first states and their rows are those of `envs.segments`, so errors can stand beside discovery's.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from envs import held, segments
from envs.logs import Log, Run
from envs.models import free_joints

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_LONGEST_STEP_S = 0.001


@dataclass(frozen=True)
class Pieces:
    """Pieces of runs, all of one length: the controller's inputs, first states, and what was measured."""

    dt: float
    """Step of the simulation in s."""
    target: np.ndarray
    """[pieces, before + after, joints] rad, the history included, from which delayed targets are taken."""
    stiffness: np.ndarray
    """[pieces, after, joints] Nm/rad of the controller."""
    damping: np.ndarray
    """[pieces, after, joints] Nm s/rad of the controller and of back electromotive force; a log has one of the two."""
    start: np.ndarray
    """[pieces, 2, joints] rad and rad/s, smoothed."""
    step: np.ndarray
    """[pieces, rows] the last step at or before each row."""
    share: np.ndarray
    """[pieces, rows] share of a step between that step and the row."""
    measured: np.ndarray
    """[pieces, rows, joints] rad."""
    real: np.ndarray
    """[pieces, rows] false where a short run's last row is repeated."""

    def __getitem__(self, index) -> "Pieces":
        """Takes some of the pieces."""
        arrays = {name: value[index] for name, value in vars(self).items() if name != "dt"}
        return Pieces(dt=self.dt, **arrays)


def step_s(log: Log) -> float:
    """Computes the simulation's step as `envs.rig.Rig` does: the longest up to 1 ms that divides the controller's."""
    period = 1.0 / log.runs[0].controller.rate_hz
    return period / np.ceil(period / _LONGEST_STEP_S - 1e-9)


def take(runs: Sequence[Run], dt: float, horizon_s: float | None = None) -> Pieces:
    """Cuts runs into pieces that start from measured states.

    Args:
      runs: of one robot. Where it is unknown how targets go on between rows, they are held.
      dt: step of the simulation in s.
      horizon_s: length of a piece; None takes whole runs, from the end of the first history on.
    """
    cut = segments.whole(runs, dt) if horizon_s is None else segments.cut(runs, horizon_s, dt)
    one, before = cut.segments, round(segments.HISTORY_S / dt)
    return Pieces(
        dt=dt,
        target=np.asarray(one.target, float),
        stiffness=np.asarray(one.stiffness[:, before:], float),
        damping=np.asarray(one.damping[:, before:] + one.emf[:, before:], float),
        start=np.asarray(one.measured[:, before, :2], float),
        step=np.asarray(one.row_step),
        share=np.asarray(one.row_share, float),
        measured=np.asarray(cut.signals["q"], float),
        real=np.diff(cut.row, axis=1, prepend=-1) > 0,
    )


def playable(spec: mujoco.MjSpec, log: Log) -> mujoco.MjSpec:
    """Adds the log's controller to a robot as actuators, and a position sensor to every joint.

    A joint has a tendon of its own with three actuators, whose controls change in time:

        command: stiffness x target,   stiffness: -stiffness x q,   damping: -damping x dq

    The tendon limits their sum, as the controller does. Back electromotive force is not limited, so a servo's third
    actuator acts on the joint. A servo's limit follows its supply; here it is the median over all runs.

    Args:
      spec: of the robot, which is copied; free joints and those that are held, contacts, and its own
        actuators, sensors and keyframes are left out.
      log: of a suspended or clamped robot.
    """
    spec = spec.copy()
    still = held.elements(spec, log.joints)
    for element in (*spec.keys, *spec.actuators, *spec.sensors, *spec.tuples, *still, *free_joints(spec)):
        spec.delete(element)
    spec.option.timestep = step_s(log)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    limits = np.concatenate([np.broadcast_to(run.impedance().limit, run.signals["q"].shape) for run in log.runs])
    servo = log.runs[0].controller.kind == "servo"
    for joint, limit in zip(log.joints, limits.T, strict=True):
        tendon = spec.add_tendon(name=f"drive.{joint}")
        tendon.wrap_joint(joint, 1.0)
        if np.isfinite(limit).all():
            most = float(np.median(limit[limit > 0]))
            tendon.actfrclimited, tendon.actfrcrange = True, [-most, most]
        for name, gains in {"command": (1, 0, 0), "stiffness": (0, -1, 0), "damping": (0, 0, -1)}.items():
            own = servo and name == "damping"
            actuator = spec.add_actuator(name=f"{name}.{joint}", target=joint if own else tendon.name)
            kinds = mujoco.mjtTrn
            actuator.trntype = kinds.mjTRN_JOINT if own else kinds.mjTRN_TENDON
            actuator.gaintype, actuator.gainprm[:3] = mujoco.mjtGain.mjGAIN_AFFINE, gains
        sensor = spec.add_sensor(name=f"q.{joint}", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objname=joint)
        sensor.objtype = mujoco.mjtObj.mjOBJ_JOINT
    return spec


def play(
    model: mujoco.MjModel, joints: Sequence[str], pieces: Pieces, delay_s: float = 0.0, bias: np.ndarray | float = 0.0
) -> np.ndarray:
    """Simulates pieces of a log from their measured first states.

    Args:
      model: of `playable`, compiled.
      joints: names, in the log's order.
      pieces: what to simulate.
      delay_s: by how much commands are late, up to the length of the history.
      bias: [joints] rad that the sensors, which the controller reads too, show beyond the position.

    Returns:
      Sensor readings at the rows, [pieces, rows, joints] rad.
    """
    found = [model.joint(name) for name in joints]
    qpos, dof = (np.array([getattr(joint, name)[0] for joint in found]) for name in ("qposadr", "dofadr"))
    steps, data = pieces.stiffness.shape[1], mujoco.MjData(model)
    whole, share = divmod(delay_s / pieces.dt, 1.0)
    first = pieces.target.shape[1] - steps - int(whole)
    late = (1.0 - share) * pieces.target[:, first : first + steps]
    late = late + share * pieces.target[:, first - 1 : first - 1 + steps]
    control = np.empty((len(late), steps - 1, model.nu))
    signals = {
        "command": pieces.stiffness * (late - bias),
        "stiffness": pieces.stiffness,
        "damping": pieces.damping,
    }
    for name, values in signals.items():
        control[..., [model.actuator(f"{name}.{joint}").id for joint in joints]] = values[:, :-1]
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.empty((len(late), size))
    for state, (position, velocity) in zip(start, pieces.start, strict=True):
        data.qpos[qpos], data.qvel[dof] = position - bias, velocity
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    threads = [mujoco.MjData(model) for _ in range(min(CORES, len(start)))]
    states, _ = rollout.rollout(model, threads, start, control)
    # The first column of a state is its time.
    read = np.concatenate([start[:, None], states], axis=1)[..., 1 + qpos] + bias
    piece = np.arange(len(read))[:, None]
    following = np.minimum(pieces.step + 1, steps - 1)
    return read[piece, pieces.step] + pieces.share[..., None] * (read[piece, following] - read[piece, pieces.step])


def mean_absolute_error(read: np.ndarray, pieces: Pieces) -> float:
    """Averages absolute errors over rows and joints of every piece, and then over the pieces, in rad."""
    error = np.abs(read - pieces.measured).mean(axis=-1)
    return float(np.mean([own[real].mean() for own, real in zip(error, pieces.real, strict=True)]))


def rms_by_joint(read: np.ndarray, pieces: Pieces) -> np.ndarray:
    """Computes the rms error of every joint over the rows of all pieces, [joints] rad."""
    return np.sqrt(((read - pieces.measured)[pieces.real] ** 2).mean(axis=0))
