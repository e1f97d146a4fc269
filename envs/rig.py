"""A robot on the test rig, hung or clamped, with every effect of the library built in.

An effect that is not there has coordinates of zero and changes nothing, so one compiled program serves all hypotheses:
what is missing is a vector.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs import domain, sensing
from envs.effects import LIBRARY, RESIDUAL
from envs.effects.memory import LONGEST_S
from envs.segments import Segment
from jaxtune.types import Effect, Parameter

Coordinates = Mapping[str, Mapping[str, jax.Array]]
"""Coordinates by effect and parameter, [places] each."""

_MIN_FRICTION_NM = 1e-6
_ITERATIONS, _LINE_SEARCHES = 6, 10  # what joint friction takes to be right (see envs.biteno)
_LONGEST_STEP_S = 0.001


@chex.dataclass(frozen=True)
class Now:
    """What an effect may look at."""

    dt: float
    position: jax.Array  # [joints] rad
    speed: jax.Array  # [joints] rad/s
    load: jax.Array  # [joints] Nm on the gears, the larger of those of their two sides
    limit: jax.Array  # [joints] Nm, the controller's
    stiffness: jax.Array  # [joints] Nm/rad
    damping: jax.Array  # [joints] Nm s/rad
    rotor: jax.Array  # [joints] kg m^2, inertia of the motor on its side of the gears
    carried: jax.Array  # [joints] Nm that the rotor takes to keep up with the joint
    body_velocity: jax.Array  # [bodies, 3] m/s of the centres of mass


@chex.dataclass(frozen=True)
class Wrench:
    """What acts from outside."""

    torque: jax.Array  # [joints] Nm
    force: jax.Array  # [bodies, 3] N at the centres of mass


@dataclass(frozen=True)
class Axis:
    """One coordinate of one effect at one place."""

    effect: str
    parameter: str
    place: str
    index: int
    """Of the place."""


class Rig:
    """A robot whose base does not move.

    Args:
      spec: the robot; free joints are taken away, contacts and its own actuators switched off.
      joints: those that are controlled and read, in the log's order.
      control_hz: the controller's rate; a simulation step divides its period.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        joints: Sequence[str],
        control_hz: float,
    ):
        model = hung(spec)
        self.control_hz = control_hz
        self.dt = 1.0 / control_hz / np.ceil(1.0 / control_hz / _LONGEST_STEP_S - 1e-9)
        model.opt.timestep = self.dt
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.joints = tuple(joints)
        found = [model.joint(name) for name in joints]
        self.qpos = np.array([joint.qposadr[0] for joint in found])
        self.dof = np.array([joint.dofadr[0] for joint in found])
        moving = [
            i
            for i in range(1, model.nbody)
            if model.body_weldid[i] > 0 and model.body_mass[i] > 0 and model.body(i).name
        ]
        self._bodies = np.array(moving)
        self.bodies = tuple(model.body(i).name for i in moving)
        self.mj_model = model
        # Joints that move, and that nobody controls or reads.
        self.others = tuple(
            model.joint(i).name or f"joint {i}" for i in range(model.njnt) if model.jnt_qposadr[i] not in self.qpos
        )
        # MJX solves for friction only in joints that had some when the model was put on the device.
        device = hung(spec)
        device.opt.timestep, device.opt.disableflags = self.dt, model.opt.disableflags
        device.opt.iterations, device.opt.ls_iterations = _ITERATIONS, _LINE_SEARCHES
        device.dof_frictionloss[self.dof] = np.maximum(model.dof_frictionloss[self.dof], _MIN_FRICTION_NM)
        self._model = mjx.put_model(device)
        self._friction = jnp.asarray(model.dof_frictionloss[self.dof], jnp.float32)
        self._data = mjx.make_data(self._model)
        # The IMU sits on the body that holds the others.
        self._gravity = sensing.projected_gravity(jnp.asarray(model.body_quat[1], jnp.float32))
        self._scales: Mapping[str, np.ndarray] = {}
        self.places = {"joint": self.joints, "body": self.bodies, "foot": (), "robot": ("robot",)}
        rows = (*LIBRARY.values(), RESIDUAL)
        self.effects = {row.name: row for row in rows if self.places[row.on] and row.needs != "free"}
        self.axes = tuple(
            Axis(name, parameter.name, place, index)
            for name, row in self.effects.items()
            for parameter in row.parameters
            for index, place in enumerate(self.places[row.on])
        )

    def scaled(self, scales: Mapping[str, np.ndarray]) -> "Rig":
        """The same robot, where coordinates stand for `scales`, [places] by name, instead of their units."""
        other = copy.copy(self)
        other._scales = dict(scales)
        return other

    def tree(self, vector: jax.Array) -> dict[str, dict[str, jax.Array]]:
        """A vector [axes] by effect and parameter."""
        tree, start = {}, 0
        for name, row in self.effects.items():
            count = len(self.places[row.on])
            tree[name] = {}
            for parameter in row.parameters:
                tree[name][parameter.name] = vector[start : start + count]
                start += count
        return tree

    def scale(self, effect: Effect, parameter: Parameter) -> np.ndarray:
        """What a coordinate of one stands for at every place."""
        ones = np.ones(len(self.places[effect.on]), np.float32)
        return np.asarray(self._scales.get(parameter.scale, 1.0) * ones, np.float32)

    def inertias(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Masses of the links in kg, and what each joint feels of the robot in a pose [joints], in kg m^2."""
        data, dense = mujoco.MjData(self.mj_model), np.zeros((self.mj_model.nv, self.mj_model.nv))
        data.qpos[self.qpos] = pose
        mujoco.mj_forward(self.mj_model, data)
        mujoco.mj_fullM(self.mj_model, data, dense)
        return self.mj_model.body_mass[self._bodies], np.diag(dense)[self.dof]

    def moves(self, on: str, place: str) -> set[int]:
        """Numbers of the joints beside which something at this place shows: the joint, or those that carry a link."""
        if on == "joint":
            return {self.joints.index(place)}
        found, body = set(), self.mj_model.body(place).id if on == "body" else 0
        while body > 0:
            mine = self.mj_model.jnt_bodyid[[self.mj_model.joint(joint).id for joint in self.joints]] == body
            found |= set(np.flatnonzero(mine).tolist())
            body = self.mj_model.body_parentid[body]
        return found

    def nominal(self) -> dict[Axis, float]:
        """The parameters that every model has, and how far they may be off: a standard deviation in coordinates.

        A tenth of the nominal value, for every link's mass and every joint's armature, damping, friction and
        controller gain, where the model has them.
        """
        share = 0.1
        fields = {"armature": "dof_armature", "viscous": "dof_damping", "coulomb": "dof_frictionloss"}
        spread = {}
        for axis in self.axes:
            row = self.effects[axis.effect]
            if axis.effect in ("link_mass", "gain_error"):
                spread[axis] = share
            elif axis.effect in fields:
                value = getattr(self.mj_model, fields[axis.effect])[self.dof[axis.index]]
                if value > 0:
                    spread[axis] = share * float(value / self.scale(row, row.parameters[0])[axis.index])
        return spread

    def model(self, values: Coordinates) -> mjx.Model:
        """The model with what effects do to its fields."""
        entries, params = {}, {}
        for name, row in self.effects.items():
            if row.enters != "model":
                continue
            for parameter in row.parameters:
                key = f"{name}.{parameter.name}"
                entries[key] = domain.Entry(
                    name=key,
                    kind=row.on,
                    targets=self.places[row.on],
                    fields=parameter.fields,
                    bounds=parameter.bounds,
                    column=parameter.column,
                    log=parameter.form == "ratio",
                )
                inner = values[name][parameter.name]
                params[key] = jnp.exp(inner) if parameter.form == "ratio" else inner
        return domain.apply(self._model, params, entries)

    def inner(self, vectors: np.ndarray) -> np.ndarray:
        """What the physics reads of coordinates [n, axes], [n, axes]."""
        trees = [self.values(self.tree(vector)) for vector in vectors]
        return np.array([np.concatenate([leaf for row in tree.values() for leaf in row.values()]) for tree in trees])

    def values(self, coordinates: Coordinates) -> dict:
        """What the physics reads of coordinates."""
        return {
            name: {
                parameter.name: parameter.inner(coordinates[name][parameter.name], self.scale(row, parameter))
                for parameter in row.parameters
            }
            for name, row in self.effects.items()
        }

    def simulate(self, values: Coordinates, segment: Segment) -> dict[str, jax.Array]:
        """Moves the robot through a segment.

        Args:
          values: what the physics reads of all effects, one hypothesis.
          segment: what was sent, and what was measured before it.

        Returns:
          What is read at the rows, [rows, joints] by signal; of `gravity` [rows, 3].
        """
        model = self.model(values)
        before = len(segment.measured) - 1 - round(LONGEST_S / self.dt)
        drive = {
            name: getattr(segment, name)
            for name in ("target", "feed", "stiffness", "damping", "limit", "emf", "sample")
        }
        past = jax.tree.map(lambda x: x[:before], drive)
        future = jax.tree.map(lambda x: x[before:], drive)
        truth = segment.measured
        for row in self._rows("sensor"):
            if row.undo is not None:
                truth = row.undo(values[row.name], truth, self.dt)
        rotor, acceleration = model.dof_armature[self.dof], jnp.gradient(truth[:, 1], self.dt, axis=0)
        # What is read of the motor stands still for what is read of the joint until play and wind-up are known.
        memory = self._start(values, truth[0], jax.tree.map(lambda x: x[0], drive))

        def remember(memory, inputs):
            state, carried, x = inputs
            return self._drive(values, memory, state, x, carried)[0], None

        memory, _ = jax.lax.scan(remember, memory, (truth[:before], rotor * acceleration[:before], past))
        start = truth[before] - self._ahead(memory)
        data = self._data.replace(
            qpos=self._data.qpos.at[self.qpos].set(start[0]),
            qvel=self._data.qvel.at[self.dof].set(start[1]),
            qacc=self._data.qacc.at[self.dof].set(acceleration[before]),
        )

        def move(carry, x):
            memory, data = carry
            joint = jnp.stack([data.qpos[self.qpos], data.qvel[self.dof]])
            bias = data.qfrc_bias[self.dof]
            motor = joint.at[0].add(self._ahead(memory)[0])
            memory, (torque, read) = self._drive(values, memory, motor, x, rotor * data.qacc[self.dof], rotor)
            now = self._now(x, joint, load=jnp.maximum(jnp.abs(torque), jnp.abs(bias)), data=data)
            friction, _ = self._stage("friction", values, self._friction, now, memory)
            wrench, _ = self._stage("wrench", values, self._calm(), now, memory)
            # With a bound of nothing at all MJX brakes the joint.
            friction = jnp.maximum(friction, _MIN_FRICTION_NM)
            moved = model.replace(dof_frictionloss=model.dof_frictionloss.at[self.dof].set(friction))
            data = data.replace(
                qfrc_applied=data.qfrc_applied.at[self.dof].set(torque + wrench.torque),
                xfrc_applied=data.xfrc_applied.at[self._bodies, :3].set(wrench.force),
            )
            return (memory, mjx.step(moved, data)), read

        _, read = jax.lax.scan(move, (memory, data), future)
        step, share = segment.row_step, segment.row_share[:, None]
        following = jnp.minimum(step + 1, len(future["sample"]) - 1)
        read = jax.tree.map(lambda x: x[step] + share * (x[following] - x[step]), read)
        gravity, _ = self._stage("gravity", values, self._gravity, None, {})
        return read | {"gravity": jnp.broadcast_to(gravity, (len(step), 3))}

    def _rows(self, stage: str) -> list[Effect]:
        return [row for row in self.effects.values() if row.enters == stage]

    def _stage(self, stage, values, signal, now, memory):
        """Hands a signal from effect to effect."""
        memory = dict(memory)
        for row in self._rows(stage):
            signal, kept = row.act(values[row.name], signal, now, memory.get(row.name))
            if row.start is not None:
                memory[row.name] = kept
        return signal, memory

    def _start(self, values, state, x) -> dict:
        """Memories of a robot that has been like this for ever."""
        torque = self._law(x, x["target"] - state[0], state[1])
        signals = {"command": x["target"], "sensor": state, "torque": torque, "transmission": torque}
        memory = {"held": torque}
        for stage, signal in signals.items():
            for row in self._rows(stage):
                if row.start is not None:
                    memory[row.name] = row.start(values[row.name], signal, self.dt)
        return memory

    @staticmethod
    def _law(x, error, speed) -> jax.Array:
        torque = x["stiffness"] * error - x["damping"] * speed
        return jnp.clip(torque, -x["limit"], x["limit"]) + x["feed"]

    def _drive(self, values, memory, motor, x, carried, rotor=None):
        """From what is true of the motors [2, joints] to the torque on the joints, and what is read.

        Args:
          carried: torque [joints] that the motors' inertia takes to keep up with the joints.
          rotor: inertia of the motors [joints]; None where they were measured, and went where they went.
        """
        now = self._now(x, motor)
        readings, memory = self._stage("sensor", values, motor, now, memory)
        target, memory = self._stage("command", values, x["target"], now, memory)
        error, memory = self._stage("error", values, target - readings[0], now, memory)
        held = jnp.where(x["sample"], self._law(x, error, readings[1]), memory["held"])
        memory["held"] = held
        torque, memory = self._stage("torque", values, held, now, memory)
        none = jnp.zeros_like(held)
        free = {"stiffness": none, "damping": none} if rotor is None else {"rotor": rotor}
        before = self._ahead(memory)[0]
        torque, memory = self._stage(
            "transmission", values, torque - x["emf"] * motor[1], now.replace(carried=carried, **free), memory
        )
        running = (self._ahead(memory)[0] - before) / self.dt
        return memory, (torque, {"q": readings[0], "dq": readings[1] + running, "tau": torque})

    def _ahead(self, memory) -> jax.Array:
        """How far and how fast the motors run ahead of the joints, [2, joints] rad and rad/s."""
        return sum(memory[row.name] for row in self._rows("transmission"))

    def _now(self, x, state, load=0.0, data=None) -> Now:
        velocity = jnp.zeros((len(self.bodies), 3)) if data is None else _velocity(self._model, data)[self._bodies]
        return Now(
            dt=self.dt,
            position=state[0],
            speed=state[1],
            load=load * jnp.ones_like(state[1]),
            limit=x["limit"],
            stiffness=x["stiffness"],
            damping=x["damping"] + x["emf"],
            rotor=jnp.zeros_like(state[1]),
            carried=jnp.zeros_like(state[1]),
            body_velocity=velocity,
        )

    def _calm(self) -> Wrench:
        return Wrench(torque=jnp.zeros(len(self.joints)), force=jnp.zeros((len(self.bodies), 3)))


def hung(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """A robot without its free joint and without contacts."""
    spec = spec.copy()
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if free:
        # Poses in keyframes have the base in them.
        for key in spec.keys:
            spec.delete(key)
    for joint in free:
        spec.delete(joint)
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model


def _velocity(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Velocity of every body's centre of mass in the world, [bodies, 3] m/s, from the last step's kinematics."""
    angular, linear = data.cvel[:, :3], data.cvel[:, 3:]
    arm = data.xipos - data.subtree_com[jnp.asarray(model.body_rootid)]
    return linear + jnp.cross(angular, arm)
