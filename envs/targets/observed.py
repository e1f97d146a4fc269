"""Makes episodes from logs that hold the policy's own observations: of any robot, without its model.

A row's observation and action belong together. Rows come at the policy's rate, and then each is a tick unless nothing
changes for long; or they are faster, and then a tick is where observation and action have changed. A run begins where
the motors are switched on. It is cut where ticks are missing, and ends where the motors are switched off, which is a
fall.
"""

import jax
import jax.numpy as jnp
import numpy as np

from envs.logs import Log, Run
from envs.targets.recorded import HOLE, Recorded, cut, find_ticks, holes
from jaxtune.types import Trajectory


def episodes(log: Log, steps: int, *, control_s: float, obs: int, act: int) -> Recorded:
    """Turns a log of observations and actions into episodes of `steps` policy steps.

    A longer piece of a run becomes several episodes; a shorter one is filled up with steps that are not alive.

    Args:
      log: of `envs.logs.read_observed`.
      steps: length of an episode in policy steps.
      control_s: period of the policy in s.
      obs, act: sizes of observation and action.

    Returns:
      The episodes. Their score is the column `reward`, if the log has one, else nan; the power is not known.

    Raises:
      ValueError: observation or action have another size, or ticks do not come at the policy's rate.
    """
    found = []
    rate = (log.policy or {}).get("rate_hz", 1.0 / control_s)
    if abs(rate * control_s - 1.0) > 1e-3:
        raise ValueError(f"policy.rate_hz: got {rate:g}, expected {1.0 / control_s:g}, as simulated")
    for index, run in enumerate(log.runs):
        for name, size in (("obs", obs), ("action", act)):
            got = run.signals[name].shape[1]
            if got != size:
                raise ValueError(f"{run.name}: got {got} components of '{name}', expected {size}, as the policy has")
        for piece, begin in _pieces(run, control_s):
            found += [one | {"run": index} for one in cut(piece, steps, begin)]
    stacked = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *found)
    alive, fell = stacked["alive"], stacked["fell"].any(axis=1)
    return Recorded(
        trajectory=Trajectory(
            obs=stacked["obs"],
            action=stacked["action"],
            alive=alive,
            score=stacked["score"],
            fell=fell,
            not_finite=jnp.zeros_like(fell),
        ),
        commands=None,
        power=jnp.full(alive.shape, jnp.nan),
        run=stacked["run"],
        begin=stacked["begin"],
    )


def _pieces(run: Run, control_s: float) -> list[tuple[dict, int]]:
    """Cuts a run into pieces of consecutive ticks, each with its first step in the run."""
    on = run.signals.get("enabled", np.ones(len(run.time))) != 0
    begin = int(on.argmax())
    off = begin + np.flatnonzero(~on[begin:])
    end = off[0] if len(off) else len(run.time)
    rows = _ticks(run, control_s, begin)
    rows = rows[rows < end]
    if not len(rows):
        raise ValueError(f"{run.name}: got no step with the motors on, expected a walk")
    time = run.time[rows]
    reward = run.other.get("reward", np.full(len(run.time), np.nan))
    pieces = []
    for part in np.split(np.arange(len(rows)), 1 + np.flatnonzero(holes(time, control_s))):
        if len(part) < 2:
            continue  # a row of a policy that stands still, before or after its walk
        at = rows[part]
        fell = np.zeros(len(at), bool)
        fell[-1] = len(off) > 0 and part[-1] == len(rows) - 1
        piece = {
            "obs": run.signals["obs"][at].astype(np.float32),
            "action": run.signals["action"][at].astype(np.float32),
            "score": reward[at].astype(np.float32),
            "alive": np.ones(len(at), bool),
            "fell": fell,
        }
        pieces.append((piece, round((time[part[0]] - time[0]) / control_s)))
    if not pieces:
        raise ValueError(f"{run.name}: got no two consecutive steps, expected a walk")
    return pieces


def _ticks(run: Run, control_s: float, begin: int) -> np.ndarray:
    """Finds the rows at which the policy acts, from the row `begin` on."""
    # An action may stay at its limit for long, but an observation does not stay the same to the last bit.
    sent = np.concatenate([run.signals["obs"], run.signals["action"]], axis=1)
    size = run.signals["obs"].shape[1]
    rows, _ = find_ticks(run.name, run.time, sent, control_s, "observation or action", size)
    rows = rows[rows >= begin]
    # The first row shows what the policy observed first, whenever that was, unless it had not begun yet, or the action
    # that answers this observation comes in a later row.
    first = (
        len(rows) > 0
        and run.time[rows[0]] - run.time[begin] < HOLE * control_s
        and (run.signals["obs"][rows[0]] != run.signals["obs"][begin]).any()
    )
    return np.union1d(begin, rows) if first else rows
