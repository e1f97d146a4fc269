"""What the parts of jaxtune, and everything built on it, hand to each other."""

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import chex
import jax
import jax.numpy as jnp

Coords = Mapping[str, jax.Array]
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


Scale = Literal["one", "torque", "damping", "stiffness", "inertia", "mass", "drag", "speed", "slow", "motor"]
"""What one unit of a coordinate stands for, where that depends on the robot and on how it was moved."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A number that an effect has, searched in a coordinate that is zero where the effect is not there."""

    name: str
    """Ends in its unit, unless it is a ratio."""
    bounds: tuple[float, float]
    """Least and largest coordinate."""
    form: Literal["added", "ratio", "reciprocal"] = "added"
    """What the coordinate is: what is added to the nominal model, the logarithm of a ratio, or the reciprocal of a
    limit or a stiffness that the nominal model has not."""
    scale: Scale = "one"
    prior: float = 1.0
    """Standard deviation of the coordinate, before anything was measured."""
    shape: bool = False
    """Means nothing where the other parameters are zero; its coordinate starts at zero all the same."""
    fields: tuple[str, ...] = ()
    """Fields of the model that it enters, where it is one of the model's."""
    column: int | None = None
    """Which column of them; every one where None."""

    def inner(self, coordinate, scale):
        """What the physics reads of a coordinate at places of this scale; zero where the effect is not there."""
        if self.form == "reciprocal":
            return coordinate / scale
        if self.form == "ratio":
            return jnp.exp(coordinate) * scale if self.shape else coordinate
        return coordinate * scale

    def value(self, coordinate, scale):
        """Physical value, in the unit of the name; infinite where there is no limit."""
        inner = self.inner(coordinate, scale)
        if self.form == "reciprocal":
            return 1.0 / inner
        return jnp.exp(inner) if self.form == "ratio" and not self.shape else inner

    def coordinate(self, value: float, scale: float) -> float:
        """The inverse of `value`."""
        if self.form == "reciprocal":
            return scale / value
        if self.form == "ratio":
            return math.log(value / scale if self.shape else value)
        return value / scale


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Something that a model may lack: one row of the library.

    `act(values, signal, now, memory) -> (signal, memory)` is what it does to the signal of the stage that it enters,
    `values` its parameters by name, [places] each. An effect of the model has none: its parameters name the fields.
    """

    name: str
    family: str
    enters: Literal["model", "command", "error", "torque", "transmission", "friction", "wrench", "sensor", "gravity"]
    on: Literal["joint", "body", "foot", "robot"]
    parameters: tuple[Parameter, ...]
    sizes: tuple[float, ...]
    """Coordinates at which it is looked for, the smallest size of interest first; effects without a derivative at zero
    have larger ones beside it."""
    sentence: str
    """What a person should picture."""
    excited_by: str
    """The experiment that shows it, and tells it from its like."""
    act: Callable[..., Any] | None = None
    start: Callable[..., Any] | None = None
    """`start(values, signal, dt) -> memory` of a robot that has been like this for ever, where it remembers."""
    undo: Callable[..., Any] | None = None
    """Of a sensor: `undo(values, readings, dt) -> truth`, [time, 2, joints] of positions and velocities."""
    needs: Literal["", "free", "gravity"] = ""
    """A free base, or a signal that must have been recorded."""
