"""What effects do to a robot between a target and a reading: one step of it, for the test rig and for the walk."""

from collections.abc import Sequence
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxtune.types import Effect

MIN_FRICTION_NM = 1e-6
"""With a bound of nothing at all MJX brakes a joint."""


@chex.dataclass(frozen=True)
class Now:
    """What an effect may look at."""

    dt: float
    position: jax.Array  # [joints] rad
    speed: jax.Array  # [joints] rad/s
    load: jax.Array  # [joints] Nm on the gears, the larger of those of their two sides
    limit: jax.Array  # [joints] Nm, the controller's
    stiffness: jax.Array  # [joints] Nm/rad, of the controller; none where the motor was measured
    damping: jax.Array  # [joints] Nm s/rad, likewise
    measured: bool  # whether the motor was, and went where it went
    rotor: jax.Array  # [joints] kg m^2, the motor's part of the joint's inertia; none where it was measured
    carried: jax.Array  # [joints] Nm that the rotor takes to keep up with the joint
    body_velocity: jax.Array  # [bodies, 3] m/s of the centres of mass


@chex.dataclass(frozen=True)
class Wrench:
    """What acts from outside."""

    torque: jax.Array  # [joints] Nm
    force: jax.Array  # [bodies, 3] N at the centres of mass


@dataclass(frozen=True)
class Chain:
    """Effects in the order in which they act.

    What a controller is asked is a dictionary `x` of [joints] arrays: `target` rad, `feed` Nm, `stiffness` Nm/rad,
    `damping` Nm s/rad, `limit` Nm of both, `emf` Nm s/rad beyond the limit, and `sample`, 1 where it looks anew.
    `values` are those of every effect by name, [places] by parameter; memories are dictionaries by effect.
    """

    dt: float
    rows: Sequence[Effect]
    qpos: np.ndarray
    """[joints] of the positions."""
    dof: np.ndarray
    """[joints] of the velocities."""
    bodies: np.ndarray
    """[bodies] that a wrench may act on."""

    def step(self, model: mjx.Model, data: mjx.Data, memory: dict, values, x) -> tuple[mjx.Data, dict, dict]:
        """Moves a robot by one step of its physics.

        Returns:
          The robot, the memories, and what was read before the step, [joints] by signal.
        """
        joint = self.joints(data)
        bias, rotor = data.qfrc_bias[self.dof], model.dof_armature[self.dof]
        motor = joint.at[0].add(self.ahead(memory)[0])
        memory, (torque, read) = self.drive(values, memory, motor, x, rotor * data.qacc[self.dof], rotor)
        now = self._now(x, joint, jnp.maximum(jnp.abs(torque), jnp.abs(bias)), model, data)
        friction, _ = self.stage("friction", values, model.dof_frictionloss[self.dof], now, memory)
        calm = Wrench(torque=jnp.zeros(len(self.dof)), force=jnp.zeros((len(self.bodies), 3)))
        wrench, _ = self.stage("wrench", values, calm, now, memory)
        friction = jnp.maximum(friction, MIN_FRICTION_NM)
        moved = model.replace(dof_frictionloss=model.dof_frictionloss.at[self.dof].set(friction))
        data = data.replace(
            qfrc_applied=data.qfrc_applied.at[self.dof].set(torque + wrench.torque),
            xfrc_applied=data.xfrc_applied.at[self.bodies, :3].set(wrench.force),
        )
        return mjx.step(moved, data), memory, read

    def read(self, values, memory: dict, joint: jax.Array, x) -> jax.Array:
        """What the encoders say of joints [2, joints], [2, joints]; nothing is remembered of it."""
        far, fast = self.ahead(memory)
        motor = joint.at[0].add(far)
        # The controller answers to how fast the motor runs ahead within a step; sensors are late for the joint alone.
        return self.stage("sensor", values, motor, self._now(x, motor), memory)[0].at[1].add(fast)

    def joints(self, data: mjx.Data) -> jax.Array:
        """Positions and velocities of the joints, [2, joints]."""
        return jnp.stack([data.qpos[self.qpos], data.qvel[self.dof]])

    def entering(self, stage: str) -> list[Effect]:
        """Effects of a stage."""
        return [row for row in self.rows if row.enters == stage]

    def stage(self, stage, values, signal, now, memory):
        """Hands a signal from effect to effect."""
        memory = dict(memory)
        for row in self.entering(stage):
            signal, kept = row.act(values[row.name], signal, now, memory.get(row.name))
            if row.start is not None:
                memory[row.name] = kept
        return signal, memory

    def start(self, values, state, x) -> dict:
        """Memories of a robot that has been like this for ever."""
        torque = self._law(x, x["target"] - state[0], state[1])
        signals = {"command": x["target"], "sensor": state, "torque": torque, "transmission": torque}
        memory = {"held": torque}
        for stage, signal in signals.items():
            for row in self.entering(stage):
                if row.start is not None:
                    memory[row.name] = row.start(values[row.name], signal, self.dt)
        return memory

    @staticmethod
    def _law(x, error, speed) -> jax.Array:
        torque = x["stiffness"] * error - x["damping"] * speed
        return jnp.clip(torque, -x["limit"], x["limit"]) + x["feed"]

    def drive(self, values, memory, motor, x, carried, rotor=None):
        """From what is true of the motors [2, joints] to the torque on the joints, and what is read.

        Args:
          carried: torque [joints] that the motors' inertia takes to keep up with the joints.
          rotor: inertia of the motors [joints]; None where they were measured, and went where they went.
        """
        now = self._now(x, motor)
        readings, memory = self.stage("sensor", values, motor, now, memory)
        target, memory = self.stage("command", values, x["target"], now, memory)
        error, memory = self.stage("error", values, target - readings[0], now, memory)
        held = jnp.where(x["sample"], self._law(x, error, readings[1]), memory["held"])
        memory["held"] = held
        torque, memory = self.stage("torque", values, held, now, memory)
        none = jnp.zeros_like(held)
        free = {"stiffness": none, "damping": none} if rotor is None else {"rotor": rotor}
        now = now.replace(carried=carried, measured=rotor is None, **free)
        running = self.ahead(memory)[1]
        torque, memory = self.stage("transmission", values, torque - x["emf"] * motor[1], now, memory)
        return memory, (torque, {"q": readings[0], "dq": readings[1] + running, "tau": torque})

    def ahead(self, memory) -> jax.Array:
        """How far and how fast the motors run ahead of the joints, [2, joints] rad and rad/s."""
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
        )


def _velocity(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Velocity of every body's centre of mass in the world, [bodies, 3] m/s, from the last step's kinematics."""
    angular, linear = data.cvel[:, :3], data.cvel[:, 3:]
    arm = data.xipos - data.subtree_com[jnp.asarray(model.body_rootid)]
    return linear + jnp.cross(angular, arm)
