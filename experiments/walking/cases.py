"""The cases of `sim2sim`: how the target differs from the simulator, after the paper's Figs. 3.1 to 3.4."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from experiments.walking.targets import TARGETS
from jaxtune.mjx import Entry, parameters


@dataclass(frozen=True, kw_only=True)
class Case:
    """How the target differs from the simulator that is tuned to it.

    The simulator starts at its nominal parameters. The target has `1 / start` times the nominal value of every
    parameter that the case scales. So the simulator starts at `start` times the target, as the paper counts: "0.5X"
    means that the target's masses are twice the nominal ones.
    """

    scaled: Callable[[str], bool] = lambda name: False
    """Tells by the name of a parameter whether the target has its nominal value divided by `start`."""
    hidden: Mapping[str, float] = field(default_factory=dict)
    """Further physical values of the target, by name. They do not depend on `start`, and need not be tuned."""
    target: str = "mjx"
    """Engine of the target."""

    def true_params(self, entries: Mapping[str, Entry], start: float) -> dict[str, float]:
        """Returns the target's physical values by name: all parameters of `entries`, and those of `hidden`."""
        nominal = parameters.nominal(entries)
        return {name: value / start if self.scaled(name) else value for name, value in nominal.items()} | self.hidden

    def off(self, entries: Mapping[str, Entry]) -> tuple[str, ...]:
        """Returns the names of tuned parameters whose true value is not nominal: those that tuning has to find."""
        return tuple(name for name in entries if self.scaled(name) or name in self.hidden)


CASES = {
    "friction": Case(scaled=lambda name: name == "foot_friction"),
    "mass": Case(scaled=lambda name: name.endswith("_mass")),
    "bullet": Case(target="bullet"),
    "weak_motor": Case(hidden={"torque_scale": 0.75}, target="bullet"),
    "weaker_motor": Case(hidden={"torque_scale": 0.6}, target="bullet"),
}
"""The paper's four cases, Figs. 3.1 to 3.4, and a weaker motor, since this walk loses little with the paper's."""


def check_case(
    name: str, start: float, entries: Mapping[str, Entry], parameter_option: str, target: str | None = None
) -> None:
    """Checks that the target of a case differs from the simulator in something that can be tuned or measured.

    Args:
      name: of the case.
      start: where the simulator starts, as a multiple of the target.
      entries: the parameter table that is tuned.
      parameter_option: value of `--parameters`, for the message.
      target: engine of the target; None means the case's own.

    Raises:
      ValueError: names the option, the value and what is allowed.
    """
    for option, value, allowed in (("case", name, CASES), ("target", target, TARGETS)):
        if value is not None and value not in allowed:
            raise ValueError(f"{option}: got '{value}', expected one of {', '.join(allowed)}")
    case = CASES[name]
    # In another engine, or with hidden values, a target differs even if no tuned parameter does.
    about_parameters = case.target == "mjx" or ((target or case.target) == "mjx" and not case.hidden)
    if about_parameters and not case.off(entries):
        raise ValueError(
            f"parameters: got '{parameter_option}', but case '{name}' needs one whose value differs in its target"
        )
    check_positive(start=start)
    # A true value outside the bounds could never be found.
    for parameter in filter(case.scaled, entries):
        low, high = entries[parameter].bounds
        if not low <= 1.0 / start <= high:
            raise ValueError(f"start: got {start}, expected {1 / high:g} to {1 / low:g} ({parameter}'s bounds)")


def check_positive(**options: float) -> None:
    """Checks that options are positive, finite numbers.

    Raises:
      ValueError: names the first option that is not.
    """
    for option, value in options.items():
        if not 0 < value < float("inf"):
            raise ValueError(f"{option}: got {value}, expected a positive, finite number")
