"""Finds signals that stay where they are, or jump by a turn, while the rest of the log says that the joint moved on.

These are columns that were never written, encoders that froze, joints whose motor is off or that are jammed, and angles
that were wrapped. Rows in which all signals repeat the row before are found elsewhere (`envs.diagnosis.repeats`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from envs.diagnosis.finding import Finding
from envs.logs import Run
from envs.readings import quantum_of

_LEAST_S = 0.3  # of a stay
_SHARE, _QUANTA, _LEAST = 0.3, 5.0, 1e-3  # of the joint's motion, quanta, and rad or m, that it moved during a stay
_ROUNDED = 2.0  # quanta of a velocity, by which a joint may creep while it reads the same
_GOES = 0.05  # rad or m of a target's motion that no friction keeps a joint from following
_TURN, _NEARLY, _ROUNDING = 2.0 * np.pi, 0.6, 1e-3  # rad; no joint turns as far between two rows


def stuck(run: Run, joints: Sequence[str]) -> list[Finding]:
    """Finds positions that freeze, velocities and torques that are constant, and joints that follow no target.

    Args:
      run: as it was read.
      joints: names of the joints, in the log's order.

    Returns:
      Findings: `frozen` of positions, `constant` of velocities and torques, `still` of joints.
    """
    position, speed = run.signals["q"], run.signals.get("dq")
    least = np.maximum(_QUANTA * quantum_of(position), _LEAST)
    moves = np.ptp(position, axis=0) > least
    found = []
    for joint, name in enumerate(joints):
        if speed is not None:
            found += _against(run, name, position[:, joint], speed[:, joint], float(least[joint]))
        if moves[joint] and _silent(run, joint):
            text = f"tau: {name} is constant, though the joint moves and its motor is on"
            found.append(Finding("constant", "tau", (name,), 1.0, text))
        goes = float(np.ptp(_wanted(run)[:, joint]))
        if not moves[joint] and goes > _GOES and not any(one.joints == (name,) for one in found):
            text = (
                f"q: {name} stays where it is while its target moves by {goes:.2g}: it is jammed, or its motor is off"
            )
            found.append(Finding("still", "q", (name,), goes, text))
    return found


def _against(run: Run, name: str, position: np.ndarray, speed: np.ndarray, least: float) -> list[Finding]:
    """Compares stays of a joint's position with its velocity, and the other way round; both are [rows]."""
    travelled = np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(run.time)))
    found = []
    for kind, signal, values, says in (("frozen", "q", position, travelled), ("constant", "dq", speed, position)):
        first, last = _stay(values)
        lasts = run.time[last] - run.time[first]
        # A velocity that is not zero explains motion in a line.
        moved = np.ptp((says - travelled if signal == "dq" else says)[first : last + 1])
        creeps = _ROUNDED * float(quantum_of(speed)) * lasts
        if lasts > _LEAST_S and moved > max(_SHARE * np.ptp(says), least, creeps):
            share, other = (last - first + 1) / len(values), "q" if signal == "dq" else "dq"
            text = (
                f"{signal}: {name} is constant in {share:.0%} of the rows, from row {first + 2}, though {other} moves"
            )
            found.append(Finding(kind, signal, (name,), share, text))
    return found


def _stay(values: np.ndarray) -> tuple[int, int]:
    """The first and the last row of the longest piece in which a column [rows] stays exactly the same."""
    edges = np.flatnonzero(np.diff(np.diff(values) == 0, prepend=False, append=False))
    if not len(edges):
        return 0, 0
    longest = int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[2 * longest]), int(edges[2 * longest + 1])


def _silent(run: Run, joint: int) -> bool:
    """Whether a measured torque is constant in all rows, although the controller asks for one that is not."""
    if "tau" not in run.signals or np.ptp(run.signals["tau"][:, joint]):
        return False
    if run.controller.kind == "unknown":
        # A joint without a motor has no torque; a robot without any was not recorded.
        return not np.ptp(run.signals["tau"], axis=0).any()
    return "target" in run.signals and run.controller.kind == "pd" and bool(np.ptp(_asked(run)[:, joint]))


def _asked(run: Run) -> np.ndarray:
    """The controller's spring, [rows, joints] Nm; a joint without a gain and motors that are off have none."""
    law = run.impedance()
    return np.clip(law.stiffness * (run.signals["target"] - run.signals["q"]), -law.limit, law.limit)


def _wanted(run: Run) -> np.ndarray:
    """Targets that joints should follow, [rows, joints]; constant where there is none, or motors are off."""
    if "target" not in run.signals or run.controller.kind == "unknown":
        return np.zeros_like(run.signals["q"])
    gain = run.controller.gains["kp" if run.controller.kind == "pd" else "gain"]
    on = run.signals.get("enabled", np.ones(len(run.time)))[:, None] > 0
    return np.where(on & (gain > 0), run.signals["target"], run.signals["target"][:1])


def wrapped(run: Run, joints: Sequence[str], turns: np.ndarray) -> tuple[list[Finding], Run]:
    """Finds angles that jump by a turn from one row to the next, as where they are kept between -pi and pi.

    Args:
      run: as it was read.
      joints: names of the joints, in the log's order.
      turns: [joints] True for a hinge, False for a slide.

    Returns:
      The findings, and the run with these angles unwrapped, targets as near to the positions as turns allow.
    """
    position = _unwrapped(run.signals["q"], turns)
    signals = {**run.signals, "q": position}
    if "target" in signals:
        target = _unwrapped(signals["target"], turns)
        target -= _TURN * turns * np.round(np.median(target - position, axis=0) / _TURN)
        # A target may step as far, but not away from the joint.
        apart = [np.abs(one - position).mean(axis=0) for one in (target, signals["target"])]
        signals["target"] = np.where(apart[0] < 0.5 * apart[1], target, signals["target"])
    found = []
    for name in ("q", "target"):
        jumps = np.zeros(len(joints), int)
        if name in signals:
            jumps = (np.abs(np.diff(signals[name] - run.signals[name], axis=0)) > 1.0).sum(axis=0)
        if jumps.any():
            names = tuple(joint for joint, one in zip(joints, jumps, strict=True) if one)
            text = f"{name}: the angle of {' and '.join(names)} jumps by a turn between rows, {jumps.sum()} times"
            found.append(Finding("wrapped", name, names, float(jumps.sum()), f"{text}; unwrap it"))
    return found, replace(run, signals=signals) if found else run


def _unwrapped(values: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Unwraps hinges [rows, joints] that stay within a turn and jump by nearly as much between rows."""
    jumps = (np.abs(np.diff(values, axis=0)) > _TURN - _NEARLY).any(axis=0)
    return np.where(turns & jumps & (np.ptp(values, axis=0) < _TURN + _ROUNDING), np.unwrap(values, axis=0), values)
