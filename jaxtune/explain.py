"""What a tuning did, in words: for a console, a notebook or a log."""

from dataclasses import dataclass

import numpy as np

from jaxtune import dist as dists
from jaxtune.types import Verdict

MEANING = {
    Verdict.ACCEPT: "The simulator covers what was measured, so its parameters were updated.",
    Verdict.UNEXPLAINED: "No parameters explain what was measured (tested at 1 %): the model lacks physics.",
    Verdict.RADIUS_EXHAUSTED: "What was measured is not covered, and the distribution may grow no wider.",
    Verdict.NOT_FINITE: "No score could be computed.",
    Verdict.NOT_COMPARABLE: "What was measured cannot be compared with simulated sets.",
}
"""What the verdict that ended a tuning means."""
ADVICE = {
    Verdict.ACCEPT: "Train the policy in the new distribution and measure again, until steps stay within intervals.",
    Verdict.UNEXPLAINED: "Add parameters that may be wrong, such as a delay or friction, or look for the missing "
    "effect with jaxtune.discovery. The robot's noise and policy must be those that are simulated, too. Do not trust "
    "the parameters.",
    Verdict.RADIUS_EXHAUSTED: "Check the bounds and the measured episodes. If both are right, a parameter is missing.",
    Verdict.NOT_FINITE: "Look for numbers that are not finite, and for simulated observations that never change.",
    Verdict.NOT_COMPARABLE: "Measure episodes in which the robot moves so that parameters show, that differ from each "
    "other and last for a window at least. Simulated ones must last as long, in enough held-out sets for the level: "
    "0.95 needs 19, and 0.99 needs 99. An observation that never changes in simulation must have the same value.",
}
"""What to do next."""
_DOUBTFUL = (
    "Measure again before you train a policy in the new distribution: it may make up for physics that the model lacks. "
    "Tuner.misfits says where the set does not fit."
)


DOUBTFUL = 0.05
"""Largest p-value (`UpdateInfo.p_value`) with which an accepted set fits so badly that its estimates are in doubt."""
_WEAK = 0.5  # least error of a coordinate that is hardly identified, as a share of its standard deviation
_SMALL = 0.3  # weight in a combination that is left out, as a share of the largest
_EXCESS = {
    "cover": "shapes that the verification model does not know",
    "lost": "how long the robot stays up",
    "misfit": "motion that no parameters of the table explain",
    "beyond": "parameters beyond the distribution",
}


def weak(info) -> np.ndarray:
    """Tells which coordinates the episodes hardly narrow: estimates err by more than half of what no data would leave.

    Args:
      info: of one tuning.

    Returns:
      [coords] in the order of `dist.names`; all False where the update gives no errors.
    """
    found = np.diag(_errors(info))
    return np.sqrt(found, where=found >= 0, out=np.zeros_like(found)) > _WEAK


def intervals(info) -> np.ndarray:
    """Computes half widths of the intervals around the new centre, where they hold.

    Held-out sets calibrate them, which say nothing of values beyond the distribution that they were drawn from. Of a
    coordinate that is not identifiable, nothing was learnt.

    Args:
      info: of one tuning.

    Returns:
      [coords] in coordinates, in the order of `dist.names`; nan where the interval reaches past the distribution, the
      coordinate is not identifiable, or the update gives none.
    """
    step, interval = (np.asarray(value) for value in (info.update.step, info.update.interval))
    low, high = map(np.asarray, dists.normalised_box(info.dist))
    inside = (step - interval >= low) & (step + interval <= high)
    return np.where(
        inside & np.asarray(info.update.identifiable), np.asarray(dists.ravel(info.dist.radius)) * interval, np.nan
    )


def doubtful(info) -> bool:
    """Tells whether an accepted set fits so badly in the distribution that was read last that estimates are in doubt.

    Args:
      info: of one tuning in which the gate was called.
    """
    accepted = int(info.verdicts[int(info.calls) - 1]) == Verdict.ACCEPT
    return accepted and float(info.update.p_value) <= DOUBTFUL


@dataclass(frozen=True, kw_only=True)
class Combination:
    """A weighted sum of coordinates that is known better than each of them."""

    weights: dict[str, float]
    """By name, the largest 1."""
    error: float
    """Of the sum, rms over held-out sets."""

    def __str__(self) -> str:
        terms = " ".join(f"{weight:+.2g} {name}" for name, weight in self.weights.items())
        return f"{terms.removeprefix('+')} is known to {self.error:.3f}"


def combinations(info) -> tuple[Combination, ...]:
    """Finds what the episodes tell of coordinates that they hardly tell singly, such as the sum of two masses.

    These are the principal axes of the errors of the weak coordinates, scaled by the distribution, along which
    estimates err by less than half of what no data would leave.

    Args:
      info: of one tuning.

    Returns:
      One for each such axis, the best known first.
    """
    names, found = np.array(dists.names(info.dist)), _errors(info)
    vague = np.flatnonzero(weak(info))
    among = found[np.ix_(vague, vague)]
    sd = np.asarray(dists.ignorance(info.dist) * dists.ravel(info.dist.radius))[vague]
    told = []
    for axis in np.linalg.eigh(among)[1].T:
        chosen = np.abs(axis) > _SMALL * np.abs(axis).max()
        # The error is that of the sum that is told, without its small terms.
        axis = np.where(chosen, axis, 0.0) / np.linalg.norm(axis[chosen])
        error = np.sqrt(max(axis @ among @ axis, 0.0))
        if error < _WEAK and chosen.sum() > 1:
            weights = axis / sd
            unit = weights[np.abs(weights).argmax()]
            picked = dict(zip(names[vague][chosen].tolist(), (weights[chosen] / unit).tolist(), strict=True))
            told.append(Combination(weights=picked, error=float(error / abs(unit))))
    return tuple(told)


def _errors(info) -> np.ndarray:
    """[coords, coords] mean products of estimates' errors, in standard deviations of the distribution."""
    size = len(dists.names(info.dist))
    found = np.broadcast_to(np.nan_to_num(np.asarray(info.update.errors, float)), (size, size))
    unknown = np.asarray(dists.ignorance(info.dist))
    return found / np.outer(unknown, unknown)


def explain(info) -> str:
    """Says what a tuning found: its verdict, what moved and how far, and what to do next.

    Args:
      info: of one tuning (`jaxtune.tuner.Info`); for a run of several, index its leaves first.

    Raises:
      ValueError: it is of several tunings.

    Returns:
      Lines of text; one where nothing was tested, as by `baselines.Untuned`. Positions, steps and intervals are in
      coordinates: of a multiplier, the logarithm.
    """
    if np.ndim(info.calls):
        last = "jax.tree.map(lambda leaf: leaf[-1], info)"
        raise ValueError(f"explain: got {len(info.calls)} tunings, expected one, such as the last: {last}")
    if not int(info.calls):
        return "Nothing was tested: the distribution stays as it is."
    last = int(info.calls) - 1
    verdict = Verdict(int(info.verdicts[last]))
    lines = [
        f"{verdict.name.lower()} after {int(info.calls)} gate call(s): {MEANING[verdict]}",
        f"  novelty {float(info.gate.novelty[last]):.3f}, threshold {float(info.gate.threshold[last]):.3f}",
    ]
    excess = {what: float(info.gate[name][last]) for name, what in _EXCESS.items()}
    replay = float(info.update.p_replay)
    if verdict == Verdict.UNEXPLAINED and not np.isnan(replay):
        lines.append(f"  its measured states fit worse than those of all simulated sets (p {replay:.2f})")
    elif verdict != Verdict.ACCEPT and np.isfinite([*excess.values()]).any():
        most = max((what for what in excess if np.isfinite(excess[what])), key=excess.__getitem__)
        lines.append(f"  most unlike the simulated sets: {most} ({excess[most]:.1f}; 1 is usual for one set in ten)")
    if int(info.not_finite):
        lines.append(f"  {int(info.not_finite)} episode(s), simulated or measured, hold numbers that are not finite")
    doubt = doubtful(info)
    if verdict == Verdict.ACCEPT:
        if doubt:
            lines.append(f"  fits badly in the distribution that was read last (p {float(info.update.p_value):.2f})")
        past = float(info.update.p_past)
        if info.update.pooled:
            lines.append(f"  joined with the sets of earlier tunings, which it does not contradict (p {past:.2f})")
        elif not np.isnan(past):
            lines.append(f"  contradicts the sets of earlier tunings (p {past:.2f}), which count no longer")
        if info.update.replayed:
            lines.append(f"  estimated from measured states, which fit (p {replay:.2f})")
        elif not np.isnan(replay):
            lines.append(f"  measured states give no better estimate (their fit: p {replay:.2f})")
        moved = dists.move(info.dist, info.update.step).centre
        interval = intervals(info)
        vague = weak(info)
        ends = (dists.ravel(end) for end in (info.dist.lower, info.dist.upper))
        at_bound = np.isclose([*ends], dists.ravel(moved), atol=1e-4).any(axis=0)
        for column, name in enumerate(dists.names(info.dist)):
            line = f"  {name}: {float(info.dist.centre[name]):.3f}"
            if info.update.identifiable[column]:
                around = "" if np.isnan(interval[column]) else f" +- {interval[column]:.3f}"
                note = ", weakly identified" if vague[column] else ""
                note += ", at a bound" if at_bound[column] else ""
                lines.append(f"{line} -> {float(moved[name]):.3f}{around}{note}")
            else:
                lines.append(f"{line}, not identifiable from these episodes")
        lines += [f"  together: {one}" for one in combinations(info)]
    return "\n".join([*lines, _DOUBTFUL if doubt else ADVICE[verdict]])
