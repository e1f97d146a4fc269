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
HOLE = 1.5  # periods of the policy between two ticks, from which on rows may be missing
_HOLE_OF_TWO = 2.5  # the same from one tick to the second next
_NEAR = 0.25  # periods by which a step of the policy may be longer or shorter
_REGULAR = 0.9  # share of the steps that must be near a multiple of the period
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
    name: str, time: np.ndarray, sent: np.ndarray, period: float, what: str = "'action'", observed: int = 0
) -> tuple[np.ndarray, bool]:
    """Finds the rows in which the policy sent an action, and whether it observed the robot in these very rows.

    If rows come at the policy's rate, every row is a tick. Among faster rows a tick is where the action changes. Where
    several columns change one after the other (an action after its observation), it is the last of these rows.

    Args:
      name: of the run, for messages.
      time: [rows] s.
      sent: [rows, columns] what the policy sends, or what else changes with its ticks alone.
      period: of the policy, in s.
      what: names the columns in messages.
      observed: how many columns, the first ones, are observations that the others answer.

    Raises:
      ValueError: rows are too slow for the policy, or actions change at another rate.
    """
    width = float(np.median(np.diff(time)))
    changed = np.append(np.zeros_like(sent[:1], bool), sent[1:] != sent[:-1], axis=0)
    if abs(width / period - 1.0) < _SAME_RATE:
        # Every row is a tick, unless the action has stayed the same for so long that the policy must have stopped.
        starts = np.append(0, np.flatnonzero(changed.any(axis=1)))
        long = np.diff(np.append(starts, len(time)))
        return np.union1d(starts, np.flatnonzero(np.repeat(long < _SILENCE, long))), True
    if width * _FASTER > period:
        raise ValueError(
            f"{name}: got {1 / width:.6g} rows a second, expected the policy's {1 / period:g}, or {_FASTER / period:g} "
            "or more"
        )
    # An action may come exactly half a period after its observation, which then is as far from the one before.
    margin = np.where(np.arange(sent.shape[1]) < observed, -0.25, 0.25) * width
    starts, rows = _joined(time, changed, 0.5 * period + margin)
    apart = np.diff(time[starts])
    if len(rows) < 2 or abs(np.median(apart) / period - 1.0) > _NEAR:
        every = f"every {np.median(apart):.3g} s" if len(rows) > 1 else f"{len(rows)} time(s)"
        raise ValueError(f"{name}: {what} changes {every}, expected every {period:g} s")
    # Rows round the time of a change up by as much as one row.
    off = np.abs(apart - np.maximum(np.round(apart / period), 1.0) * period) > max(_NEAR * period, 1.01 * width)
    regular = 1.0 - off[apart < _SILENCE * period].mean()
    if regular < _REGULAR:
        raise ValueError(
            f"{name}: {what} changes at multiples of {period:g} s in {regular:.0%} of the steps, expected in "
            f"{_REGULAR:.0%} or more"
        )
    # Two equal actions in a row show no change, so the tick of the second one is filled in. After a long silence
    # nothing is filled in, because the policy has stopped.
    unchanged = [
        np.searchsorted(time, time[row] + np.arange(1, round(gap / period)) * period - 0.5 * width)
        for row, gap, hole in zip(rows, apart, holes(time[starts], period), strict=False)
        if hole and gap < _SILENCE * period
    ]
    rows = np.unique(np.concatenate([rows, *unchanged]))
    # Where ticks are always the same number of rows apart, rows and policy share a clock.
    steady = np.diff(rows) == round(period / width)
    return rows, bool(steady.mean() >= _STEADY)


def _joined(time: np.ndarray, changed: np.ndarray, longest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joins the changes of one tick, whose columns may change one after the other.

    A tick ends where a column changes once more, and at the latest `longest` s after it began. So a policy that is
    twice as fast does not pass for a slow one.

    Args:
      time: [rows] s.
      changed: [rows, columns], True where a value is another than in the row before.
      longest: [columns] from a tick's first change to that of a column, in s.

    Returns:
      The rows of the first change of every tick, and of the last.
    """
    first, last, seen = [], [], None
    for row in np.flatnonzero(changed.any(axis=1)):
        late = first and time[row] - time[first[-1]] > longest[changed[row]].min()
        if not first or late or (seen & changed[row]).any():
            first.append(row)
            last.append(row)
            seen = changed[row]
        else:
            last[-1] = row
            seen = seen | changed[row]
    return np.array(first, int), np.array(last, int)


def holes(time: np.ndarray, period: float) -> np.ndarray:
    """Finds where ticks are missing, [ticks - 1], True where some are between a tick and the next.

    After a tick that is only late the next one is back in step: from the tick before to the one after it, two periods
    pass.

    Args:
      time: [ticks] s.
      period: of the policy, in s.
    """
    steps = np.diff(time) / period
    return (steps > HOLE) & (steps + np.append(steps[1:], 1.0) > _HOLE_OF_TWO)


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
