"""The state of a discovery between two steps, and how it is saved.

A step never changes a state: it returns another one. What is saved is enough to go on from the last accepted effect
with the results of a run that was never interrupted.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from jaxtune.discovery.decide import Evidence, Thresholds
from jaxtune.discovery.evaluate import fit_null
from jaxtune.discovery.fit import Fit, Free, fit_at
from jaxtune.discovery.noise_floor import Calibration, Floor, NoiseFloor
from jaxtune.discovery.problem import Hypothesis, Problem

Columns = Mapping[tuple[int, float], np.ndarray]
"""Secants [features] of the residuals by (axis, size), per unit of the coordinate."""


@dataclass(frozen=True)
class AcceptedTerm:
    """An effect that forward selection added to the model, with the evidence that let it pass."""

    hypothesis: Hypothesis
    evidence: Evidence
    thresholds: Thresholds
    confusable_with: tuple[str, ...]
    """Names of other effects that these logs cannot distinguish from it, or that explain nearly as much."""


@dataclass(frozen=True, kw_only=True)
class State:
    """What a discovery knows after a step; the next step needs nothing else.

    The first group of fields is the model, the second what the first look at the logs settled for all later rounds,
    the third what the rounds reported.
    """

    fits: Mapping[float, Fit]
    """The model with all accepted effects, by horizon. At first there is the main horizon alone."""
    null: Fit
    """The model with none, at the main horizon."""
    terms: tuple[AcceptedTerm, ...] = ()
    """Accepted effects in their order."""
    columns: Columns | None = None
    """The screen's secants where the model stands; None where it has moved since."""
    finished: bool = False
    """True where no further step is to be taken."""

    least_gain: float = 0.0
    """Gain (fall of the loss, `screen.Score.gain`) that the best hypothesis exceeds on null logs with probability
    `Settings.level`; zero before it is known."""
    penalty: float = 0.0
    """Smallest weight of the group lasso (`localise.free_torque`) at which no joint of a null log gets a torque; zero
    before it is known."""
    promise: Mapping[str, float] = field(default_factory=dict)
    """The screen's gain of every hypothesis, by key, before anything was accepted; empty before the first screen."""
    not_testable: tuple[str, ...] = ()
    """Names of effects that these logs could not show at the smallest size of interest."""
    where: tuple[Mapping[str, Any], ...] = ()
    """Cells above the floor before anything was accepted; see `localise.cells`."""

    needs_torque: Mapping[str, float] = field(default_factory=dict)
    """Norm over all segments of the torque that `localise.free_torque` gives every joint beside the model as it stands,
    in floor units; zero where the joint needs none."""
    not_finite: tuple[str, ...] = ()
    """Keys of hypotheses that broke the simulation."""
    dropped: tuple[str, ...] = ()
    """Keys of hypotheses that were accepted and no longer paid beside later ones."""
    rejected: Mapping[str, Any] = field(default_factory=dict)
    """The best hypothesis that was not accepted last: `hypothesis`, `tests`, `evidence`."""

    @property
    def screened(self) -> bool:
        """True once the library was screened: the second group of fields is settled, and the first look was taken."""
        return bool(self.promise)

    def with_model(self, fits: Mapping[float, Fit], **changes: Any) -> "State":
        """Replaces the model and other fields, and forgets the screen's secants, which are the old model's."""
        return replace(self, fits=fits, columns=None, **changes)


def begin(problem: Problem, floor: NoiseFloor, calibration: Calibration | None) -> State:
    """Makes the first state: the null is fitted, and nothing was accepted yet.

    Args:
      problem: names the main horizon.
      floor: the noise floor.
      calibration: thresholds that are known already.

    Raises:
      ValueError: the nominal model cannot be simulated on these logs.
    """
    null = fit_null(floor[problem.main_horizon])
    state = State(fits={problem.main_horizon: null}, null=null)
    if calibration is None:
        return state
    return replace(state, least_gain=calibration.gain, penalty=calibration.penalty)


def to_json(problem: Problem, state: State) -> dict[str, Any]:
    """Turns a state into numbers, texts, lists and dictionaries of them.

    Of fits only the coordinates are kept: their residuals and slopes are found by simulating again.
    """
    # The keys are those of files that were written before; they stay.
    return {
        "rungs": [
            {
                "key": term.hypothesis.key,
                "evidence": asdict(term.evidence),
                "thresholds": asdict(term.thresholds),
                "alike": list(term.confusable_with),
            }
            for term in state.terms
        ],
        "fits": [_fit_to_json(state.fits[horizon]) for horizon in problem.horizons],
        "null": _fit_to_json(state.null),
        "where": list(state.where),
        "needs_torque": dict(state.needs_torque),
        "promise": dict(state.promise),
        "not_testable": list(state.not_testable),
        "not_finite": list(state.not_finite),
        "dropped": list(state.dropped),
        "healthy_gain": state.least_gain,
        "penalty": state.penalty,
    }


def from_json(problem: Problem, floor: NoiseFloor, saved: Mapping[str, Any]) -> State:
    """Restores the state that `to_json` turned into `saved`, for the same problem and noise floor."""
    by_key = {hypothesis.key: hypothesis for hypothesis in problem.hypotheses}
    terms = tuple(_term_from_json(by_key, term) for term in saved["rungs"])
    fits = zip(problem.horizons, saved["fits"], strict=True)
    return State(
        fits={horizon: _fit_from_json(floor[horizon], fit) for horizon, fit in fits},
        null=_fit_from_json(floor[problem.main_horizon], saved["null"]),
        terms=terms,
        least_gain=saved["healthy_gain"],
        penalty=saved["penalty"],
        promise=saved["promise"],
        not_testable=tuple(saved["not_testable"]),
        where=tuple(saved["where"]),
        needs_torque=saved["needs_torque"],
        not_finite=tuple(saved["not_finite"]),
        dropped=tuple(saved["dropped"]),
    )


def _fit_to_json(fit: Fit) -> dict[str, Any]:
    names = ("directions", "sd", "bounds", "nominal")
    free = {name: part.tolist() for name, part in zip(names, fit.free.parts(), strict=True)}
    return {"free": free, "coordinates": fit.coordinates.tolist()}


def _fit_from_json(at: Floor, saved: Mapping[str, Any]) -> Fit:
    free = Free(**{name: np.array(values) for name, values in saved["free"].items()})
    return fit_at(free, np.array(saved["coordinates"]), at.weight, at.residuals["train"])


def _term_from_json(by_key: Mapping[str, Hypothesis], saved: Mapping[str, Any]) -> AcceptedTerm:
    # JSON has no tuples.
    evidence = Evidence(**{**saved["evidence"], "interval": tuple(saved["evidence"]["interval"])})
    return AcceptedTerm(by_key[saved["key"]], evidence, Thresholds(**saved["thresholds"]), tuple(saved["alike"]))
