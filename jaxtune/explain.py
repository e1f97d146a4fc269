"""What a tuning did, in words: for a console, a notebook or a log."""

import numpy as np

from jaxtune import dist as dists
from jaxtune.types import Verdict

MEANING = {
    Verdict.ACCEPT: "The simulator covers what was measured, so its parameters were updated.",
    Verdict.UNEXPLAINED: "What was measured is not covered, and widening came no closer: the model lacks physics.",
    Verdict.RADIUS_EXHAUSTED: "What was measured is not covered, and the distribution may grow no wider.",
    Verdict.NOT_FINITE: "No score could be computed.",
}
"""What the verdict that ended a tuning means."""
ADVICE = {
    Verdict.ACCEPT: "Train the policy in the new distribution and measure again, until steps stay within intervals.",
    Verdict.UNEXPLAINED: "Add parameters that may be wrong, such as a delay or friction, or look for the missing "
    "effect with jaxtune.discovery. Do not trust the parameters.",
    Verdict.RADIUS_EXHAUSTED: "Check the bounds and the measured episodes. If both are right, a parameter is missing.",
    Verdict.NOT_FINITE: "Look for episodes that end before their first window, for numbers that are not finite, and "
    "for observations that never change.",
}
"""What to do next."""


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
    if verdict == Verdict.ACCEPT:
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
