"""The walking task of the paper's section IV: BITeno follows velocity commands.

`Biteno` is one robot, pure and unbatched; `vmap` it. Physical parameters are an argument of every step. A state holds
positions and velocities, not a whole `mjx.Data`, so resets are cheap.

The sum of Table I can be negative, and then an early fall earns more than a walk. An explicit cost of termination
(`TaskConfig.termination_cost`) prevents that; it is part of the trained reward, never of the score (`State.score`).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs import sensing, stepping
from envs.biteno import constants, gait, rewards
from envs.biteno.task import Drive, Motion, State, TaskConfig
from envs.chain import MIN_FRICTION_NM
from jaxtune.mjx import parameters

ACTION_LIMIT = 10.0
"""Actions are clipped to +- this. The policy's Gaussian is not squashed: tanh would hold the knee within 0.25 rad of
the stand, and a lift of 8 cm needs 0.55 rad."""
_MIN_HEIGHT_M = 0.35
_MAX_TILT_COS = np.cos(np.pi / 4)

_BASES = ("stand", "raibert")
_KEPT = ("qpos", "qvel", "qacc_warmstart", "command", "phase", "action", "joint_error", "memory")
_EXPLODED = 1e4  # m, rad or either per second
# Time step in s, steps in a policy step, solver iterations, line-search iterations. At 1 ms, three iterations agree
# with more of them to five decimals after 0.3 s; one is off by up to 0.023 rad.
_PHYSICS = {"exact": (0.001, 10, 3, 5), "fast": (0.002, 5, 2, 5)}


class Biteno:
    """BITeno and its task as pure functions of a state: `reset`, `step`, and the parts of a step.

    A step has three parts. `drive` turns the action into joint targets, `simulate` moves the robot in MJX, and `settle`
    computes observation, reward and termination. Another engine replaces `simulate` alone (`envs.targets.host`), so
    everything else is the same code everywhere.

    Args:
      config: the task.
      entries: the parameters that a step may be given. Joint friction among them costs time even where it is zero.
      path: of the MJCF.

    Raises:
      ValueError: a field of the task has a value that is not allowed.
    """

    observation_size = 40
    action_size = 6

    def __init__(
        self,
        config: TaskConfig,
        entries: Mapping[str, parameters.Entry] = constants.ENTRIES,
        path: Path = constants.MODEL_PATH,
    ):
        if set(config.weights) != set(constants.TABLE_ONE):
            raise ValueError(f"weights: got {sorted(config.weights)}, expected {sorted(constants.TABLE_ONE)}")
        if not set(config.shaping) <= set(constants.SHAPING):
            raise ValueError(f"shaping: got {sorted(config.shaping)}, expected some of {sorted(constants.SHAPING)}")
        for name, allowed in {"physics": _PHYSICS, "base": _BASES}.items():
            if getattr(config, name) not in allowed:
                raise ValueError(f"{name}: got '{getattr(config, name)}', expected one of {', '.join(allowed)}")
        self.config = config
        self.entries = entries
        model = mujoco.MjModel.from_xml_path(str(path))
        model.opt.timestep, self.substeps, model.opt.iterations, model.opt.ls_iterations = _PHYSICS[config.physics]
        joints = [model.joint(name) for name in constants.JOINTS]
        self.joint_qpos = np.array([joint.qposadr[0] for joint in joints])
        self.joint_dof = np.array([joint.dofadr[0] for joint in joints])
        self._joint_range = np.array([joint.range for joint in joints]).T
        self._shanks = np.array([model.body(f"{side}_shank").id for side in constants.SIDES])
        self._home = jnp.array(model.keyframe("home").qpos, jnp.float32)
        self._prepare(model)
        self.mj_model = model
        self._model = mjx.put_model(model)
        self._data = mjx.make_data(model)

    def _prepare(self, model: mujoco.MjModel) -> None:
        """Prepares a model before it is put on the device, since MJX fixes then which constraints it will solve."""
        for entry in self.entries.values():
            if "dof_frictionloss" in entry.field_names:
                # MJX solves for friction only in joints that had some when the model was put on the device.
                rows, _ = entry.rows(model, "dof_frictionloss")
                model.dof_frictionloss[rows] = np.maximum(model.dof_frictionloss[rows], MIN_FRICTION_NM)
        if (model.dof_frictionloss > 0).any():
            # Dry friction takes twice the iterations: at 2 Nm three are off by 2e-4 rad after 10 ms, six by nothing.
            model.opt.iterations *= 2
            model.opt.ls_iterations *= 2

    def model(self, params: parameters.Params) -> mjx.Model:
        """Makes the MJX model of the robot with these physical parameters (`jaxtune.mjx.apply`).

        Every step makes its model anew, so parameters may differ between robots of a batch and change in an episode.
        """
        return parameters.apply(self._model, params, self.entries)

    def reset(self, params: parameters.Params, key: jax.Array) -> State:
        """Starts an episode near the standing pose, at a random phase, under a random command.

        Args:
          params: physical values by name (`jaxtune.mjx`). A reset does not depend on them; the argument is
            there because every function of an episode takes it.
          key: random key; it is also the source of everything random in the episode.

        Returns:
          The state before the first step: joints within 0.1 rad of the stand, velocities within 0.2.
        """
        del params
        key, key_joint, key_velocity, key_phase, key_command, key_noise = jax.random.split(key, 6)
        joint = self._home[self.joint_qpos] + jax.random.uniform(key_joint, (6,), minval=-0.1, maxval=0.1)
        qvel = jax.random.uniform(key_velocity, (self.mj_model.nv,), minval=-0.2, maxval=0.2)
        zeros = jnp.zeros(6)
        state = State(
            qpos=self._home.at[self.joint_qpos].set(joint),
            qvel=qvel,
            qacc_warmstart=jnp.zeros_like(qvel),
            command=self._draw_command(key_command),
            # The legs are half a cycle apart.
            phase=jnp.mod(jax.random.uniform(key_phase) + jnp.array([0.0, 0.5]), 1.0),
            action=zeros,
            joint_error=zeros,
            obs=jnp.zeros(self.observation_size),
            reward=jnp.zeros(()),
            score=jnp.zeros(()),
            done=jnp.zeros(()),
            not_finite=jnp.zeros(()),
            steps=jnp.zeros((), jnp.int32),
            terms={name: jnp.zeros(()) for name in (*constants.TABLE_ONE, *self.config.shaping)},
            key=key,
        )
        return state.replace(obs=self._observe(state, key_noise))

    @staticmethod
    def observed(obs: jax.Array) -> jax.Array:
        """Returns the observation as it is; other robots (`jaxtune.mjx.Robot`) may have several arrays."""
        return obs

    def step(self, params: parameters.Params, state: State, action: jax.Array) -> State:
        """Moves the robot by one policy step of 10 ms.

        Args:
          params: physical values by name; those left out are nominal.
          state: of the robot before the step.
          action: [6], clipped to +-10; the joint targets are the base pose plus `action_scale` times it.
        """
        return self.move(params, state, action)[0]

    def move(self, params: parameters.Params, state: State, action: jax.Array) -> tuple[State, Motion]:
        """Moves the robot by one policy step, as `step` does, and returns the engine's motion as well.

        Use it to record what the state does not keep: torques and the forces on the feet.
        """
        drive = self.drive(params, state, action)
        motion = self.simulate(params, state, drive)
        return self.settle(state, drive, motion), motion

    def kept(self, state: State) -> dict[str, Any]:
        """Takes what the next steps depend on out of a state, by name; see `jaxtune.mjx.Robot`."""
        return {name: getattr(state, name) for name in _KEPT}

    def resumed(self, params: parameters.Params, kept: Mapping[str, Any]) -> State:
        """Makes a state of what was kept of one. Rewards and the observation are those of a fresh start."""
        return self.reset(params, jax.random.PRNGKey(0)).replace(**kept)

    def drive(self, params: parameters.Params, state: State, action: jax.Array) -> Drive:
        """Turns an action [6] into joint targets for every sub-step.

            target = base + action_scale clip(action, -10, 10)

        The policy observes this target. What acts on the joints is clipped to their ranges, as on the robot. With an
        `action_delay_s` among the parameters the previous target acts until the delay is over.
        """
        action = jnp.clip(action, -ACTION_LIMIT, ACTION_LIMIT)
        reference = gait.joint_reference(state.phase, state.command)
        base = reference if self.config.base == "raibert" else jnp.asarray(constants.STAND_RAD)
        target = base + self.config.action_scale * action
        # The error is the last target less the reading, so the sum is the last target.
        held = state.joint_error + self.perceive(state)["joint"]
        sent, held = (jnp.clip(one, *self._joint_range) for one in (target, held))
        delay = params.get("action_delay_s", 0.0) / self.mj_model.opt.timestep
        # In the sub-step in which the delay ends, the two targets are averaged by their shares of time.
        arrived = jnp.clip(jnp.arange(1, self.substeps + 1) - delay, 0.0, 1.0)
        targets = sent + (1.0 - arrived[:, None]) * (held - sent)
        return Drive(action=action, target=target, targets=targets, reference=reference)

    def simulate(self, params: parameters.Params, state: State, drive: Drive) -> Motion:
        """Simulates one policy step in MJX; the only part of a step that other engines replace."""
        model = self.model(params)
        # The solver starts from the last step's accelerations, as it would in one continuous simulation.
        data = self._data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart)
        data, _ = jax.lax.scan(
            lambda data, ctrl: (stepping.step(model, data.replace(ctrl=ctrl)), None), data, drive.targets
        )
        return Motion(
            qpos=data.qpos,
            qvel=data.qvel,
            qacc_warmstart=data.qacc_warmstart,
            torque=data.qfrc_actuator[self.joint_dof],
            foot_force=self._foot_force(model, data),
        )

    def _foot_force(self, model: mjx.Model, data: mjx.Data) -> jax.Array:
        # Only the floor touches a shank, so the external force on it is the floor's on the foot. `cfrc_ext` holds the
        # torque first, then the force.
        return mjx.rne_postconstraint(model, data)._impl.cfrc_ext[self._shanks, 3:]

    def settle(self, state: State, drive: Drive, motion: Motion) -> State:
        """Computes observation, rewards, termination and the next command after the robot moved.

        A motion that is not finite ends the episode: the robot is put back to its home pose, earns nothing and is
        counted in `not_finite`.

        Args:
          state: before the step.
          drive: the targets of the step.
          motion: where an engine left the robot.
        """
        # What explodes is large before it is infinite, and its observations would spoil the statistics of all others.
        finite = (jnp.abs(motion.qpos) < _EXPLODED).all() & (jnp.abs(motion.qvel) < _EXPLODED).all()
        zeros = jnp.zeros_like(state.qvel)
        qpos, qvel, warmstart, torque, action, target = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old),
            (motion.qpos, motion.qvel, motion.qacc_warmstart, motion.torque, drive.action, drive.target),
            (self._home, zeros, zeros, jnp.zeros(6), jnp.zeros(6), self._home[self.joint_qpos]),
        )
        key, key_command, key_noise, key_push = jax.random.split(state.key, 4)
        steps = state.steps + 1
        # Of a broken step no memory is kept: the effects go on from the one before.
        memory = jax.tree.map(lambda new, old: jnp.where(finite, new, old), motion.memory, state.memory)
        moved = state.replace(qpos=qpos, qvel=self._push(key_push, qvel, steps), memory=memory)
        # The reward is of the true state; sensor errors and noise are in the observation alone.
        readings = self._readings(moved)
        values = rewards.terms(
            **readings,
            command=state.command,
            last_joint_velocity=state.qvel[self.joint_dof],
            torque=torque,
            action=action,
            last_action=state.action,
            joint_reference=drive.reference,
        )
        # Contact is that of the last sub-step, so it is compared with the clock at the end of the step.
        phase = gait.advance(state.phase)
        shaped = rewards.shaping(foot_force=motion.foot_force, phase=phase)
        values |= {name: shaped[name] for name in self.config.shaping}
        values = {name: jnp.where(finite, value, 0.0) for name, value in values.items()}
        trained = rewards.weigh(values, self.config.weights) + rewards.weigh(values, self.config.shaping)
        # MuJoCo's position of the free joint is the trunk's origin, which lies on the hip axis.
        fell = fallen(readings["gravity"], qpos[2])
        done = (fell | ~finite).astype(jnp.float32)

        # The new command is in the next observation; this step was rewarded by the old one.
        redraw = steps % round(self.config.command_s / constants.POLICY_DT_S) == 0
        moved = moved.replace(
            qacc_warmstart=warmstart,
            command=jnp.where(redraw, self._draw_command(key_command), state.command),
            phase=phase,
            action=action,
            joint_error=target - self.perceive(moved)["joint"],
            reward=trained - self.config.termination_cost * done,
            score=rewards.weigh(values, constants.TABLE_ONE),
            done=done,
            not_finite=(~finite).astype(jnp.float32),
            steps=steps,
            terms=values,
            key=key,
        )
        return moved.replace(obs=self._observe(moved, key_noise))

    def _readings(self, state: State) -> dict[str, jax.Array]:
        quat = state.qpos[3:7]
        return {
            "velocity": sensing.rotate_inverse(quat, state.qvel[:3]),
            "gyro": state.qvel[3:6],  # MuJoCo keeps a free joint's angular velocity in the body frame
            "gravity": sensing.projected_gravity(quat),
            "joint": state.qpos[self.joint_qpos],
            "joint_velocity": state.qvel[self.joint_dof],
        }

    def perceive(self, state: State) -> dict[str, jax.Array]:
        """Returns what the sensors read, by signal: `velocity`, `gyro`, `gravity`, `joint`, `joint_velocity`.

        The nominal robot's sensors are ideal; a corrected robot overrides this.
        """
        return self._readings(state)

    def _observe(self, state: State, key: jax.Array) -> jax.Array:
        readings, joint_error = self.perceive(state), state.joint_error
        if self.config.noise > 0.0:
            noisy = sensing.disturb(key, readings, self.config.noise)
            # The robot subtracts the same reading that it observes; before the first target there is no error.
            joint_error += jnp.where(state.steps > 0, readings["joint"] - noisy["joint"], 0.0)
            readings = noisy
        return sensing.observe(
            **readings,
            command=state.command,
            last_action=state.action,
            joint_error=joint_error,
            phase=state.phase,
            stand=jnp.asarray(constants.STAND_RAD),
        )

    @staticmethod
    def with_command(state: State, command: jax.Array, phase: jax.Array) -> State:
        """Gives the robot another command [3] and gait clock [2]; the observation is rewritten accordingly.

        Use it to repeat the commands of measured episodes.
        """
        return state.replace(command=command, phase=phase, obs=sensing.with_command(state.obs, command, phase))

    def _push(self, key: jax.Array, qvel: jax.Array, steps: jax.Array) -> jax.Array:
        if not self.config.push_mps:
            return qvel
        angle = jax.random.uniform(key, maxval=2 * jnp.pi)
        push = self.config.push_mps * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        due = steps % round(self.config.push_s / constants.POLICY_DT_S) == 0
        return qvel.at[:2].add(jnp.where(due, push, 0.0))

    def _draw_command(self, key: jax.Array) -> jax.Array:
        key_size, key_zero = jax.random.split(key)
        command = jax.random.uniform(key_size, (3,), minval=-1.0) * jnp.array(self.config.command_max)
        return jnp.where(jax.random.bernoulli(key_zero, self.config.zero_command_share), 0.0, command)


def fallen(gravity: jax.Array, height: jax.Array) -> jax.Array:
    """Decides whether a robot has fallen: tilted by more than 45 degrees, or its hip axis below 0.35 m.

    Args:
      gravity: projected gravity [..., 3] in the body frame.
      height: [...] m, of the hip axis above the floor.

    Returns:
      Booleans [...].
    """
    return (gravity[..., 2] > -_MAX_TILT_COS) | (height < _MIN_HEIGHT_M)
