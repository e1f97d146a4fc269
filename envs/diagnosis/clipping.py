"""Finds signals that are cut off at a largest or smallest value, and does not take rest or turning points for it.

A joint that turns round slows down before its extreme, and one that stands still does so at many values. A signal that
is cut off arrives at full speed, stays at exactly one value again and again, and stays long at no other.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from envs.diagnosis.finding import Finding
from envs.logs import Run
from envs.readings import quantum_of

_LEAST_SHARE = 0.01  # of the rows, which lie at the end
_LEAST_ROWS = 8
_LEAST_STAY = 3  # rows of a stay; a shorter one may be a coincidence
_LEAST_STAYS = 2  # in one run
_ELSEWHERE = 4.0  # rows at the end for every row at the most frequent value between both ends
_ABRUPT = 0.5  # step before a stay, as a share of the usual step
_LEAST_STEP = 3.0  # quanta of that step; below, a joint that stops cannot be distinguished


def clipped(run: Run, joints: Sequence[str], least_stays: int = _LEAST_STAYS) -> list[Finding]:
    """Finds signals of a run that are cut off, torques at the controller's own limit excepted.

    Args:
      run: with `q`, and `dq` and `tau` where they were recorded.
      joints: names of the joints, in the log's order.
      least_stays: separate stays at the end that are needed. Fewer than in one run are enough for an end that several
        runs share.
    """
    found = []
    for name in ("q", "dq", "tau"):
        for joint, column in enumerate(run.signals.get(name, np.empty((0, 0))).T):
            limit = run.controller.gains.get("torque_limit_nm") if name == "tau" else None
            for end, share in _ends(column, least_stays):
                if limit is None or abs(end) < 0.99 * limit[joint]:
                    text = f"{name}: {joints[joint]} is clipped at {end:.4g}, in {share:.0%} of the rows"
                    found.append(Finding("clipped", name, (joints[joint],), end, text))
    return found


def clipped_alike(runs: Sequence[Run], joints: Sequence[str]) -> dict[str, list[Finding]]:
    """Finds signals that are cut off at the same value in two runs or more, where one stay in each is enough.

    Returns:
      Findings by the name of the run, those of `clipped` in that run excepted.
    """
    each = {run.name: clipped(run, joints, 1) for run in runs}
    ends = [(one.signal, one.joints, one.size) for found in each.values() for one in found]
    alone = {run.name: clipped(run, joints) for run in runs}
    return {
        name: [one for one in found if one not in alone[name] and ends.count((one.signal, one.joints, one.size)) > 1]
        for name, found in each.items()
    }


def _ends(column: np.ndarray, least_stays: int) -> Iterator[tuple[float, float]]:
    """Yields the largest or smallest value of a column [rows] if it is cut off there, and the share of rows there."""
    quantum = float(quantum_of(column))
    steps = np.abs(np.diff(column))
    if not (steps > 0).any() or np.ptp(column) <= 20 * quantum:
        return
    usual = float(np.median(steps[steps > 0.5 * quantum]))
    values, counts = np.unique(column, return_counts=True)
    between = counts[1:-1].max(initial=0)
    for end, count in ((values[0], counts[0]), (values[-1], counts[-1])):
        edges = np.flatnonzero(np.diff(column == end, prepend=False, append=False))
        starts = edges[::2][np.diff(edges)[::2] >= _LEAST_STAY]
        arrivals = steps[starts[starts >= 2] - 2]
        abrupt = (arrivals >= max(_ABRUPT * usual, _LEAST_STEP * quantum)).sum()
        often = count >= max(_LEAST_ROWS, _LEAST_SHARE * len(column), _ELSEWHERE * between)
        if often and abrupt >= least_stays and 2 * abrupt >= len(starts):
            yield float(end), count / len(column)
