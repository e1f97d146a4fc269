"""Plays target runs on robots of the field benchmark: controller, motors, friction and sensors around a plant.

All lanes (motions of one of the robots) are simulated together, because Python is slow and its arrays are not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.discovery.field.forms import Form, Now, Setting
from experiments.discovery.field.links import Kinematics
from experiments.discovery.field.robots import Robot
from experiments.discovery.target_runs import TargetRun

LEAD_S = 0.4
"""Time before the first row in which the robot settles at the first target."""

_MOST_NM, _MOST_RAD_S = 1e5, 300.0  # beyond which a simulation has diverged
_CARRIED = 0.9  # share of a joint's armature that is behind its gears, where they have play or a spring


@dataclass(frozen=True, kw_only=True)
class Hidden:
    """An effect at some columns, with a size for every lane."""

    form: Form
    columns: tuple[int, ...]
    size: np.ndarray
    """[lanes]"""


@dataclass(frozen=True, kw_only=True)
class Script:
    """The runs of a case in the steps of a plant."""

    target: np.ndarray
    """[runs, rows, joints] rad"""
    enabled: np.ndarray
    """[runs, rows]"""
    gain: np.ndarray
    """[runs] factor on kp and kd."""
    ticks: np.ndarray
    """[runs, steps] where the controller reads anew; the first steps are those of `LEAD_S`."""
    other_ticks: np.ndarray
    """The same with another jitter, as one who does not know it would simulate it."""
    steps_a_row: int
    period: float
    """Of the controller in s."""
    linear: bool
    """Whether targets move linearly between rows; otherwise they are held."""


def script(
    motions: Sequence[TargetRun], dt: float, control_hz: float, linear: bool, rng: np.random.Generator
) -> Script:
    """Turns target runs into steps, and draws when the controller ticks.

    Ticks have a phase of their own in every case, and a jitter.

    Args:
      motions: the runs, on an even row grid.
      dt: step of the plant in s.
      control_hz: rate of the controller.
      linear: whether targets move between rows.
      rng: random numbers.
    """
    row_s = float(motions[0].time[1] - motions[0].time[0])
    steps_a_row, period = round(row_s / dt), 1.0 / control_hz
    steps = len(motions[0].time) * steps_a_row + round(LEAD_S / dt)
    phase = rng.uniform(0, 0.4)

    def ticks() -> np.ndarray:
        found, count = np.zeros((len(motions), steps), bool), int(steps * dt / period)
        for run in found:
            times = (np.arange(count) + phase + rng.uniform(0, 0.25, count)) * period
            run[np.minimum((times / dt).astype(int), steps - 1)] = True
        return found

    return Script(
        target=np.stack([motion.target for motion in motions]),
        enabled=np.stack([motion.enabled for motion in motions]),
        gain=np.array([motion.gain for motion in motions]),
        ticks=ticks(),
        other_ticks=ticks(),
        steps_a_row=steps_a_row,
        period=period,
        linear=linear,
    )


@dataclass(frozen=True, kw_only=True)
class Lanes:
    """What is simulated together: in each lane one robot plays a part of one run."""

    robot: np.ndarray
    """[lanes] index of the robot."""
    run: np.ndarray
    """[lanes] index of the run."""
    row: np.ndarray
    """[lanes] first row; -1 plays a run from its start, after settling."""
    rows: int
    """Number of rows that are played."""
    q: np.ndarray
    """[lanes, joints] rad at the first row."""
    v: np.ndarray
    held: np.ndarray
    """[lanes, joints] Nm, torque that the controller held."""
    bristle: np.ndarray
    """[lanes, joints] memory of dry friction."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """What was read at rows, [lanes, rows, joints] each."""

    q: np.ndarray
    v: np.ndarray
    held: np.ndarray
    bristle: np.ndarray


def whole(robots: int, script: Script, runs: Sequence[int]) -> Lanes:
    """Returns lanes in which each robot plays each of some runs from its start."""
    run = np.tile(np.asarray(runs), robots)
    start = script.target[run, 0]
    none = np.zeros_like(start)
    return Lanes(
        robot=np.repeat(np.arange(robots), len(runs)),
        run=run,
        row=np.full(len(run), -1),
        rows=script.target.shape[1],
        q=start,
        v=none,
        held=none,
        bristle=none,
    )


def play(plant_type, friction_type, robots: Sequence[Robot], script: Script, lanes: Lanes, hidden=()) -> Trace:
    """Simulates all lanes.

    Args:
      plant_type: one of `plants.PLANTS`.
      friction_type: the generator's dry friction; made with levels [lanes, joints] Nm and dt, called with speeds.
      robots: that occur; joints beyond those of the targets hang loose.
      script: the runs.
      lanes: who plays what.
      hidden: effects (`Hidden`), none of the stage `numbers`.

    Returns:
      Readings without noise.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        return _Play(plant_type, friction_type, robots, script, lanes, hidden).trace()


class _Play:
    """The state of one simulation of many lanes."""

    def __init__(self, plant_type, friction_type, robots, script: Script, lanes: Lanes, hidden: Sequence[Hidden]):
        self._script, self._lanes, self._dt = script, lanes, plant_type.dt
        count = script.target.shape[2]
        gears = [number for one in hidden if one.form.stage == "gear" for number in one.columns]
        behind = np.zeros(count)
        behind[gears] = _CARRIED
        rotor = np.stack([robot.armature[:count] * behind for robot in robots])[lanes.robot]
        robots = [robot.with_at("armature", slice(count), robot.armature[:count] * (1 - behind)) for robot in robots]
        loose = np.zeros((len(lanes.run), len(robots[0].joints) - count))
        self._plant = plant_type(robots, lanes.robot, np.hstack([lanes.q, loose]), np.hstack([lanes.v, loose]))
        gain = script.gain[lanes.run][:, None]

        def of(field: str) -> np.ndarray:
            return np.stack([getattr(robot, field) for robot in robots])[lanes.robot]

        self._kp, self._kd = of("kp")[:, :count] * gain, of("kd")[:, :count] * gain
        self._limit, self._damping = of("limit")[:, :count], of("damping")
        self._friction = friction_type(of("friction")[:, :count], self._dt, lanes.bristle)
        self._stages: dict[str, list] = {}
        for one in hidden:
            at = list(one.columns)
            setting = Setting(
                dt=self._dt,
                period=script.period,
                size=one.size[:, None],
                kp=self._kp[:, at],
                kd=self._kd[:, at],
                limit=self._limit[:, at],
                rotor=rotor[:, at],
                quick=np.full((1, len(at)), 1.5),
                strong=0.15 * self._limit[:, at],
            )
            links = (Kinematics(robots[0]), at) if one.form.stage == "links" else ()
            self._stages.setdefault(one.form.stage, []).append((at, one.form.make(setting, *links)))
        self._held = lanes.held.copy()
        self._lost = np.zeros(len(lanes.run), bool)

    def _through(self, stage: str, signal: np.ndarray, now: Now) -> np.ndarray:
        """Sends a signal [lanes, joints] through the effects of a stage."""
        for at, act in self._stages.get(stage, ()):
            signal = signal.copy()
            signal[:, at] = act(signal[:, at], _columns(now, at))
        return signal

    def trace(self) -> Trace:
        """Plays all steps, and returns what was read at rows."""
        script, lanes = self._script, self._lanes
        each, lead = script.steps_a_row, round(LEAD_S / self._dt)
        settling = lead if (lanes.row < 0).all() else 0
        first = np.where(lanes.row < 0, 0, lanes.row)
        kept: dict[str, list] = {"q": [], "v": [], "held": [], "bristle": []}
        last = script.target.shape[1] - 1
        steps_all = lead + (last + 1) * each
        count = script.target.shape[2]
        for step in range(-settling, (lanes.rows - 1) * each + 1):
            at_row = step % each == 0
            row = np.minimum(np.maximum(first + step // each, 0), last)
            if at_row or script.linear:
                target = self._targets(row, step, last)
            if at_row:
                on = script.enabled[lanes.run, row][:, None]
            tick = script.ticks[lanes.run, np.minimum(lead + first * each + step, steps_all - 1)][:, None]
            share = (np.maximum(first * each + step, 0) / steps_all)[:, None]
            q, v, torque = self._step(target, on, tick, share, count)
            if at_row and step >= 0:
                for name, value in (("q", q), ("v", v), ("held", torque), ("bristle", self._friction.bristle)):
                    kept[name].append(value.copy())
        stacked = {name: np.stack(values, axis=1) for name, values in kept.items()}
        for values in stacked.values():
            values[self._lost] = np.nan
        return Trace(**stacked)

    def _targets(self, row: np.ndarray, step: int, last: int) -> np.ndarray:
        script, run = self._script, self._lanes.run
        here = script.target[run, row]
        if not script.linear or step < 0:
            return here
        share = (step % script.steps_a_row) / script.steps_a_row
        return here + share * (script.target[run, np.minimum(row + 1, last)] - here)

    def _step(self, target, on, tick, share, count) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Moves all lanes by a step; returns what was read before it, and the torque that the controller holds."""
        plant = self._plant
        joint_q, joint_v = plant.q[:, :count].copy(), plant.v[:, :count].copy()
        now = Now(share=share, q=joint_q, v=joint_v, torque=self._held)
        q, v = joint_q, joint_v
        for at, gear in self._stages.get("gear", ()):
            q, v = q.copy(), v.copy()
            q[:, at], v[:, at] = gear.motor(joint_q[:, at], joint_v[:, at])
        if "sensor" in self._stages:
            read = np.stack([q, v])
            for at, act in self._stages["sensor"]:
                read[..., at] = act(read[..., at], _columns(now, at))
            q, v = read
        asked = self._through("command", target, now)
        if tick.any() or "error" in self._stages:
            error = self._through("error", asked - q, now)
            law = np.clip(self._kp * error - self._kd * v, -self._limit, self._limit)
            self._held = np.where(tick, on * law, self._held)
        held = self._held
        now.torque = motor = self._through("torque", held, now)
        total = motor
        for at, gear in self._stages.get("gear", ()):
            total = total.copy()
            total[:, at] = gear(motor[:, at], joint_q[:, at], joint_v[:, at])
        total = self._through("outside", total, now) - self._friction(joint_v)
        for _, act in self._stages.get("links", ()):
            total = total + act(plant.q, plant.v)[:, :count]
        every = -self._damping * plant.v
        every[:, :count] += total
        # A lane that diverges goes on without torques, and is reported as not finite.
        self._lost |= ~(np.abs(every) < _MOST_NM).all(axis=1) | ~(np.abs(plant.v) < _MOST_RAD_S).all(axis=1)
        every[self._lost] = 0.0
        plant.step(every)
        return q, v, held


def _columns(now: Now, at: list[int]) -> Now:
    return Now(share=now.share, q=now.q[:, at], v=now.v[:, at], torque=now.torque[:, at])


def with_numbers(robot: Robot, form: Form, places: Sequence[int], size: float) -> Robot:
    """Returns the robot with an effect of the stage `numbers` at some joints or bodies."""
    for place in places:
        robot = form.make(robot, place, size)
    return robot
