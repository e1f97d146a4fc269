"""Plays an exported policy on a robot's computer: NumPy and this file are enough.

    player = Player("policy.npz")
    while walking:  # 100 times a second
        target = player.step(velocity=..., command=..., gyro=..., gravity=..., joint=..., joint_velocity=...)
        player.tick()

Numbers and layout come with the policy (`python -m experiments.export`). What is written here a second time, without
JAX, is compared with the simulator's own observation, clock and reference in the tests.
"""

import json
from pathlib import Path

import numpy as np


class Player:
    """A policy, its gait clock and what it remembers of its last step.

    Args:
      path: of the `.npz` that was exported.
      phase: where the left foot's clock starts, in cycles; the right one's is half a cycle ahead.
    """

    def __init__(self, path: str | Path, phase: float = 0.0):
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            self.meta = json.loads(str(stored["meta"]))
            arrays = {name: stored[name] for name in stored.files if name != "meta"}
        self._mean, self._std = arrays["mean"], arrays["std"]
        self._layers = [(arrays[f"kernel_{i}"], arrays[f"bias_{i}"]) for i in range(self.meta["layers"])]
        self.reset(phase)

    def reset(self, phase: float = 0.0) -> None:
        """Forgets the last step, as before a walk.

        Args:
          phase: where the left foot's clock starts, in cycles.
        """
        self.phase = np.mod(phase + np.array(self.meta["clock"]["offsets"]), 1.0)
        self.action = np.zeros(len(self.meta["joints"]))
        self.target = None
        """Last joint target [joints], rad; None before the first step."""

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
        """Asks the policy what the joints should do until the next step.

        Args:
          velocity: [3] m/s, of the trunk's origin, body frame.
          command: [3] m/s, m/s, rad/s.
          gyro: [3] rad/s, body frame.
          gravity: [3] direction of gravity in the body frame.
          joint, joint_velocity: [joints] rad, rad/s, in the order of `meta["joints"]`.

        Returns:
          Joint targets [joints], rad. `action` and `phase` are those of this step until `tick` is called.

        Raises:
          ValueError: a reading is not finite; the player remembers what it did before.
        """
        meta = self.meta
        error = np.zeros(len(joint)) if self.target is None else self.target - joint
        obs = self.observe(velocity, command, gyro, gravity, joint, joint_velocity, self.action, error, self.phase)
        if not np.isfinite(obs).all():
            names = [row["name"] for row in meta["observation"] for _ in range(row["size"])]
            bad = dict.fromkeys(name for name, value in zip(names, obs, strict=True) if not np.isfinite(value))
            raise ValueError(f"{', '.join(bad)}: got a number that is not finite")
        self.action = np.clip(self.network(obs), -meta["action_limit"], meta["action_limit"])
        base = self.reference(self.phase, command) if meta["base"] == "raibert" else np.array(meta["stand_rad"])
        self.target = base + meta["action_scale"] * self.action
        return self.target.copy()

    def tick(self) -> None:
        """Advances the gait clock by one policy step. Call it after every `step`, once the targets were sent."""
        clock = self.meta["clock"]
        self.phase = np.mod(self.phase + clock["hz"] / self.meta["rate_hz"], 1.0)

    def network(self, obs: np.ndarray) -> np.ndarray:
        """Computes the action [act] for an observation [obs]: normaliser, dense layers with ELU, no output
        squashing."""
        value = (obs - self._mean) / self._std
        for number, (kernel, bias) in enumerate(self._layers):
            value = value @ kernel + bias
            if number + 1 < len(self._layers):
                value = np.where(value > 0, value, np.expm1(np.minimum(value, 0.0)))
        return value

    def observe(self, velocity, command, gyro, gravity, joint, joint_velocity, action, error, phase) -> np.ndarray:
        """Builds the observation [obs] from readings, laid out and scaled as `meta["observation"]` says.

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
        """Computes joint angles [joints], rad, of feet that follow the clock (Raibert's heuristic), by inverse
        kinematics.

        Args:
          phase: [2] cycles; a foot stands below `duty` and swings above.
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
