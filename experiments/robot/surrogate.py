"""The body of the stand-in robot, with effects that real robots have and the learner's simulator lacks.

It is simulated in MuJoCo C. Targets arrive late, motors lag and give less torque the faster they turn, encoders round,
the IMU is noisy and biased, the velocity estimate drifts, and the feet have another friction.
`experiments.robot_stub` connects it to requests and logs.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from envs.biteno import TaskConfig, constants, env
from envs.biteno.player import Player
from envs.logs import Controller, Log, Run
from envs.models import suspended as fixed_base

_STEP_S = 0.0005  # of the physics; shorter than the learner's, so that the engine differs too
_TICK_S = 0.001  # period of the joint controllers
ROW_S = 0.002
"""Time between the rows of its logs, in s."""
_TASK = TaskConfig()  # ranges and timing of the commands that it draws


@dataclass(frozen=True, kw_only=True)
class Body:
    """Properties of the robot; a name without a unit is a multiple of the nominal model's value."""

    trunk_mass: float = 1.0
    """Mass of the trunk, as a multiple of nominal."""
    leg_mass: float = 1.0
    """Mass of each of the six leg links, as a multiple of nominal."""
    foot_friction: float = 0.75
    """Friction of the feet, as a multiple of nominal."""
    transport_s: float = 0.01
    """Delay of joint targets on their way to the controllers, in s."""
    motor_lag_s: float = 0.004
    """Time constant of the motors' torque, a first-order lag, in s."""
    no_load_rad_s: float = 30.0
    """Joint speed at which a motor gives no torque, in rad/s; its limit falls linearly up to there."""
    torque_scale: float = 1.0
    """Torque that a motor gives, as a multiple of the torque that its controller wants."""
    encoder_rad: float = 2 * np.pi / 2**14
    """Resolution of the encoders in rad."""
    velocity_noise_rad_s: float = 0.05
    """Standard deviation of the noise of joint velocities, in rad/s."""
    gyro_noise_rad_s: float = 0.02
    """Standard deviation of the gyro's noise, in rad/s."""
    gyro_bias_rad_s: float = 0.01
    """Standard deviation of the gyro's bias, in rad/s; one bias is drawn for every run."""
    tilt_bias_rad: float = 0.01
    """Standard deviation of the error of the estimated direction of gravity, in rad; one is drawn for every run."""
    drift_mps: float = 0.05
    """Standard deviation of the drifting error of the velocity estimate, in m/s."""


class Robot:
    """The simulated robot with its controllers and sensors; it records one run at a time.

    Args:
      body: its properties.
      suspended: True fixes the base in the air, to `play` targets; False puts the robot on the ground, to `walk`.
    """

    def __init__(self, body: Body, suspended: bool = False):
        self.body = body
        spec = mujoco.MjSpec.from_file(str(constants.MODEL_PATH))
        for link in spec.bodies[1:]:
            for geom in link.geoms:
                geom.mass *= body.trunk_mass if link.name == "trunk" else body.leg_mass
        for foot in constants.FEET:
            friction = spec.geom(foot).friction
            spec.geom(foot).friction = [friction[0] * body.foot_friction, *friction[1:]]
        model = spec.compile()
        # The controller of its walks; targets that are played while it is suspended bring their own.
        self.controller = Controller(
            kind="pd",
            rate_hz=1.0 / _TICK_S,
            gains={
                "kp": model.actuator_gainprm[:, 0].copy(),
                "kd": -model.actuator_biasprm[:, 2].copy(),
                "torque_limit_nm": model.actuator_forcerange[:, 1].copy(),
            },
        )
        model = fixed_base(spec) if suspended else model
        model.opt.timestep = _STEP_S
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        # The solver converges here, while the learner's few iterations trade accuracy for speed.
        model.opt.iterations, model.opt.ls_iterations = 100, 50
        # The model's own actuators are off, because torques with lag and limits are applied by `_push`.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        # A simulation that broke is seen as such, and not put back on its feet.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.model = model
        joints = [model.joint(name) for name in constants.JOINTS]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        self._feet = [model.geom(foot).id for foot in constants.FEET]

    load = staticmethod(Player)
    """Loads an exported policy."""

    def log(self, meta: Mapping[str, Any], runs: tuple[Run, ...]) -> Log:
        """Makes the log of walks with a policy that has this `meta`."""
        return Log(
            robot=meta["robot"],
            base="free",
            rate_hz=1.0 / ROW_S,
            joints=tuple(meta["joints"]),
            policy={name: meta[name] for name in ("rate_hz", "action_scale", "base")},
            runs=runs,
        )

    def walk(self, name: str, player: Player, seconds: float, rng: np.random.Generator) -> tuple[Run, bool]:
        """Walks with a policy from a standing start until the time is over or the robot has fallen.

        Args:
          name: of the run.
          player: the exported policy.
          seconds: length of the walk in s.
          rng: random generator of commands, start and noise.

        Returns:
          The recorded run, and whether the robot fell. After a fall the last row has the motors off (`enabled` 0).
        """
        self._stand_up(rng)
        player.reset(rng.uniform())
        per_tick, per_row = round(_TICK_S / _STEP_S), round(ROW_S / _STEP_S)
        per_policy = round(constants.POLICY_DT_S / _STEP_S)
        command, rows, fell = _command(rng), [], False
        for step in range(round(seconds / _STEP_S)):
            if step % round(_TASK.command_s / _STEP_S) == 0 and step:
                command = _command(rng)
            if step % per_tick == 0:
                seen = self._look(rng)
            if step % per_policy == 0:
                if step:
                    player.tick()
                target = player.step(
                    velocity=seen["vel"],
                    command=command,
                    gyro=seen["gyro"],
                    gravity=seen["gravity"],
                    joint=seen["q"],
                    joint_velocity=seen["dq"],
                )
            if step % per_tick == 0:
                self._line.append(target)
                wanted = self._wanted_torque(self._line[0], seen, self.controller)
            if step % per_row == 0:
                sent = {"target": target, "action": player.action, "phase": player.phase, "cmd": command}
                rows.append({"tau": self._torque.copy(), "enabled": 1.0, "contact": self._contact()} | seen | sent)
            self._push(wanted)
            mujoco.mj_step(self.model, self.data)
            if self._fallen():
                fell = True
                # A last row with the motors off tells the reader of the log that the walk ended in a fall.
                rows.append(rows[-1] | self._look(rng) | {"enabled": 0.0})
                break
        signals = {signal: np.stack([row[signal] for row in rows]).astype(float) for signal in rows[0]}
        walked = Run(
            name=name,
            condition="walk",
            split=None,
            controller=self.controller,
            time=ROW_S * np.arange(len(rows)),
            signals=signals,
        )
        return walked, fell

    def play(self, targets: Run, rng: np.random.Generator) -> Run:
        """Plays the targets of a run on the suspended robot, from rest at the first target.

        Args:
          targets: a run without measurements, from `experiments.excite`.
          rng: random generator of noise.

        Returns:
          The run with measured joint positions and velocities.

        Raises:
          ValueError: the run's controller is no PD controller, or its period is no multiple of the physics' step.
        """
        tick_s = 1.0 / targets.controller.rate_hz
        per_tick = round(tick_s / _STEP_S)
        if targets.controller.kind != "pd" or not np.isclose(per_tick * _STEP_S, tick_s):
            raise ValueError(
                f"{targets.name}: controller: got {targets.controller.kind} at {targets.controller.rate_hz:g} Hz, "
                f"expected pd with ticks that are multiples of {_STEP_S} s"
            )
        self.data = mujoco.MjData(self.model)
        self.data.qpos[self._qpos] = targets.signals["target"][0]
        self._begin(tick_s)
        grid = np.arange(targets.time[0], targets.time[-1] + _STEP_S, _STEP_S)
        enabled = targets.signals.get("enabled", np.ones(len(targets.time)))
        moved = []
        for step, row in enumerate(np.searchsorted(targets.time, grid + 1e-9, side="right") - 1):
            moved.append(np.stack([self.data.qpos[self._qpos], self.data.qvel[self._dof]]))
            if step % per_tick == 0:
                self._line.append(targets.signals["target"][row])
                torque = enabled[row] * self._wanted_torque(
                    self._line[0], self._joints(*moved[-1], rng), targets.controller
                )
            self._push(torque)
            mujoco.mj_step(self.model, self.data)
        moved = np.stack(moved, axis=1)  # [2, steps, joints]
        position, speed = (np.stack([np.interp(targets.time, grid, joint) for joint in one.T], axis=1) for one in moved)
        return replace(targets, signals=dict(targets.signals) | self._joints(position, speed, rng))

    def _begin(self, tick_s: float) -> None:
        """Starts at rest, as if the present position had been the target for longer than the delay."""
        mujoco.mj_forward(self.model, self.data)
        late = round(self.body.transport_s / tick_s)
        self._torque = np.zeros(len(self._qpos))
        self._line = deque([self.data.qpos[self._qpos].copy()] * (1 + late), maxlen=1 + late)

    def _stand_up(self, rng: np.random.Generator) -> None:
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.keyframe("home").id)
        self.data.qpos[self._qpos] += rng.uniform(-0.1, 0.1, len(self._qpos))
        self._begin(_TICK_S)
        body = self.body
        self._bias = {
            "gyro": body.gyro_bias_rad_s * rng.standard_normal(3),
            "tilt": body.tilt_bias_rad * rng.standard_normal(3),
            "vel": body.drift_mps * rng.standard_normal(3),
        }

    def _look(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Returns the readings of all sensors at this moment, with their noise, bias and drift."""
        body, data = self.body, self.data
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, data.qpos[3:7])
        into_body = turn.reshape(3, 3).T
        # The error of the velocity estimate is a first-order autoregressive process with a time constant of 2 s.
        stays = np.exp(-_TICK_S / 2.0)
        wander = body.drift_mps * np.sqrt(1 - stays**2) * rng.standard_normal(3)
        self._bias["vel"] = stays * self._bias["vel"] + wander
        gravity = into_body @ np.array([0.0, 0.0, -1.0])
        gravity = gravity + np.cross(self._bias["tilt"], gravity)
        return self._joints(data.qpos[self._qpos], data.qvel[self._dof], rng) | {
            "gyro": data.qvel[3:6] + self._bias["gyro"] + body.gyro_noise_rad_s * rng.standard_normal(3),
            "gravity": gravity / np.linalg.norm(gravity),
            "vel": into_body @ data.qvel[:3] + self._bias["vel"],
        }

    def _joints(self, position: np.ndarray, speed: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
        body = self.body
        return {
            "q": np.round(position / body.encoder_rad) * body.encoder_rad,
            "dq": speed + body.velocity_noise_rad_s * rng.standard_normal(speed.shape),
        }

    @staticmethod
    def _wanted_torque(target: np.ndarray, seen: dict[str, np.ndarray], controller: Controller) -> np.ndarray:
        gains = controller.gains
        torque = gains["kp"] * (target - seen["q"]) - gains["kd"] * seen["dq"]
        return np.clip(torque, -gains["torque_limit_nm"], gains["torque_limit_nm"])

    def _push(self, wanted: np.ndarray) -> None:
        """Applies the wanted torque as the motors give it: lagged, and limited by speed."""
        body, speed = self.body, self.data.qvel[self._dof]
        share = 1.0 - np.exp(-_STEP_S / max(body.motor_lag_s, 1e-9))
        self._torque += share * (body.torque_scale * wanted - self._torque)
        limit = self.controller.gains["torque_limit_nm"]
        drop = limit / body.no_load_rad_s * speed
        self._torque = np.clip(self._torque, -limit - drop, limit - drop)
        self.data.qfrc_applied[self._dof] = self._torque

    def _contact(self) -> np.ndarray:
        touching = {int(geom) for pair in self.data.contact.geom for geom in pair}
        return np.array([float(foot in touching) for foot in self._feet])

    def _fallen(self) -> bool:
        _, x, y, _ = self.data.qpos[3:7]
        gravity = np.array([0.0, 0.0, 2 * (x * x + y * y) - 1])
        return bool(env.fallen(gravity, self.data.qpos[2])) or not np.isfinite(self.data.qpos).all()


def _command(rng: np.random.Generator) -> np.ndarray:
    """Draws a command as the task does: forward in m/s, sideways in m/s, turning in rad/s."""
    command = rng.uniform(-1, 1, 3) * _TASK.command_max
    return np.zeros(3) if rng.uniform() < _TASK.zero_command_share else command
