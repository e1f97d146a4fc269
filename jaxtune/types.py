"""Records that the parts of jaxtune, and the code built on it, pass to each other.

`Trajectory`, `Coords`, `ParamDist` and `Verdict` belong to the tuner. `Parameter` and `Effect` describe what the
discovery workflow may add to a model. `episodes`, which reads lists of them, is all of the package that this module
imports.

Two kinds of value have two names. A *parameter* is physical: a multiplier of the nominal model's value (0.8 of a mass)
or an offset (0.004 s of delay). A *coordinate* is the number that is searched in its stead: the logarithm of a
multiplier, so that halving and doubling are equally far, or an offset in units of order one. The tuner sees
coordinates alone.
"""

import enum
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import chex
import jax
import jax.numpy as jnp

from jaxtune.episodes import joined

Coords = Mapping[str, jax.Array]
"""Searched values by name: the logarithm of a multiplier, or a scaled offset. Arrays have one shape, often [episodes].

Physical values, by contrast, are called `params`.
"""


@chex.dataclass(frozen=True)
class Trajectory:
    """A set of episodes of equal length, simulated or measured.

    This is what a user's `simulate` and `measure` return, and all that the tuner ever sees of a robot. Simulated and
    measured episodes must come from the same policy, commands, resets and observation noise; otherwise their comparison
    measures those instead of the physics. An episode that ends early keeps its length: later steps are masked by
    `alive` and may hold anything, nan included. Units of observations, actions and scores are the user's. Leading
    dimensions may be stacked in front of `episodes`, such as [sets, episodes, time]. Episodes need at least as many
    steps as a window (`SPMConfig.window`, `DVMConfig.window`: 50 by default).
    """

    obs: jax.Array  # [episodes, time, obs], what the policy saw at the beginning of each step
    action: jax.Array  # [episodes, time, act], what it answered
    alive: jax.Array  # [episodes, time], True where the episode had not ended and the robot's state was finite
    score: jax.Array  # [episodes, time], reward of each step, zero where not alive
    fell: jax.Array  # [episodes], True where the episode ended early
    not_finite: jax.Array  # [episodes], True where it ended because the simulation broke
    # [episodes, time, ...] on every leaf: the robot's whole state at the beginning of each step, from which a simulator
    # can go on (`jaxtune.replay`); None where it is not known. Gate and update never read it.
    state: Any = None

    @classmethod
    def from_episodes(cls, episodes: Sequence[Mapping[str, Any]], *, steps: int | None = None) -> "Trajectory":
        """Makes a set of episodes from lists of any length, as a Gymnasium loop collects them.

        Args:
          episodes: mappings with `observation` [time, obs], `action` [time, act], `reward` [time] and `terminated`, for
            the episode or [time]. `truncated` is not read: an episode that was not terminated did not fall.
            Observations may have one entry more, the one after the last step, which is left out. With `state`, arrays
            [time, ...] by name, the robot's whole state at the beginning of each step, and maybe after the last.
          steps: length of the set; longer episodes are cut, shorter ones masked. That of the longest where None.

        Returns:
          NumPy arrays. An episode fell where it was terminated within `steps`. From a step on that is not finite it is
          masked, and counts as one that fell and broke.

        Raises:
          ValueError: there is no episode, one lacks a key or a step, or its lists or widths do not agree; or states
            are of some episodes alone.
        """
        return cls(**joined(episodes, steps))


@chex.dataclass(frozen=True)
class ParamDist:
    """A uniform distribution over named coordinates: what the tuner tunes.

    Every coordinate is drawn independently from

        U(max(centre - radius, lower), min(centre + radius, upper)).

    Policy, gate and search-parameter model are all trained on draws of it. An update moves `centre` and may narrow
    `radius`; widening multiplies `radius`; `lower` and `upper` are fixed physical bounds. All four fields map the same
    names to scalars in coordinates (log space for multipliers). This is the paper's Xi ~ U(mu, r), with a radius for
    every coordinate. Make one with `jaxtune.dist.make`, which checks it.
    """

    centre: dict
    radius: dict
    lower: dict
    upper: dict


class Verdict(enum.IntEnum):
    """What the gate concludes about a measured set.

    `WIDEN` keeps the tuning going; the others end it. Only `ACCEPT` is followed by an update. `Info.verdicts` holds
    the verdicts of one tuning in order, with -1 for gate calls that were not made.
    """

    ACCEPT = 0
    """The simulated episodes cover the measured ones, so an update can be trusted."""
    WIDEN = 1
    """The simulated episodes do not cover the measured ones, but a wider distribution may."""
    UNEXPLAINED = 2
    """No parameters explain the measured set, tested at 1 %. The model lacks physics: use discovery."""
    RADIUS_EXHAUSTED = 3
    """The measured set is not covered, and the distribution fills its bounds or was widened as often as allowed."""
    NOT_FINITE = 4
    """No score could be computed: a number was not finite, or no simulated observation ever changed."""
    NOT_COMPARABLE = 5
    """There is too little to compare: no measured episode holds a whole window or moves, two are copies, simulated ones
    show no coordinate or too few of their sets have a window, or what never changes in them has another value."""


Scale = Literal[
    "one",
    "torque",
    "damping",
    "quadratic",
    "stiffness",
    "spring",
    "hardening",
    "inertia",
    "mass",
    "drag",
    "air",
    "speed",
    "slow",
    "angle",
    "motor",
    "of_before",
    "of_after",
]
"""Quantity that one unit of a discovery coordinate stands for.

Except for `one`, its size depends on the robot and on how it moved in the log; `envs.scales` measures it. Per joint:
`torque` is the rms torque (Nm), `speed` the rms speed (rad/s), `slow` a tenth of it, `damping` torque / speed,
`quadratic` torque / speed^2, `angle` 1 rad of a hinge or 0.05 m of a slide, `stiffness` torque / (0.02 angle),
`spring` torque / rms angle, `hardening` 1 / (0.02 angle)^2, `motor` the largest torque limit / speed, `of_before`
and `of_after` torque / that of the joint before and after, `inertia` the diagonal of the joint-space
inertia (kg m^2). Per body: `mass` (kg), the body's or, where that is more, a twentieth of all links', `drag`, a drag of
the centre of mass that takes the rms torque of a joint (N s/m), and `air`, drag / speed.
"""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One number of an effect, with the rule that turns its coordinate into a physical value.

    Discovery fits coordinates, since they are of order one for every effect and zero where an effect is absent. A place
    is where the effect sits, such as one joint. For a coordinate c at a place of scale s (see `Scale`):

        form                `inner`: the physics reads    `value`: a report prints
        added               c s                           c s
        ratio               c                             exp(c)
        ratio, `shape`      exp(c) s                      exp(c) s
        reciprocal          c / s                         s / c

    The three methods also take arrays, and broadcast coordinate against scale.
    """

    name: str
    """Ends in its unit, unless it is a ratio."""
    bounds: tuple[float, float]
    """Smallest and largest coordinate."""
    form: Literal["added", "ratio", "reciprocal"] = "added"
    """What the coordinate is: an addition to the nominal model, the logarithm of a ratio to it, or the reciprocal of a
    limit or stiffness that the nominal model does not have (infinite there, so its reciprocal is zero)."""
    scale: Scale = "one"
    """What one unit of the coordinate stands for."""
    prior: float = 1.0
    """Coordinate up to which, before a log is seen, all are about as likely (`jaxtune.discovery.least_squares`)."""
    shape: bool = False
    """True for a parameter that only shapes its effect, such as the speed at which friction falls off. It has no
    influence while the effect's other parameters are zero, and its coordinate starts at zero like theirs."""
    fields: tuple[str | tuple[str, int], ...] = ()
    """Fields of the MuJoCo model that it changes, if any: a name for all columns, or (name, column) for one."""

    def inner(self, coordinate, scale):
        """Converts a coordinate at a place of this scale into the number that the physics reads.

        That number is zero where the effect is absent (except for a `shape`), so limits and stiffnesses enter as
        reciprocals and ratios as logarithms.
        """
        if self.form == "reciprocal":
            return coordinate / scale
        if self.form == "ratio":
            return jnp.exp(coordinate) * scale if self.shape else coordinate
        return coordinate * scale

    def value(self, coordinate, scale):
        """Converts a coordinate into the physical value that a report shows, in the unit that `name` ends in.

        A limit or a stiffness is infinite where its coordinate is zero.
        """
        inner = self.inner(coordinate, scale)
        if self.form == "reciprocal":
            return 1.0 / inner
        return jnp.exp(inner) if self.form == "ratio" and not self.shape else inner

    def coordinate(self, value: float, scale: float) -> float:
        """Converts a physical value back into its coordinate; the inverse of `value`.

        It is for values that are read from files, so it takes plain numbers.
        """
        if self.form == "reciprocal":
            return scale / value
        if self.form == "ratio":
            return math.log(value / scale if self.shape else value)
        return value / scale


@dataclass(frozen=True)
class Form:
    """Another form of an effect: parameters more, usually one, which are tried only beside the effect."""

    name: str
    effect: str
    """Row that has the parameters: the effect itself, or another one that acts beside it at the same places."""
    parameters: tuple[str, ...] = ()
    """Empty for all parameters of that row."""
    screened: bool = False
    """True where the effect may show in this form alone: it is screened with the form's smallest size too."""
    alone: bool = False
    """True where the effect may be all in this form, with nothing of what it is without it."""
    beside: str = ""
    """Another form of the effect, without which this one may not show: both are screened together too."""
    like: str = ""
    """Row, of as many parameters, that a small effect in this form is taken for: where that one leads, this is fitted
    too."""
    far: bool = False
    """True where with much of it the effect itself is little, or, where it is far below zero, more than without it. A
    fit from what the effect is alone may not come there, so others begin there."""


@dataclass(frozen=True, kw_only=True)
class Effect:
    """A physical effect that a model may lack, such as friction, delay or play: one row of the discovery library.

    An effect either changes the model (`enters="model"`) or acts on a signal on its way between controller and joint.
    Of the first kind the parameters name the model's fields, to which they add or which they multiply. Where that does
    not describe it, there is

        act(values, model, places) -> model

    with the ids of its bodies, or of the degrees of freedom of its joints. Of the second kind there is always

        act(values, signal, now, memory) -> (signal, memory)

    transforms the signal of the stage that it enters, at every step. `values` maps parameter names to what
    `Parameter.inner` gives, [places] each; `now` holds the joints' state at this step; `memory` is what the effect kept
    from the step before, None where it has no `start`.
    """

    name: str
    family: str
    """Group of related effects, such as those of the actuator."""
    enters: Literal[
        "model",
        "command",
        "error",
        "speed",
        "back_emf",
        "torque",
        "transmission",
        "encoder",
        "log",
        "friction",
        "bristle",
        "wrench",
        "sensor",
        "torque_reading",
        "gravity",
    ]
    """Stage at which it acts: the model, or a signal from the commanded target to the sensor."""
    on: Literal["joint", "body", "foot", "robot"]
    """Kind of place that has values of its own."""
    parameters: tuple[Parameter, ...]
    sizes: tuple[float, ...]
    """Coordinates at which discovery first simulates the effect, the smallest size of interest first. An effect whose
    derivative at zero does not exist (a delay, a deadband) lists larger ones too, for secants."""
    sentence: str
    """What happens in the robot, for a report."""
    excited_by: str
    """Experiment in which the effect shows and is distinguishable from similar ones."""
    act: Callable[..., Any] | None = None
    """Transforms the stage's signal, or the model; None for an effect whose parameters name the model's fields."""
    start: Callable[..., Any] | None = None
    """`start(values, signal, dt) -> memory`: the memory after what the robot did before, which the stage's signal tells
    (`envs.chain.Chain.start`). None where the effect has no memory."""
    undo: Callable[..., Any] | None = None
    """For a sensor effect, `undo(values, readings, dt) -> truth`: recovers the true motion from what was recorded,
    [time, 4, joints]: positions, velocities, and slopes with less noise (`envs.segments.Segment.measured`)."""
    forms: tuple[Form, ...] = ()
    """Other forms that it may have."""
    differs: bool = False
    """True where robots often have it at all joints, in another size at each: no two gears rub alike. What would stand
    for any misfit of a joint, such as a scale of its torque, is better left out."""
    needs: Literal["", "free", "gravity"] = ""
    """What the log must offer: a robot with a free base, or a recorded gravity vector."""
