"""How severe an effect of a size is, measured in its own generator.

The runs are simulated with the effect and without noise. From what would be read, segments of 0.15 s start again on the
same robot without the effect. The difference at their rows is what a model that lacks the effect gets wrong. Of this,
errors of the nominal parameters (masses, armatures, dampings, frictions, kp, kd; at most three prior deviations each)
may imitate a part, which a least-squares fit takes away. Severity is the rms of the rest in the position of the most
affected joint, over the floor: the rms of the same difference for the same robot without any effect, whose readings
have noise and quantum, whose segments start from what a smoothing of these readings gives, and whose controller ticks
with another jitter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.discovery.field.playing import Lanes, Script, Trace, play, whole
from experiments.discovery.field.readings import Sensors
from experiments.discovery.field.robots import Robot
from experiments.discovery.field.sizes import Scales

_HORIZON_S = 0.15
_BIN_S = 0.01
_PRIOR = {"mass": 0.1, "armature": 0.1, "damping": 0.1, "friction": 0.1, "kp": 0.035, "kd": 0.035}
_LOOSE_M = 1e-3  # prior deviation of a centre of mass in each direction
_MOST = 3.0  # prior deviations that a parameter may be off
_MOST_SEVERE = 1e4  # in place of infinity, which files cannot hold
_RUNS, _STARTS = 4, 9  # that are measured, and segments of each


@dataclass(frozen=True, kw_only=True)
class Generator:
    """One of the three ways in which robots are simulated."""

    plant: type
    friction: type

    def play(self, robots: Sequence[Robot], script: Script, lanes: Lanes, hidden=()) -> Trace:
        """Simulates all lanes (`playing.play`)."""
        return play(self.plant, self.friction, robots, script, lanes, hidden)


class Meter:
    """Measures severities on one robot in the motions of its case.

    Args:
      generator: of the case.
      robot: the real one, without any effect.
      script: the runs.
      sensors: noise and quantum.
      seed: of noise.
    """

    def __init__(self, generator: Generator, robot: Robot, script: Script, sensors: Sensors, seed: int):
        self._generator, self._robot, self._script = generator, robot, script
        runs, rows = script.target.shape[:2]
        self.row_s = script.steps_a_row * generator.plant.dt
        self._chosen = np.unique(np.linspace(0, runs - 1, min(runs, _RUNS)).astype(int))
        self._long = max(2, round(_HORIZON_S / self.row_s)) + 1
        rng = np.random.default_rng(seed)
        # Spread over each run, at other times in each.
        self._starts = (rng.uniform(0, 1, (len(self._chosen), _STARTS)) + np.arange(_STARTS)) / _STARTS
        self._starts = (self._starts * (rows - self._long - 1)).astype(int)
        self._plain = generator.play([robot], script, whole(1, script, self._chosen))
        self._floor = self._measure_floor(sensors, rng)
        self._slopes = self._measure_slopes()

    def scales(self, joint: int) -> Scales:
        """Returns what a joint does without any effect."""
        torque, speed = np.abs(self._plain.held[..., joint]), np.abs(self._plain.v[..., joint])
        return Scales(
            torque_nm=float(np.sqrt((torque**2).mean())),
            peak_nm=float(torque.max()),
            speed_rad_s=float(np.sqrt((speed**2).mean())),
            peak_rad_s=float(speed.max()),
        )

    @property
    def floor_rad(self) -> np.ndarray:
        """[joints] rad"""
        return self._floor

    def play(self, robots: Sequence[Robot], hidden=()) -> Trace:
        """Plays the measured runs on each of some robots, lanes ordered by robot."""
        return self._generator.play(robots, self._script, whole(len(robots), self._script, self._chosen), hidden)

    @property
    def lanes_a_robot(self) -> int:
        """Number of runs that are measured."""
        return len(self._chosen)

    def severities(self, trace: Trace) -> np.ndarray:
        """Returns the severity of each robot of a trace of `play`; infinite where a simulation diverged."""
        difference = self._difference(trace, trace, self._script)
        count = len(difference) // self._starts.size
        found = np.empty(count)
        for number, one in enumerate(np.split(difference, count)):
            # A robot that throws itself about is more severe than any that is wanted.
            if not np.isfinite(one).all() or np.abs(one).max() > 2.0:
                found[number] = np.inf
                continue
            left = self._without_parameters(one) / self._floor
            found[number] = np.sqrt((left**2).mean(axis=(0, 1))).max()
        return found

    def _without_parameters(self, difference: np.ndarray) -> np.ndarray:
        """Takes away what nominal parameters can imitate; each segment and joint counts as one measurement."""
        slopes = self._slopes / self._floor
        weight = 1.0 / np.sqrt(difference.shape[1])
        matrix = weight * slopes.reshape(len(slopes), -1).T
        normal = matrix.T @ matrix + np.eye(len(slopes))
        off = np.linalg.solve(normal, matrix.T @ (weight * (difference / self._floor).ravel()))
        return difference - np.tensordot(np.clip(off, -_MOST, _MOST), self._slopes, axes=1)

    def _difference(self, measured: Trace, starts: Trace, script: Script) -> np.ndarray:
        """Returns what was read less what segments without the effect show, [segments, bins, joints] rad."""
        lanes = self._segments(starts)
        simulated = self._generator.play([self._robot], script, lanes)
        lane = np.repeat(np.arange(len(measured.q)), _STARTS)
        row = lanes.row[:, None] + np.arange(self._long)
        return self._binned(measured.q[lane[:, None], row] - simulated.q)

    def _segments(self, trace: Trace) -> Lanes:
        lane = np.repeat(np.arange(len(trace.q)), _STARTS)
        row = np.tile(self._starts.ravel(), len(trace.q) // len(self._chosen))
        return Lanes(
            robot=np.zeros(len(lane), int),
            run=np.tile(self._chosen, len(trace.q) // len(self._chosen))[lane],
            row=row,
            rows=self._long,
            q=trace.q[lane, row],
            v=trace.v[lane, row],
            held=trace.held[lane, row],
            bristle=trace.bristle[lane, row],
        )

    def _binned(self, values: np.ndarray) -> np.ndarray:
        together = max(1, round(_BIN_S / self.row_s))
        rows = values[:, 1 : 1 + (self._long - 1) // together * together]
        return rows.reshape(len(rows), -1, together, rows.shape[2]).mean(axis=2)

    def _measure_floor(self, sensors: Sensors, rng: np.random.Generator) -> np.ndarray:
        trace = self._plain
        q = sensors.positions(trace.q, rng)
        smooth_q, smooth_v = sensors.smoothed(q, trace.v, self.row_s, rng)
        other = replace(self._script, ticks=self._script.other_ticks)
        difference = self._difference(replace(trace, q=q), replace(trace, q=smooth_q, v=smooth_v), other)
        return np.sqrt((difference**2).mean(axis=(0, 1)))

    def _measure_slopes(self) -> np.ndarray:
        """Returns what a prior deviation of each parameter moves, [parameters, segments, bins, joints] rad."""
        robot, lanes = self._robot, self._segments(self._plain)
        robots = [robot]
        for field, deviation in _PRIOR.items():
            for joint in range(len(robot.joints)):
                off = robot.with_at(field, joint, getattr(robot, field)[joint] * np.exp(deviation))
                if field == "mass":
                    off = off.with_at("inertia", joint, robot.inertia[joint] * np.exp(deviation))
                robots.append(off)
        for joint, centre in enumerate(robot.com):
            robots += [robot.with_at("com", joint, centre + shift) for shift in _LOOSE_M * np.eye(3)]
        count = len(lanes.run)
        fields = {
            name: np.tile(value, (len(robots),) + (1,) * (np.ndim(value) - 1))
            for name, value in vars(lanes).items()
            if name != "rows"
        }
        fields["robot"] = np.repeat(np.arange(len(robots)), count)
        trace = self._generator.play(robots, self._script, Lanes(rows=lanes.rows, **fields))
        binned = self._binned(trace.q).reshape(len(robots), count, -1, trace.q.shape[2])
        return binned[1:] - binned[:1]


def search(
    severities: Callable[[np.ndarray], np.ndarray], low: float, high: float, wanted: float
) -> tuple[float, float]:
    """Searches the size that has a severity.

    Args:
      severities: takes several sizes [sizes], and returns the severity of each.
      low: the harmless size.
      high: the extreme size.
      wanted: severity.

    Returns:
      The size and its severity, which differs from the wanted one where no size between the bounds has it.
    """
    for _ in range(2):
        sizes = np.exp(np.linspace(np.log(low), np.log(high), 6))
        found = np.clip(severities(sizes), 1e-3, _MOST_SEVERE)
        above = np.flatnonzero(found >= wanted)
        close = int(np.abs(np.log(found / wanted)).argmin())
        if not len(above) or above[0] == 0:
            break
        low, high = sizes[above[0] - 1], sizes[above[0]]
    return float(sizes[close]), float(found[close])
