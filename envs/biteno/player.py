"""Runs an exported policy on BITeno's computer, which needs only NumPy, this file and `network.py` beside it.

    player = Player("policy.npz")
    while walking:  # 100 times per second
        target = player.step(velocity=..., command=..., gyro=..., gravity=..., joint=..., joint_velocity=...)
        player.tick()

Where `step` raises an error the robot has fallen, or a sensor has failed: switch its motors to damping then.
`python -m experiments.export` writes the policy with all numbers that are needed here. Observation, clock and reference
exist a second time in this file, without JAX; tests compare them with the simulator's own.
"""

from pathlib import Path

import numpy as np

try:
    from jaxtune.network import Network
except ImportError:  # on a robot's computer, where the exported copy lies beside this file
    from network import Network


class Player(Network):
    """A policy with its gait clock and its memory of the last step (action and joint target, which it observes).

    Call `step` and then `tick`, once per policy period, and send the targets to the joint controllers.

    Args:
      path: of the `.npz` that was exported.
      phase: where the left foot's clock starts, in cycles; the right one's is half a cycle ahead.
    """

    def __init__(self, path: str | Path, phase: float = 0.0):
        super().__init__(path)
        self.reset(phase)

    def reset(self, phase: float = 0.0) -> None:
        """Forgets the last step and restarts the gait clock; call it before every walk.

        Args:
          phase: where the left foot's clock starts, in cycles.
        """
        self.phase = np.mod(phase + np.array(self.meta["clock"]["offsets"]), 1.0)
        self.action = np.zeros(len(self.meta["joints"]))
        self.target = None
        """Last joint target [joints] before it was limited, rad; None before the first step."""

    def step(
        self,
        *,
        velocity: np.ndarray,
        command: np.ndarray,
        gyro: np.ndarray,
        gravity: np.ndarray,
        joint: np.ndarray,
        joint_velocity: np.ndarray,
    ) -> np.ndarray:
        """Computes the joint targets that hold until the next step.

        The target is `base + action_scale * action`, where the action is the network's output for the observation, and
        `base` is the reference walk or the standing pose. What is returned never leaves the joints' ranges. The policy
        observes the target as it was meant, since that is what it was trained with.

        Args:
          velocity: [3] m/s, of the trunk's origin, body frame.
          command: [3] forward in m/s, sideways in m/s, turning in rad/s; clipped to what the policy was trained with.
          gyro: [3] rad/s, body frame.
          gravity: [3] direction of gravity, unit vector in the body frame.
          joint, joint_velocity: [joints] rad, rad/s, in the order of `meta["joints"]`.

        Returns:
          Joint targets [joints], rad. `action` and `phase` are those of this step until `tick` is called.

        Raises:
          ValueError: a reading is not finite, gravity is no unit vector, the trunk is tilted as far as after a fall,
            or the robot does not stand before its first step. The player's memory is unchanged, so the step can be
            repeated.
        """
        meta = self.meta
        self._check(np.asarray(gravity), np.asarray(joint))
        command = np.clip(command, -np.array(meta["command_max"]), meta["command_max"])
        error = np.zeros(len(joint)) if self.target is None else self.target - joint
        obs = self.observe(velocity, command, gyro, gravity, joint, joint_velocity, self.action, error, self.phase)
        self.action = np.clip(self(obs), -meta["action_limit"], meta["action_limit"])
        base = self.reference(self.phase, command) if meta["base"] == "raibert" else np.array(meta["stand_rad"])
        self.target = base + meta["action_scale"] * self.action
        return np.clip(self.target, *np.array(meta["joint_range_rad"]).T)

    def _check(self, gravity: np.ndarray, joint: np.ndarray) -> None:
        """Checks that the robot is where the policy has been in training; what is not finite is found later."""
        length = np.linalg.norm(gravity)
        if not 0.8 < length < 1.2 and np.isfinite(length):
            raise ValueError(f"gravity: got a length of {length:.2f}, expected 1")
        tilt, limit = np.arccos(np.clip(-gravity[2] / max(length, 1e-9), -1.0, 1.0)), self.meta["tilt_limit_rad"]
        if tilt > limit:
            raise ValueError(f"gravity: got a tilt of {tilt:.2f} rad, expected at most {limit:g}: the robot has fallen")
        off, limit = np.abs(joint - np.array(self.meta["stand_rad"])), self.meta["start_rad"]
        if self.target is None and off.max() > limit:
            name = self.meta["joints"][off.argmax()]
            raise ValueError(f"joint: {name} is {off.max():.2f} rad off the stand, expected at most {limit:g} at first")

    def tick(self) -> None:
        """Advances the gait clock by one policy period; call it once after every `step`."""
        clock = self.meta["clock"]
        self.phase = np.mod(self.phase + clock["hz"] / self.meta["rate_hz"], 1.0)

    def observe(self, velocity, command, gyro, gravity, joint, joint_velocity, action, error, phase) -> np.ndarray:
        """Returns the observation [obs], with the order and the scales that `meta["observation"]` lists.

        Args:
          velocity, command, gyro, gravity, joint, joint_velocity: as in `step`.
          action: [joints] of the last step.
          error: [joints] rad, last target minus joint position.
          phase: [2] cycles, of the gait clock.
        """
        angle = 2.0 * np.pi * np.asarray(phase)
        parts = {
            "velocity": velocity,
            "command": command,
            "gyro": gyro,
            "gravity": gravity,
            "joint": joint - np.array(self.meta["stand_rad"]),
            "joint_velocity": joint_velocity,
            "last_action": action,
            "joint_error": error,
            "clock": np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(-1),
        }
        return np.concatenate([np.asarray(parts[row["name"]]) * row["scale"] for row in self.meta["observation"]])

    def reference(self, phase: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Returns joint angles [joints] in rad of a reference walk in which the feet follow the clock.

        It is Raibert's heuristic: the foot is placed ahead by half of the way that the commanded velocity covers in
        stance. Inverse kinematics of a leg with two links of equal length give the angles.

        Args:
          phase: [2] cycles of left and right foot; a foot is in swing above `duty`.
          command: [3] m/s, m/s, rad/s.
        """
        leg, clock = self.meta["leg"], self.meta["clock"]
        reach = (np.abs(1.0 - 2.0 * phase) - 0.5) * clock["duty"] / clock["hz"]
        x = reach * (command[0] - command[2] * np.array(leg["hip_y_m"]))
        y = reach * command[1]
        lift = np.where(phase > clock["duty"], leg["swing_height_m"] * np.sin(np.pi * (2.0 * phase - 1.0)), 0.0)
        z = lift - leg["stance_depth_m"]
        depth = np.hypot(y, z)
        length = np.hypot(x, depth)
        knee = 2.0 * np.arccos(np.clip(length / (2.0 * leg["link_m"]), 0.0, 1.0))
        return np.stack([np.arctan2(y, -z), -np.arctan2(x, depth) - knee / 2.0, knee], axis=-1).reshape(-1)
