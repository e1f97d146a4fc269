"""What a self-test counted, and the words for it."""

from dataclasses import dataclass

import numpy as np

INSIDE = "inside the distribution"
"""Case of the robots that the distribution could have drawn."""


@dataclass(frozen=True)
class Rate:
    """So many of so many.

    Attributes:
      hits: how many.
      of: of how many.
      by_gate: the same two of every gate; empty where they are not counted by gate.
    """

    hits: int
    of: int
    by_gate: tuple[tuple[int, int], ...] = ()

    @property
    def share(self) -> float:
        """As a number from 0 to 1; nan of none."""
        return self.hits / self.of if self.of else float("nan")

    @property
    def independent(self) -> float:
        """How many independent robots say as much: fewer than there are if gates differ by more than chance."""
        counted = np.array([pair for pair in self.by_gate if pair[1]], float)
        if len(counted) < 2 or self.hits in (0, self.of):
            return float(self.of)
        hits, each = counted.T
        chance = self.share * (1.0 - self.share) / each.mean()
        return self.of * chance / max(chance, float(np.var(hits / each, ddof=1)))


@dataclass(frozen=True, kw_only=True)
class Tuned:
    """What was counted of one tuning, the first, second and so on of the robots of a case."""

    verdicts: dict[str, int]
    """How it ended: robots by verdict."""
    held: Rate
    """Robots accepted whose true coordinates all lie in the distribution afterwards."""
    covered: Rate
    """Robots accepted whose identifiable coordinates all lie in their intervals."""
    error: dict[str, float]
    """Median |centre - truth| afterwards, by coordinate, whatever the verdict."""


@dataclass(frozen=True, kw_only=True)
class SelfTest:
    """What was counted. Robots of one gate share its models, so they are no independent draws."""

    level: float
    """Share of sets that the gate should let pass."""
    gates: int
    """Gates, each with episodes and models of its own."""
    alarms: Rate
    """Robots inside the distribution that were rejected."""
    outside: dict[str, Rate]
    """Robots rejected that lie outside by one radius, by the coordinate in which they do. A coordinate whose bounds
    leave no room for that is left out."""
    noticed: dict[str, Rate]
    """The same robots rejected, or, where accepted, inside the distribution after the first update."""
    others: dict[str, Rate]
    """Robots rejected of which something else is different, by name."""
    identified: dict[str, Rate]
    """Robots inside and accepted of which the first update called the coordinate identifiable."""
    error: dict[str, float]
    """Median |estimate - truth| of the first update in coordinates, where identifiable; nan where never."""
    interval: dict[str, float]
    """Median half width of its interval, likewise."""
    covered: Rate
    """Robots inside and accepted whose identifiable coordinates all lie in their intervals; of those that have
    intervals, which `vote_update` gives none."""
    tuned: dict[str, tuple[Tuned, ...]]
    """Whole tunings in their order, by case; empty where none was run."""
    unusable: dict[str, int]
    """Sets that were not comparable or not finite, by case, where there are any. No rate counts them."""


def summary(report: SelfTest) -> str:
    """Says in words what a self-test found: lines of text."""
    percent = lambda rate: f"{100 * rate.share:.0f} % of {rate.of}" if rate.of else "unknown"  # noqa: E731
    lines = [
        f"false alarms: {percent(report.alarms)} (nominal {100 * (1 - report.level):.0f} %)",
        f"all true values in their intervals: {percent(report.covered)}",
    ]
    for name, rate in report.outside.items():
        found = report.identified[name]
        told = f"estimated to {report.error[name]:.3f}" if found.share > 0.5 else "not identifiable"
        held = percent(report.noticed[name])
        lines.append(f"{name}: {told}; rejected one radius outside: {percent(rate)}, or then inside: {held}")
    lines += [f"{name}: rejected: {percent(rate)}" for name, rate in report.others.items()]
    lines += [f"{place}: {text}" for place, text in whole_tunings(report).items()]
    lines += [f"{name}: {count} sets are not comparable or not finite" for name, count in report.unusable.items()]
    return "\n".join(lines)


def whole_tunings(report: SelfTest) -> dict[str, str]:
    """Says in words how whole tunings ended, by case and number of the tuning."""
    return {
        f"tuning {index + 1}, {name}": ", ".join(
            [
                *(f"{count} {verdict}" for verdict, count in sorted(one.verdicts.items())),
                f"truth in the distribution: {one.held.hits} of {one.held.of}",
                f"in its intervals: {one.covered.hits} of {one.covered.of}",
            ]
        )
        for name, each in report.tuned.items()
        for index, one in enumerate(each)
    }
