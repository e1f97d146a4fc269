"""What a log shows of a robot: noise and quantum of each joint, speeds raw, filtered or not there, and time stamps."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter, savgol_filter


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Sensors of one robot, and what its log keeps of them."""

    noise_rad: np.ndarray
    """[joints] standard deviation."""
    quantum_rad: float
    speed: str
    """`raw`, `filtered` or `none`: what the log has of speeds."""
    speed_noise: float
    """rad/s"""
    speed_quantum: float
    """rad/s"""
    filter_hz: float
    """Of filtered speeds, a low-pass of first order."""

    def positions(self, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns positions [..., joints] with noise, rounded."""
        noisy = q + self.noise_rad * rng.standard_normal(q.shape)
        return np.round(noisy / self.quantum_rad) * self.quantum_rad

    def speeds(self, v: np.ndarray, row_s: float, rng: np.random.Generator) -> np.ndarray | None:
        """Returns speeds [rows, joints] as the log has them; None where it has none.

        Args:
          v: [rows, joints] rad/s without noise.
          row_s: time between rows.
          rng: random numbers.
        """
        if self.speed == "none":
            return None
        noisy = v + self.speed_noise * rng.standard_normal(v.shape)
        if self.speed == "filtered":
            keep = np.exp(-2 * np.pi * self.filter_hz * row_s)
            noisy = lfilter([1 - keep], [1, -keep], noisy, axis=0, zi=keep * noisy[:1])[0]
        return np.round(noisy / self.speed_quantum) * self.speed_quantum

    def smoothed(
        self, q: np.ndarray, v: np.ndarray, row_s: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions and speeds [lanes, rows, joints] as one would estimate them from noisy positions.

        Args:
          q: [lanes, rows, joints] rad, noisy.
          v: [lanes, rows, joints] rad/s, exact.
          row_s: time between rows.
          rng: random numbers.
        """
        window = max(5, 2 * round(0.02 / row_s) + 1)
        smooth = savgol_filter(q, window, 3, axis=1)
        if self.speed == "raw":
            noisy = v + self.speed_noise * rng.standard_normal(v.shape)
            return smooth, savgol_filter(noisy, window, 3, axis=1)
        return smooth, savgol_filter(q, window, 3, deriv=1, delta=row_s, axis=1)


def draw(joints: int, rng: np.random.Generator) -> Sensors:
    """Draws the sensors of a robot, from hobby servos to industrial encoders.

    Args:
      joints: number of joints.
      rng: random numbers.
    """
    bits = rng.choice([12, 13, 14, 14, 15, 16])
    speed = str(rng.choice(["raw", "raw", "filtered", "none"]))
    return Sensors(
        noise_rad=np.exp(rng.uniform(np.log(5e-5), np.log(6e-4))) * rng.uniform(0.5, 1.5, joints),
        quantum_rad=float(2 * np.pi / 2**bits),
        speed=speed,
        speed_noise=float(np.exp(rng.uniform(np.log(0.004), np.log(0.03)))),
        speed_quantum=float(rng.choice([0.001, 0.005, 0.01])),
        filter_hz=float(rng.uniform(7, 14)),
    )


def stamped_late(time: np.ndarray, late_s: float, rng: np.random.Generator) -> np.ndarray:
    """Stamps rows as a program does that other programs delay: most by little, and one in 150 by five times the mean.

    Args:
      time: [rows] s, when they were read.
      late_s: mean delay.
      rng: random numbers.
    """
    # No row is stamped after the next one was.
    late = np.minimum(rng.exponential(late_s, len(time)), 0.9 * np.diff(time).min())
    return time + late - late[0]
