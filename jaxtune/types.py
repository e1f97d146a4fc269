"""What the parts of jaxtune, and everything built on it, hand to each other."""

import enum
from collections.abc import Mapping

import chex
import jax

Named = Mapping[str, jax.Array]
"""Parameters by name, in the coordinates that are searched (the logarithm of a multiplier, say)."""


@chex.dataclass(frozen=True)
class Trajectory:
    """Episodes of equal length, simulated or measured; what follows an early end is masked, not cut.

    Leading dimensions may be stacked in front of `episodes`.
    """

    obs: jax.Array  # [episodes, time, obs]
    action: jax.Array  # [episodes, time, act]
    alive: jax.Array  # [episodes, time], True where the step began in a living, finite robot
    score: jax.Array  # [episodes, time], reward of each step, zero where not alive
    fell: jax.Array  # [episodes], True where the episode ended early
    not_finite: jax.Array  # [episodes], True where it ended because the simulation broke


@chex.dataclass(frozen=True)
class ParamDist:
    """A uniform distribution over named parameters, `U(centre - radius, centre + radius)` cut to the bounds.

    Every field maps the same names to scalars in search coordinates. The paper's Xi ~ U(mu, r).
    """

    centre: dict
    radius: dict
    lower: dict
    upper: dict


class Verdict(enum.IntEnum):
    """What the gate says of a measured set."""

    ACCEPT = 0
    """The simulated episodes cover the measured ones."""
    WIDEN = 1
    """They do not; a wider distribution may."""
    UNEXPLAINED = 2
    """They do not, and widening did not bring them closer: physics is missing."""
    RADIUS_EXHAUSTED = 3
    """They do not, and the distribution has reached its bounds or its last permitted widening."""
    NOT_FINITE = 4
    """No score could be computed: no usable window, or a number that is not finite."""
