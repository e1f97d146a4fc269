"""Simulates one step of a robot with effects between its targets and its readings, on the test rig and in a walk.

The effects are rows of `envs.effects`, which draws the stages that they act at. This chain alone applies them.
`envs.rig` uses it for a robot whose base is fixed, and `envs.corrected` for a BITeno that walks. `envs.history` uses it
for measured motion, which they remember.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from envs import stepping
from envs.carried import Lift
from jaxtune.types import Effect

MIN_FRICTION_NM = 1e-6
"""Smallest bound of dry friction, in Nm: small enough to change nothing, and not zero.

MJX solves for friction only in joints that had some when the model was put on the device, and brakes a joint whose
bound is exactly zero."""

LIGHTEST = 0.01
"""Least share of a joint's inertia that its link has; the rest is the rotor's."""


@chex.dataclass(frozen=True)
class Now:
    """State of the robot at one step, as far as an effect may depend on it beside its values, signal and memory."""

    dt: float  # step of the simulation in s
    position: jax.Array  # [joints] rad
    speed: jax.Array  # [joints] rad/s
    load: jax.Array  # [joints] Nm, the larger of the motor's torque and of gravity and Coriolis torque
    limit: jax.Array  # [joints] Nm, largest torque of the controller
    stiffness: jax.Array  # [joints] Nm/rad, of a controller that acts within the step
    damping: jax.Array  # [joints] Nm s/rad, of such a controller and its back electromotive force
    rotor: jax.Array  # [joints] kg m^2, the rotor's part of the joint's inertia
    link: jax.Array  # [joints] share of the joint's inertia that is not the rotor's
    mobility: jax.Array  # [joints] 1/(kg m^2), the inverse of the link's part of the joint's inertia
    alone: jax.Array  # [joints] rad/s^2, acceleration of the link without its gears and dry friction, but with bristles
    stopped: jax.Array  # [joints] rad/s^2, acceleration of a joint that dry friction can stop
    rigid: jax.Array  # [joints] share of dry friction that is not of bristles
    body_velocity: jax.Array  # [bodies, 3] m/s of the centres of mass
    between: jax.Array  # [joints] rad, how far targets are from the held ones if they move on between rows
    unit: jax.Array  # [joints] unit of angle: 1 rad of a hinge, or the way in m that a slide has instead
    before: jax.Array  # [joints] index of the joint that carries this one, past the last where there is none
    after: jax.Array  # [joints] of the one joint that this one carries, past the last where there is no such


@chex.dataclass(frozen=True)
class Wrench:
    """Forces on the robot from outside its motors: the signal of the stage `wrench`, to which effects add."""

    torque: jax.Array  # [joints] Nm
    force: jax.Array  # [bodies, 3] N at the centres of mass


@dataclass(frozen=True)
class Chain:
    """A controller, its motors and its sensors, with effects in the order in which they act.

    Three arguments of its methods are always the same:

    - `values` holds [places] by effect and parameter, in the form that effects read. Zero means no effect.
    - `memory` is a dictionary: what each effect remembers, by its name, `held`, the controller's last torque, `passed`,
      the torque of motors and of dry friction on the joints in the last step, less what bristles rub at links (after
      `envs.history.remember`: the motors' torque), and `within`, the share of its gains with which the controller acted
      within it.
    - `x` holds the controller's inputs of one step, [joints] each: `target` rad, `feed` Nm (torque sent directly),
      `stiffness` Nm/rad, `damping` Nm s/rad, `limit` Nm, `emf` Nm s/rad (back electromotive force, not limited), and
      `sample`, a scalar that is true where the controller reads the joint anew.

    The controller's law is that of `envs.logs.Impedance`.
    """

    dt: float
    rows: Sequence[Effect]
    qpos: np.ndarray
    """[joints] addresses of the joints' positions."""
    dof: np.ndarray
    """[joints] addresses of the joints' velocities."""
    bodies: np.ndarray
    """[bodies] ids of the bodies that a wrench may act on."""
    period_s: float
    """Of the controller."""
    before: np.ndarray
    """[joints] index of the joint that carries each joint (`envs.carried.carriers`)."""
    lead_s: float = 0.0
    """How far positions of the simulation are ahead of its velocities; half a step makes semi-implicit Euler of second
    order, which is then the leapfrog scheme."""
    lift: Lift | None = None
    """What carries the robot's weight; none where None."""
    units: np.ndarray | None = None
    """[joints] 1 rad of a hinge, or the way in m that a slide has instead (`envs.rig.Rig.units`); hinges where None."""

    @property
    def beside(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the joints before and after each, [joints]; as many as joints for none.

        Where a robot branches, no joint is after the last one before.
        """
        count = len(self.dof)
        children = [np.flatnonzero(self.before == number) for number in range(count)]
        return self.before, np.array([mine[0] if len(mine) == 1 else count for mine in children])

    def step(self, model: mjx.Model, data: mjx.Data, memory: dict, values, x) -> tuple[mjx.Data, dict, dict]:
        """Simulates one step of the physics, from the controller's inputs to the robot's motion.

        Args:
          model: of the robot, effects on its fields included.
          data: the robot before the step, as the last one or `stepping.placed` has left it.
          memory: of the effects before the step.
          values: of the effects.
          x: the controller's inputs.

        Returns:
          The robot and the memories after the step, and what was read before it, [joints] each: `q`, `dq`, `tau`, the
          torque of the motors, and `command`, that which the controller asked for.
        """
        joint, within = self.joints(data), self.within(model, x)
        motor, running = self._seen(values, joint, memory, within)
        unlogged = self.unlogged(values, memory)
        memory, torque, readings = self.control(values, memory | {"within": within}, motor, x)
        # The controller answers a motor that runs ahead only as far as it sees it.
        within = self.at_encoders(values, within)
        gains = {name: within * x[name] for name in ("stiffness", "damping")}
        torque = torque - x["emf"] * joint[1]
        data, memory, torque = self.move(model, data, memory, values, torque, x | gains)
        torques, memory = self.stage("torque_reading", values, jnp.stack([torque, memory["held"]]), None, memory)
        position, velocity = readings - unlogged
        return data, memory, {"q": position, "dq": velocity + running, "tau": torques[0], "command": torques[1]}

    def within(self, model, x) -> jax.Array:
        """Share of the controller's gains that acts within the step, [joints].

        A controller acts on what it saw at the beginning of its period. A rotor that is too light for that, or has no
        inertia in the model, would be thrown about, so its controller acts within every step.

        Args:
          model: of the robot; its armatures [dofs] kg m^2 count.
          x: the controller's inputs.
        """
        gain = (x["stiffness"] * self.period_s + x["damping"]) * self.period_s
        return jnp.clip(gain / jnp.maximum(model.dof_armature[self.dof], 1e-9) - 1.0, 0.0, 1.0)

    def at_encoders(self, values, ahead: jax.Array) -> jax.Array:
        """What encoders see of how motors run ahead [..., joints]: all of it where they sit on the motors."""
        return self.stage("encoder", values, ahead, None, {})[0]

    def at_log(self, values, ahead: jax.Array) -> jax.Array:
        """What the log sees of how motors run ahead [..., joints]: as the controller does, or less (`JOINT_LOG`)."""
        return self.stage("log", values, self.at_encoders(values, ahead), None, {})[0]

    def unlogged(self, values, memory) -> jax.Array:
        """What the controller sees of how motors run ahead and the log does not, [2, joints] rad and rad/s."""
        ahead = self.ahead(memory)
        return self.at_encoders(values, ahead) - self.at_log(values, ahead)

    def _seen(self, values, joint, memory, within) -> tuple[jax.Array, jax.Array]:
        """What encoders and controller see of the motors.

        Args:
          values: of the effects.
          joint: positions and velocities of the joints, [2, joints].
          memory: of the effects.
          within: share of the controller's gains that acts within the step, [joints].

        Returns:
          Positions and velocities [2, joints], and the part of the motors' velocities [joints] that is not in them,
          because it acts within the step.
        """
        far, fast = self.at_encoders(values, self.ahead(memory))
        return joint + jnp.stack([far, (1.0 - within) * fast]), within * fast

    def move(self, model, data, memory, values, torque, x, on_links=0.0) -> tuple[mjx.Data, dict, jax.Array]:
        """Moves the robot by a step, without its controller.

        Args:
          model: of the robot, effects on its fields included.
          data: the robot before the step, as the last one or `stepping.placed` has left it.
          memory: before the step.
          values: of the effects.
          torque: of the motors, [joints] Nm.
          x: the controller's inputs, whose gains act within the step where motors run ahead of their joints.
          on_links: torques from outside, [joints] Nm.

        Returns:
          The robot and the memories after the step, and what the motors gave in it, [joints] Nm.
        """
        joint, (before, fast) = self.joints(data), self.ahead(memory)
        given = torque - (x["damping"] + x["emf"]) * fast
        now = self.now_of(x, joint).replace(
            load=jnp.maximum(jnp.abs(given), jnp.abs(data.qfrc_bias[self.dof])),
            body_velocity=_velocity(model, data)[self.bodies],
            **self._rotors_and_links(model, data, memory),
        )
        # Effects of friction and of forces from outside have no memory, but bristles have.
        friction, _ = self.stage("friction", values, model.dof_frictionloss[self.dof], now, memory)
        none = jnp.zeros_like(torque)
        (left, _), _ = self.stage("bristle", values, jnp.stack([friction, none]), now, memory)
        now = now.replace(rigid=jnp.where(friction > 0, left / jnp.maximum(friction, MIN_FRICTION_NM), 1.0))
        signal = jnp.stack([torque, friction, model.dof_damping[self.dof], none, none])
        (passed, friction, damping, rubs, slows), memory = self.stage("transmission", values, signal, now, memory)
        share, friction, damping = rubs / jnp.maximum(friction + rubs, 1e-9), friction + rubs, damping + slows
        # What its controller gave while the motor ran ahead within the step.
        far, fast = self.ahead(memory)
        torque = torque - now.stiffness * (far - before) - now.damping * fast
        calm = Wrench(torque=none + on_links, force=jnp.zeros((len(self.bodies), 3)))
        wrench, _ = self.stage("wrench", values, calm, now, memory)
        (friction, rubbing), memory = self.stage("bristle", values, jnp.stack([friction, wrench.torque]), now, memory)
        friction = jnp.maximum(friction, MIN_FRICTION_NM)
        moved = model.replace(
            dof_frictionloss=model.dof_frictionloss.at[self.dof].set(friction),
            dof_damping=model.dof_damping.at[self.dof].set(damping),
        )
        # Data of a step hold where links were before it.
        there = mjx.com_pos(model, mjx.kinematics(model, data)) if self.lift else data
        data = data.replace(
            qfrc_applied=self.lifted(model, there).at[self.dof].add(passed + rubbing),
            xfrc_applied=data.xfrc_applied.at[self.bodies, :3].set(wrench.force),
        )
        data = stepping.step(moved, data)
        # Motor and link may rub as one. What that takes of the motor's torque does not come from the link.
        memory["passed"] = passed - slows * joint[1] + share * (rubbing - wrench.torque)
        memory["passed"] += stepping.dry_friction(data)[self.dof]
        return data, memory, torque

    def lifted(self, model, data) -> jax.Array:
        """Torques with which the robot's weight is carried, [dofs] Nm, where `data` says that the links are."""
        return self.lift.torques(model, data) if self.lift else jnp.zeros_like(data.qvel)

    def _rotors_and_links(self, model, data, memory) -> dict:
        """What `Now` says of rotors and their links before a step."""
        rotor, acceleration = model.dof_armature[self.dof], data.qacc[self.dof]
        mobility = stepping.mobility(model, data)[self.dof]
        link = jnp.clip(1.0 - rotor * mobility, LIGHTEST, 1.0)
        mobility = mobility / link
        # Less what gears and friction gave in the step before. Else a rotor would expect the blow of the moment in
        # which it met its link to go on, and leave it again; and a link that its friction has just stopped to turn
        # back.
        given = memory["passed"] - rotor * acceleration
        return {
            "rotor": rotor,
            "link": link,
            "mobility": mobility,
            "alone": acceleration - given * mobility,
            "stopped": stepping.stopped(model, data)[self.dof],
        }

    def read(self, values, memory: dict, joint: jax.Array, x) -> jax.Array:
        """Reads the joints through the effects of transmission and sensors, without advancing a memory.

        Args:
          values: of the effects.
          memory: as `step` or `start` left it.
          joint: true positions and velocities, [2, joints].
          x: the controller's inputs.

        Returns:
          Read positions and velocities, [2, joints].
        """
        motor, running = self._seen(values, joint, memory, memory["within"])
        return self.stage("sensor", values, motor, self.now_of(x, motor), memory)[0].at[1].add(running)

    def joints(self, data: mjx.Data) -> jax.Array:
        """Takes positions and velocities of the joints from MJX's data, [2, joints] rad and rad/s.

        They are the true ones, before any effect of transmission or sensors.
        """
        speed = data.qvel[self.dof]
        return jnp.stack([data.qpos[self.qpos] - self.lead_s * speed, speed])

    def entering(self, stage: str) -> list[Effect]:
        """Lists the effects that enter a stage (`jaxtune.types.Effect.enters`), in the order in which they act."""
        return [row for row in self.rows if row.enters == stage]

    def stage(self, stage, values, signal, now, memory):
        """Passes a signal through all effects of one stage.

        Args:
          stage: what the effects enter (`jaxtune.types.Effect.enters`).
          values: of the effects.
          signal: as the stage's effects take it.
          now: `Now`, or None where no effect of the stage looks at it.
          memory: of the effects; it is copied, not changed.

        Returns:
          The signal after the last effect, and the memories.
        """
        memory = dict(memory)
        for row in self.entering(stage):
            signal, kept = row.act(values[row.name], signal, now, memory.get(row.name))
            # Without a start there is no memory; an entry of None would change the structure of a scan's carry.
            if row.start is not None:
                memory[row.name] = kept
        return signal, memory

    def start(self, values, state, x, past_target=None) -> dict:
        """Makes the memories in steady state: of a robot that has been in one state, with one target, for a long time.

        Use it before the first step. A segment of a log then replays its history to get the real ones (`envs.rig`).

        Args:
          values: of the effects.
          state: positions and velocities, [2, joints].
          x: the controller's inputs.
          past_target: targets [past targets, joints] rad that led to the first one, which a slew limit may still be
            behind; None where they never moved. For the time between two, see `envs.effects.memory`.
        """
        torque = self._law(x, x["target"] - state[0], state[1])
        # What reaches each of these stages in steady state, other effects left aside.
        signals = {"sensor": state, "torque": torque, "transmission": torque[None]}
        # A robot that walks begins with bristles without a load; those of a segment carry it (`envs.history`).
        signals["bristle"] = jnp.zeros_like(torque), state[:1]
        signals["command"] = x["target"][None] if past_target is None else past_target
        memory = {"held": torque, "passed": torque, "within": jnp.zeros_like(torque)}
        for stage, signal in signals.items():
            for row in self.entering(stage):
                if row.start is not None:
                    memory[row.name] = row.start(values[row.name], signal, self.dt)
        return memory

    @staticmethod
    def _law(x, error, speed) -> jax.Array:
        """`envs.logs.Impedance.torque` in JAX, of an error that effects may have changed."""
        torque = x["stiffness"] * error - x["damping"] * speed
        return jnp.clip(torque, -x["limit"], x["limit"]) + x["feed"]

    def control(self, values, memory, motor, x):
        """Computes the motors' torques, from their state through sensors and controller.

        Args:
          values: of the effects.
          memory: before the step.
          motor: true positions and velocities of the motors, seen at the joints, [2, joints].
          x: the controller's inputs.

        Returns:
          The memories after the step, the torques of the motors [joints] Nm without back electromotive force, which
          acts continuously, and positions and velocities as read.
        """
        now = self.now_of(x, motor)
        readings, memory = self.stage("sensor", values, motor, now, memory)
        target, memory = self.stage("command", values, x["target"], now, memory)
        error, memory = self.stage("error", values, target - readings[0], now, memory)
        # A controller holds its torque from one reading of the joint to the next.
        speed, memory = self.stage("speed", values, readings[1], now, memory)
        held = jnp.where(x["sample"], self._law(x, error, speed), memory["held"])
        memory["held"] = held
        torque, memory = self.stage("torque", values, held, now, memory)
        return memory, torque, readings

    def ahead(self, memory) -> jax.Array:
        """Computes how far and how fast the motors run ahead of their joints, [2, joints] rad and rad/s.

        It is the sum over the effects of the transmission, whose memories are just that.
        """
        rows = self.entering("transmission")
        return sum((memory[row.name] for row in rows), start=jnp.zeros((2, len(self.dof))))

    def now_of(self, x, state) -> Now:
        """`Now` of a robot whose forces, rotors and links do not matter.

        Args:
          x: the controller's inputs.
          state: positions and velocities of the joints, [2, joints] rad and rad/s.
        """
        none = jnp.zeros_like(state[1])
        return Now(
            dt=self.dt,
            position=state[0],
            speed=state[1],
            load=none,
            limit=x["limit"],
            stiffness=x["stiffness"],
            damping=x["damping"] + x["emf"],
            rotor=none,
            link=none + 1.0,
            mobility=none,
            alone=none,
            stopped=none,
            rigid=none + 1.0,
            body_velocity=jnp.zeros((len(self.bodies), 3)),
            between=x["between"],
            unit=none + 1.0 if self.units is None else jnp.asarray(self.units, jnp.float32),
            before=jnp.asarray(self.beside[0]),
            after=jnp.asarray(self.beside[1]),
        )


def _velocity(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Velocity of every body's centre of mass in the world, [bodies, 3] m/s, from the last step's kinematics."""
    angular, linear = data.cvel[:, :3], data.cvel[:, 3:]
    arm = data.xipos - data.subtree_com[jnp.asarray(model.body_rootid)]
    return linear + jnp.cross(angular, arm)
