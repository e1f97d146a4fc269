"""Makes episodes from measured logs: what a policy observed and did in each of its steps, in the simulator's form.

A *tick* is a step of the policy as it shows in a log; a *piece* is a part of a run without falls and holes. A run is
cut where the robot falls and where its rows have a hole. Motors that are switched off under a walking policy count as a
fall, because most robots are switched off when they fall. So does a trunk that sinks; if its height was not measured,
it is estimated from the legs. The first tick of every piece is left out, because the action before it is unknown. So is
the last tick of a piece that does not end in a fall, because its outcome is unknown.
"""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np

from envs import sensing
from envs.biteno import constants, env, gait, rewards
from envs.logs import Log, Run
from envs.logs.format import JOINT_SIGNALS
from envs.logs.sampling import HELD, sampled
from envs.targets.protocol import Commands
from jaxtune.types import Trajectory

_NEEDED = ("q", "dq", "target", "action", "phase", "cmd", "gyro", "gravity", "vel")
_READINGS = {"velocity": "vel", "gyro": "gyro", "gravity": "gravity", "joint": "q", "joint_velocity": "dq"}
_SAME_RATE = 0.02  # a row is a tick where the two periods differ by a smaller share
_FASTER = 1.5  # rows must be faster than ticks by this factor, so that ticks can be found among them
_SILENCE = 10.5  # periods of the policy without a new action, after which it has stopped
HOLE = 1.5  # periods of the policy between two ticks, from which on rows are missing
_UP_S = 0.5  # time for which a robot must be up after a fall to count as standing again
_STEADY = 0.95  # share of ticks that are equally many rows apart where rows and ticks are synchronous


@chex.dataclass(frozen=True)
class Recorded:
    """Measured episodes, and the commands with which a simulation can repeat them.

    Commands begin one or two steps before the trajectory. These ticks are not part of the trajectory (see the module's
    docstring), but a simulation must walk through them to be where the robot was.
    """

    trajectory: Trajectory
    commands: Commands | None  # from the run's first tick on, one or two steps before the trajectory
    power: jax.Array  # [episodes, time] W, mechanical; braking is not regained; nan where it was not recorded
    run: jax.Array  # [episodes] index of the run, increasing; every run has at least one episode
    begin: jax.Array  # [episodes] policy steps from the run's first step to the episode's first


def episodes(log: Log, steps: int) -> Recorded:
    """Turns a log of a walking BITeno into episodes of `steps` policy steps.

    A longer piece of a run becomes several episodes; a shorter one is filled up with steps that are not alive. If the
    log has no measured torques, the torques that the controller commanded take their place.

    Args:
      log: of one or more runs.
      steps: length of an episode in policy steps.

    Returns:
      The episodes, with observations and scores as the simulator would have computed them.

    Raises:
      ValueError: the log is of another robot or policy, its base is fixed, or a signal is missing; or a run has no two
        consecutive ticks with the robot on its feet.
    """
    if log.robot != "biteno" or set(log.joints) != set(constants.JOINTS):
        raise ValueError(f"robot: got '{log.robot}' with {', '.join(log.joints)}, expected biteno with all its joints")
    if log.base != "free":
        raise ValueError(f"base: got {log.base}, expected free: the robot must walk")
    rate = (log.policy or {}).get("rate_hz", 1.0 / constants.POLICY_DT_S)
    if abs(rate * constants.POLICY_DT_S - 1.0) > 1e-6:
        raise ValueError(f"policy.rate_hz: got {rate:g}, expected {1.0 / constants.POLICY_DT_S:g}")
    order = [log.joints.index(joint) for joint in constants.JOINTS]
    found, leads = [], []
    for index, run in enumerate(log.runs):
        ticks = _at_ticks(run, order)
        pieces = _pieces(ticks)
        # A run without a walk is refused, because every run of the result must have an episode.
        if not pieces:
            raise ValueError(f"{run.name}: got no two consecutive ticks with the robot on its feet, expected a walk")
        begins = np.round((ticks["time"] - ticks["time"][pieces[0][0][0]]) / constants.POLICY_DT_S).astype(int)
        for rows, fell in pieces:
            found += [one | {"run": index} for one in cut(_steps(ticks, rows, fell), steps, begins[rows[0]])]
        # Among faster rows ticks are found by changes of the action, so the run's first tick is not among them.
        first_missing = 0.5 < (ticks["time"][0] - run.time[0]) / constants.POLICY_DT_S < 1.5
        leads.append(2 if first_missing else 1)
    return _as_simulated(jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *found), max(leads))


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


def _at_ticks(run: Run, order: list[int]) -> dict[str, np.ndarray]:
    """Samples the signals at the moments at which the policy observed the robot, joints in the model's order.

    Returns:
      Signals [ticks, ...] by name, with `time` in s and `up`, which is True where the robot is on its feet.
    """
    signals = dict(run.signals)
    if "quat" in signals and "gravity" not in signals:
        signals["gravity"] = np.asarray(jax.vmap(sensing.projected_gravity)(signals["quat"]))
    for name in _NEEDED:
        if name not in signals:
            raise ValueError(f"{run.name}: there is no '{name}', expected {', '.join(_NEEDED)}")
    for name in JOINT_SIGNALS:
        if name in signals:
            signals[name] = signals[name][:, order]
    by_legs = lambda: np.asarray(jax.vmap(gait.trunk_height)(signals["gravity"], signals["q"]))  # noqa: E731
    height = signals["pos"][:, 2] if "pos" in signals else by_legs()
    down = np.asarray(env.fallen(signals["gravity"], height)) | (signals.get("enabled", np.ones(len(height))) == 0)
    rows, aligned = find_ticks(run.name, run.time, signals["action"], constants.POLICY_DT_S)
    # After a fall the policy may send no more actions, so the fall itself is made a tick.
    rows = np.union1d(rows, 1 + np.flatnonzero(down[1:] & ~down[:-1]))
    if aligned:
        seen = {name: values[rows] for name, values in signals.items()} | {"time": run.time[rows]}
    else:
        # The action appears in this row for the first time, so the policy observed the robot between the row before and
        # this one.
        at = 0.5 * (run.time[rows] + run.time[np.maximum(rows - 1, 0)])
        seen = {name: values[rows] for name, values in signals.items() if name in HELD} | {"time": at}
        for name in signals.keys() - set(HELD):
            seen[name] = sampled(run.time, signals[name], at, constants.POLICY_DT_S)
    if "tau" not in seen:
        seen["tau"] = _wanted_torque(run, seen, order)
    return seen | {"up": ~down[rows]}


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


def _wanted_torque(run: Run, seen: dict[str, np.ndarray], order: list[int]) -> np.ndarray:
    """Computes the torque that the joints' controller commanded, [ticks, joints] Nm, for logs without measured ones."""
    if run.controller.kind != "pd":
        raise ValueError(f"{run.name}: there is no 'tau', which a controller of type servo needs")
    # At the moment of a tick the target of the tick before is still acting.
    target = np.concatenate([seen["target"][:1], seen["target"][:-1]])
    return run.controller.impedance()[order].torque(target, seen["q"], seen["dq"])


def _pieces(ticks: dict[str, np.ndarray]) -> list[tuple[np.ndarray, bool]]:
    """Finds pieces of consecutive ticks with the robot on its feet, and whether each ends in a fall."""
    up = ticks["up"]
    hole = np.append(False, np.diff(ticks["time"]) > HOLE * constants.POLICY_DT_S)
    found, down = [], False
    # Split at holes, and wherever the robot falls or stands up.
    for rows in np.split(np.arange(len(up)), np.flatnonzero(hole | np.append(False, up[1:] != up[:-1]))):
        # A step needs the ticks before and after it, hence three; after a fall the robot must stay up for a while.
        stands = up[rows[0]] and len(rows) >= (round(_UP_S / constants.POLICY_DT_S) if down else 3)
        if stands:
            after = rows[-1] + 1
            # If the robot fell in a hole of the rows, it lies on the ground in the next row.
            found.append((rows, bool(after < len(up) and not up[after])))
        down = not up[rows[0]] or (down and not stands)
    return found


def _steps(ticks: dict[str, np.ndarray], rows: np.ndarray, fell: bool) -> dict:
    """Takes the signals before, at and after every step [steps] of a piece, by name.

    The observation needs the action before a step, the reward the state after it.
    """
    # A fall is itself a tick, so the last step before it has an outcome; other pieces lose their last tick.
    last = None if fell else -1
    places = {"before": rows[:-1][:last], "now": rows[1:][:last], "after": rows[1:][:last] + 1}
    moments = {
        moment: {name: ticks[name][at].astype(np.float32) for name in (*_NEEDED, "tau")}
        for moment, at in places.items()
    }
    ends = np.zeros(len(places["now"]), bool)
    ends[-1:] = fell
    return moments | {"alive": np.ones(len(ends), bool), "fell": ends}


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


@partial(jax.jit, static_argnums=1)
def _as_simulated(steps: dict, lead: int) -> Recorded:
    """Computes observations, scores and commands as the simulator would, `lead` steps after the commands begin."""
    before, now, after = (steps[moment] for moment in ("before", "now", "after"))
    each = lambda function: jax.vmap(jax.vmap(function))  # noqa: E731
    obs = each(partial(sensing.observe, stand=jnp.asarray(constants.STAND_RAD)))(
        **{name: now[signal] for name, signal in _READINGS.items()},
        command=now["cmd"],
        last_action=before["action"],
        joint_error=before["target"] - now["q"],
        phase=now["phase"],
    )
    values = each(rewards.terms)(
        **{name: after[signal] for name, signal in _READINGS.items()},
        command=now["cmd"],
        last_joint_velocity=now["dq"],
        torque=after["tau"],
        action=now["action"],
        last_action=before["action"],
        joint_reference=each(gait.joint_reference)(now["phase"], now["cmd"]),
    )
    alive, fell = steps["alive"], steps["fell"].any(axis=1)
    # A simulation that repeats an episode may stay up for longer than the robot did. It then keeps the last command.
    held = jnp.clip(jnp.arange(-lead, alive.shape[1]), 0, alive.sum(axis=1, keepdims=True) - 1)
    return Recorded(
        trajectory=Trajectory(
            obs=obs,
            action=now["action"],
            alive=alive,
            score=jnp.where(alive, rewards.weigh(values, constants.TABLE_ONE), 0.0),
            fell=fell,
            not_finite=jnp.zeros_like(fell),
        ),
        commands=Commands(
            command=jnp.take_along_axis(now["cmd"], held[..., None], axis=1),
            phase=gait.advance(now["phase"][:, 0], -lead),
        ),
        power=jnp.where(alive, gait.power(now["tau"], now["dq"]), 0.0),
        run=steps["run"],
        begin=steps["begin"],
    )
