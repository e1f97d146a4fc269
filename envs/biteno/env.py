"""BITeno follows velocity commands: the task of the paper's section IV, its physical parameters an argument.

`Biteno` is one robot, pure and unbatched; `vmap` it. A state holds positions and velocities, not a whole `mjx.Data`, so
a reset is cheap and fresh.

The sum of Table I can be negative, and then falling early pays. The remedy is an explicit cost of termination
(`TaskConfig.termination_cost`); it is part of the trained reward, never of the scored one (`State.score`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs import sensing
from envs.biteno import constants, gait, rewards
from envs.chain import MIN_FRICTION_NM
from jaxtune.mjx import parameters

ACTION_LIMIT = 10.0
_MIN_HEIGHT_M = 0.35
_MAX_TILT_COS = np.cos(np.pi / 4)

_BASES = ("stand", "raibert")
# time step in s, steps in a policy step, solver iterations, line-search iterations
_PHYSICS = {"exact": (0.001, 10, 3, 5), "fast": (0.002, 5, 2, 5)}


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """The task; defaults are the paper's where it has one."""

    physics: Literal["exact", "fast"] = "exact"
    """`exact`: 10 sub-steps of 1 ms. `fast`: 5 of 2 ms with fewer solver iterations; what is learnt there walks at 1
    ms."""
    base: Literal["stand", "raibert"] = "stand"
    """What an action is added to: the standing pose, or Raibert's reference."""
    action_scale: float = 0.25
    """Joint target in rad per unit of action."""
    noise: float = 0.0
    """Width of the observation noise in units of `sensing.NOISE`."""
    weights: Mapping[str, float] = field(default_factory=lambda: dict(constants.WALKING))
    """Trained reward: weight of every term of Table I."""
    shaping: Mapping[str, float] = field(default_factory=lambda: dict(constants.SHAPING))
    """Trained reward: weight of terms beside Table I (`rewards.shaping`)."""
    termination_cost: float = 1.0
    """Taken from the trained reward where an episode ends in a fall."""
    episode_s: float = 20.0
    """Time limit of an episode."""
    command_s: float = 5.0
    """Time between two commands."""
    command_max: tuple[float, float, float] = (1.0, 0.3, 0.8)
    """Largest command forward in m/s, sideways in m/s, turning in rad/s."""
    zero_command_share: float = 0.1
    """Share of commands that are zero."""
    push_mps: float = 0.0
    """Speed that a push adds to the trunk, in a random horizontal direction."""
    push_s: float = 4.0
    """Time between two pushes."""


@chex.dataclass(frozen=True)
class State:
    """One robot between two policy steps."""

    qpos: jax.Array  # [13]
    qvel: jax.Array  # [12]
    qacc_warmstart: jax.Array  # [12]
    command: jax.Array  # [3] m/s, m/s, rad/s
    phase: jax.Array  # [2] cycles
    action: jax.Array  # [6]
    joint_error: jax.Array  # [6] rad
    obs: jax.Array  # [40]
    reward: jax.Array  # trained reward
    score: jax.Array  # reward under the weights of Table I
    done: jax.Array  # 1 where the robot fell or is not finite
    not_finite: jax.Array  # 1 where the simulation broke
    steps: jax.Array  # policy steps since the reset
    terms: dict  # unweighted terms of Table I, and of the shaping that has a weight
    key: jax.Array
    memory: dict = field(default_factory=dict)  # of motors and sensors that are not ideal


@chex.dataclass(frozen=True)
class Drive:
    """What an action asks of the joints during a policy step."""

    action: jax.Array  # [6] clipped
    target: jax.Array  # [6] rad
    targets: jax.Array  # [substeps, 6] rad, what has arrived of it at each sub-step
    reference: jax.Array  # [6] rad, Raibert's q*


@chex.dataclass(frozen=True)
class Motion:
    """Where an engine leaves the robot after a policy step."""

    qpos: jax.Array  # [13] m, quaternion (w, x, y, z) and rad, in MuJoCo's order
    qvel: jax.Array  # [12] m/s in the world, rad/s in the trunk, rad/s
    qacc_warmstart: jax.Array  # [12]; zeros where the engine keeps its own
    torque: jax.Array  # [6] Nm, of the last sub-step
    foot_force: jax.Array  # [2, 3] N, world frame, of the floor on each foot in the last sub-step
    memory: dict = field(default_factory=dict)  # of motors and sensors that are not ideal


class Biteno:
    """One robot.

    Args:
      config: the task.
      entries: the parameters that a step may be given; joint friction costs time even where it is zero.
      path: of the model.
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
        self._shanks = np.array([model.body(f"{side}_shank").id for side in constants.SIDES])
        self._home = jnp.array(model.keyframe("home").qpos, jnp.float32)
        self._prepare(model)
        self.mj_model = model
        self._model = mjx.put_model(model)
        self._data = mjx.make_data(model)

    def _prepare(self, model: mujoco.MjModel) -> None:
        """What a model needs before it goes on the device."""
        for entry in self.entries.values():
            if "dof_frictionloss" in entry.fields:
                # MJX solves for friction only in joints that had some when the model was put on the device.
                rows = entry.rows(model)
                model.dof_frictionloss[rows] = np.maximum(model.dof_frictionloss[rows], MIN_FRICTION_NM)
        if (model.dof_frictionloss > 0).any():
            # Its kinks take twice the iterations: at 2 Nm three are off by 2e-4 rad after 10 ms, six by nothing.
            model.opt.iterations *= 2
            model.opt.ls_iterations *= 2

    def model(self, params: parameters.Params) -> mjx.Model:
        """The robot with these parameters."""
        return parameters.apply(self._model, params, self.entries)

    def reset(self, params: parameters.Params, key: jax.Array) -> State:
        """Starts an episode near the standing pose, at a random phase, under a random command.

        Args:
          params: physical values by name (`jaxtune.mjx`); a reset does not depend on them, a step does.
          key: random key.
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

    def step(self, params: parameters.Params, state: State, action: jax.Array) -> State:
        """Moves the robot on by one policy step of 10 ms under an action [6]."""
        return self.move(params, state, action)[0]

    def move(self, params: parameters.Params, state: State, action: jax.Array) -> tuple[State, Motion]:
        """A step, and the motion behind it."""
        drive = self.drive(params, state, action)
        motion = self.simulate(params, state, drive)
        return self.settle(state, drive, motion), motion

    def drive(self, params: parameters.Params, state: State, action: jax.Array) -> Drive:
        """What an action [6] asks of the joints."""
        action = jnp.clip(action, -ACTION_LIMIT, ACTION_LIMIT)
        reference = gait.joint_reference(state.phase, state.command)
        base = reference if self.config.base == "raibert" else jnp.asarray(constants.STAND_RAD)
        target = base + self.config.action_scale * action
        held = state.joint_error + self.perceive(state)["joint"]
        delay = params.get("action_delay_s", 0.0) / self.mj_model.opt.timestep
        # A sub-step in which the target changes has the mean of both.
        arrived = jnp.clip(jnp.arange(1, self.substeps + 1) - delay, 0.0, 1.0)
        targets = target + (1.0 - arrived[:, None]) * (held - target)
        return Drive(action=action, target=target, targets=targets, reference=reference)

    def simulate(self, params: parameters.Params, state: State, drive: Drive) -> Motion:
        """Physics in MJX; another engine may stand in for it."""
        model = self.model(params)
        data = self._data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart)
        data, _ = jax.lax.scan(lambda data, ctrl: (mjx.step(model, data.replace(ctrl=ctrl)), None), data, drive.targets)
        return Motion(
            qpos=data.qpos,
            qvel=data.qvel,
            qacc_warmstart=data.qacc_warmstart,
            torque=data.qfrc_actuator[self.joint_dof],
            foot_force=self._foot_force(model, data),
        )

    def _foot_force(self, model: mjx.Model, data: mjx.Data) -> jax.Array:
        # Nothing but the floor touches a shank.
        return mjx.rne_postconstraint(model, data)._impl.cfrc_ext[self._shanks, 3:]

    def settle(self, state: State, drive: Drive, motion: Motion) -> State:
        """Observation, rewards, termination and the next command, after the robot moved."""
        finite = jnp.isfinite(motion.qpos).all() & jnp.isfinite(motion.qvel).all()
        zeros = jnp.zeros_like(state.qvel)
        qpos, qvel, warmstart, torque, action, target = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old),
            (motion.qpos, motion.qvel, motion.qacc_warmstart, motion.torque, drive.action, drive.target),
            (self._home, zeros, zeros, jnp.zeros(6), jnp.zeros(6), self._home[self.joint_qpos]),
        )
        key, key_command, key_noise, key_push = jax.random.split(state.key, 4)
        steps = state.steps + 1
        memory = jax.tree.map(lambda new, old: jnp.where(finite, new, old), motion.memory, state.memory)
        moved = state.replace(qpos=qpos, qvel=self._push(key_push, qvel, steps), memory=memory)
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
        phase = gait.advance(state.phase)
        shaped = rewards.shaping(foot_force=motion.foot_force, phase=phase)
        values |= {name: shaped[name] for name in self.config.shaping}
        values = {name: jnp.where(finite, value, 0.0) for name, value in values.items()}
        trained = rewards.weigh(values, self.config.weights) + rewards.weigh(values, self.config.shaping)
        fell = fallen(readings["gravity"], qpos[2])
        done = (fell | ~finite).astype(jnp.float32)

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
        """What the sensors say, by signal; here they are ideal."""
        return self._readings(state)

    def _observe(self, state: State, key: jax.Array) -> jax.Array:
        readings = self.perceive(state)
        if self.config.noise > 0.0:
            readings = sensing.disturb(key, readings, self.config.noise)
        return sensing.observe(
            **readings,
            command=state.command,
            last_action=state.action,
            joint_error=state.joint_error,
            phase=state.phase,
            stand=jnp.asarray(constants.STAND_RAD),
        )

    @staticmethod
    def with_command(state: State, command: jax.Array, phase: jax.Array) -> State:
        """The same robot under another command [3], its gait clock at another phase [2]."""
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
    """True where a robot has fallen: by projected gravity [..., 3] and height [...] of its trunk in m."""
    return (gravity[..., 2] > -_MAX_TILT_COS) | (height < _MIN_HEIGHT_M)
