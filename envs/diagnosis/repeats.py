"""Finds rows that repeat the row before although the robot must have moved; a robot that stands still repeats itself.

A stay is a piece of consecutive rows in which every measured value is that of the row before the piece. It counts as
repeated where one of these says so:

- other rows: a joint moves on in the same direction before and after the stay;
- speed: the readings, though constant, include a velocity that would have moved the joint far;
- noise: in the rows around the stay readings of two joints change from row to row and back, as they do at rest too.

Targets that go far say nothing: a weak servo sticks for seconds while its target moves on.
"""

import numpy as np

from envs.diagnosis.finding import MEASURED
from envs.logs import Run
from envs.readings import noise_of, quantum_of

_SUDDEN_S = 0.008  # in which no robot stops, and starts again as fast
_NEAR = 25  # rows before and after a stay, from which noise is estimated
_LEAST_QUANTA = 3.0  # of motion before and after a stay, for its speed to be known
_MISSED_QUANTA = 1.75  # of motion that must have been seen during the stay
_MISSED_SD, _FINE = 4.5, 0.25  # of noise, which may undo as much between two readings; a fine quantum, as its share
_CHANCE = 0.3  # stays that noise may bring about in a run, at most
_FAR = (0.3, 5.0, 2e-3)  # of the joint's own range of motion, quanta, and rad or m
_FAST_QUANTA = 2.0  # below which a speed may be of rounding alone


def repeated(run: Run) -> np.ndarray:
    """Marks rows, without the first [rows - 1], that repeat the row before although the robot must have moved."""
    measured = [run.signals[name] for name in (*MEASURED, "gyro", "acc", "vel") if name in run.signals]
    values = np.concatenate([one.reshape(len(run.time), -1) for one in measured], axis=1)
    same = (np.diff(values, axis=0) == 0).all(axis=1)
    joints = run.signals["q"].shape[1]
    edges = np.flatnonzero(np.diff(same, prepend=False, append=False))
    quanta = quantum_of(values)
    # Rows from first to last are equal, both included.
    stays = list(zip(edges[::2], edges[1::2], strict=True))
    # Readings of one joint are not independent.
    parts = np.concatenate([np.arange(one[0].size) + 1000 * (one.shape[1:] != (joints,)) for one in measured])
    chance = np.array([_chance(values, first, last, quanta, parts) for first, last in stays])
    expected = len(same) * chance
    # Beyond chance by itself, or as one of many more than noise brings about.
    noisy = (chance < 1) & ((expected < _CHANCE) | ((chance < 1).sum() > 3.0 * expected + 1.0))
    share, steps, least = _FAR
    far = np.maximum(np.maximum(share * np.ptp(run.signals["q"], axis=0), steps * quanta[:joints]), least)
    speeds = np.zeros((len(values), joints))
    if "dq" in run.signals:
        rounding = quanta[joints : 2 * joints]  # `MEASURED` begins with positions and velocities
        speeds = np.where((fast := np.abs(run.signals["dq"])) > _FAST_QUANTA * rounding, fast, 0.0)
    # Noise of positions holds that of rounding. Where that is much finer, no two readings are equal by chance.
    sd = np.sqrt(np.maximum(noise_of(run, "q") ** 2 - quanta[:joints] ** 2 / 12.0, 0.0))
    hidden = np.where(quanta[:joints] > _FINE * sd, _MISSED_SD * sd, 0.0)
    seen = _MISSED_QUANTA * quanta[:joints] + hidden
    for (first, last), beyond in zip(stays, noisy, strict=True):
        driven = (speeds[first] * (run.time[last] - run.time[first]) > far).any()
        if not (beyond or driven or _passes(run, first, last, quanta[:joints], seen)):
            same[first:last] = False
    return same


def _passes(run: Run, first: int, last: int, quanta: np.ndarray, seen: np.ndarray) -> bool:
    """Whether a joint moves in the same direction up to a stay and from its end on, without slowing down for it.

    So it must have moved by more than `seen` [joints] in between, which neither rounding nor noise hides.
    """
    position = run.signals["q"]
    width = max(1, round(_SUDDEN_S / float(np.median(np.diff(run.time)))))
    if first < 2 * width or last + 2 * width >= len(position):
        return False
    far, near = np.diff(position[[first - 2 * width, first - width, first]], axis=0)
    leaving, gone = np.diff(position[[last, last + width, last + 2 * width]], axis=0)
    # Of a constant deceleration to rest, the last piece is a third of the one before.
    sudden = (near * far > 0.6 * far**2) & (leaving * gone > 0.6 * gone**2) & (near * leaving > 0)
    pace = np.minimum(np.abs(near), np.abs(leaving))
    missed = pace * (last - first) / width
    return bool((sudden & (pace > _LEAST_QUANTA * quanta) & (missed > seen)).any())


def _chance(values: np.ndarray, first: int, last: int, quanta: np.ndarray, parts: np.ndarray) -> float:
    """Computes how probable a stay is by chance if readings of two joints scatter in all rows around it; else one."""
    sides = [values[max(0, first - _NEAR) : first + 1], values[last : last + 1 + _NEAR]]
    rows = [side[np.append(True, (np.diff(side, axis=0) != 0).any(axis=1))] for side in sides]
    # Of neighbours that stand still as well, too few rows differ.
    if any(len(side) < max(_NEAR // 2, 0.4 * count) for side, count in zip(rows, map(len, sides), strict=True)):
        return 1.0
    third = [np.diff(side, n=3, axis=0) for side in rows]
    sd = np.min([1.4826 * np.median(np.abs(each), axis=0) / np.sqrt(20.0) for each in third], axis=0)
    # Of white noise three in four third differences have the other sign than the one before; of motion hardly any.
    turns = np.min([(np.sign(each[1:]) * np.sign(each[:-1]) < 0).mean(axis=0) for each in third], axis=0)
    # Rounding and a change to and fro between neighbouring values have half a quantum.
    noise = (turns > 0.5) & (sd > np.maximum(0.8 * quanta, 1e-9))
    # Two readings of noise are equal with this probability.
    same = np.maximum(quanta[noise] / (sd[noise] * np.sqrt(4 * np.pi)), 0.25 / _NEAR)
    return float(np.prod(same) ** (last - first)) if len(set(parts[noise])) >= 2 else 1.0


def slope(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Computes the least-squares slope of values [rows, ...] over time [rows]."""
    time = time - time.mean()
    return time @ (values - values.mean(axis=0)) / max(time @ time, 1e-12)
