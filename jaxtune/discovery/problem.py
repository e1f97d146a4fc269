"""What a discovery is asked: a simulator, hypotheses about what it lacks, and measured segments.

Nothing here knows a robot. The simulator is a function of a vector of coordinates, which is zero for the nominal model,
and of a segment of a log. A hypothesis is a handful of directions in the space of that vector.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

Simulate = Callable[[Any, jax.Array, Any, jax.Array], Mapping[str, jax.Array]]
"""`simulate(system, values [axes], inputs, steps) -> {signal: [rows, components]}`, for one segment.

It must be hashable: programs are compiled once, and simulators that are equal share them. The `system` is an argument,
so robots that differ in numbers alone, such as masses, share programs as well. The number of `steps` is one too, and
inputs are padded to the longest segment; rows after the last step may hold anything.
"""


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """One effect at one or several places, with the same size at each of them or (`each`) one of its own.

    A hypothesis has a coordinate for each parameter of the effect. With coordinates `c`, the model that has the effect
    is the nominal vector plus `c @ directions`. Discovery screens, fits and compares hypotheses, and an accepted one is
    what its answer names.
    """

    name: str
    family: str
    """Group of related effects, such as joint friction; the shortlist keeps the best hypothesis of every family."""
    places: tuple[str, ...]
    """Joints or bodies that have the effect."""
    directions: np.ndarray
    """[parameters, axes]: how far each axis moves per unit of each coordinate. It is one at the first place; at the
    others it converts between the scales of the places, so that the physical size is the same everywhere."""
    probes: np.ndarray
    """[probes, parameters]: coordinates at which the screen simulates it, the smallest of interest among them. An
    effect with several sizes, such as x, y and z, has a probe for each of them alone."""
    bounds: np.ndarray
    """[parameters, 2]: least and largest coordinate."""
    spent: bool = False
    """True where the least coordinates take away nearly all that the nominal model has of it, such as its damping."""
    prior: np.ndarray
    """[parameters]: coordinates up to which all sizes are about as likely before anything was measured."""
    joints: tuple[int, ...]
    """Joints that it acts at: its places, or for a link the joint that moves it; empty where it acts at none alone."""
    form: str = ""
    """Empty for an effect. Else the hypothesis is that the effect of this name, at the same places, has this form: it
    frees further parameters, is tried only beside the effect, and is no name of its own."""
    screened: bool = False
    """True for a form without which its effect may not be seen: the screen tries both together as well."""
    alone: bool = False
    """Of a form: whether an effect may be all in it."""
    beside: str = ""
    """Of a form: another form of the effect, which the screen tries together with both as well."""
    like: str = ""
    """Of a form: name of the effect that a small one in this form is taken for."""
    far: bool = False
    """Of a form: much of it makes the effect itself little, or more where it is below zero, so fits begin there too."""
    each: bool = False
    """True where every place has a size of its own: `directions` has a row for each, `joints` one joint."""

    @property
    def key(self) -> str:
        """Name and places as one word, such as `coulomb@elbow`; it identifies the hypothesis in messages and files.

        A form's is such as `coulomb(presliding)@elbow`, and one with a size for each place `coulomb@shoulder&elbow`.
        """
        return f"{self.name}{f'({self.form})' if self.form else ''}@{('&' if self.each else '+').join(self.places)}"

    @property
    def further(self) -> float:
        """How many prices of an effect its sizes beyond the first cost: half of one each."""
        return 0.5 * (len(self.places) - 1) if self.each else 0.0

    @property
    def worth(self) -> float:
        """How many prices of an effect it costs: one, or half of one for a form, and its further sizes."""
        return (0.5 if self.form else 1.0) + self.further

    def shapes(self, other: "Hypothesis") -> bool:
        """Says whether this is a form of another hypothesis."""
        return bool(self.form) and not other.form and (self.name, self.places) == (other.name, other.places)


def are_distinct(one: Hypothesis, two: Hypothesis) -> bool:
    """Says whether two hypotheses may stand side by side: no axis is moved by both."""
    return not ((one.directions != 0).any(axis=0) & (two.directions != 0).any(axis=0)).any()


def acts_within(one: Hypothesis, other: Hypothesis) -> bool:
    """Says whether a hypothesis acts at some joints, and at no others than another one."""
    return bool(one.joints) and set(one.joints) <= set(other.joints)


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Pieces of measured runs, all of one length, each simulated from its own first state.

    Short segments keep a simulation close to the measured motion, so that an error of the model shows as a small
    residual instead of a diverging rollout. The segments of a run follow on each other.
    """

    inputs: Any
    """[segments, ...] on every leaf: what the simulator is given (first state, targets, ...)."""
    signals: Mapping[str, np.ndarray]
    """[segments, rows, components] by name: what was measured."""
    steps: int
    """Steps of the simulation to the last row."""
    run: np.ndarray
    """[segments]: index of the run that the segment was cut from."""
    regimes: np.ndarray
    """[segments, rows, joints]: index of the regime that each joint is in."""
    repeats: np.ndarray | None = None
    """[segments]: the same number for segments in which several runs were told the same and began alike, -1 for all
    others; None where that is not known."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A question to discovery: the nominal model, what it may lack, and the logs that shall decide.

    Data are split by runs: `train` is fitted, `select` (validation) decides, and `sealed` (held-out test) is simulated
    once, for the proof.
    """

    simulate: Simulate
    system: Any
    """Numbers of the nominal robot, the first argument of `simulate`."""
    axes: int
    """Length of the vector of coordinates."""
    hypotheses: Sequence[Hypothesis]
    prior: np.ndarray
    """[axes]: standard deviation of the nominal parameters, which are free under every hypothesis; zero elsewhere."""
    unknowns: np.ndarray
    """[directions, axes]: one standard deviation along other unknowns that are free from the start: the delay with
    which the controller reads its sensors and applies its commands, that of velocities beside positions, how far
    positions lead both and torques, how targets go on between rows, where centres of mass are, how far dry friction
    creeps, the travel over which it sets in, and the scale of recorded torques."""
    unknown_bounds: np.ndarray
    """[directions, 2]: least and largest coordinate along each."""
    data: Mapping[str, Mapping[float, Segments]]
    """Measured segments by split and horizon (their length in s)."""
    null_logs: Sequence[Mapping[str, Mapping[float, Segments]]]
    """Segments, by split and horizon, of simulated logs of a robot that lacks nothing: the nominal model in another
    engine, with masses, centres of mass, armatures, dampings and frictions drawn from the prior, and with the noise of
    the measured log."""
    bin_rows: int
    """Rows of a signal whose residuals are averaged to one bin."""
    regimes: tuple[str, ...]
    """Names of the regimes."""
    components: Mapping[str, tuple[str, ...]]
    """Names of the components of every signal, such as the joints."""
    trees: np.ndarray
    """[joints]: number of the kinematic tree that each joint is in; joints of different trees do not move each
    other."""
    axis_trees: np.ndarray
    """[axes]: number of the tree whose joints an axis moves; -1 where it may move several."""
    values: Callable[[np.ndarray], np.ndarray] = lambda vectors: vectors
    """Turns coordinates [n, axes] into what the simulator is given, [n, axes]."""
    least_floor: np.ndarray = field(default_factory=lambda: np.zeros(()))
    """[cells]: what noise and rounding leave in the mean of a bin; the noise floor is never below it."""
    push: Mapping[str, int] = field(default_factory=dict)
    """Axis of a constant torque by joint, with which `localise` asks where a torque is missing; empty to skip that."""
    forms: Sequence[Hypothesis] = ()
    """Forms that effects may have, at all places of `hypotheses`."""
    residual: Hypothesis | None = None
    """A learned torque at all joints that names nothing; it bounds what is explainable, and is the fallback."""
    residual_parts: Sequence[Hashable] = ()
    """[parameters of `residual`]: the part of it to which each belongs, such as what depends on one joint's speed."""
    whole_runs: Callable[[np.ndarray], np.ndarray] | None = None
    """Mean absolute errors [vectors] with which coordinates [vectors, axes] predict whole runs of `train` and `select`,
    without correction by measured states in between; None where models are compared by segments alone."""

    @property
    def horizons(self) -> tuple[float, ...]:
        """Lengths of the segments in s, rising; the same for all splits."""
        return tuple(sorted(self.data["train"]))

    @property
    def main_horizon(self) -> float:
        """The middle horizon in s: hypotheses are screened, fitted and tested there; the others have to confirm."""
        return self.horizons[len(self.horizons) // 2]

    @property
    def cells(self) -> list[tuple[str, str]]:
        """Signal and component (such as a joint) of every column of the residuals, in the columns' order."""
        return [(signal, part) for signal in sorted(self.components) for part in self.components[signal]]

    @property
    def cell_trees(self) -> np.ndarray:
        """[cells] number of the tree of every column of the residuals; -1 for one that belongs to no joint."""
        joints = self.components["q"]
        return np.array([self.trees[joints.index(part)] if part in joints else -1 for _, part in self.cells])

    def is_nominal(self, hypothesis: Hypothesis) -> bool:
        """Says whether a hypothesis is about parameters that the nominal model has, for instance a link's mass."""
        return bool((self.prior[(hypothesis.directions != 0).any(axis=0)] > 0).all())

    def is_change(self, effect: Hypothesis, forms: Sequence[Hypothesis]) -> bool:
        """Says whether an effect in some forms is reported as a parameter change and not as missing.

        It is about parameters that the nominal model has, and forms are about such or what is free in every model.
        """
        free = (self.unknowns != 0).any(axis=0) | (self.prior > 0)
        return self.is_nominal(effect) and all(free[(one.directions != 0).any(axis=0)].all() for one in forms)
