"""A target in PyBullet, an engine with its own contacts and solver; its body is written from the compiled MJCF.

PyBullet has neither rotor inertia (`joint_armature`) nor the solver's time constant (`contact_time_constant`); a target
whose parameters change them is refused. PyBullet multiplies the frictions of two bodies, so the floor's is set to one.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.biteno import Biteno, Drive, Motion, State, constants
from envs.targets.host import HostTarget
from jaxtune.mjx import parameters

try:
    import pybullet
    from pybullet_utils.bullet_client import BulletClient
except ImportError as error:
    raise ValueError("target: 'bullet' needs PyBullet: pip install 'jaxtune[bullet]'") from error

_MISSING = ("joint_armature", "contact_time_constant")
_ITERATIONS = 100  # of PyBullet's contact solver


def urdf(model: mujoco.MjModel) -> str:
    """Writes a compiled model as URDF: masses, inertias, joint axes and limits, and the feet's spheres.

    Args:
      model: BITeno's, parameters applied.

    Raises:
      ValueError: a body's inertia is not diagonal in its own frame; PyBullet would ignore the rest.
    """
    robot = ElementTree.Element("robot", name="biteno")
    for body in range(1, model.nbody):
        name = model.body(body).name
        link = ElementTree.SubElement(robot, "link", name=name)
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=_words(model.body_ipos[body]))
        ElementTree.SubElement(inertial, "mass", value=repr(float(model.body_mass[body])))
        inertia = _inertia(model, body)
        if np.abs(inertia - np.diag(np.diag(inertia))).max() > 1e-9:
            raise ValueError(f"inertia of '{name}': got {inertia.tolist()}, expected a diagonal matrix")
        moments = dict(zip(("ixx", "iyy", "izz"), (repr(float(moment)) for moment in np.diag(inertia)), strict=True))
        ElementTree.SubElement(inertial, "inertia", ixy="0", ixz="0", iyz="0", **moments)
        for geom in range(model.ngeom):
            if model.geom_bodyid[geom] == body and model.geom(geom).name in constants.FEET:
                collision = ElementTree.SubElement(link, "collision")
                ElementTree.SubElement(collision, "origin", xyz=_words(model.geom_pos[geom]))
                shape = ElementTree.SubElement(collision, "geometry")
                ElementTree.SubElement(shape, "sphere", radius=repr(float(model.geom_size[geom, 0])))
    for name in constants.JOINTS:
        joint = model.joint(name)
        body = model.jnt_bodyid[joint.id]
        element = ElementTree.SubElement(robot, "joint", name=name, type="revolute")
        ElementTree.SubElement(element, "parent", link=model.body(model.body_parentid[body]).name)
        ElementTree.SubElement(element, "child", link=model.body(body).name)
        ElementTree.SubElement(element, "origin", xyz=_words(model.body_pos[body]))
        ElementTree.SubElement(element, "axis", xyz=_words(joint.axis))
        lower, upper = (repr(float(end)) for end in joint.range)
        ElementTree.SubElement(element, "limit", lower=lower, upper=upper, effort="1000", velocity="1000")
    return ElementTree.tostring(robot, encoding="unicode")


def _inertia(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Computes the inertia matrix [3, 3] kg m^2 of a body about its centre of mass, in the body's own axes."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    turn = turn.reshape(3, 3)
    return turn @ np.diag(model.body_inertia[body]) @ turn.T


def _words(vector) -> str:
    return " ".join(repr(float(value)) for value in vector)


class Bullet:
    """PyBullet as an engine for `HostTarget`, with a world of its own for each robot.

    Args:
      robot: task and robot.
      params: true physical values by name.

    Raises:
      ValueError: a parameter needs physics that PyBullet does not have.
    """

    def __init__(self, robot: Biteno, params: Mapping[str, float]):
        for name in _MISSING:
            if params.get(name, 1.0) != 1.0:
                raise ValueError(f"params['{name}']: got {params[name]}, expected 1: PyBullet cannot simulate it")
        model = parameters.apply_mujoco(robot.mj_model, params, robot.entries)
        self._model = model
        self._dt = model.opt.timestep
        self._com = model.body("trunk").ipos.copy()
        rows = [model.actuator(name).id for name in constants.JOINTS]
        # kp (target - q) - kv dq, within the limits.
        self._gain = model.actuator_gainprm[rows, 0]
        self._bias = model.actuator_biasprm[rows, 1:3]
        self._limit = model.actuator_forcerange[rows]
        self._worlds = []

    def start(self, state: State) -> None:
        """Puts every robot into its own world, at its first state; see `envs.targets.host.Engine`."""
        # Worlds of an earlier set of episodes are used again.
        while len(self._worlds) < len(state.qpos):
            self._worlds.append(self._world())
        self._last_qvel = np.asarray(state.qvel)
        for world, qpos, qvel in zip(self._worlds, np.asarray(state.qpos, float), self._last_qvel, strict=False):
            client, body, joints, _ = world
            turn = _rotation(qpos[3:7])
            # PyBullet's base is the centre of mass, and its quaternions end with w; MuJoCo's base is the body's origin.
            client.resetBasePositionAndOrientation(body, qpos[:3] + turn @ self._com, np.roll(qpos[3:7], -1))
            for joint, angle, speed in zip(joints, qpos[7:], qvel[6:], strict=True):
                client.resetJointState(body, joint, angle, float(speed))
            self._set_base_velocity(world, turn, qvel)

    def move(self, state: State, drive: Drive) -> Motion:
        """Moves every robot by one policy step, one after the other; see `envs.targets.host.Engine`."""
        pushed = np.asarray(state.qvel)
        targets = np.asarray(drive.targets, float)
        rows = []
        for row in range(len(pushed)):
            world = self._worlds[row]
            # Only a push changes a velocity between two steps; else the engine keeps its own, which is more exact.
            if np.any(pushed[row] != self._last_qvel[row]):
                self._set_base_velocity(world, _rotation(np.asarray(state.qpos[row], float)[3:7]), pushed[row])
            rows.append(self._move(world, targets[row]))
        qpos, qvel, torque, force = (jnp.asarray(np.stack(column), jnp.float32) for column in zip(*rows, strict=True))
        self._last_qvel = np.asarray(qvel)
        return Motion(qpos=qpos, qvel=qvel, qacc_warmstart=jnp.zeros_like(qvel), torque=torque, foot_force=force)

    def _world(self):
        client = BulletClient(pybullet.DIRECT)
        client.setGravity(*self._model.opt.gravity)
        client.setPhysicsEngineParameter(fixedTimeStep=self._dt, numSolverIterations=_ITERATIONS)
        floor = client.createMultiBody(0, client.createCollisionShape(pybullet.GEOM_PLANE))
        client.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "biteno.urdf"
            path.write_text(urdf(self._model))
            body = client.loadURDF(str(path), flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
        index = {client.getJointInfo(body, joint)[1].decode(): joint for joint in range(client.getNumJoints(body))}
        joints = [index[name] for name in constants.JOINTS]
        feet = [index[f"{side}_knee"] for side in constants.SIDES]
        # PyBullet damps every link by default, as if in air; MuJoCo does not.
        client.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)
        for name, joint in zip(constants.JOINTS, joints, strict=True):
            dof = self._model.joint(name).dofadr[0]
            client.changeDynamics(
                body, joint, linearDamping=0.0, angularDamping=0.0, jointDamping=self._model.dof_damping[dof]
            )
            # PyBullet brakes every joint by default. With the friction loss as its largest force, the brake is the
            # joint's dry friction.
            client.setJointMotorControl2(
                body, joint, pybullet.VELOCITY_CONTROL, force=float(self._model.dof_frictionloss[dof])
            )
        for name, foot in zip(constants.FEET, feet, strict=True):
            friction = self._model.geom(name).friction[0]
            client.changeDynamics(body, foot, lateralFriction=friction, restitution=0.0)
        return client, body, joints, feet

    def _set_base_velocity(self, world, turn: np.ndarray, qvel: np.ndarray) -> None:
        client, body, *_ = world
        spin = turn @ qvel[3:6]
        client.resetBaseVelocity(body, qvel[:3] + np.cross(spin, turn @ self._com), spin)

    def _move(self, world, targets: np.ndarray):
        client, body, joints, feet = world
        for target in targets:
            states = client.getJointStates(body, joints)
            angle, speed = np.array([state[:2] for state in states]).T
            # The PD law of MuJoCo's actuators, computed here so that both engines have the same controller.
            torque = self._gain * target + self._bias[:, 0] * angle + self._bias[:, 1] * speed
            torque = np.clip(torque, self._limit[:, 0], self._limit[:, 1])
            client.setJointMotorControlArray(body, joints, pybullet.TORQUE_CONTROL, forces=torque)
            client.stepSimulation()
        qpos, qvel = self._read(world)
        return qpos, qvel, torque, np.stack([self._force(client, body, foot) for foot in feet])

    def _read(self, world) -> tuple[np.ndarray, np.ndarray]:
        """Reads positions and velocities as MuJoCo defines them: of the trunk's origin, not of its centre of mass."""
        client, body, joints, _ = world
        position, turned = client.getBasePositionAndOrientation(body)
        quat = np.roll(turned, 1)
        turn = _rotation(quat)
        velocity, spin = (np.array(value) for value in client.getBaseVelocity(body))
        # Both are in the world's frame; MuJoCo has the angular velocity in the body's.
        states = client.getJointStates(body, joints)
        angle, speed = np.array([state[:2] for state in states]).T
        origin = np.array(position) - turn @ self._com
        at_origin = velocity - np.cross(spin, turn @ self._com)
        qpos = np.concatenate([origin, quat, angle])
        qvel = np.concatenate([at_origin, turn.T @ spin, speed])
        return qpos, qvel

    @staticmethod
    def _force(client, body: int, foot: int) -> np.ndarray:
        """Sums the contact forces on a foot, normal and both tangential ones, [3] N in the world."""
        total = np.zeros(3)
        for point in client.getContactPoints(bodyA=body, linkIndexA=foot):
            normal, press = np.array(point[7]), point[9]
            total += press * normal + point[10] * np.array(point[11]) + point[12] * np.array(point[13])
        return total


def _rotation(quat: np.ndarray) -> np.ndarray:
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(quat, float))
    return turn.reshape(3, 3)


def target(robot: Biteno, params: Mapping[str, float]) -> HostTarget:
    """Makes a target in PyBullet.

    Args:
      robot: task and robot.
      params: true physical values by name.

    Raises:
      ValueError: a parameter needs physics that PyBullet does not have.
    """
    return HostTarget(robot, params, Bullet(robot, params))
