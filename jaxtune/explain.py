"""What a tuning did, in words: for a console, a notebook or a log."""

import numpy as np

from jaxtune import dist as dists
from jaxtune.types import Verdict

MEANING = {
    Verdict.ACCEPT: "The simulator covers what was measured, so its parameters were updated.",
    Verdict.UNEXPLAINED: "No parameters explain what was measured (tested at 1 %): the model lacks physics.",
    Verdict.RADIUS_EXHAUSTED: "What was measured is not covered, and the distribution may grow no wider.",
    Verdict.NOT_FINITE: "No score could be computed.",
    Verdict.NOT_COMPARABLE: "There is too little to compare.",
}
"""What the verdict that ended a tuning means."""
ADVICE = {
    Verdict.ACCEPT: "Train the policy in the new distribution and measure again, until steps stay within intervals.",
    Verdict.UNEXPLAINED: "Add parameters that may be wrong, such as a delay or friction, or look for the missing "
    "effect with jaxtune.discovery. Do not trust the parameters.",
    Verdict.RADIUS_EXHAUSTED: "Check the bounds and the measured episodes. If both are right, a parameter is missing.",
    Verdict.NOT_FINITE: "Look for numbers that are not finite, and for simulated observations that never change.",
    Verdict.NOT_COMPARABLE: "Measure episodes in which the robot moves, that differ from each other and last for a "
    "window at least. Simulated ones must last as long; a level of 0.95 needs 19 held-out sets that do.",
}
"""What to do next."""


_MISFIT = 0.05  # largest p-value that is worth a word
_EXCESS = {
    "cover": "shapes that the verification model does not know",
    "lost": "how long the robot stays up",
    "misfit": "motion that no parameters of the table explain",
    "beyond": "parameters beyond the distribution",
}


def explain(info) -> str:
    """Says what a tuning found: its verdict, what moved and how far, and what to do next.

    Args:
      info: of one tuning (`jaxtune.tuner.Info`); for a run of several, index its leaves first.

    Returns:
      Lines of text. Positions, steps and intervals are in coordinates: of a multiplier, the logarithm.
    """
    verdict = Verdict(int(info.verdicts[int(info.calls) - 1]))
    last = int(info.calls) - 1
    lines = [
        f"{verdict.name.lower()} after {int(info.calls)} gate call(s): {MEANING[verdict]}",
        f"  novelty {float(info.gate.novelty[last]):.3f}, threshold {float(info.gate.threshold[last]):.3f}",
    ]
    excess = {what: float(info.gate[name][last]) for name, what in _EXCESS.items()}
    if verdict != Verdict.ACCEPT and np.isfinite([*excess.values()]).any():
        most = max((what for what in excess if np.isfinite(excess[what])), key=excess.__getitem__)
        lines.append(f"  most unlike the simulated sets: {most} ({excess[most]:.1f}; 1 is usual for one set in ten)")
    if verdict == Verdict.ACCEPT:
        fit = float(info.update.p_value)
        if fit <= _MISFIT:
            lines.append(f"  fits badly in the distribution that was read last (p {fit:.2f})")
        moved = dists.move(info.dist, info.update.step).centre
        interval = np.asarray(dists.ravel(info.dist.radius) * info.update.interval)
        for column, name in enumerate(dists.names(info.dist)):
            line = f"  {name}: {float(info.dist.centre[name]):.3f}"
            if info.update.identifiable[column]:
                around = "" if np.isnan(interval[column]) else f" +- {interval[column]:.3f}"
                lines.append(f"{line} -> {float(moved[name]):.3f}{around}")
            else:
                lines.append(f"{line}, not identifiable from these episodes")
    return "\n".join([*lines, ADVICE[verdict]])
