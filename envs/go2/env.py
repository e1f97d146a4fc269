"""A Go2 that follows velocity commands: model, task and parameter table.

The policy sees what the robot's own sensors give, and sends joint targets around a standing pose at 50 Hz.
"""

from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs import stepping
from envs.sensing import projected_gravity
from jaxtune.mjx import Simulator, action_delay, field, friction, mass, strength

MODEL_PATH = Path(__file__).parent / "model.xml"
LEGS = ("FL", "FR", "RL", "RR")
JOINTS = tuple(f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "thigh", "calf"))

_STAND_RAD = np.tile([0.0, 0.9, -1.8], 4)
_STAND_M = 0.27  # height of the base in this pose
_FALLEN_M, _FALLEN_TILT = 0.15, 0.5  # height of the base, and the upward component of its axis, of a robot that fell
_SUBSTEPS = 5
_ACTION_RAD = 0.25  # change of a joint target by an action of 1
_MOST_MPS = np.array([1.0, 0.4, 1.0])  # largest commands: forward in m/s, sideways in m/s, turning in rad/s
_SCALES = np.repeat([0.25, 1.0, 1.0, 1.0, 0.05, 1.0], [3, 3, 3, 12, 12, 12])  # of what is observed
_WEIGHTS = {"forward": 1.0, "turning": 0.5, "bouncing": -2.0, "rolling": -0.05, "power": -2e-4, "jerk": -0.01}


@chex.dataclass(frozen=True)
class State:
    """The robot between two policy steps."""

    data: mjx.Data
    obs: jax.Array  # [45] angular velocity, gravity, command, joint angles and velocities, last action; scaled
    reward: jax.Array
    done: jax.Array  # 1 where the robot has fallen
    metrics: dict  # terms of the reward, unweighted
    command: jax.Array  # [3], the same for all of an episode
    action: jax.Array  # [12] the last one


class Go2:
    """A Go2 on flat ground, commanded to walk at a velocity."""

    action_size = 12

    def __init__(self):
        self.mj_model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
        self._mjx_model = mjx.put_model(self.mj_model)

    @property
    def mjx_model(self) -> mjx.Model:
        """The model that is simulated."""
        return self._mjx_model

    @property
    def dt(self) -> float:
        """Period of the policy in s."""
        return self.mj_model.opt.timestep * _SUBSTEPS

    def reset(self, key: jax.Array) -> State:
        """Puts the robot on its feet, with a command for the episode."""
        key_pose, key_command = jax.random.split(key)
        joints = _STAND_RAD + 0.05 * jax.random.uniform(key_pose, (12,), minval=-1.0)
        qpos = jnp.concatenate([jnp.array([0.0, 0.0, _STAND_M + 0.01, 1.0, 0.0, 0.0, 0.0]), joints])
        data = mjx.forward(self._mjx_model, mjx.make_data(self.mj_model).replace(qpos=qpos, ctrl=joints))
        command = _MOST_MPS * jax.random.uniform(key_command, (3,), minval=-1.0)
        still = jnp.zeros(12)
        return self._state(data, command, still, jnp.zeros(()), {name: jnp.zeros(()) for name in _WEIGHTS})

    def step(self, state: State, action: jax.Array) -> State:
        """Moves the robot by one policy step, under an action [12]."""
        data = state.data.replace(ctrl=_STAND_RAD + _ACTION_RAD * action)
        data, _ = jax.lax.scan(lambda data, _: (stepping.step(self._mjx_model, data), None), data, length=_SUBSTEPS)
        rotation = data.xmat[1]
        linear, angular = rotation.T @ data.qvel[:3], data.qvel[3:6]
        terms = {
            "forward": jnp.exp(-4.0 * jnp.sum((linear[:2] - state.command[:2]) ** 2)),
            "turning": jnp.exp(-4.0 * (angular[2] - state.command[2]) ** 2),
            "bouncing": linear[2] ** 2,
            "rolling": jnp.sum(angular[:2] ** 2),
            "power": jnp.sum(jnp.abs(data.actuator_force * data.qvel[6:])),
            "jerk": jnp.sum((action - state.action) ** 2),
        }
        # A reward for a second does not depend on the period of the policy.
        reward = self.dt * jnp.maximum(sum(weight * terms[name] for name, weight in _WEIGHTS.items()), 0.0)
        return self._state(data, state.command, action, reward, terms)

    def _state(self, data, command, action, reward, terms) -> State:
        gravity = projected_gravity(data.qpos[3:7])
        seen = [data.qvel[3:6], gravity, command, data.qpos[7:] - _STAND_RAD, data.qvel[6:], action]
        fallen = (data.qpos[2] < _FALLEN_M) | (gravity[2] > -_FALLEN_TILT)
        return State(
            data=data,
            obs=jnp.concatenate(seen) * _SCALES,
            reward=reward,
            done=fallen.astype(jnp.float32),
            metrics=terms,
            command=command,
            action=action,
        )


def simulator() -> Simulator:
    """Makes the robot that `--robot go2` names: episodes of 20 s, and the parameters that may be wrong."""
    links = {part: [f"{leg}_{part}" for leg in LEGS] for part in ("hip", "thigh", "calf")}
    table = {
        "base_mass": mass("base", bounds=(0.5, 2.0)),
        **{f"{part}_mass": mass(names, bounds=(0.5, 2.0)) for part, names in links.items()},
        "foot_friction": friction([f"{leg}_foot" for leg in LEGS], bounds=(0.3, 3.0)),
        "strength": strength(None, bounds=(0.5, 1.5)),
        "damping": field("dof_damping", joints=JOINTS, bounds=(0.3, 5.0)),
        "dry_friction": field("dof_frictionloss", joints=JOINTS, bounds=(0.3, 5.0)),
        "delay": action_delay(bounds_s=(0.0, 0.04)),
    }
    return Simulator(Go2(), steps=1000, parameters=table)
