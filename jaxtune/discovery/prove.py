"""The verdict, from open segments, and the proof, on sealed ones (steps 9 and 10)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxtune.discovery.compete import Start, begin
from jaxtune.discovery.evaluate import ablate, position_gap, residuals_on, rms, standard_errors
from jaxtune.discovery.fit import Fit, refine
from jaxtune.discovery.noise_floor import NoiseFloor, Say
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import looks_like, secant_columns
from jaxtune.discovery.state import State

_AT_FLOOR = 1.0  # floor units of a perfect model


@dataclass(frozen=True)
class Conclusion:
    """What the open segments say in the end; `Result` tells what the fields mean."""

    verdict: str
    errors: np.ndarray
    changed: Mapping[int, float]
    changed_alike: Mapping[int, tuple[str, ...]]
    residual: Fit | None


@dataclass(frozen=True)
class Proof:
    """What the sealed segments say; `Result` tells what the fields mean."""

    gap: Mapping[str, float]
    proof: Mapping[str, Any]


def conclude(settings: Settings, problem: Problem, floor: NoiseFloor, state: State, say: Say) -> Conclusion:
    """Reaches the verdict from `train` and `select` together.

    From `select` alone it would depend on how the floor of a few postures compares with that of all. Where the model
    does not explain the logs, no parameter is called changed: parameters of a wrong model mean nothing.

    Args:
      settings: what counts as explained and as changed.
      problem: the simulator and the segments.
      floor: the noise floor.
      state: after the last step, fitted at the main horizon.
      say: told about progress.
    """
    fit = state.fits[problem.main_horizon]
    errors = standard_errors(problem, floor, fit)
    if not explains(settings, problem, floor, state):
        learned = _with_learned_torque(settings, problem, floor, state)
        return Conclusion("unnamed", errors, changed={}, changed_alike={}, residual=learned)
    changed = _changed_parameters(settings, problem, fit, errors)
    alike = _mistaken_for(settings, problem, floor, state, tuple(changed), say)
    if any(not problem.is_nominal(term.hypothesis) for term in state.terms):
        verdict = "named"
    else:
        verdict = "parameter_change" if changed or state.terms else "no_missing_effect"
    return Conclusion(verdict, errors, changed, alike, residual=None)


def explains(settings: Settings, problem: Problem, floor: NoiseFloor, state: State) -> bool:
    """Says whether the model explains the open segments: it is at the floor, or explains enough of the null's gap.

    With the null's gap n and the model's m in floor units, the share explained is (n^2 - m^2) / (n^2 - 1).

    Args:
      settings: what counts as at the floor, and as enough.
      problem: the simulator and the segments.
      floor: the noise floor.
      state: the model and the null.
    """
    vectors = (state.null.vector, state.fits[problem.main_horizon].vector)
    null, after = (position_gap(problem, rms(problem, floor, vector[None])[0]) for vector in vectors)
    unexplained = after > settings.at_floor
    if state.terms and null > _AT_FLOOR:
        unexplained &= (null**2 - after**2) / (null**2 - _AT_FLOOR) < settings.share
    return not unexplained


def prove(settings: Settings, problem: Problem, floor: NoiseFloor, state: State, conclusion: Conclusion) -> Proof:
    """Simulates the sealed segments, once: the nominal model, the null, the answer, its ablations and its placebos.

    An effect is proved if the gap falls on runs that nothing was fitted to, if it opens again without the effect, and
    if another place or another effect with the same number of rounds does not close it.

    Args:
      settings: rounds of the placebos' fits.
      problem: the simulator and the segments.
      floor: the noise floor.
      state: the model, its terms and the null.
      conclusion: has the learned torque, where there is one.
    """
    final, main = conclusion.residual or state.fits[problem.main_horizon], problem.main_horizon
    named = {"before": np.zeros(problem.axes), "null": state.null.vector, "after": final.vector}
    without = {
        f"without {term.hypothesis.key}": ablate(problem, floor, main, state.fits[main], term.hypothesis).vector
        for term in state.terms
    }
    others = without | _placebos(settings, problem, floor, state)
    found = rms(problem, floor, np.stack([*named.values(), *others.values()]), ("sealed",))
    of_model = dict(zip([*named, *others], found, strict=True))
    return Proof(
        gap={name: position_gap(problem, of_model[name]) for name in named},
        proof={
            "cells": [
                {"signal": signal, "joint": part} | {name: float(of_model[name][index]) for name in named}
                for index, (signal, part) in enumerate(problem.cells)
            ],
            "no_cell_worse": bool((of_model["after"] <= of_model["null"] + 1.0).all()),
            "others": {name: position_gap(problem, of_model[name]) for name in others},
        },
    )


def _changed_parameters(settings: Settings, problem: Problem, fit: Fit, errors: np.ndarray) -> dict[int, float]:
    """Nominal axes further from the prior's centre than `settings.changed` deviations and than chance, and how far."""
    prior = problem.prior
    deviations = np.divide(fit.vector, prior, out=np.zeros_like(fit.vector), where=prior > 0)
    error = np.sqrt((errors[:, None] ** 2 * fit.free.directions**2).sum(axis=0))
    moved = (np.abs(deviations) > settings.changed) & (np.abs(fit.vector) > 1.96 * error)
    return {int(axis): float(deviations[axis]) for axis in np.flatnonzero(moved)}


def _mistaken_for(
    settings: Settings, problem: Problem, floor: NoiseFloor, state: State, axes: tuple[int, ...], say: Say
) -> dict[int, tuple[str, ...]]:
    """Names of the effects that look like the change of each of these nominal axes."""
    if not axes:
        return {}
    fit = state.fits[problem.main_horizon]
    columns = state.columns or secant_columns(problem, floor, fit, problem.hypotheses, say)
    return {axis: looks_like(fit, columns, axis, problem.hypotheses, settings.same) for axis in axes}


def _with_learned_torque(settings: Settings, problem: Problem, floor: NoiseFloor, state: State) -> Fit | None:
    """The model with a bounded torque at the joint that needs it most, so that there is a better simulator at least."""
    need, stand_in = state.needs_torque, problem.residual
    if not stand_in:
        return None
    worst = [cell["joint"] for cell in state.where if cell["joint"] in stand_in]
    joint = max(need, key=need.get) if any(need.values()) else next(iter(worst or stand_in))
    zero = np.zeros(len(stand_in[joint].directions))
    return _fit_beside(problem, floor, state.fits[problem.main_horizon], stand_in[joint], [zero], settings.rounds)


def _placebos(settings: Settings, problem: Problem, floor: NoiseFloor, state: State) -> dict[str, np.ndarray]:
    """The first effect at a wrong place, and a wrong effect at its place: the best of each kind, beside the null."""
    if not state.terms:
        return {}
    truth, hypotheses = state.terms[0].hypothesis, problem.hypotheses
    kinds = {
        "wrong place": [h for h in hypotheses if h.name == truth.name and not set(h.places) & set(truth.places)],
        "wrong effect": [h for h in hypotheses if h.places == truth.places and h.family != truth.family],
    }
    best = {
        label: max(options, key=lambda h: state.promise.get(h.key, 0.0)) for label, options in kinds.items() if options
    }
    rounds = 2 * settings.rounds  # as many as an accepted one had
    return {
        f"{label}: {wrong.key}": _fit_beside(problem, floor, state.null, wrong, list(wrong.probes), rounds).vector
        for label, wrong in best.items()
    }


def _fit_beside(
    problem: Problem, floor: NoiseFloor, base: Fit, hypothesis: Hypothesis, points: list[np.ndarray], rounds: int
) -> Fit:
    """A hypothesis fitted at the main horizon beside what is free in `base`, from the best of some points."""
    evaluate = residuals_on(problem, floor, problem.main_horizon, "train")
    (fit,) = refine(begin(base, [Start(hypothesis, points)], evaluate), evaluate, rounds)
    return fit
