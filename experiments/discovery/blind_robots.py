"""Robots with a hidden effect, for the blind benchmark.

This module shares no simulation code with discovery, and models effects in other forms than the library: a benchmark
that shares forms with the fitter would measure the sharing. The robot is simulated in MuJoCo C with another time step,
integrator and friction cone. The controller ticks with a jitter and holds its torque between ticks. Friction is a
bristle model (LuGre), motors saturate smoothly, lags are of second order, and play and springs are additional joints.
Readings are noisy and rounded.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from envs.logs import Controller, Log, Run
from envs.models import suspended
from experiments.discovery.blind_drive import STEP_S, Bristles, Control, Motors, Sensors, Truth
from experiments.discovery.target_runs import TargetRun, scaled

_ENCODER_RAD = 2 * np.pi / 2**14  # 14 bits, common for joint encoders
_SPEED_NOISE, _SPEED_QUANTUM = 0.01, 0.005  # standard deviation and rounding of joint velocities, rad/s

OUTSIDE = ("cogging", "temperature_fade", "detent", "loose_foot")
"""Effects that the library does not have, so that the right verdict is `unnamed`."""

# Torques at a joint's positions in rad, by effect and per unit of its size.
_OF_POSITION = {
    "constant_push": np.ones_like,
    "cogging": lambda position: np.sin(20.0 * position),
    # It stiffens.
    "joint_spring": lambda position: -position * (1.0 + 0.3 * position**2),
    # A magnet that holds the joint within a tenth of a radian, and hardly farther off.
    "detent": lambda position: -position * np.exp(-50.0 * position**2),
}


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
        model.opt.timestep = STEP_S
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.qpos = np.array([model.joint(name).qposadr[0] for name in joints])
        self.dof = np.array([model.joint(name).dofadr[0] for name in joints])
        model.dof_armature[self.dof] *= [off() for _ in joints]
        model.dof_damping[self.dof] *= [off() for _ in joints]
        self._friction = model.dof_frictionloss[self.dof] * np.array([off() for _ in joints])
        model.dof_frictionloss[:] = 0.0  # `Bristles` has it
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
        truth, at, model = self._truth, self._at, self._model
        data = mujoco.MjData(model)
        data.qpos[self.qpos] = motion.target[0]
        read, control = Sensors(truth, at), Control(truth, at, motion, controller, self._gain, rng)
        drive, rub = Motors(truth, at, control.limit), Bristles(truth, at, self._friction)
        grid = np.arange(int(np.ceil(motion.time[-1] / STEP_S)) + 2) * STEP_S
        seen = np.empty((len(grid), 2, len(at)))
        for step, now in enumerate(grid):
            position, speed = data.qpos[self.qpos], data.qvel[self.dof]
            seen[step] = read(position, speed)
            torque = drive(control(now, seen[step]), speed, now / motion.time[-1])
            data.qfrc_applied[self.dof] = torque - rub(speed, torque) + self._outside(position)
            for body, drag in self._drag:
                velocity = np.zeros(6)
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
                data.xfrc_applied[body, :3] = -drag * velocity[3:]
            mujoco.mj_step(model, data)
        position, speed = (
            np.stack([np.interp(motion.time, grid, column) for column in seen[:, kind].T], axis=1) for kind in (0, 1)
        )
        return position, speed

    def _outside(self, position) -> np.ndarray:
        """Returns torques in Nm that depend on position alone (`_OF_POSITION`)."""
        shape = _OF_POSITION.get(self._truth.effect)
        return np.zeros(len(self._at)) if shape is None else self._truth.size * self._at * shape(position)
