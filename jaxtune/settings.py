"""Settings of a tuning: sizes, which fix array shapes and loop lengths (`TunerConfig`), and scalars (`Knobs`)."""

from dataclasses import dataclass, field
from numbers import Integral

import chex
import jax
import jax.numpy as jnp

from jaxtune.conformal import ROUNDING
from jaxtune.dvm import DVMConfig
from jaxtune.regression import RegressionConfig
from jaxtune.shooting import ReplayConfig
from jaxtune.spm import SPMConfig

UNEXPLAINED = 0.01
"""Largest p-value of a set that is `unexplained`."""
SETS_TO_EXPLAIN = round(1 / UNEXPLAINED) - 1
"""Simulated sets of which a conformal p-value can be as small as that."""


@dataclass(frozen=True, kw_only=True)
class TunerConfig:
    """Sizes of a tuning: whatever fixes array shapes and loop lengths, so a change compiles the tuner anew.

    The defaults are for walking robots on two CPU cores. More `episodes` sharpen both models and take longer.
    For scalars that may vary within one compiled program, see `Knobs`.

    Raises:
      ValueError: a count is too small, `coverage` is not between 0 and 1, or `min_radius` is not positive.
    """

    episodes: int = 600
    """Simulated episodes in D_q, the set that both models are trained on. Each has coordinates of its own."""
    set_episodes: int = 5
    """Episodes in a measured set, and in every held-out set that it is compared with."""
    held_out_sets: int = 99
    """Simulated sets that calibrate the gate's threshold and the update's interval. Each set is one robot, with
    coordinates of its own. With 99 sets, p-values are multiples of 1/100. A level of 0.95 needs 19 sets at least, and
    the verdict `unexplained` needs 99."""
    max_widenings: int = 6
    """Largest number of calls of the gate within one tuning that widen the distribution; one more may follow."""
    refinements: int = 3
    """Times that an accepted set is read again, in the distribution that the update narrowed. Use 0 with `vote_update`,
    whose steps are meant for one set each."""
    coverage: float = 0.9
    """Share of held-out sets whose true coordinates the interval of the posterior update must contain."""
    min_radius: float = 0.1
    """Smallest radius, in coordinates, that the posterior update narrows to."""
    regression: RegressionConfig = field(default_factory=RegressionConfig)
    """Sizes of the regression that the posterior update estimates with."""
    spm: SPMConfig = field(default_factory=SPMConfig)
    """Sizes of the search-parameter model, which the vote update trains."""
    dvm: DVMConfig = field(default_factory=DVMConfig)
    """Sizes of the verification model."""
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    """Sizes of the estimate from measured states, of a tuner that has a `replay`."""

    def __post_init__(self):
        least = {"episodes": 1, "set_episodes": 1, "held_out_sets": 1, "max_widenings": 0, "refinements": 0}
        for name, value in least.items():
            if not isinstance(given := getattr(self, name), Integral) or given < value:
                raise ValueError(f"{name}: got {given!r}, expected a whole number, {value} or more")
        if not 0 < self.coverage < 1:
            raise ValueError(f"coverage: got {self.coverage}, expected a number between 0 and 1")
        if not self.min_radius > 0:
            raise ValueError(f"min_radius: got {self.min_radius}, expected a positive number")

    def check_level(self, level: float) -> None:
        """Checks that so many held-out sets can tell a quantile: at 0.95 that takes 19.

        Raises:
          ValueError: they cannot.
        """
        most = self.held_out_sets / (self.held_out_sets + 1)
        if level > most + ROUNDING:
            raise ValueError(
                f"level: got {level:g}, expected {most:.3g} or less with {self.held_out_sets} simulated sets"
            )

    @property
    def may_be_unexplained(self) -> bool:
        """Whether the verdict `unexplained` can be reached with so many held-out sets."""
        return self.held_out_sets >= SETS_TO_EXPLAIN

    @property
    def longest_window(self) -> int:
        """Steps that an episode must have at least."""
        return max(self.regression.window, self.spm.window, self.dvm.window)


@chex.dataclass(frozen=True)
class Knobs:
    """Scalars of a tuning that change no array's shape, so a sweep can vmap over them in one compiled program.

    They travel in the tuner's state. Make them with `knobs`, which has defaults and checks them.
    """

    step_size: jax.Array  # the paper's alpha: radii that `vote_update` moves per unit of vote
    widen_factor: jax.Array  # the paper's c: factor on the radius after a failed check
    level: jax.Array  # quantile of the held-out sets' novelty that is the threshold
    threshold: jax.Array  # the paper's sigma': a fixed mean rank of windows instead; nan where there is none


def knobs(
    *, step_size: float = 0.5, widen_factor: float = 2.0, level: float = 0.95, threshold: float | None = None
) -> Knobs:
    """Makes knobs from plain numbers, and checks them.

    Args:
      step_size: radii that the centre moves per unit of vote; `posterior_update` does not use it.
      widen_factor: what every radius is multiplied by after a failed check.
      level: share of covered sets that the gate lets pass. At 0.95 it rejects a set that came from the distribution
        with a probability of at most 0.05.
      threshold: a fixed mean rank of windows, in (0, 1). The verification model alone then decides. The paper sets its
        threshold by hand like this.

    Raises:
      ValueError: step size not positive, widening factor not above 1, level or threshold not in (0, 1).
    """
    if not step_size > 0:
        raise ValueError(f"step_size: got {step_size}, expected a positive number")
    if not widen_factor > 1:
        raise ValueError(f"widen_factor: got {widen_factor}, expected a number above 1")
    if not 0 < level < 1:
        raise ValueError(f"level: got {level}, expected a number between 0 and 1")
    if threshold is not None and not 0 < threshold < 1:
        raise ValueError(f"threshold: got {threshold}, expected a number between 0 and 1")
    values = {"step_size": step_size, "widen_factor": widen_factor, "level": level}
    values["threshold"] = jnp.nan if threshold is None else threshold
    return Knobs(**{name: jnp.asarray(value, jnp.float32) for name, value in values.items()})
