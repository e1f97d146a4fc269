"""A walking BITeno with discovered effects between its targets, its joints and its sensors' readings.

Train or tune a policy in it as in the nominal robot, `envs.biteno.Biteno`.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs.biteno import Biteno, Drive, Motion, State, TaskConfig, constants
from envs.carried import carriers
from envs.chain import MIN_FRICTION_NM, Chain
from envs.corrected.record import Correction
from jaxtune.mjx import parameters


class CorrectedBiteno(Biteno):
    """BITeno with the effects of a corrected model: the same task, interface and observation, another body.

    MuJoCo's actuators are switched off. At every sub-step `envs.chain.Chain` computes the joint torques, with the
    actuators' own gains and limits, and lets the effects act on targets, torques, joints and readings.

    Args:
      config: the task.
      entries: the parameters that a step may be given, relative to the corrected model.
      correction: the MJCF and the effects.

    Raises:
      ValueError: the MJCF is not BITeno's, or an effect is on a place, or has a parameter, that the robot does not
        have.
    """

    def __init__(self, config: TaskConfig, entries: Mapping[str, parameters.Entry], correction: Correction):
        spec = mujoco.MjSpec.from_file(str(correction.path))
        if not {*constants.JOINTS} <= {joint.name for joint in spec.joints} or not spec.key("home"):
            raise ValueError(f"model: {correction.path} lacks joints of BITeno's or its keyframe home, expected BITeno")
        self._rows = correction.rows
        super().__init__(config, entries, correction.path)
        model = self.mj_model
        bodies = [i for i in range(1, model.nbody) if model.body_mass[i] > 0]
        places = {
            "joint": constants.JOINTS,
            "body": tuple(model.body(i).name for i in bodies),
            "foot": constants.FEET,
            "robot": ("robot",),
        }
        self._values = correction.values(places)
        # One step of the chain for each step of the physics; the controller reads the joints in every one.
        step = float(model.opt.timestep)
        before = carriers(model, self.joint_dof)
        self._chain = Chain(step, self._rows, self.joint_qpos, self.joint_dof, np.array(bodies), step, before)

    def _prepare(self, model: mujoco.MjModel) -> None:
        # The chain computes the torques; MuJoCo's actuators stay in the model for their gains and limits.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        if any(row.enters == "friction" for row in self._rows):
            dof = self.joint_dof
            model.dof_frictionloss[dof] = np.maximum(model.dof_frictionloss[dof], MIN_FRICTION_NM)
        super()._prepare(model)

    def reset(self, params: parameters.Params, key: jax.Array) -> State:
        """Starts an episode of a robot that has stood still at its first target for as long as any effect remembers."""
        state = super().reset(params, key)
        joint = state.qpos[self.joint_qpos]
        still = jnp.stack([joint, jnp.zeros_like(joint)])
        state = state.replace(
            memory=self._chain.start(self._values, still, self._controller_inputs(self._model, joint))
        )
        # Once more, because readings depend on the memories.
        return state.replace(obs=self._observe(state, jax.random.fold_in(key, 1)))

    def simulate(self, params: parameters.Params, state: State, drive: Drive) -> Motion:
        """Simulates a policy step in MJX, through the effects; see `Biteno.simulate`.

        The `Motion` has the memories of the effects as well, and the torques of the motors.
        """
        model = self.model(params)
        data = self._data.replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, qacc=state.qacc_warmstart
        )
        # Effects look at loads and velocities before the first sub-step has found them.
        data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))

        def step(carry, target):
            data, memory, read = self._chain.step(model, *carry, self._values, self._controller_inputs(model, target))
            return (data, memory), read["tau"]

        (data, memory), torque = jax.lax.scan(step, (data, state.memory), drive.targets)
        return Motion(
            qpos=data.qpos,
            qvel=data.qvel,
            qacc_warmstart=data.qacc_warmstart,
            torque=torque[-1],
            # Forces of effects on a shank are not the floor's.
            foot_force=self._foot_force(model, data.replace(xfrc_applied=jnp.zeros_like(data.xfrc_applied))),
            memory=memory,
        )

    def perceive(self, state: State) -> dict[str, jax.Array]:
        """Returns what the sensors read, by signal, with their errors (bias, delay, tilt); see `Biteno.perceive`."""
        readings = super().perceive(state)
        # While the parent class resets, there are no memories yet.
        if not state.memory:
            return readings
        joint = jnp.stack([readings["joint"], readings["joint_velocity"]])
        inputs = self._controller_inputs(self._model, readings["joint"])
        read = self._chain.read(self._values, state.memory, joint, inputs)
        gravity, _ = self._chain.stage("gravity", self._values, readings["gravity"], None, {})
        return readings | {"joint": read[0], "joint_velocity": read[1], "gravity": gravity}

    @staticmethod
    def _controller_inputs(model: mjx.Model, target: jax.Array) -> dict[str, jax.Array]:
        """What the chain's controller is given: the targets [6] in rad, and gains and limits of MuJoCo's actuators."""
        none = jnp.zeros_like(target)
        return {
            "target": target,
            "feed": none,
            "stiffness": model.actuator_gainprm[:, 0],
            "damping": -model.actuator_biasprm[:, 2],
            "limit": model.actuator_forcerange[:, 1],
            "emf": none,
            "between": none,
            "sample": jnp.ones((), bool),
        }


def make(config: TaskConfig, entries: Mapping[str, parameters.Entry], correction: Correction | None = None) -> Biteno:
    """Makes the nominal robot, or the one that a correction describes.

    Args:
      config: the task.
      entries: the parameters that a step may be given.
      correction: what discovery found; None for the nominal robot.

    Raises:
      ValueError: an effect is on a place, or has a parameter, that the robot does not have.
    """
    return Biteno(config, entries) if correction is None else CorrectedBiteno(config, entries, correction)
