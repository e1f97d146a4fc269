"""The cases of `sim2sim`: how the target differs from the simulator, after the paper's Figs. 3.1 to 3.4."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxtune.mjx import Entry, parameters

_LARGEST_SEED = 2**24  # that a float32 holds exactly, as the lanes of a sweep do


@dataclass(frozen=True, kw_only=True)
class Case:
    """How the target differs from the simulator that is tuned to it.

    The simulator starts at its nominal parameters. The target has `1 / start` times the nominal value of every
    parameter that the case scales. So the simulator starts at `start` times the target, as the paper counts: "0.5X"
    means that the target's masses are twice the nominal ones.
    """

    scaled: str = ""
    """Field of the model; the target has the nominal value divided by `start` of every multiplier of this field."""
    hidden: Mapping[str, float] = field(default_factory=dict)
    """Physical values of the target, by name. They do not depend on `start`, and need not be tuned."""
    target: str = "mjx"
    """Engine of the target."""

    def with_truth(self, truth: Mapping[str, float]) -> "Case":
        """Returns the case with these physical values of the target, by name; where given, they alone differ."""
        return replace(self, scaled="", hidden=dict(truth)) if truth else self

    def scales(self, entry: Entry) -> bool:
        """Tells whether the target has a nominal value divided by `start` of this parameter."""
        return entry.log and self.scaled in entry.field_names

    def true_params(self, entries: Mapping[str, Entry], start: float) -> dict[str, float]:
        """Returns the target's physical values by name: all parameters of `entries`, and those of `hidden`."""
        nominal = parameters.nominal(entries)
        scaled = {name: value / start for name, value in nominal.items() if self.scales(entries[name])}
        return {**nominal, **scaled, **self.hidden}

    def off(self, entries: Mapping[str, Entry]) -> tuple[str, ...]:
        """Returns the names of tuned parameters whose true value is not nominal: those that tuning has to find."""
        return tuple(name for name, entry in entries.items() if self.scales(entry) or name in self.hidden)


CASES = {
    "friction": Case(scaled="geom_friction"),
    "mass": Case(scaled="body_mass"),
    "bullet": Case(target="bullet"),
    "weak_motor": Case(hidden={"torque_scale": 0.75}, target="bullet"),
    "weaker_motor": Case(hidden={"torque_scale": 0.6}, target="bullet"),
}
"""The paper's four cases, Figs. 3.1 to 3.4, and a weaker motor, since this walk loses little with the paper's."""


def errors(
    entries: Mapping[str, Entry], estimate: Mapping[str, Any], truth: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Computes errors of physical values by name.

    They are relative for multipliers, |estimate / truth - 1|. For offsets, which may be zero, they are
    |estimate - truth| in half widths of the parameter's bounds: numbers that may be averaged with the others.

    Args:
      entries: the parameter table.
      estimate: of any shape.
      truth: values by name; every name of the estimate.
    """
    off = {name: np.abs(np.asarray(value) - truth[name]) for name, value in estimate.items()}
    return {name: error / (truth[name] if entries[name].log else entries[name].unit) for name, error in off.items()}


def checked_case(
    name: str,
    start: float,
    entries: Mapping[str, Entry],
    *,
    engines: Collection[str],
    target: str | None = None,
    truth: Mapping[str, float] | None = None,
) -> Case:
    """Returns a case whose target differs from the simulator in something that can be tuned or measured.

    Args:
      name: of the case.
      start: where the simulator starts, as a multiple of the target.
      entries: the parameter table that is tuned.
      engines: those that have a target of this robot.
      target: engine of the target; None means the case's own.
      truth: physical values of the target by name, in place of the case's; empty or None for the case's.

    Raises:
      ValueError: names the option, the value and what is allowed.
    """
    for option, value, allowed in (("case", name, CASES), ("target", target, engines)):
        if value is not None and value not in allowed:
            raise ValueError(f"{option}: got '{value}', expected one of {', '.join(allowed)}")
    case = CASES[name].with_truth(truth or {})
    case = replace(case, target=target or case.target)
    if case.target not in engines:
        raise ValueError(f"case: got '{name}', whose target is in {case.target}; this robot has {', '.join(engines)}")
    # A case of another engine, or of values that nobody need tune, has a gap even if no tuned parameter differs.
    about_parameters = "mjx" in (case.target, CASES[name].target) and not case.hidden
    if about_parameters and not case.off(entries):
        raise ValueError(
            f"parameters: got {', '.join(entries)}, but case '{name}' needs one whose value differs in its target"
        )
    check_positive(start=start)
    # A true value outside the bounds could never be found.
    for parameter, entry in entries.items():
        low, high = entry.bounds
        if case.scales(entry) and not low <= 1.0 / start <= high:
            raise ValueError(f"start: got {start}, expected {1 / high:g} to {1 / low:g} ({parameter}'s bounds)")
    return case


def check_positive(**options: float) -> None:
    """Checks that options are positive, finite numbers.

    Raises:
      ValueError: names the first option that is not.
    """
    for option, value in options.items():
        if not 0 < value < float("inf"):
            raise ValueError(f"{option}: got {value}, expected a positive, finite number")


def check_seeds(seeds: Sequence[int]) -> None:
    """Checks that there are random seeds, each of them once.

    Raises:
      ValueError: there are none, one comes twice, or one is negative or so large that single precision rounds it.
    """
    if not seeds:
        raise ValueError("seeds: got none, expected one or more")
    for seed in seeds:
        if not 0 <= seed <= _LARGEST_SEED or seeds.count(seed) > 1:
            raise ValueError(f"seeds: got {', '.join(map(str, seeds))}, expected 0 to {_LARGEST_SEED}, each once")
