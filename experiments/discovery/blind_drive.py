"""Sensors, controller, motors and friction of a robot with a hidden effect, for the blind benchmark.

They share nothing with the library of effects (`experiments.discovery.blind_robots` says why). Each remembers what it
needs from one step to the next, so a run has its own.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from envs.logs import Controller
from experiments.discovery.target_runs import TargetRun

STEP_S = 0.0004
"""Step of the simulation in s."""
_BRISTLE = 2000.0  # 1/rad: one over the displacement at which bristles slip


@dataclass(frozen=True)
class Truth:
    """What is hidden in a robot. Only the scorer reads it; discovery never does."""

    effect: str | None
    """Name of the effect, of the library or of `blind_robots.OUTSIDE`; None hides nothing."""
    places: tuple[str, ...] = ()
    """Names of the joints or bodies that have it."""
    size: float = 0.0
    """Value of the effect's first parameter, in its unit."""


class _Lag:
    """Two equal stages, each with half of the time constant."""

    def __init__(self, seconds: float, first: np.ndarray):
        self._share, self._stages = STEP_S / (0.5 * seconds), np.stack([first, first])

    def __call__(self, signal: np.ndarray) -> np.ndarray:
        self._stages[0] += self._share * (signal - self._stages[0])
        self._stages[1] += self._share * (self._stages[0] - self._stages[1])
        return self._stages[1]


class Sensors:
    """Encoders and speeds of the joints.

    Args:
      truth: what is hidden.
      at: [joints] one where a joint has it, else zero.
    """

    def __init__(self, truth: Truth, at: np.ndarray):
        self._truth, self._at = truth, at
        self._lag: _Lag | None = None
        self._line: list[np.ndarray] = []

    def __call__(self, position: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Reads the joints, [2, joints] rad and rad/s."""
        effect, size = self._truth.effect, self._truth.size
        seen = np.stack([position, speed])
        if effect == "encoder_bias":
            seen[0] += size * self._at
        if effect == "sensor_lag":
            self._lag = self._lag or _Lag(size, seen)
            seen = np.where(self._at > 0, self._lag(seen), seen)
        if effect == "sensor_delay":
            seen = np.where(self._at > 0, self._past(seen, round(size / STEP_S)), seen)
        return seen

    def _past(self, seen: np.ndarray, behind: int) -> np.ndarray:
        """The readings of so many steps ago; before the start, those of the first step."""
        self._line = self._line or [seen] * (behind + 1)
        self._line.append(seen)
        return self._line[-1 - behind]


class Control:
    """A controller that ticks with a jitter, and holds its torque between ticks.

    Args:
      truth: what is hidden.
      at: [joints] one where a joint has it, else zero.
      motion: the targets.
      controller: rate and gains, as the log says.
      gain: [joints] true over said stiffness.
      rng: of the jitter.
    """

    def __init__(
        self,
        truth: Truth,
        at: np.ndarray,
        motion: TargetRun,
        controller: Controller,
        gain: np.ndarray,
        rng: np.random.Generator,
    ):
        self._truth, self._at, self._motion, self._rng = truth, at, motion, rng
        gains: Mapping[str, np.ndarray] = {name: np.asarray(values) for name, values in controller.gains.items()}
        self._kp = gains["kp"] * gain * (np.where(at > 0, truth.size, 1.0) if truth.effect == "gain_error" else 1.0)
        self._kd, self.limit = gains["kd"], gains["torque_limit_nm"]
        self._period, self._rate = 1.0 / controller.rate_hz, 1.0 / float(np.median(np.diff(motion.time)))
        # Real controllers are late by a part of their period; discovery has to find the timing by itself.
        self._tick, self._jitter = 0.0, rng.uniform(0, 0.3) * self._period
        self._held, self._slewed = np.zeros(len(at)), motion.target[0].copy()

    def __call__(self, now: float, seen: np.ndarray) -> np.ndarray:
        """The torque [joints] Nm that it holds at a time, given readings [2, joints]."""
        if now >= self._tick + self._jitter:
            self._tick += self._period
            self._jitter = self._rng.uniform(0, 0.3) * self._period
            error = self._error(self._target(now) - seen[0])
            torque = np.clip(self._kp * error - self._kd * seen[1], -self.limit, self.limit)
            self._held = self._motion.enabled[self._row(now)] * torque
        return self._held

    def _target(self, now: float) -> np.ndarray:
        effect, size = self._truth.effect, self._truth.size
        target = self._motion.target[self._row(now)]
        if effect == "command_delay":
            return np.where(self._at > 0, self._motion.target[self._row(now - size)], target)
        if effect == "target_slew":
            most = size * self._period
            self._slewed = self._slewed + np.clip(target - self._slewed, -most, most)
            return np.where(self._at > 0, self._slewed, target)
        return target

    def _error(self, error: np.ndarray) -> np.ndarray:
        if self._truth.effect != "deadband":
            return error
        half = self._truth.size / 2
        soft = np.where(np.abs(error) > half, error - np.sign(error) * half, 0.0)
        return np.where(self._at > 0, soft, error)

    def _row(self, time: float) -> int:
        return min(max(int(time * self._rate + 1e-6), 0), len(self._motion.target) - 1)


class Motors:
    """Motors that give another torque than they are told.

    Args:
      truth: what is hidden.
      at: [joints] one where a joint has it, else zero.
      limit: [joints] Nm of the controller.
    """

    def __init__(self, truth: Truth, at: np.ndarray, limit: np.ndarray):
        self._truth, self._at, self._limit = truth, at, limit
        self._lag = _Lag(truth.size, np.zeros(len(at))) if truth.effect == "torque_lag" else None

    def __call__(self, told: np.ndarray, speed: np.ndarray, share: float) -> np.ndarray:
        """The torque [joints] Nm at a speed [joints] rad/s, at a share of the run."""
        effect, size, torque = self._truth.effect, self._truth.size, told
        if effect == "torque_lag":
            torque = self._lag(torque)
        if effect == "torque_limit":
            torque = size * np.tanh(torque / size)
        if effect == "torque_speed":
            most = np.maximum(self._limit - size * np.abs(speed), 0.0)
            torque = np.where(torque * speed > 0, np.clip(torque, -most, most), torque)
        if effect == "torque_scale":
            torque = size * torque
        if effect == "temperature_fade":
            torque = (1.0 - size * share) * torque
        return np.where(self._at > 0, torque, told)


class Bristles:
    """Dry friction by the LuGre model.

    With deflection z and speed v: dz/dt = v - s |v| z / g(v), torque = s z + d dz/dt. The level is
    g(v) = slide + (stick - slide) exp(-(v / 0.15)^2), which holds Coulomb, load and Stribeck friction.

    Args:
      truth: what is hidden.
      at: [joints] one where a joint has it, else zero.
      slides: [joints] Nm, the dry friction of a robot that lacks nothing.
    """

    def __init__(self, truth: Truth, at: np.ndarray, slides: np.ndarray):
        self._truth, self._at, self._slides = truth, at, slides
        self._deflection = np.zeros(len(at))

    def __call__(self, speed: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Moves the bristles by a step, and returns the torque of friction in Nm, [joints]."""
        effect, size = self._truth.effect, self._truth.size
        slides = self._slides.copy()
        if effect == "coulomb":
            slides = slides + size * self._at
        if effect == "load_friction":
            slides = slides + size * self._at * np.abs(torque)
        sticks = slides + size * self._at if effect == "stribeck" else slides
        level = slides + (sticks - slides) * np.exp(-((speed / 0.15) ** 2))
        there = level > 1e-9
        stiffness = _BRISTLE * np.maximum(level, 1e-9)
        rate = speed - stiffness * np.abs(speed) / np.maximum(level, 1e-9) * self._deflection
        # Implicit in the bristle: the explicit form is unstable where speed is high.
        moved = (self._deflection + STEP_S * speed) / (1 + STEP_S * _BRISTLE * np.abs(speed))
        self._deflection = np.where(there, moved, 0.0)
        damping = 0.3 * np.sqrt(stiffness * 1e-3)
        slow = damping * np.where(np.abs(speed) < 0.05, rate, 0.0)
        return np.where(there, stiffness * self._deflection + slow, 0.0)
