"""The verdict, from open segments, and the proof, on sealed ones (steps 9 and 10)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxtune.discovery.compete import Start, fit_beside
from jaxtune.discovery.evaluate import ablate, position_gap, rms
from jaxtune.discovery.fit import Fit
from jaxtune.discovery.noise_floor import Floor, NoiseFloor, Say
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.resample import standard_errors
from jaxtune.discovery.result import Result, Settings
from jaxtune.discovery.screen import looks_like, secant_columns
from jaxtune.discovery.state import State

_PERFECT = 1.0  # floor units


@dataclass(frozen=True)
class Conclusion:
    """The verdict and what it stands on, before any sealed segment was looked at; the fields are those of `Result`."""

    verdict: str
    errors: np.ndarray
    changed: Mapping[int, float]
    changed_alike: Mapping[int, tuple[str, ...]]
    residual: Fit | None


def conclude(settings: Settings, problem: Problem, floor: NoiseFloor, state: State, say: Say) -> Conclusion:
    """Reaches the verdict from `train` and `select` together.

    From `select` alone it would depend on how the floor of a few postures compares with that of all. Where the model
    does not explain the logs, no parameter is called changed: parameters of a wrong model mean nothing.

    Args:
      settings: what counts as explained and as changed.
      problem: the hypotheses, and the torque that stands in where none fits.
      floor: the noise floor.
      state: after the last step, fitted at the main horizon.
      say: receives a line of text about progress.
    """
    at, fit = floor[problem.main_horizon], state.fits[problem.main_horizon]
    errors = standard_errors(fit, problem.data["train"][at.horizon].run)
    null, after = (position_gap(problem, rms(at, one.vector[None])[0]) for one in (state.null, fit))
    if not _explains(settings, bool(state.terms), null, after):
        learned = _with_learned_torque(settings, problem, at, state)
        return Conclusion("unnamed", errors, changed={}, changed_alike={}, residual=learned)
    changed = _changed_parameters(settings, problem, fit, errors)
    alike = _mistaken_for(settings, problem, at, state, tuple(changed), say)
    # A term about a nominal parameter is a change, however large: the model has the parameter.
    if any(not problem.is_nominal(term.hypothesis) for term in state.terms):
        verdict = "named"
    else:
        verdict = "parameter_change" if changed or state.terms else "no_missing_effect"
    return Conclusion(verdict, errors, changed, alike, residual=None)


def prove(settings: Settings, problem: Problem, floor: NoiseFloor, state: State, conclusion: Conclusion) -> Result:
    """Simulates the sealed segments, once: the nominal model, the null, the answer, its ablations and its placebos.

    An effect is proved if the gap falls on runs that nothing was fitted to, if it opens again without the effect, and
    if another place or another effect with the same number of rounds does not close it.

    Args:
      settings: rounds of the placebos' fits.
      problem: the hypotheses, among which are the placebos.
      floor: the noise floor.
      state: the model, its terms and the null.
      conclusion: the verdict, with the learned torque where there is one.

    Returns:
      All that was found.
    """
    at, fit = floor[problem.main_horizon], state.fits[problem.main_horizon]
    named = {
        "before": np.zeros(problem.axes),
        "null": state.null.vector,
        "after": (conclusion.residual or fit).vector,
    }
    others = _placebos(settings, problem, at, state)
    without = {f"without {term.hypothesis.key}": ablate(at, fit, term.hypothesis).vector for term in state.terms}
    others = without | others
    found = rms(at, np.stack([*named.values(), *others.values()]), ("sealed",))
    of_model = dict(zip([*named, *others], found, strict=True))
    proof = {
        "cells": [
            {"signal": signal, "joint": part} | {name: float(of_model[name][index]) for name in named}
            for index, (signal, part) in enumerate(problem.cells)
        ],
        "no_cell_worse": bool((of_model["after"] <= of_model["null"] + 1.0).all()),
        "others": {name: position_gap(problem, of_model[name]) for name in others},
    }
    gap = {name: position_gap(problem, of_model[name]) for name in named}
    return _result(fit, state, conclusion, gap, proof)


def _explains(settings: Settings, named: bool, null: float, after: float) -> bool:
    """Whether a model explains the logs: it is at the floor, or its effects explain enough of the null's gap.

    With the null's gap n and the model's m in floor units, the share explained is (n^2 - m^2) / (n^2 - 1).
    """
    unexplained = after > settings.at_floor
    if named and null > _PERFECT:
        unexplained &= (null**2 - after**2) / (null**2 - _PERFECT) < settings.share
    return not unexplained


def _changed_parameters(settings: Settings, problem: Problem, fit: Fit, errors: np.ndarray) -> dict[int, float]:
    """Nominal axes further from the prior's centre than `settings.changed` deviations and than chance, and how far."""
    prior = problem.prior
    deviations = np.divide(fit.vector, prior, out=np.zeros_like(fit.vector), where=prior > 0)
    error = np.sqrt((errors[:, None] ** 2 * fit.free.directions**2).sum(axis=0))
    moved = (np.abs(deviations) > settings.changed) & (np.abs(fit.vector) > 1.96 * error)
    return {int(axis): float(deviations[axis]) for axis in np.flatnonzero(moved)}


def _mistaken_for(
    settings: Settings, problem: Problem, at: Floor, state: State, axes: Sequence[int], say: Say
) -> dict[int, tuple[str, ...]]:
    """Names of the effects that look like the change of each of these nominal axes."""
    # The screen's secants may be gone, and to take them anew is as long as a screen.
    if not axes:
        return {}
    fit = state.fits[at.horizon]
    columns = state.columns or secant_columns(at, fit, problem.hypotheses, say)
    return {axis: looks_like(fit, columns, axis, problem.hypotheses, settings.same) for axis in axes}


def _with_learned_torque(settings: Settings, problem: Problem, at: Floor, state: State) -> Fit | None:
    """The model with a bounded torque at the joint that needs it most, so that there is a better simulator at least."""
    need, stand_in = state.needs_torque, problem.residual
    if not stand_in:
        return None
    worst = [cell["joint"] for cell in state.where if cell["joint"] in stand_in]
    joint = max(need, key=need.get) if any(need.values()) else next(iter(worst or stand_in))
    start = Start(stand_in[joint], [np.zeros(len(stand_in[joint].directions))])
    return fit_beside(state.fits[at.horizon], [start], at.residuals["train"], settings.rounds)[0]


def _placebos(settings: Settings, problem: Problem, at: Floor, state: State) -> dict[str, np.ndarray]:
    """The first effect at a wrong place, and a wrong effect at its place: the best of each kind, beside the null."""
    if not state.terms:
        return {}
    truth, hypotheses = state.terms[0].hypothesis, problem.hypotheses
    kinds = {
        "wrong place": [h for h in hypotheses if h.name == truth.name and not set(h.places) & set(truth.places)],
        "wrong effect": [h for h in hypotheses if h.places == truth.places and h.family != truth.family],
    }
    found, rounds = {}, 2 * settings.rounds  # as many as an accepted one had
    for label, options in kinds.items():
        if options:
            wrong = max(options, key=lambda h: state.promise.get(h.key, 0.0))
            (fit,) = fit_beside(state.null, [Start(wrong, list(wrong.probes))], at.residuals["train"], rounds)
            found[f"{label}: {wrong.key}"] = fit.vector
    return found


def _result(
    fit: Fit, state: State, conclusion: Conclusion, gap: Mapping[str, float], proof: Mapping[str, Any]
) -> Result:
    """Puts together what the steps, the verdict and the proof have found."""
    # What was accepted was shown, whatever the screen had thought of it at the smallest size.
    named = {term.hypothesis.name for term in state.terms}
    return Result(
        verdict=conclusion.verdict,
        terms=state.terms,
        fit=fit,
        errors=conclusion.errors,
        null=state.null,
        where=state.where,
        needs_torque=state.needs_torque,
        not_testable=tuple(name for name in state.not_testable if name not in named),
        not_finite=state.not_finite,
        dropped=state.dropped,
        rejected=state.rejected,
        changed=conclusion.changed,
        changed_alike=conclusion.changed_alike,
        residual=conclusion.residual,
        gap=gap,
        proof=proof,
    )
