"""A robot on the test rig, suspended or clamped, with every effect of the library built in.

Every effect has coordinates, which are zero where the effect is absent. A hypothesis about what a model lacks is
therefore a vector, and one compiled program simulates all of them.

Three forms of the same numbers occur. *Coordinates* are searched, and are of order one. *Values* are what the functions
of the effects read (`Rig.values`). *Physical values*, in units, stand in reports and files
(`jaxtune.types.Parameter.value`).
"""

import copy
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs import beginning, sensing
from envs.axes import Axis, describe_axis, loose
from envs.carried import Lift, carriers
from envs.chain import MIN_FRICTION_NM, Chain
from envs.effects import EVERY
from envs.held import unread_joints
from envs.models import hinges, links, suspended
from envs.segments import Segment
from jaxtune import devices
from jaxtune.mjx import parameters, set_const
from jaxtune.types import Effect, Parameter

ByEffect = Mapping[str, Mapping[str, jax.Array]]
"""Coordinates or values by effect and parameter, [places] each."""

System = tuple[mjx.Model, mjx.Data]
"""A robot's model and first state in MJX."""

# Of the solver, with up to so many joints, and with more. After 100 steps with friction in every joint of an arm,
# positions are 0.05 to 1.4 microrad (rms) from those of a solver that has converged; with three iterations, up to 8. A
# hand of 11 joints needs six: after 150 ms it is 0.03 microrad off, and with four 200.
_ITERATIONS, _FEW_JOINTS, _ITERATIONS_OF_MANY = 4, 8, 6
_LONGEST_STEP_S = 0.001
_PINION_M = 0.05  # radius of a pinion that moves a slide
_PARALLEL = 0.1  # share of axes' common length that may lie across it


class Rig:
    """A robot whose base does not move, simulated in MJX with every effect of the library.

    Make it from the nominal MJCF, scale its coordinates to what the robot did in a log (`scaled`), and simulate
    segments of the log (`envs.segments`) under any vector of coordinates:

        values = rig.values(rig.tree(vector))
        read = rig.simulate(values, segment)

    Args:
      spec: of the robot; free joints are removed, contacts and its own actuators switched off, and joints that are not
        read are held where they can be (`envs.held`).
      joints: names of the joints that are controlled and read, in the log's order.
      control_hz: rate of the controller. The simulation's step is the longest that divides the controller's period and
        is no longer than 1 ms.

    Raises:
      ValueError: the robot has something that MJX lacks.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        joints: Sequence[str],
        control_hz: float,
    ):
        model = suspended(spec, joints)
        for name in ("jnt_stiffnesspoly", "dof_dampingpoly", "tendon_stiffnesspoly", "tendon_dampingpoly"):
            if getattr(model, name).any():
                raise ValueError(f"robot: got springs or dampers of several terms ({name}), which MJX lacks")
        self.control_hz = control_hz
        self.dt = 1.0 / control_hz / np.ceil(1.0 / control_hz / _LONGEST_STEP_S - 1e-9)
        model.opt.timestep = self.dt
        # Torques are the chain's, applied to the joints directly.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.joints = tuple(joints)
        found = [model.joint(name) for name in joints]
        self.qpos = np.array([joint.qposadr[0] for joint in found])
        self.dof = np.array([joint.dofadr[0] for joint in found])
        self._bodies = links(model)
        # Equality constraints and tendons may couple what is apart as kinematic trees.
        self.trees = np.zeros_like(self.dof) if model.neq or model.ntendon else model.dof_treeid[self.dof].copy()
        self.bodies = tuple(model.body(i).name for i in self._bodies)
        self.mj_model = model
        # Joints that move but are neither controlled nor read; `check_matches` refuses a model that has some.
        self.others = unread_joints(model, joints)
        # Another copy for MJX, which solves for friction only in joints that had some when the model was put on the
        # device. `mj_model` keeps the nominal friction, from which priors and saved models are computed.
        device = suspended(spec, joints)
        device.opt.timestep, device.opt.disableflags = self.dt, model.opt.disableflags
        # MJX refuses shapes whose contacts it does not know, though nothing touches here.
        device.geom_contype[:] = device.geom_conaffinity[:] = 0
        device.opt.iterations = _ITERATIONS if model.nv <= _FEW_JOINTS else _ITERATIONS_OF_MANY
        # The chain lifts what the nominal model's controller lifts, whatever a link weighs.
        device.body_gravcomp[:] = 0.0
        device.dof_frictionloss[self.dof] = np.maximum(model.dof_frictionloss[self.dof], MIN_FRICTION_NM)
        try:
            self._model = mjx.put_model(device)
        except NotImplementedError as error:
            raise ValueError(f"robot: MJX cannot simulate it: {error}") from error
        self._data = mjx.make_data(self._model)
        self._scales: Mapping[str, np.ndarray] = {}
        turns = hinges(model, self.joints)
        self.slides = tuple(np.array(self.joints)[~turns].tolist())
        # Of angle, [joints]: 1 rad of a hinge; of a slide the way in m that its pinion moves it by.
        self.units = np.where(turns, 1.0, _PINION_M)
        # A robot on a rig has no feet on the ground, so what they need has no place and drops out below.
        self.places = {"joint": self.joints, "body": self.bodies, "foot": (), "robot": ("robot",)}
        self.effects = {row.name: row for row in EVERY.values() if self.places[row.on] and row.needs != "free"}
        self.chain = Chain(
            dt=self.dt,
            rows=tuple(self.effects.values()),
            qpos=self.qpos,
            dof=self.dof,
            bodies=self._bodies,
            period_s=1.0 / control_hz,
            lead_s=0.5 * self.dt,
            before=carriers(model, self.dof),
            units=self.units,
            lift=Lift.of(model),
        )
        self.axes = self._describe_axes()

    @property
    def system(self) -> System:
        """The numbers of this robot, which programs take as an argument; see `on`."""
        # Not on a device yet: a program may run on several.
        return jax.tree.map(np.asarray, (self._model, self._data))

    @property
    def layout(self) -> tuple:
        """All that compiled programs depend on beside `system`: robots of equal layout can share them."""
        addresses = (self.qpos.tobytes(), self.dof.tobytes(), self._bodies.tobytes(), self.trees.tobytes())
        frames = np.asarray(self._model.body_quat).tobytes()
        carried = self.chain.before.tobytes(), self.chain.lift and self.chain.lift.layout
        paces = self.dt, self.control_hz, self.units.tobytes()
        return self.joints, self.bodies, *paces, addresses, frames, carried, jax.tree.structure(self.system)

    def on(self, system: System) -> "Rig":
        """Returns the rig with another robot of the same layout on it, also inside a compiled program."""
        other = copy.copy(self)
        model, other._data = system
        # Most frames of bodies are parallel to their parent's. Where the program knows that, on a CPU a step takes 0.6
        # of the time.
        other._model = model.replace(body_quat=self._model.body_quat)
        return other

    def check_matches(self, joints: Sequence[str], control_hz: float) -> None:
        """Checks that the rig can be compared with a log: its joints and rate, and no other joint that may move.

        Args:
          joints: of the log, in its order.
          control_hz: rate of the log's controller.

        Raises:
          ValueError: joints or rate differ, or a joint of the model is not in the log.
        """
        if (self.joints, self.control_hz) != (tuple(joints), control_hz):
            raise ValueError(
                f"rig: got {self.joints} at {self.control_hz:g} Hz, expected {tuple(joints)} at {control_hz:g} Hz"
            )
        if self.others:
            raise ValueError(f"joints: got a log without {', '.join(self.others)}, expected all joints that may move")

    def scaled(self, scales: Mapping[str, np.ndarray]) -> "Rig":
        """Returns the same robot with other units of its coordinates.

        Without scales a coordinate of one is one unit of its parameter. With them it is a typical size of this robot's
        motion (say its rms torque), so that coordinates of different effects can be compared.

        Args:
          scales: [places] by the name of the scale (`jaxtune.types.Scale`); a name that is left out stays one unit.
        """
        # A shallow copy shares the model on the device.
        other = copy.copy(self)
        other._scales = dict(scales)
        other.axes = other._describe_axes()
        return other

    def _describe_axes(self) -> tuple[Axis, ...]:
        return tuple(
            describe_axis(
                self.mj_model, self.dof, row, parameter, place, index, float(scale), self.moves(row.on, place)
            )
            for row in self.effects.values()
            for parameter in row.parameters
            for index, (place, scale) in enumerate(zip(self.places[row.on], self.scale(row, parameter), strict=True))
        )

    def tree(self, vector: jax.Array) -> dict[str, dict[str, jax.Array]]:
        """Splits vectors of coordinates [..., axes] into arrays [..., places] by effect and parameter.

        The vector is in the order of `axes`. Searches work on vectors; the effects read such a tree.
        """
        tree, start = {}, 0
        for name, row in self.effects.items():
            count = len(self.places[row.on])
            tree[name] = {}
            for parameter in row.parameters:
                tree[name][parameter.name] = vector[..., start : start + count]
                start += count
        return tree

    def scale(self, effect: Effect, parameter: Parameter) -> np.ndarray:
        """Returns the size of one unit of a coordinate at every place of an effect, [places], in the parameter's unit.

        It is one where `scaled` was given no such scale.
        """
        ones = np.ones(len(self.places[effect.on]), np.float32)
        return np.asarray(self._scales.get(parameter.scale, 1.0) * ones, np.float32)

    def inertias(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Computes masses and joint-space inertias, from which scales of coordinates follow.

        Args:
          pose: of the joints, [joints] rad.

        Returns:
          Masses of the bodies, [bodies] kg, and the diagonal of the inertia matrix in this pose, [joints] kg m^2.
        """
        dense = np.zeros((self.mj_model.nv, self.mj_model.nv))
        mujoco.mj_fullM(self.mj_model, self._posed(pose), dense)
        return self.mj_model.body_mass[self._bodies], np.diag(dense)[self.dof]

    def levers(self, pose: np.ndarray) -> np.ndarray:
        """Computes how fast each joint moves each body's centre of mass, from which scales of coordinates follow.

        Args:
          pose: of the joints, [joints] rad.

        Returns:
          Speed of the centre by speed of the joint, [bodies, joints] m; of a slide without unit.
        """
        data, jacobian = self._posed(pose), np.zeros((len(self._bodies), 3, self.mj_model.nv))
        for body, mine in zip(self._bodies, jacobian, strict=True):
            mujoco.mj_jacBodyCom(self.mj_model, data, mine, None, body)
        return np.linalg.norm(jacobian, axis=1)[:, self.dof]

    def _posed(self, pose: np.ndarray) -> mujoco.MjData:
        data = mujoco.MjData(self.mj_model)
        data.qpos[self.qpos] = pose
        mujoco.mj_forward(self.mj_model, data)
        return data

    def loose_centres(self) -> dict[str, np.ndarray]:
        """Directions along which centres of mass are known least, [directions, 3] m in the link's frame, by link.

        A direction is as long as a centre is usually off (`envs.axes.loose`). Where all hinges that carry a link are
        parallel, its centre shows across them alone, and where none does, not at all; the rest is left out.
        """
        data, found = self._posed(np.zeros(len(self.joints))), {}
        for name in self.bodies:
            body = self.mj_model.body(name)
            carrying = [self.mj_model.joint(self.joints[number]).id for number in self.moves("body", name)]
            turning = [one for one in carrying if self.mj_model.jnt_type[one] == mujoco.mjtJoint.mjJNT_HINGE]
            axes = data.xaxis[turning].reshape(-1, 3) @ data.xmat[body.id].reshape(3, 3)
            _, lengths, directions = np.linalg.svd(axes)
            several = (lengths > _PARALLEL * lengths[:1]).sum() > 1
            shown = directions if several else directions[1:] if turning else directions[:0]
            found[name] = loose(body.mass, body.inertia[None])[0] * shown
        return found

    def moves(self, on: str, place: str) -> tuple[int, ...]:
        """Finds the joints whose motion an effect at a place changes directly.

        Args:
          on: what the effect is on: `joint`, `body` or `robot`.
          place: name of the joint or body.

        Returns:
          Indices of the joints: the joint itself, or those that carry the body, nearest first; none for the whole
          robot.
        """
        if on == "joint":
            return (self.joints.index(place),)
        found, body = [], self.mj_model.body(place).id if on == "body" else 0
        # From the body up to the world, whose id is 0; the whole robot is no body and finds nothing.
        while body > 0:
            mine = self.mj_model.jnt_bodyid[[self.mj_model.joint(joint).id for joint in self.joints]] == body
            # Of several joints in one body the last is nearest.
            found += sorted(np.flatnonzero(mine).tolist(), key=lambda number: -self.dof[number])
            body = self.mj_model.body_parentid[body]
        return tuple(found)

    @devices.precisely
    def model(self, values: ByEffect) -> mjx.Model:
        """Makes the MJX model that the effects change that enter the model, with its derived fields recomputed.

        Every parameter that names fields becomes a row of a table for `jaxtune.mjx.apply`. What has a function of its
        own acts on the model that comes out.
        """
        entries, params = {}, {}
        rows = {name: row for name, row in self.effects.items() if row.enters == "model"}
        for name, row in rows.items():
            for parameter in row.parameters if row.act is None else ():
                key = f"{name}.{parameter.name}"
                entries[key] = parameters.Entry(
                    kind=row.on,
                    targets=self.places[row.on],
                    fields=parameter.fields,
                    bounds=parameter.bounds if parameter.form != "ratio" else tuple(np.exp(parameter.bounds)),
                    log=parameter.form == "ratio",
                )
                inner = values[name][parameter.name]
                params[key] = jnp.exp(inner) if parameter.form == "ratio" else inner
        model = parameters.apply(self._model, params, entries)
        for name, row in rows.items():
            if row.act is not None:
                model = row.act(values[name], model, self.dof if row.on == "joint" else self._bodies)
        return set_const(model)

    def inner(self, vectors: np.ndarray) -> np.ndarray:
        """Translates vectors of coordinates [n, axes] into values [n, axes], the form that effects read.

        It is `values` for flat vectors, in the order of `axes`.
        """
        tree = self.values(self.tree(np.asarray(vectors)))
        return np.concatenate([np.asarray(leaf) for row in tree.values() for leaf in row.values()], axis=-1)

    def values(self, coords: ByEffect) -> ByEffect:
        """Translates coordinates into values, the form that effects read (`jaxtune.types.Parameter.inner`).

        Both are [places] by effect and parameter; zero coordinates give values with which no effect acts.
        """
        return {
            name: {
                parameter.name: parameter.inner(coords[name][parameter.name], self.scale(row, parameter))
                for parameter in row.parameters
            }
            for name, row in self.effects.items()
        }

    def simulate(self, values: ByEffect, segment: Segment, steps: jax.Array | None = None) -> dict[str, jax.Array]:
        """Simulates a segment of a log under one hypothesis.

        First the measured history before the segment fills the memories of the effects. Where gears give way, its
        end is simulated as well, to know where their links are, with rotors held to their measured motion. Where
        encoders are at joints, it is to know where rotors are, with links held. Then the robot starts from its measured
        state, with the errors of its sensors undone, and is simulated to the segment's end.

        Args:
          values: of all effects, as `values` returns them.
          segment: the controller's inputs, and the motion measured before the segment.
          steps: how many steps are simulated, all where None; later rows repeat zeros. As it may be traced, segments of
            all lengths can share one program.

        Returns:
          Readings at the segment's rows by signal: `q`, `dq`, `tau` and `command` [rows, joints], `gravity` [rows, 3].
        """
        model = self.model(values)
        chain = self.chain
        data, memory, future = beginning.begin(chain, model, self._data, values, segment)
        take = lambda index: jax.tree.map(lambda x: x[index], future)  # noqa: E731

        def move(index, carry):
            data, memory, reads = carry
            data, memory, read = chain.step(model, data, memory, values, take(index))
            return data, memory, jax.tree.map(lambda all, now: all.at[index].set(now), reads, read)

        count = len(future["sample"])
        one = jax.eval_shape(lambda: chain.step(model, data, memory, values, take(0))[2])
        reads = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), one)
        _, _, read = jax.lax.fori_loop(0, count if steps is None else steps, move, (data, memory, reads))
        # The rows of a log lie between steps of the simulation, so readings are interpolated.
        step, share = segment.row_step, segment.row_share[:, None]
        following = jnp.minimum(step + 1, len(future["sample"]) - 1)
        read = jax.tree.map(lambda x: x[step] + share * (x[following] - x[step]), read)
        # The base does not move, so the IMU reads the same at all rows. It is taken to sit on the first body, which
        # carries the others.
        gravity, _ = chain.stage("gravity", values, sensing.resting_gravity(model), None, {})
        return read | {"gravity": jnp.broadcast_to(gravity, (len(step), 3))}
