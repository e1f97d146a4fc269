"""Robots with a hidden effect, for the blind benchmark.

This module shares no simulation code with discovery, and models effects in other forms than the library: a benchmark
that shares forms with the fitter would measure the sharing. The robot is simulated in MuJoCo C with another time step,
integrator and friction cone. The controller ticks with a jitter and holds its torque between ticks. Friction is a
bristle model (LuGre), motors saturate smoothly, lags are of second order, and play and springs are additional joints.
Readings are noisy and rounded.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from envs.logs import Controller, Log, Run
from envs.models import suspended
from experiments.discovery.target_runs import TargetRun, scaled

_STEP_S = 0.0004
_BRISTLE = 2000.0  # 1/rad: one over the displacement at which bristles slip
_ENCODER_RAD = 2 * np.pi / 2**14  # 14 bits, common for joint encoders
_SPEED_NOISE, _SPEED_QUANTUM = 0.01, 0.005  # standard deviation and rounding of joint velocities, rad/s

OUTSIDE = ("cogging", "temperature_fade", "cable_stiffness", "loose_foot")
"""Effects that the library does not have, so that the right verdict is `unnamed`."""


@dataclass(frozen=True)
class Truth:
    """What is hidden in a robot. Only the scorer reads it; discovery never does."""

    effect: str | None
    """Name of the effect, of the library or of `OUTSIDE`; None hides nothing."""
    places: tuple[str, ...] = ()
    """Names of the joints or bodies that have it."""
    size: float = 0.0
    """Value of the effect's first parameter, in its unit."""


def record(
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    motions: Sequence[TargetRun],
    controller: Controller,
    truth: Truth,
    nominal_error: float,
    seed: int,
    noise: bool = True,
) -> Log:
    """Plays target runs on a robot with a hidden effect, and returns the log that a user would have recorded.

    Args:
      spec: the nominal model.
      joints: names, in the log's order.
      motions: `target_runs.TargetRun`s.
      controller: of the joints; each run uses its share of the gains.
      truth: what is hidden.
      nominal_error: relative error of masses, armatures, dampings and frictions; gains are wrong by a third of it.
      seed: of everything random.
      noise: whether readings are noisy and rounded. False gives exact readings, to measure the effect alone.
    """
    rng = np.random.default_rng(seed)
    robot = _Robot(spec, joints, truth, nominal_error, rng)
    runs = []
    for motion in motions:
        own = scaled(controller, motion.gain)
        position, speed = robot.play(motion, own, np.random.default_rng((seed, len(runs))))
        if noise:
            position = np.round(position / _ENCODER_RAD) * _ENCODER_RAD
            speed = speed + _SPEED_NOISE * rng.standard_normal(speed.shape)
            speed = np.round(speed / _SPEED_QUANTUM) * _SPEED_QUANTUM
        signals = {"q": position, "dq": speed, "target": motion.target, "enabled": motion.enabled}
        runs.append(
            Run(
                name=motion.name,
                condition=motion.condition,
                split=motion.split,
                controller=own,
                time=motion.time,
                signals=signals,
            )
        )
    rate = 1.0 / float(np.median(np.diff(motions[0].time)))
    return Log(robot="", base="fixed", rate_hz=rate, joints=tuple(joints), policy=None, runs=tuple(runs))


class _Robot:
    """One robot with its wrong parameters and its hidden effect."""

    def __init__(self, spec, joints, truth: Truth, nominal_error: float, rng: np.random.Generator):
        self._truth, self._joints = truth, tuple(joints)
        spec = spec.copy()
        nominal = suspended(spec)

        def off() -> float:
            """Draws a factor that is wrong by half to one and a half times `nominal_error`, up or down."""
            return float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.5, 1.5) * nominal_error))

        masses = {nominal.body(i).name: off() for i in range(1, nominal.nbody)}
        for body in spec.bodies:
            if body.name in masses:
                for geom in body.geoms:
                    geom.mass *= masses[body.name]
        self._on_body(spec)
        self._springs = {}
        for name in truth.places if truth.effect in ("backlash", "compliance") else ():
            self._springs[name] = self._split(spec, name)
        model = suspended(spec)
        for name in self._springs:
            # What the joint carried stays with the motor; the spare hinge is light.
            model.dof_armature[model.joint(f"{name}_play").dofadr[0]] = 1e-4
            model.dof_damping[model.joint(f"{name}_play").dofadr[0]] = 0.02
        model.opt.timestep = _STEP_S
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.qpos = np.array([model.joint(name).qposadr[0] for name in joints])
        self.dof = np.array([model.joint(name).dofadr[0] for name in joints])
        model.dof_armature[self.dof] *= [off() for _ in joints]
        model.dof_damping[self.dof] *= [off() for _ in joints]
        self._friction = model.dof_frictionloss[self.dof] * np.array([off() for _ in joints])
        model.dof_frictionloss[:] = 0.0  # `_rub` has it, as a bristle model
        # Gains are set and not measured: they are taken to be wrong by a third as much.
        self._gain = np.array([off() for _ in joints]) ** 0.3
        self._at = np.array([name in truth.places for name in joints], float)
        if truth.effect in ("armature", "viscous"):
            field = {"armature": model.dof_armature, "viscous": model.dof_damping}[truth.effect]
            field[self.dof] += truth.size * self._at
        for name in truth.places if truth.effect == "com_offset" else ():
            model.body_ipos[model.body(name).id, 0] += truth.size
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self._model = model
        self._drag = [(model.body(name).id, truth.size) for name in truth.places if truth.effect == "drag"]

    def _on_body(self, spec) -> None:
        """Adds what is hidden on a link: more mass, a payload, or a loose part."""
        truth = self._truth
        if truth.effect == "loose_foot":
            for name in truth.places:
                loose = spec.joint(name).parent.add_body(name=f"{name}_loose", pos=[0.0, 0.0, -0.2])
                loose.add_joint(
                    name=f"{name}_loose", axis=[0, 1, 0], stiffness=[0.5, 0.0, 0.0], damping=[0.002, 0.0, 0.0]
                )
                loose.add_geom(size=[0.02, 0, 0], pos=[0, 0, -0.06], mass=truth.size, contype=0, conaffinity=0)
        for name in truth.places:
            if truth.effect not in ("link_mass", "payload"):
                return
            body = spec.body(name)
            if truth.effect == "link_mass":
                for geom in body.geoms:
                    geom.mass *= truth.size
            else:
                model = suspended(spec)
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_SPHERE,
                    size=[0.015, 0, 0],
                    pos=model.body(name).ipos,
                    mass=truth.size,
                    contype=0,
                    conaffinity=0,
                )

    def _split(self, spec, name: str):
        """Adds a second hinge in series with a joint: with play in a range, or with a spring."""
        joint = spec.joint(name)
        body = joint.parent
        spare = body.add_joint(name=f"{name}_play", axis=joint.axis, pos=joint.pos, type=joint.type)
        if self._truth.effect == "backlash":
            half = 0.5 * self._truth.size
            spare.limited, spare.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-half, half]
            spare.solref_limit = [0.002, 1.0]
        elif self._truth.effect == "compliance":
            spare.stiffness = [self._truth.size, 0.0, 0.0]
        return spare

    def play(
        self, motion: TargetRun, controller: Controller, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Plays a target run.

        Returns:
          Positions in rad and speeds in rad/s as the sensors see them, [rows, joints] each, before noise.
        """
        truth, model, at = self._truth, self._model, self._at
        effect, size = truth.effect, truth.size
        data = mujoco.MjData(model)
        data.qpos[self.qpos] = motion.target[0]
        count = int(np.ceil(motion.time[-1] / _STEP_S)) + 2
        period = 1.0 / controller.rate_hz
        gains = {name: np.asarray(values) for name, values in controller.gains.items()}
        kp = gains["kp"] * self._gain * (np.where(at > 0, size, 1.0) if effect == "gain_error" else 1.0)
        limit, kd = gains["torque_limit_nm"], gains["kd"]
        seconds = size if effect in ("command_delay", "sensor_delay") else 0.0
        behind = round(seconds / _STEP_S)
        read = np.empty((count, 2, len(at)))
        # Real controllers are late by a part of their period; discovery has to find the timing by itself.
        tick, jitter = 0.0, rng.uniform(0, 0.3) * period
        held = np.zeros(len(at))
        slewed = motion.target[0].copy()
        lag, lag_read = np.zeros((2, len(at))), None
        bristle = np.zeros(len(at))
        rate = 1.0 / float(np.median(np.diff(motion.time)))

        def row_of(time: float) -> int:
            return min(max(int(time * rate + 1e-6), 0), len(motion.target) - 1)

        torque = np.zeros(len(at))
        for step in range(count):
            now = step * _STEP_S
            position, speed = data.qpos[self.qpos], data.qvel[self.dof]
            seen = np.stack([position, speed])
            if effect == "encoder_bias":
                seen[0] += size * at
            if effect == "sensor_lag":
                lag_read = np.stack([seen, seen]) if lag_read is None else lag_read
                share = _STEP_S / (0.5 * size)  # two equal stages, each with half of the time constant
                lag_read[0] += share * (seen - lag_read[0])
                lag_read[1] += share * (lag_read[0] - lag_read[1])
                seen = np.where(at > 0, lag_read[1], seen)
            read[step] = seen
            if effect == "sensor_delay":
                read[step] = np.where(at > 0, self._past(read_true := seen, step, behind), read_true)
            seen = read[step]
            enabled = motion.enabled[row_of(now)]
            if now >= tick + jitter:
                tick += period
                jitter = rng.uniform(0, 0.3) * period
                target = motion.target[row_of(now)]
                if effect == "command_delay":
                    target = np.where(at > 0, motion.target[row_of(now - size)], target)
                if effect == "target_slew":
                    slewed = slewed + np.clip(target - slewed, -size * period, size * period)
                    target = np.where(at > 0, slewed, target)
                error = target - seen[0]
                if effect == "deadband":
                    soft = np.where(np.abs(error) > size / 2, error - np.sign(error) * size / 2, 0.0)
                    error = np.where(at > 0, soft, error)
                held = enabled * np.clip(kp * error - kd * seen[1], -limit, limit)
            torque = self._motor(held, speed, limit, lag, now / motion.time[-1])
            bristle, friction = self._rub(bristle, speed, torque)
            outside = self._outside(position, now)
            data.qfrc_applied[self.dof] = torque - friction + outside
            for body, drag in self._drag:
                velocity = np.zeros(6)
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
                data.xfrc_applied[body, :3] = -drag * velocity[3:]
            mujoco.mj_step(model, data)
        grid = np.arange(count) * _STEP_S
        position, speed = (
            np.stack([np.interp(motion.time, grid, column) for column in read[:, kind].T], axis=1) for kind in (0, 1)
        )
        return position, speed

    def _past(self, seen, step, behind):
        """Returns the readings of `behind` steps ago; before the start, those of the first step."""
        if step == 0:
            self._line = [seen] * (behind + 1)
        self._line.append(seen)
        return self._line[-1 - behind]

    def _motor(self, held, speed, limit, lag, share) -> np.ndarray:
        """Returns the torque that the motors give for the torque that the controller holds, `share` into the run."""
        effect, size, at = self._truth.effect, self._truth.size, self._at
        torque = held
        if effect == "torque_lag":
            step = _STEP_S / (0.5 * size)
            lag[0] += step * (torque - lag[0])
            lag[1] += step * (lag[0] - lag[1])
            torque = np.where(at > 0, lag[1], torque)
        if effect == "torque_limit":
            torque = np.where(at > 0, size * np.tanh(torque / size), torque)
        if effect == "torque_speed":
            most = np.maximum(limit - size * np.abs(speed), 0.0)
            driving = torque * speed > 0
            torque = np.where((at > 0) & driving, np.clip(torque, -most, most), torque)
        if effect == "torque_scale":
            torque = np.where(at > 0, size * torque, torque)
        if effect == "temperature_fade":
            torque = np.where(at > 0, (1.0 - size * share) * torque, torque)
        return torque

    def _rub(self, bristle, speed, torque) -> tuple[np.ndarray, np.ndarray]:
        """Moves the bristles of the LuGre model by a step.

        With deflection z and speed v: dz/dt = v - s |v| z / g(v), torque = s z + d dz/dt. The level is
        g(v) = slide + (stick - slide) exp(-(v / 0.15)^2), which holds Coulomb, load and Stribeck friction.

        Returns:
          The bristles' deflection and the torque of friction in Nm, [joints] each.
        """
        effect, size, at = self._truth.effect, self._truth.size, self._at
        slides = self._friction.copy()
        if effect == "coulomb":
            slides = slides + size * at
        if effect == "load_friction":
            slides = slides + size * at * np.abs(torque)
        sticks = slides.copy()
        if effect == "stribeck":
            sticks = sticks + size * at
        level = slides + (sticks - slides) * np.exp(-((speed / 0.15) ** 2))
        there = level > 1e-9
        stiffness = _BRISTLE * np.maximum(level, 1e-9)
        rate = speed - stiffness * np.abs(speed) / np.maximum(level, 1e-9) * bristle
        # Implicit in the bristle: the explicit form is unstable where speed is high.
        bristle = np.where(there, (bristle + _STEP_S * speed) / (1 + _STEP_S * _BRISTLE * np.abs(speed)), 0.0)
        damping = 0.3 * np.sqrt(stiffness * 1e-3)
        return bristle, np.where(there, stiffness * bristle + damping * np.where(np.abs(speed) < 0.05, rate, 0.0), 0.0)

    def _outside(self, position, now) -> np.ndarray:
        """Returns torques in Nm that depend on position alone: a push, cogging, or a cubic cable spring."""
        effect, size, at = self._truth.effect, self._truth.size, self._at
        if effect == "constant_push":
            return size * at
        if effect == "cogging":
            return size * at * np.sin(20.0 * position)
        if effect == "cable_stiffness":
            return -size * at * position**3
        return np.zeros(len(at))
