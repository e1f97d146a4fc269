"""What came of a robot's walks, and what is to be expected of the next ones."""

from collections.abc import Mapping, Sequence

from scipy.stats import binom

from envs.biteno import constants
from envs.targets.recorded import Recorded, whole
from experiments.loop import walked

_SURPRISE = 0.2
"""Chance under which falls are not what simulation expects. Large: a few walks rule little out, and to believe what
they merely allow may cost a robot, where to doubt it costs a walk."""


def measured(found: Recorded, steps: int) -> dict:
    """What came of walks of so many steps; those that end before their time and not in a fall are told apart."""
    walks, power = whole(found, steps)
    return walked(walks, power) | {
        "episodes": len(walks.fell),
        "seconds": walks.alive.sum() * constants.POLICY_DT_S,
        "cut_short": int((~walks.alive[:, -1] & ~walks.fell).sum()),
    }


def verdict(line: Mapping) -> str | None:
    """How a round's tuning ended; None where nobody asked."""
    tuning = line["tuning"]
    return tuning["verdicts"][-1] if tuning["verdicts"] and tuning["p_value"][-1] is not None else None


def _ended(walks: Mapping) -> int:
    """Walks that ended too early."""
    return round(walks["fall_rate"] * walks["episodes"]) + walks["cut_short"]


def surprise(line: Mapping) -> float:
    """Chance of as many falls as were measured, if the tuned simulator were right."""
    walks, simulated = line["measured"], line["tuning"]["explained"]
    # Of few simulated walks one may have been lucky.
    rate = (simulated["fall_rate"] * simulated["episodes"] + 1) / (simulated["episodes"] + 2)
    return float(binom.sf(_ended(walks) - 1, walks["episodes"], rate))


def expected_falls(predicted: Mapping, history: Sequence[Mapping]) -> float:
    """Share of walks that are expected to end in a fall; what ended before its time may have been one.

    Before anything was measured there is nothing but simulation.
    """
    if not history:
        return predicted["fall_rate"]
    line = history[-1]
    if verdict(line) == "accept" and surprise(line) >= _SURPRISE:
        return predicted["fall_rate"]
    walks = line["measured"]
    return max(predicted["fall_rate"], _ended(walks) / walks["episodes"])
