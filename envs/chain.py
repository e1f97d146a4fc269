"""Simulates one step of a robot with effects between its targets and its readings, on the test rig and in a walk.

The effects are rows of `envs.effects`, which draws the stages that they act at; this is the only place that applies
them. `envs.rig` uses it for a robot whose base is fixed, `envs.corrected` for a BITeno that walks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from envs import stepping
from jaxtune.types import Effect

MIN_FRICTION_NM = 1e-6
"""Smallest bound of dry friction, in Nm: small enough to change nothing, and not zero.

MJX solves for friction only in joints that had some when the model was put on the device, and brakes a joint whose
bound is exactly zero."""


@chex.dataclass(frozen=True)
class Now:
    """State of the robot at one step, as far as an effect may depend on it beside its values, signal and memory.

    While the history of a segment is replayed, the motor's motion is measured, not simulated (`measured`). It already
    contains how controller and rotor reacted to an offset between motor and joint, so `stiffness`, `damping` and
    `rotor` are zero then.
    """

    dt: float  # step of the simulation in s
    position: jax.Array  # [joints] rad
    speed: jax.Array  # [joints] rad/s
    load: jax.Array  # [joints] Nm on the gears: the larger of motor torque and of gravity and Coriolis torque
    limit: jax.Array  # [joints] Nm, largest torque of the controller
    stiffness: jax.Array  # [joints] Nm/rad, of the controller
    damping: jax.Array  # [joints] Nm s/rad, of controller and back electromotive force
    measured: bool  # whether the motor's motion was measured, and so is not simulated
    rotor: jax.Array  # [joints] kg m^2, the rotor's part of the joint's inertia
    carried: jax.Array  # [joints] Nm, the part of the torque that accelerates the rotor along with the joint
    body_velocity: jax.Array  # [bodies, 3] m/s of the centres of mass
    between: jax.Array  # [joints] rad, how far targets are from the held ones if they move on between rows


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
    - `memory` is a dictionary: what each effect remembers, by its name, and `held`, the controller's last torque.
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
    lead_s: float = 0.0
    """How far positions of the simulation are ahead of its velocities; half a step makes semi-implicit Euler of second
    order, which is then the leapfrog scheme."""

    def step(self, model: mjx.Model, data: mjx.Data, memory: dict, values, x) -> tuple[mjx.Data, dict, dict]:
        """Simulates one step of the physics, from the controller's inputs to the robot's motion.

        Args:
          model: of the robot, effects on its fields included.
          data: the robot before the step.
          memory: of the effects before the step.
          values: of the effects.
          x: the controller's inputs.

        Returns:
          The robot and the memories after the step, and what was read before it: `q`, `dq` and `tau`, [joints] each.
        """
        joint = self.joints(data)
        bias, rotor = data.qfrc_bias[self.dof], model.dof_armature[self.dof]
        # Encoders sit on the motor, which may run ahead of its joint.
        motor = joint.at[0].add(self.ahead(memory)[0])
        memory, (torque, read) = self.drive(values, memory, motor, x, rotor * data.qacc[self.dof], rotor)
        now = self._now(x, joint, jnp.maximum(jnp.abs(torque), jnp.abs(bias)), model, data)
        # Effects of friction and of forces from outside have no memory, but bristles have.
        friction, _ = self.stage("friction", values, model.dof_frictionloss[self.dof], now, memory)
        calm = Wrench(torque=jnp.zeros(len(self.dof)), force=jnp.zeros((len(self.bodies), 3)))
        wrench, _ = self.stage("wrench", values, calm, now, memory)
        (friction, rubbing), memory = self.stage("bristle", values, jnp.stack([friction, wrench.torque]), now, memory)
        friction = jnp.maximum(friction, MIN_FRICTION_NM)
        moved = model.replace(dof_frictionloss=model.dof_frictionloss.at[self.dof].set(friction))
        data = data.replace(
            qfrc_applied=data.qfrc_applied.at[self.dof].set(torque + rubbing),
            xfrc_applied=data.xfrc_applied.at[self.bodies, :3].set(wrench.force),
        )
        return stepping.step(moved, data), memory, read

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
        far, fast = self.ahead(memory)
        motor = joint.at[0].add(far)
        # The rate at which the motor runs ahead reaches the controller within the step; only the joint's motion is
        # delayed.
        return self.stage("sensor", values, motor, self._now(x, motor), memory)[0].at[1].add(fast)

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

    def start(self, values, state, x, past=None, past_target=None) -> dict:
        """Makes the memories in steady state: of a robot that has been in one state, with one target, for a long time.

        Use it before the first step. A segment of a log then replays its history to get the real ones (`envs.rig`).

        Args:
          values: of the effects.
          state: positions and velocities, [2, joints].
          x: the controller's inputs.
          past: positions [past, joints] rad that led to the state, which bristles remember; None where it never moved.
          past_target: targets [past, joints] rad that led to the first one, which a slew limit may still be behind;
            None where they never moved. Both are `envs.effects.memory.PAST_STEP_S` apart.
        """
        torque = self._law(x, x["target"] - state[0], state[1])
        # What reaches each of these stages in steady state, other effects left aside.
        signals = {"sensor": state, "torque": torque, "transmission": torque}
        signals["bristle"] = state[:1] if past is None else past
        signals["command"] = x["target"][None] if past_target is None else past_target
        memory = {"held": torque}
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

    def drive(self, values, memory, motor, x, carried, rotor=None):
        """Computes torques on the joints, from the motors' state through sensors, controller and transmission.

        `step` calls it on simulated motors. `envs.rig` also calls it on measured ones, to fill the memories.

        Args:
          values: of the effects.
          memory: before the step.
          motor: true positions and velocities of the motors, seen at the joints, [2, joints].
          x: the controller's inputs.
          carried: torque [joints] Nm that accelerates the rotors with the joints.
          rotor: inertia of the rotors, [joints] kg m^2; None where their motion was measured and is not simulated.

        Returns:
          The memories after the step; the torques on the joints [joints] Nm; and what is read, by signal.
        """
        now = self._now(x, motor)
        readings, memory = self.stage("sensor", values, motor, now, memory)
        target, memory = self.stage("command", values, x["target"], now, memory)
        error, memory = self.stage("error", values, target - readings[0], now, memory)
        # A controller holds its torque from one reading of the joint to the next.
        speed, memory = self.stage("speed", values, readings[1], now, memory)
        held = jnp.where(x["sample"], self._law(x, error, speed), memory["held"])
        memory["held"] = held
        torque, memory = self.stage("torque", values, held, now, memory)
        none = jnp.zeros_like(held)
        free = {"stiffness": none, "damping": none} if rotor is None else {"rotor": rotor}
        now = now.replace(carried=carried, measured=rotor is None, **free)
        if rotor is None:
            # Measured motion winds up the bristles as simulated motion does.
            _, memory = self.stage("bristle", values, jnp.zeros_like(motor), now, memory)
        running = self.ahead(memory)[1]
        # Back electromotive force acts continuously, so it is not part of the held torque.
        torque, memory = self.stage("transmission", values, torque - x["emf"] * motor[1], now, memory)
        read, memory = self.stage("torque_reading", values, torque, now, memory)
        return memory, (torque, {"q": readings[0], "dq": readings[1] + running, "tau": read})

    def ahead(self, memory) -> jax.Array:
        """Computes how far and how fast the motors run ahead of their joints, [2, joints] rad and rad/s.

        It is the sum over the effects of the transmission, whose memories are just that.
        """
        rows = self.entering("transmission")
        return sum((memory[row.name] for row in rows), start=jnp.zeros((2, len(self.dof))))

    def _now(self, x, state, load=0.0, model=None, data=None) -> Now:
        velocity = jnp.zeros((len(self.bodies), 3)) if data is None else _velocity(model, data)[self.bodies]
        return Now(
            dt=self.dt,
            position=state[0],
            speed=state[1],
            load=load * jnp.ones_like(state[1]),
            limit=x["limit"],
            stiffness=x["stiffness"],
            damping=x["damping"] + x["emf"],
            measured=False,
            rotor=jnp.zeros_like(state[1]),
            carried=jnp.zeros_like(state[1]),
            body_velocity=velocity,
            between=x["between"],
        )


def _velocity(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Velocity of every body's centre of mass in the world, [bodies, 3] m/s, from the last step's kinematics."""
    angular, linear = data.cvel[:, :3], data.cvel[:, 3:]
    arm = data.xipos - data.subtree_com[jnp.asarray(model.body_rootid)]
    return linear + jnp.cross(angular, arm)
