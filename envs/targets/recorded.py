"""Episodes from measured logs: what a policy saw and did, at its own ticks, as the simulator would have told it.

A run is cut where the robot falls and where its rows have a hole. Motors that are switched off under a walking policy
are a fall: that is how most robots fall. So is a trunk that sinks; where nobody measured how high it is, its legs say
it. Of every piece the first tick is left out, because nobody knows what was done before it, and so is the last one of a
piece that does not end in a fall, because nobody knows what came of it.
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
_SAME_RATE = 0.02  # rows and ticks are one where their periods differ by a smaller share
_FASTER = 1.5  # times as fast as ticks are rows between which ticks can be found
_SILENCE = 10.5  # periods of the policy
_HOLE = 1.5  # periods of the policy
_UP_S = 0.5  # after a fall, for which it must stand to have got up
_STEADY = 0.95  # share of ticks that are equally many rows apart, where rows and ticks keep step


@chex.dataclass(frozen=True)
class Recorded:
    """Measured episodes, and what a simulation needs to repeat them."""

    trajectory: Trajectory
    commands: Commands  # from the run's first step on, a few before the trajectory's
    power: jax.Array  # [episodes, time] W, mechanical, braking not regained
    run: jax.Array  # [episodes] of the log, from 0; in order, and every run has one episode or more
    begin: jax.Array  # [episodes] policy steps between the first one of the run and that of the episode


def episodes(log: Log, steps: int) -> Recorded:
    """Turns a log of a walking BITeno into episodes of `steps` policy steps.

    A longer piece of a run becomes several episodes; a shorter one is filled up with steps that are not alive.

    Args:
      log: of one or more runs.
      steps: length of an episode.

    Raises:
      ValueError: the log is of another robot or policy, or of one that hangs, or lacks a signal; or a run has no two
        ticks in a row with the robot on its feet.
    """
    if log.robot != "biteno" or set(log.joints) != set(constants.JOINTS):
        raise ValueError(f"robot: got '{log.robot}' with {', '.join(log.joints)}, expected biteno with all its joints")
    if log.base != "free":
        raise ValueError(f"base: got {log.base}, expected free, of a robot that walks")
    rate = (log.policy or {}).get("rate_hz", 1.0 / constants.POLICY_DT_S)
    if abs(rate * constants.POLICY_DT_S - 1.0) > 1e-6:
        raise ValueError(f"policy.rate_hz: got {rate:g}, expected {1.0 / constants.POLICY_DT_S:g}")
    order = [log.joints.index(joint) for joint in constants.JOINTS]
    found, leads = [], []
    for index, run in enumerate(log.runs):
        ticks = _at_ticks(run, order)
        pieces = _pieces(ticks)
        if not pieces:
            raise ValueError(f"{run.name}: got no two ticks in a row on its feet, expected a robot that walks")
        begins = np.round((ticks["time"] - ticks["time"][pieces[0][0][0]]) / constants.POLICY_DT_S).astype(int)
        for rows, fell in pieces:
            found += [one | {"run": index} for one in _chunks(_steps(ticks, rows, fell), steps, begins[rows[0]])]
        # A first action that does not change is not heard.
        unheard = 0.5 < (ticks["time"][0] - run.time[0]) / constants.POLICY_DT_S < 1.5
        leads.append(2 if unheard else 1)
    return _as_simulated(jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *found), max(leads))


def beginning(recorded: Recorded, steps: int) -> Recorded:
    """The first `steps` of every run's first episode."""
    first = np.unique(np.asarray(recorded.run), return_index=True)[1]
    one = jax.tree.map(lambda leaf: leaf[first], recorded)
    trajectory, commands = one.trajectory, one.commands
    lead = commands.command.shape[1] - trajectory.alive.shape[1]
    # Who still stands when the cut comes has not fallen before it.
    fell = trajectory.fell & ~trajectory.alive[:, steps:].any(axis=1)
    cut = {name: trajectory[name][:, :steps] for name in ("obs", "action", "alive", "score")}
    return one.replace(
        trajectory=trajectory.replace(fell=fell, **cut),
        commands=commands.replace(command=commands.command[:, : lead + steps]),
        power=one.power[:, :steps],
    )


def whole(recorded: Recorded, steps: int) -> tuple[Trajectory, np.ndarray]:
    """The first `steps` of every run as one episode, and its power: for what came of a walk, not for windows.

    Not alive is it where nothing is known, also in between, and from its first fall on.

    Returns:
      Of shapes [runs, steps, ...] and [runs, steps] W.
    """
    run, begin, trajectory = np.asarray(recorded.run), np.asarray(recorded.begin), recorded.trajectory
    alive = np.asarray(trajectory.alive)
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
    """Signals [ticks, ...] by name when the policy looked, joints in the model's order, and `time` and `up`."""
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
    rows, aligned = _ticks(run.name, run.time, signals["action"])
    # Who has fallen may be asked for no more actions.
    rows = np.union1d(rows, 1 + np.flatnonzero(down[1:] & ~down[:-1]))
    if aligned:
        seen = {name: values[rows] for name, values in signals.items()} | {"time": run.time[rows]}
    else:
        # The policy looked some time after the row before.
        at = 0.5 * (run.time[rows] + run.time[np.maximum(rows - 1, 0)])
        seen = {name: values[rows] for name, values in signals.items() if name in HELD} | {"time": at}
        for name in signals.keys() - set(HELD):
            seen[name] = sampled(run.time, signals[name], at, constants.POLICY_DT_S)
    if "tau" not in seen:
        seen["tau"] = _wanted_torque(run, seen, order)
    return seen | {"up": ~down[rows]}


def _ticks(name: str, time: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, bool]:
    """Rows in which the policy spoke, and whether they are when it looked."""
    period, width = constants.POLICY_DT_S, float(np.median(np.diff(time)))
    changes = 1 + np.flatnonzero((np.diff(action, axis=0) != 0).any(axis=1))
    if abs(width / period - 1.0) < _SAME_RATE:
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
        raise ValueError(f"{name}: 'action' changes {every}, expected every {period:g} s")
    # A policy that says the same twice is not heard the second time; one that is silent for long has stopped.
    unheard = [
        np.searchsorted(time, time[row] + np.arange(1, round(gap / period)) * period - 0.5 * width)
        for row, gap in zip(rows, apart, strict=False)
        if gap < _SILENCE * period
    ]
    rows = np.unique(np.concatenate([rows, *unheard]))
    steady = np.diff(rows) == round(period / width)
    return rows, bool(steady.mean() >= _STEADY)


def _wanted_torque(run: Run, seen: dict[str, np.ndarray], order: list[int]) -> np.ndarray:
    """What the joints' controller has asked for, [ticks, joints] Nm, where nobody measured what came of it."""
    if run.controller.kind != "pd":
        raise ValueError(f"{run.name}: there is no 'tau', expected it beside a controller of type servo")
    # Until now the target was that of the tick before.
    target = np.concatenate([seen["target"][:1], seen["target"][:-1]])
    return run.controller.impedance()[order].torque(target, seen["q"], seen["dq"])


def _pieces(ticks: dict[str, np.ndarray]) -> list[tuple[np.ndarray, bool]]:
    """Ticks [ticks] that follow on each other with the robot on its feet, and whether it fell after them."""
    up = ticks["up"]
    hole = np.append(False, np.diff(ticks["time"]) > _HOLE * constants.POLICY_DT_S)
    found, down = [], False
    for rows in np.split(np.arange(len(up)), np.flatnonzero(hole | np.append(False, up[1:] != up[:-1]))):
        stands = up[rows[0]] and len(rows) >= (round(_UP_S / constants.POLICY_DT_S) if down else 3)
        if stands:
            after = rows[-1] + 1
            # Where nobody saw it fall it is enough to see it lie.
            found.append((rows, bool(after < len(up) and not up[after])))
        down = not up[rows[0]] or (down and not stands)
    return found


def _steps(ticks: dict[str, np.ndarray], rows: np.ndarray, fell: bool) -> dict:
    """What was before, at and after every step [steps] of a piece, by name."""
    last = None if fell else -1
    places = {"before": rows[:-1][:last], "now": rows[1:][:last], "after": rows[1:][:last] + 1}
    moments = {
        moment: {name: ticks[name][at].astype(np.float32) for name in (*_NEEDED, "tau")}
        for moment, at in places.items()
    }
    ends = np.zeros(len(places["now"]), bool)
    ends[-1:] = fell
    return moments | {"alive": np.ones(len(ends), bool), "fell": ends}


def _chunks(steps: dict, length: int, begin: int) -> list[dict]:
    """Episodes of a length, of a piece that begins so many steps after its run."""
    count = len(steps["alive"])

    def cut(start: int) -> dict:
        fill = max(0, start + length - count)
        filled = lambda leaf: np.pad(leaf[start : start + length], [(0, fill)] + [(0, 0)] * (leaf.ndim - 1))  # noqa: E731
        return jax.tree.map(filled, steps) | {"begin": begin + start}

    return [cut(start) for start in range(0, count, length)]


@partial(jax.jit, static_argnums=1)
def _as_simulated(steps: dict, lead: int) -> Recorded:
    """What the simulator would have told of steps [episodes, time] before which the robot has walked a few."""
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
    # Who repeats an episode may stay up for longer.
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
