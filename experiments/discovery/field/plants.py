"""Bodies in motion: many robots of one tree at once, in MuJoCo C, PyBullet or Pinocchio.

A plant knows masses, rotor inertias and gravity, no friction and no controller. Every lane is one motion of one of the
robots.
"""

import tempfile
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Protocol

import mujoco
import numpy as np

from experiments.discovery.field.robots import Robot, mjcf

_GRAVITY = 9.81


class Plant(Protocol):
    """Robots that move under joint torques."""

    dt: float
    """Step in s."""
    q: np.ndarray
    """[lanes, joints] rad"""
    v: np.ndarray
    """[lanes, joints] rad/s"""

    def step(self, torque: np.ndarray) -> None:
        """Moves all lanes by a step under torques [lanes, joints] in Nm."""


class MujocoPlant:
    """MuJoCo C with its fully implicit integrator, at 2 kHz and with elliptic cones.

    Args:
      robots: that occur.
      robot_of: [lanes] index of each lane's robot.
      q: [lanes, joints] rad at the start.
      v: [lanes, joints] rad/s at the start.
    """

    dt = 0.0005

    def __init__(self, robots: Sequence[Robot], robot_of: np.ndarray, q: np.ndarray, v: np.ndarray):
        self.q, self.v = q.copy(), v.copy()
        models = [self._model(robot) for robot in robots]
        self._lanes = [(models[number], mujoco.MjData(models[number])) for number in robot_of]
        # Views into the engine's memory, which stay valid.
        self._views = [(data.qpos, data.qvel, data.qfrc_applied) for _, data in self._lanes]
        for (qpos, qvel, _), at, speed in zip(self._views, q, v, strict=True):
            qpos[:], qvel[:] = at, speed

    def _model(self, robot: Robot) -> mujoco.MjModel:
        model = mujoco.MjModel.from_xml_string(mjcf(robot))
        model.dof_damping[:], model.dof_frictionloss[:] = 0.0, 0.0  # `playing` has them
        model.opt.timestep = self.dt
        model.opt.integrator, model.opt.cone = mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtCone.mjCONE_ELLIPTIC
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        return model

    def step(self, torque: np.ndarray) -> None:
        """Moves all lanes by a step under torques [lanes, joints] in Nm."""
        for lane, ((model, data), (qpos, qvel, applied)) in enumerate(zip(self._lanes, self._views, strict=True)):
            applied[:] = torque[lane]
            mujoco.mj_step(model, data)
            self.q[lane], self.v[lane] = qpos, qvel


class PinocchioPlant:
    """Pinocchio's articulated-body algorithm, with semi-implicit Euler steps at 4 kHz.

    Args:
      robots: that occur.
      robot_of: [lanes] index of each lane's robot.
      q: [lanes, joints] rad at the start.
      v: [lanes, joints] rad/s at the start.
    """

    dt = 0.00025

    def __init__(self, robots: Sequence[Robot], robot_of: np.ndarray, q: np.ndarray, v: np.ndarray):
        pinocchio = _engine("pinocchio")
        self._aba = pinocchio.aba
        self.q, self.v = q.copy(), v.copy()
        models = [self._model(pinocchio, robot) for robot in robots]
        datas = [model.createData() for model in models]
        self._lanes = [(models[number], datas[number]) for number in robot_of]
        self._acceleration = np.zeros_like(q)

    @staticmethod
    def _model(pinocchio, robot: Robot):
        model, ids = pinocchio.Model(), []
        for number, parent in enumerate(robot.parents):
            joint = pinocchio.JointModelRevoluteUnaligned(robot.axis[number])
            place = pinocchio.SE3(np.eye(3), robot.pos[number])
            ids.append(model.addJoint(ids[parent] if parent >= 0 else 0, joint, place, robot.joints[number]))
            inertia = pinocchio.Inertia(float(robot.mass[number]), robot.com[number], robot.inertia[number])
            model.appendBodyToJoint(ids[-1], inertia, pinocchio.SE3.Identity())
        model.gravity.linear = np.array([0.0, 0.0, -_GRAVITY])
        model.armature = robot.armature.copy()
        return model

    def step(self, torque: np.ndarray) -> None:
        """Moves all lanes by a step under torques [lanes, joints] in Nm."""
        for lane, (model, data) in enumerate(self._lanes):
            self._acceleration[lane] = self._aba(model, data, self.q[lane], self.v[lane], torque[lane])
        self.v += self.dt * self._acceleration
        self.q += self.dt * self.v


class BulletPlant:
    """PyBullet's mass matrix and inverse dynamics, with rotors added and second-order Taylor steps at 2 kHz.

    Bullet's joints have no rotor inertia, so its own stepping cannot be used.

    Args:
      robots: that occur.
      robot_of: [lanes] index of each lane's robot.
      q: [lanes, joints] rad at the start.
      v: [lanes, joints] rad/s at the start.
    """

    dt = 0.0005

    def __init__(self, robots: Sequence[Robot], robot_of: np.ndarray, q: np.ndarray, v: np.ndarray):
        pybullet = _engine("pybullet")
        self.q, self.v = q.copy(), v.copy()
        self._client = _engine("pybullet_utils.bullet_client").BulletClient(pybullet.DIRECT)
        self._client.setGravity(0, 0, -_GRAVITY)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        bodies = []
        with tempfile.TemporaryDirectory() as folder:
            for number, robot in enumerate(robots):
                # Each in a file of its own: Bullet keeps the content of files by their names.
                path = Path(folder) / f"robot_{id(self)}_{number}.urdf"
                path.write_text(urdf(robot))
                bodies.append(self._client.loadURDF(str(path), useFixedBase=1, flags=flags))
        self._lanes = [bodies[number] for number in robot_of]
        # Bullet may number the joints of a branching tree in another order than ours.
        found = [self._client.getJointInfo(bodies[0], at)[1].decode() for at in range(q.shape[1])]
        self._order = [robots[0].joints.index(name) for name in found]
        self._place = np.argsort(self._order)
        rotors = np.stack([robot.armature for robot in robots])[robot_of]
        self._rotors = rotors[:, :, None] * np.eye(q.shape[1])
        self._mass, self._bias = np.zeros((*q.shape, q.shape[1])), np.zeros_like(q)

    def step(self, torque: np.ndarray) -> None:
        """Moves all lanes by a step under torques [lanes, joints] in Nm."""
        rest = [0.0] * self.q.shape[1]
        places, speeds = self.q[:, self._order].tolist(), self.v[:, self._order].tolist()
        # Bullet has the PyBullet client's methods behind a slow lookup by name.
        mass, bias = self._client.calculateMassMatrix, self._client.calculateInverseDynamics
        for lane, body in enumerate(self._lanes):
            self._mass[lane] = mass(body, places[lane])
            self._bias[lane] = bias(body, places[lane], speeds[lane], rest)
        full = self._mass[:, self._place][:, :, self._place] + self._rotors
        acceleration = np.linalg.solve(full, (torque - self._bias[:, self._place])[..., None])[..., 0]
        self.q += self.dt * (self.v + 0.5 * self.dt * acceleration)
        self.v += self.dt * acceleration


def _engine(name: str) -> ModuleType:
    """Imports an engine that is an extra."""
    try:
        return import_module(name)
    except ImportError as error:
        raise ValueError(f"size: 'field' needs {name}: pip install 'jaxtune[bullet]'") from error


def urdf(robot: Robot) -> str:
    """Writes the robot's bodies as a URDF; each inertia is turned into its principal axes, which Bullet needs."""
    parts = [
        '<robot name="robot"><link name="base"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>',
    ]
    for number, parent in enumerate(robot.parents):
        values, turn = np.linalg.eigh(robot.inertia[number])
        turn = turn * np.sign(np.linalg.det(turn))
        angles = _roll_pitch_yaw(turn)
        x, y, z = values
        name, above = robot.bodies[number], robot.bodies[parent] if parent >= 0 else "base"
        parts.append(
            f'<link name="{name}"><inertial><origin xyz="{_text(robot.com[number])}" rpy="{_text(angles)}"/>'
            f'<mass value="{robot.mass[number]:.9g}"/>'
            f'<inertia ixx="{x:.9g}" iyy="{y:.9g}" izz="{z:.9g}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{robot.joints[number]}" type="continuous"><parent link="{above}"/><child link="{name}"/>'
            f'<origin xyz="{_text(robot.pos[number])}"/><axis xyz="{_text(robot.axis[number])}"/></joint>'
        )
    return "".join([*parts, "</robot>"])


def _text(values) -> str:
    return " ".join(repr(float(value)) for value in values)


def _roll_pitch_yaw(turn: np.ndarray) -> tuple[float, float, float]:
    pitch = -np.arcsin(np.clip(turn[2, 0], -1, 1))
    return float(np.arctan2(turn[2, 1], turn[2, 2])), float(pitch), float(np.arctan2(turn[1, 0], turn[0, 0]))


PLANTS = {"mujoco_c": MujocoPlant, "bullet": BulletPlant, "pinocchio": PinocchioPlant}
"""Plants by the name of their generator."""
