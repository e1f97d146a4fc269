"""How much a discovery tries, and what it finds."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much a discovery tries, and how much evidence it asks for.

    More hypotheses on the shortlist cost time; the other numbers trade missed effects against invented ones.
    """

    shortlist: int = 12
    """Hypotheses that are fitted, beside the best of each family."""
    firsts: int = 12
    """How many of the best hypotheses are screened with every other one as a pair."""
    again: int = 24
    """How many of the best hypotheses are screened again beside a model that has effects."""
    pairs: int = 8
    """How many of the best pairs are fitted."""
    shaped: int = 4
    """How many of the best hypotheses, by the screen and again by their fits, are fitted in all their forms as well."""
    swaps: int = 4
    """How many hypotheses are fitted in the place of an effect."""
    finalists: int = 4
    """How many of those with one effect are fitted on with fresh slopes, and half as many pairs."""
    most: int = 6
    """Largest number of effects that are accepted."""
    level: float = 0.05
    """Probability of naming something where nothing is missing, which the thresholds allow."""
    share: float = 0.7
    """Share of the explainable gap, and of the explainable cost, that an accepted effect must explain; with less the
    verdict is `unnamed`. Several may leave together what one may leave, divided by their number."""
    share_near: float = 0.5
    """That share where at most `near` floor units are left. No form of the library is exactly the robot's, and what it
    leaves weighs more in a small gap."""
    near: float = 3.0
    """Gap in floor units that is small."""
    least: float = 0.3
    """The same share of the whole gap above the floor: a learned torque cannot explain everything either."""
    strained: int = 2
    """Nominal parameters at the end of their belief from which on a model that leaves `much` explains nothing: they
    imitate what the library lacks."""
    much: float = 5.0
    """Gap in floor units that is much."""
    at_floor: float = 1.5
    """Gap in floor units that counts as none. No further effect is looked for once every signal is below it."""
    promising: float = 0.3
    """Share of the price of an effect that the screen must see in a hypothesis before it is fitted."""
    same: float = 0.6
    """Share of what an effect explains from which on another name in its place may as well be right, since effects have
    more functional forms than the one in the library."""
    possible: float = 0.05
    """Probability from which on another name may as well be right."""
    as_likely: float = 0.1
    """Share of the best model's probability from which on another one is believed about as much."""
    share_whole: float = 0.7
    """Share of the best model's error on whole runs of `train` and `select` below which it gives way to another."""
    inexact: float = 0.08
    """Standard deviation, as a share, by which the form of the library may shift the parameters of an effect. Intervals
    hold it beside the noise."""
    own: float = 0.5
    """Share of the evidence for a stronger effect at the same joints from which on an effect is a name of its own. With
    less it may make up for the form of that one."""
    rivals: int = 3
    """Largest number of names that are reported beside one."""
    rounds: int = 4
    """Rounds of a fit."""


DEFAULTS = Settings()


@dataclass(frozen=True)
class AcceptedTerm:
    """An effect of the model that is reported, with the evidence that let it pass."""

    hypothesis: Any
    """A `problem.Hypothesis`."""
    evidence: Any
    """A `evidence.Evidence`."""
    thresholds: Any
    """The `evidence.Thresholds` that it passed."""
    confusable_with: tuple[str, ...] = ()
    """Names of other effects that these logs cannot distinguish from it, or that explain most of what it does."""
    forms: tuple[Any, ...] = ()
    """Each a `problem.Hypothesis` about its form; none where its first form is as good."""
    clear: tuple[str, ...] | None = None
    """Of an effect with a size for each place, those where it is clear of zero; None for any other effect."""
    refines: str | None = None
    """Key of a stronger effect at the same joints that it may only refine; None for an effect that is named."""


@dataclass(frozen=True)
class DroppedTerm:
    """An effect of the cheapest model that did not pass, and so is not in the model that is reported."""

    hypothesis: Any
    """A `problem.Hypothesis`."""
    evidence: Any
    """A `evidence.Evidence`."""
    failed: tuple[str, ...]
    """The tests of `evidence.passes` that it failed."""


@dataclass(frozen=True)
class Change:
    """A nominal parameter that went as far as it may."""

    deviations: float
    """How far that is, in prior standard deviations."""
    confusable_with: tuple[str, ...] = ()
    """Names of effects that explain most of what it does, where it keeps its nominal value."""


@dataclass(frozen=True)
class Suspect:
    """An effect that may be part of the truth."""

    hypothesis: Any
    """A `problem.Hypothesis`."""
    forms: tuple[Any, ...]
    """Its forms in the most likely model that has it, as in `AcceptedTerm`."""
    probability: float


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a discovery found, for reports."""

    verdict: str
    """`named` (an effect is missing), `parameter_change` (nominal parameters alone are off), `no_missing_effect` (the
    model is at the floor) or `unnamed` (something is missing that no hypothesis explains)."""
    terms: tuple[AcceptedTerm, ...]
    fit: Any
    """The `fit.Fit` with all accepted effects, at the main horizon."""
    errors: np.ndarray
    """[coordinates] standard errors of `fit`: of its effects by noise and `Settings.inexact`, of others by noise."""
    null: Any
    """The `fit.Fit` with none, its nominal parameters fitted."""
    proposed: np.ndarray
    """[axes]: the model that was chosen on `select`, and what `gap` calls `after`."""
    model: np.ndarray
    """[axes]: the corrected model, as the simulator is given it: `proposed`, unless that was withdrawn."""
    model_is: str
    """What `model` is: `nominal`, `null`, `effects`, or `learned` (effects and a learned torque)."""
    suspects: tuple[Suspect, ...]
    """Effects that may be part of the truth, most likely first, whatever the verdict."""
    families: Mapping[tuple[str, tuple[str, ...]], float]
    """The probability that an effect of a family is at some places, by family and places, most likely first."""
    rivals: tuple[tuple[str, np.ndarray], ...]
    """Keys of the two sets of effects that are most believed, and vectors [axes] of their best models. Fewer where
    others have a probability below 0.01."""
    explained_share: float
    """Share that the reported effects explain on `train` and `select`, of what they and a learned torque explain
    together: of the gap or of the cost, whichever is smaller. The gap is that of all segments but a few or of typical
    ones, whichever speaks for the effects."""
    explainable_share: float
    """Share of the null's gaps on `train` and `select` that the effects and a learned torque explain together. The rest
    is no torque of the joints' motion, or differs from run to run."""
    learned_parts: Mapping[Hashable, float]
    """The share of what the learned torque explains that is lost without each of its parts (`Problem.residual_parts`),
    all else fitted anew; the largest first."""
    withdrawn: bool
    """True if `proposed` was worse on `sealed` than the better of the nominal model and the null; then `model` is that
    one."""
    where: tuple[Mapping[str, Any], ...]
    """Cells above the floor before anything was accepted, largest first; see `localise.cells`."""
    needs_torque: Mapping[str, float]
    """How much every joint needs a torque of its own beside the last model that was looked at."""
    not_testable: tuple[str, ...]
    """Names of effects that these logs could not show. They are not absent: other motions could show them."""
    not_finite: tuple[str, ...]
    """Keys of models that broke the simulation."""
    dropped: tuple[DroppedTerm, ...]
    """Effects of the cheapest model that did not pass, in the order in which they were taken out."""
    changed: Mapping[int, Change]
    """Nominal axes that went as far as they may."""
    gap: Mapping[str, float]
    """Rms of the worst position on the sealed segments, in floor units: `before`, `null` and `after`."""
    proof: Mapping[str, Any]
    """`cells` (rms of every component), `no_cell_worse` (no component is more than a floor unit above the null's), and
    `others`: the gap of ablations and placebos."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """Models that were compared, by key: cost, probability."""
