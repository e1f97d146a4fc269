"""Where simulation and measurement disagree (step 4): which joint, which signal, in which regime of motion."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxtune.discovery.fit import Fit
from jaxtune.discovery.noise_floor import Floor
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.resample import times_drawn, units
from jaxtune.discovery.state import State

_PUSH = 0.05  # coordinate of the torque that the slopes are secants of
_LASSO_ROUNDS = 300
_LEAST_SEGMENTS = 3  # in which a regime must occur to be reported


def localise(problem: Problem, at: Floor, state: State, fit: Fit) -> State:
    """Finds the cells above the floor, the first time, and the joints that need a torque of their own, every time.

    Both say to a person where the model is wrong.

    Args:
      problem: the simulator and the segments.
      at: the floor at the main horizon; its null logs give the penalty, if that is not known.
      state: what is known so far.
      fit: where the model stands.

    Returns:
      The state with `where`, `needs_torque` and `penalty`.
    """
    residual = at.unflatten(fit.residual)
    if problem.push:
        slopes = torque_slopes(problem, at, fit)
        penalty = state.penalty or null_penalty(at.null_residuals, slopes)
        need = free_torque(residual.reshape(len(residual), -1), slopes, penalty)
        needs_torque = dict(zip(problem.push, need.tolist(), strict=True))
        state = replace(state, penalty=penalty, needs_torque=needs_torque)
    if state.where:
        return state
    segments = problem.data["train"][at.horizon]
    # The regime of a bin is that of its first row.
    regimes = segments.regimes[:, :: problem.bin_rows][:, : residual.shape[1]]
    return replace(state, where=tuple(cells(residual, regimes, problem.regimes, problem.cells, segments.run)))


def cells(
    residual: np.ndarray,
    regimes: np.ndarray,
    regime_names: Sequence[str],
    components: Sequence[tuple[str, str]],
    run: np.ndarray,
) -> list[dict]:
    """Lists the energy above the floor by component and regime, largest first.

    Intervals come from a block bootstrap over segments. A regime that fewer than three segments reach is left out.

    Args:
      residual: [segments, bins, components] in floor units.
      regimes: [segments, bins, joints] index of each joint's regime.
      regime_names: by that index.
      components: (signal, joint) of every component.
      run: [segments] index of each segment's run.

    Returns:
      A dictionary for every cell: `joint`, `signal`, `regime`, `excess_floor_units` with its 95 % interval `low` and
      `high`, and `bins`, how many there were.
    """
    energy = (residual**2).mean(axis=1)
    times = times_drawn(units(run, energy, 0), 200)
    joints = [joint for signal, joint in components if signal == "q"]
    found = []
    for index, (signal, joint) in enumerate(components):
        # Components that belong to no joint, as of the gravity vector, go by the first joint's regime.
        column = regimes[..., joints.index(joint) if joint in joints else 0]
        for number, name in enumerate(regime_names):
            there = (column == number).astype(float)
            count = there.sum(axis=1)
            if (count > 0).sum() < _LEAST_SEGMENTS:
                continue
            energy = (residual[..., index] ** 2 * there).sum(axis=1)
            resampled = times @ energy / np.maximum(times @ count, 1.0)
            low, high = (excess(bound) for bound in np.quantile(resampled, (0.025, 0.975)))
            found.append(
                {
                    "joint": joint,
                    "signal": signal,
                    "regime": name,
                    "excess_floor_units": excess(energy.sum() / count.sum()),
                    "low": low,
                    "high": high,
                    "bins": int(count.sum()),
                }
            )
    return sorted(found, key=lambda cell: -cell["excess_floor_units"])


def excess(energy: float) -> float:
    """Turns a mean square in floor units into the amplitude above the floor: sqrt(energy - 1), at least zero."""
    return float(np.sqrt(max(energy - 1.0, 0.0)))


def torque_slopes(problem: Problem, at: Floor, fit: Fit) -> np.ndarray:
    """Takes secants along a constant torque at every joint of `problem.push`, from a model.

    Returns:
      [segments, features of a segment, joints] in floor units.
    """
    directions = np.zeros((len(problem.push), problem.axes))
    directions[np.arange(len(directions)), list(problem.push.values())] = _PUSH
    (slopes,) = at.residuals["train"].changes([fit.vector], [fit.residual], [directions])
    return at.unflatten(slopes.T).reshape(-1, at.scale["train"].size, len(directions))


def free_torque(residual: np.ndarray, slopes: np.ndarray, penalty: float) -> np.ndarray:
    """Says what every joint needs if each may have a torque of its own in every segment.

    A group lasso whose groups are the joints (Yuan and Lin, 2006), solved by proximal gradient steps. With residuals
    r_s and slopes S_s of segment s, and a torque a_sj for every segment and joint,

        min over a:  sum_s |r_s + S_s a_s|^2 / 2  +  penalty * sum_j |a_.j|,

    in units in which a joint's slopes have length one. The penalty on a joint's whole history makes it exactly zero
    for joints that need no torque.

    Args:
      residual: [segments, features] in floor units.
      slopes: [segments, features, joints] of a constant torque at each joint.
      penalty: as large as the largest need in null logs.

    Returns:
      |a_.j|, [joints].
    """
    slopes = _unit_length(slopes)
    torque = np.zeros((len(residual), slopes.shape[-1]))
    # The step of proximal gradient descent: one over the largest curvature.
    rate = 1.0 / max(np.linalg.eigvalsh(np.einsum("sfi,sfj->sij", slopes, slopes)).max(), 1e-12)
    for _ in range(_LASSO_ROUNDS):
        left = residual + np.einsum("sfj,sj->sf", slopes, torque)
        torque = torque - rate * np.einsum("sfj,sf->sj", slopes, left)
        norm = np.sqrt((torque**2).sum(axis=0))
        torque = torque * np.maximum(1.0 - rate * penalty / np.maximum(norm, 1e-12), 0.0)
    return np.sqrt((torque**2).sum(axis=0))


def null_penalty(null_residuals: np.ndarray, slopes: np.ndarray) -> float:
    """Finds the smallest penalty under which no joint of any null log needs a torque.

    Args:
      null_residuals: [logs, features] what fits of the prior directions leave of every null log.
      slopes: [segments, features, joints] of a constant torque at each joint.
    """
    return max(least_penalty(log.reshape(len(slopes), -1), slopes) for log in null_residuals)


def least_penalty(residual: np.ndarray, slopes: np.ndarray) -> float:
    """Finds the smallest penalty under which `free_torque` gives every joint zero: max over joints of |S'r|."""
    pull = np.einsum("sfj,sf->sj", _unit_length(slopes), residual)
    return float(np.sqrt((pull**2).sum(axis=0)).max())


def _unit_length(slopes: np.ndarray) -> np.ndarray:
    """Slopes [segments, features, joints] scaled so that every joint's have length one."""
    size = np.sqrt((slopes**2).sum(axis=(0, 1)))
    return slopes / np.where(size > 0, size, 1.0)
