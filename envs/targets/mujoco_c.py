"""A target in MuJoCo C: many robots in parallel on the machine's cores."""

import os
from collections.abc import Mapping

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from envs.biteno import Biteno, Drive, Motion, State, constants
from envs.targets.host import HostTarget
from jaxtune.mjx import parameters

_NET_FORCE = 3  # the contact sensor's code for the sum over contacts
_ITERATIONS = 100  # MuJoCo's own default, with which its solver converges


class MujocoC:
    """MuJoCo C as an engine for `HostTarget`.

    With other options than MJX (elliptic cones, another integrator, half the time step) it stands for a robot whose
    physics the tuner's simulator does not have.

    Args:
      robot: task and robot; its table of parameters is used.
      params: true physical values by name.
      threads: number of threads; all cores where None.
      options: fields of `mujoco.MjOption` by name (`cone`, `integrator`, `timestep`, ...).

    Raises:
      ValueError: the time step does not divide the task's, or a parameter is unknown.
    """

    def __init__(self, robot: Biteno, params: Mapping[str, float], threads: int | None = None, **options):
        spec = mujoco.MjSpec.from_file(str(constants.MODEL_PATH))
        for joint in constants.JOINTS:
            kind = {"type": mujoco.mjtSensor.mjSENS_ACTUATORFRC, "objtype": mujoco.mjtObj.mjOBJ_ACTUATOR}
            spec.add_sensor(name=f"{joint}_torque", objname=joint, **kind)
        for foot in constants.FEET:
            sensor = spec.add_sensor(name=f"{foot}_force", type=mujoco.mjtSensor.mjSENS_CONTACT)
            sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, foot
            # Force alone, the sum over all contacts, in the world's frame.
            sensor.intprm[:3] = [1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), _NET_FORCE, 1]
        model = spec.compile()
        model.opt.timestep = robot.mj_model.opt.timestep
        model.opt.iterations = _ITERATIONS
        # MuJoCo puts a robot whose simulation broke back on its feet; here the episode ends.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        for name, value in options.items():
            setattr(model.opt, name, value)
        ratio = robot.mj_model.opt.timestep / model.opt.timestep
        self._repeats = round(ratio)
        if self._repeats < 1 or abs(ratio - self._repeats) > 1e-6:
            raise ValueError(f"timestep: got {model.opt.timestep}, expected a divisor of {robot.mj_model.opt.timestep}")
        self._model = parameters.apply_mujoco(model, params, robot.entries)
        # One workspace for each thread; robots are distributed over them.
        threads = os.cpu_count() if threads is None else threads
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads)

    def start(self, state: State) -> None:
        """Does nothing, because every call of `move` starts from the state that it is given."""

    def move(self, state: State, drive: Drive) -> Motion:
        """Moves every robot by one policy step, distributed over threads; see `envs.targets.host.Engine`."""
        count = len(state.qpos)
        # MuJoCo's full physics state is time, positions and velocities.
        start = np.concatenate([np.zeros((count, 1)), state.qpos, state.qvel], axis=1)
        control = np.repeat(np.asarray(drive.targets, float), self._repeats, axis=1)
        states, sensors = self._pool.rollout(
            self._model, self._data, start, control, initial_warmstart=np.asarray(state.qacc_warmstart, float)
        )
        last, sensed = states[:, -1], sensors[:, -1]
        qpos, qvel = np.split(last[:, 1:], [self._model.nq], axis=1)
        torque, force = np.split(sensed, [len(constants.JOINTS)], axis=1)
        return Motion(
            qpos=jnp.asarray(qpos, jnp.float32),
            qvel=jnp.asarray(qvel, jnp.float32),
            qacc_warmstart=jnp.zeros((count, self._model.nv)),
            torque=jnp.asarray(torque, jnp.float32),
            # The sensor gives the force of the foot on the floor.
            foot_force=jnp.asarray(-force.reshape(count, 2, 3), jnp.float32),
        )


def target(robot: Biteno, params: Mapping[str, float], **options) -> HostTarget:
    """Makes a target in MuJoCo C.

    Args:
      robot: task and robot.
      params: true physical values by name.
      options: `threads` and fields of `mujoco.MjOption`, as `MujocoC` takes them.
    """
    return HostTarget(robot, params, MujocoC(robot, params, **options))
