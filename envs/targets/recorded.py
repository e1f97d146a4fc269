"""Measured episodes, in the simulator's form, and what is done with them whatever robot they are of.

A *tick* is a step of the policy as it shows in a log; a *piece* is a part of a run without falls and holes.
`envs.biteno.walks` makes episodes of BITeno's logs, and `envs.targets.observed` of any robot's whose policy's
observations were recorded.
"""

import chex
import jax
import numpy as np

from envs.targets.protocol import Commands
from jaxtune.types import Trajectory

_SAME_RATE = 0.02  # a row is a tick where the two periods differ by a smaller share
_FASTER = 1.5  # rows must be faster than ticks by this factor, so that ticks can be found among them
_SILENCE = 10.5  # periods of the policy without a new action, after which it has stopped
HOLE = 1.5  # periods of the policy between two ticks, from which on rows are missing
_STEADY = 0.95  # share of ticks that are equally many rows apart where rows and ticks are synchronous


@chex.dataclass(frozen=True)
class Recorded:
    """Measured episodes, and the commands with which a simulation can repeat them.

    Commands begin one or two steps before the trajectory. These ticks are not part of it, because nobody knows what
    came before the first. But a simulation must walk through them to be where the robot was.
    """

    trajectory: Trajectory
    commands: Commands | None  # from the run's first tick on, one or two steps before the trajectory
    power: jax.Array  # [episodes, time] W, mechanical; braking is not regained; nan where it was not recorded
    run: jax.Array  # [episodes] index of the run, increasing; every run has at least one episode
    begin: jax.Array  # [episodes] policy steps from the run's first step to the episode's first


def beginning(recorded: Recorded, steps: int) -> Recorded:
    """Cuts to the first `steps` of every run's first episode.

    Use it to compare a simulation with a log from the start of the walk; later on the two are in different states.

    Returns:
      One episode for every run, [runs, steps, ...], with its commands.
    """
    first = np.unique(np.asarray(recorded.run), return_index=True)[1]
    one = jax.tree.map(lambda leaf: leaf[first], recorded)
    trajectory, commands = one.trajectory, one.commands
    # A fall after the cut does not count: the robot was still up.
    fell = trajectory.fell & ~trajectory.alive[:, steps:].any(axis=1)
    kept = {name: trajectory[name][:, :steps] for name in ("obs", "action", "alive", "score")}
    if commands is not None:
        lead = commands.command.shape[1] - trajectory.alive.shape[1]
        commands = commands.replace(command=commands.command[:, : lead + steps])
    return one.replace(trajectory=trajectory.replace(fell=fell, **kept), commands=commands, power=one.power[:, :steps])


def whole(recorded: Recorded, steps: int) -> tuple[Trajectory, np.ndarray]:
    """Joins the episodes of every run into one, to summarise a walk: its falls, score and power.

    A step is alive if it was recorded and comes before the run's first fall. Steps may be missing between two that are
    alive, so windows for the tuner must not be cut from such episodes.

    Args:
      recorded: as `episodes` makes it.
      steps: length of the joined episodes in policy steps.

    Returns:
      Episodes [runs, steps, ...], and mechanical power [runs, steps] W.
    """
    run, begin, trajectory = np.asarray(recorded.run), np.asarray(recorded.begin), recorded.trajectory
    alive = np.asarray(trajectory.alive)
    # The step of the first fall of every run; runs without one get a step that no walk reaches.
    falls = np.full(run[-1] + 1, np.iinfo(np.int32).max)
    np.minimum.at(falls, run, np.where(trajectory.fell, begin + alive.sum(axis=1), falls[run]))
    place = begin[:, None] + np.arange(alive.shape[1])
    known = alive & (place < np.minimum(falls, steps)[run, None])
    rows = np.broadcast_to(run[:, None], place.shape)[known], place[known]

    def spread(leaf: jax.Array) -> np.ndarray:
        values = np.zeros((len(falls), steps, *leaf.shape[2:]), leaf.dtype)
        values[rows] = np.asarray(leaf)[known]
        return values

    spreads = {name: spread(trajectory[name]) for name in ("obs", "action", "alive", "score")}
    fell = falls <= steps
    return Trajectory(**spreads, fell=fell, not_finite=np.zeros_like(fell)), spread(recorded.power)


def find_ticks(
    name: str, time: np.ndarray, sent: np.ndarray, period: float, what: str = "'action'"
) -> tuple[np.ndarray, bool]:
    """Finds the rows in which the policy sent an action, and whether it observed the robot in these very rows.

    If rows come at the policy's rate, every row is a tick. Among faster rows a tick is where the action changes.

    Args:
      name: of the run, for messages.
      time: [rows] s.
      sent: [rows, columns] what the policy sends, or what else changes with its ticks alone.
      period: of the policy, in s.
      what: names the columns in messages.

    Raises:
      ValueError: rows are too slow for the policy, or actions change at another rate.
    """
    width = float(np.median(np.diff(time)))
    changes = 1 + np.flatnonzero((np.diff(sent, axis=0) != 0).any(axis=1))
    if abs(width / period - 1.0) < _SAME_RATE:
        # Every row is a tick, unless the action has stayed the same for so long that the policy must have stopped.
        starts = np.append(0, changes)
        long = np.diff(np.append(starts, len(time)))
        return np.union1d(starts, np.flatnonzero(np.repeat(long < _SILENCE, long))), True
    if width * _FASTER > period:
        raise ValueError(
            f"{name}: got {1 / width:.6g} rows a second, expected the policy's {1 / period:g}, or {_FASTER / period:g} "
            "or more"
        )
    rows, apart = changes, np.diff(time[changes])
    if len(rows) < 2 or abs(np.median(apart) / period - 1.0) > 0.25:
        every = f"every {np.median(apart):.3g} s" if len(rows) > 1 else f"{len(rows)} time(s)"
        raise ValueError(f"{name}: {what} changes {every}, expected every {period:g} s")
    # Two equal actions in a row show no change, so the tick of the second one is filled in. After a long silence
    # nothing is filled in, because the policy has stopped.
    unchanged = [
        np.searchsorted(time, time[row] + np.arange(1, round(gap / period)) * period - 0.5 * width)
        for row, gap in zip(rows, apart, strict=False)
        if gap < _SILENCE * period
    ]
    rows = np.unique(np.concatenate([rows, *unchanged]))
    # Where ticks are always the same number of rows apart, rows and policy share a clock.
    steady = np.diff(rows) == round(period / width)
    return rows, bool(steady.mean() >= _STEADY)


def cut(steps: dict, length: int, begin: int) -> list[dict]:
    """Divides a piece of a run, whose leaves are [steps, ...], into episodes of a length; the last one is filled up.

    `begin` is the piece's first step in its run; it becomes that of every episode.
    """
    count = len(steps["alive"])

    def episode(start: int) -> dict:
        fill = max(0, start + length - count)
        filled = lambda leaf: np.pad(leaf[start : start + length], [(0, fill)] + [(0, 0)] * (leaf.ndim - 1))  # noqa: E731
        return jax.tree.map(filled, steps) | {"begin": begin + start}

    return [episode(start) for start in range(0, count, length)]
