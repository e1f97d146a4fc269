"""Makes episodes from BITeno's logs: what its policy observed and did in each of its steps, in the simulator's form.

A *tick* is a step of the policy as it shows in a log; a *piece* is a part of a run without falls and holes. A run is
cut where the robot falls and where its rows have a hole. Motors that are switched off under a walking policy count as a
fall, because most robots are switched off when they fall. So does a trunk that sinks; if its height was not measured,
it is estimated from the legs. The first tick of every piece is left out, because the action before it is unknown. So is
the last tick of a piece that does not end in a fall, because its outcome is unknown.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import sensing
from envs.biteno import constants, env, gait, rewards
from envs.biteno.onboard import joint_ranges
from envs.logs import Log, Run
from envs.logs.format import JOINT_SIGNALS
from envs.logs.sampling import HELD, sampled
from envs.targets.protocol import Commands
from envs.targets.recorded import Recorded, cut, find_ticks, holes
from jaxtune.types import Trajectory

_NEEDED = ("q", "dq", "target", "action", "phase", "cmd", "gyro", "gravity", "vel")
_READINGS = {"velocity": "vel", "gyro": "gyro", "gravity": "gravity", "joint": "q", "joint_velocity": "dq"}
_AT_LIMIT = 1e-4  # rad from the end of a joint's range: a target that was clipped
_UP_S = 0.5  # time for which a robot must be up after a fall to count as standing again


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
        ticks["meant"] = _meant(log.policy or {}, ticks)
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


def _wanted_torque(run: Run, seen: dict[str, np.ndarray], order: list[int]) -> np.ndarray:
    """Computes the torque that the joints' controller commanded, [ticks, joints] Nm, for logs without measured ones."""
    if run.controller.kind != "pd":
        raise ValueError(f"{run.name}: there is no 'tau', which a controller of type servo needs")
    # At the moment of a tick the target of the tick before is still acting.
    target = np.concatenate([seen["target"][:1], seen["target"][:-1]])
    return run.controller.impedance()[order].torque(target, seen["q"], seen["dq"])


def _meant(policy: Mapping[str, Any], seen: dict[str, np.ndarray]) -> np.ndarray:
    """The targets that the policy meant and observed, [ticks, joints] rad.

    What is sent, and logged, is clipped to the joints' ranges.
    """
    target = seen["target"]
    if "action_scale" not in policy:
        return target
    raibert = policy.get("base", "raibert") == "raibert"
    base = jax.vmap(gait.joint_reference)(seen["phase"], seen["cmd"]) if raibert else constants.STAND_RAD
    meant = base + policy["action_scale"] * np.clip(seen["action"], -env.ACTION_LIMIT, env.ACTION_LIMIT)
    low, high = joint_ranges()
    return np.where((target <= low + _AT_LIMIT) | (target >= high - _AT_LIMIT), meant, target)


def _pieces(ticks: dict[str, np.ndarray]) -> list[tuple[np.ndarray, bool]]:
    """Finds pieces of consecutive ticks with the robot on its feet, and whether each ends in a fall."""
    up = ticks["up"]
    hole = np.append(False, holes(ticks["time"], constants.POLICY_DT_S))
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
        moment: {name: ticks[name][at].astype(np.float32) for name in (*_NEEDED, "tau", "meant")}
        for moment, at in places.items()
    }
    ends = np.zeros(len(places["now"]), bool)
    ends[-1:] = fell
    return moments | {"alive": np.ones(len(ends), bool), "fell": ends}


@partial(jax.jit, static_argnums=1)
def _as_simulated(steps: dict, lead: int) -> Recorded:
    """Computes observations, scores and commands as the simulator would, `lead` steps after the commands begin."""
    before, now, after = (steps[moment] for moment in ("before", "now", "after"))
    each = lambda function: jax.vmap(jax.vmap(function))  # noqa: E731
    obs = each(partial(sensing.observe, stand=jnp.asarray(constants.STAND_RAD)))(
        **{name: now[signal] for name, signal in _READINGS.items()},
        command=now["cmd"],
        last_action=before["action"],
        joint_error=before["meant"] - now["q"],
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
