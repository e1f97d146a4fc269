"""The proof, on sealed segments, which are simulated once, after all decisions (step 10)."""

from collections.abc import Sequence

import numpy as np

from jaxtune.discovery.candidate import Candidate
from jaxtune.discovery.conclude import Conclusion
from jaxtune.discovery.evaluate import is_worse, position_gap, rms
from jaxtune.discovery.noise_floor import NoiseFloor
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.result import Result
from jaxtune.discovery.state import State


def prove(problem: Problem, floor: NoiseFloor, state: State, conclusion: Conclusion) -> Result:
    """Simulates the sealed segments, once: the nominal model, the null, the answer, its ablations and its placebos.

    An effect is proved if the gap falls on runs that nothing was fitted to, if it opens again without the effect, and
    if another place or another effect does not close it. A model that is worse there than the better of the nominal
    model and the null is withdrawn: whatever was believed, the user gets the better one, and the verdict is `unnamed`.

    Args:
      problem: the hypotheses, among which are the placebos.
      floor: the noise floor.
      state: the models that were fitted, and the null.
      conclusion: the verdict and the model.

    Returns:
      All that was found.
    """
    at = floor[problem.main_horizon]
    (model_is, model), *_ = conclusion.models.items()
    named = {"before": np.zeros(problem.axes), "null": state.null.fit.vector, "after": model}
    others = {f"without {key}": vector for key, vector in conclusion.ablated.items()} | _placebos(state, conclusion)
    found = at.residuals["sealed"](np.stack([*named.values(), *others.values()]))
    of_model = dict(zip([*named, *others], (rms(at, one) for one in found), strict=True))
    gap = {name: position_gap(problem, of_model[name]) for name in named}
    saved = model
    if withdrawn := is_worse(gap):
        model_is = "null" if gap["null"] < gap["before"] else "nominal"
        saved = conclusion.models[model_is]
    proof = {
        "cells": [
            {"signal": signal, "joint": part} | {name: float(of_model[name][index]) for name in named}
            for index, (signal, part) in enumerate(problem.cells)
        ],
        "no_cell_worse": bool((of_model["after"] <= of_model["null"] + 1.0).all()),
        "others": {name: position_gap(problem, of_model[name]) for name in others},
    }
    return Result(
        verdict="unnamed" if withdrawn else conclusion.verdict,
        terms=conclusion.terms,
        fit=conclusion.best.fit,
        errors=conclusion.errors,
        null=state.null.fit,
        proposed=model,
        model=saved,
        model_is=model_is,
        suspects=conclusion.suspects,
        families=conclusion.families,
        rivals=conclusion.rivals,
        explained_share=conclusion.explained_share,
        explainable_share=conclusion.explainable_share,
        learned_parts=conclusion.learned_parts,
        withdrawn=withdrawn,
        where=state.where,
        needs_torque=state.needs_torque,
        # What was accepted was shown, whatever the screen had thought of it at the smallest size.
        not_testable=tuple(n for n in state.not_testable if n not in {t.hypothesis.name for t in conclusion.terms}),
        not_finite=state.not_finite,
        dropped=conclusion.dropped,
        changed=conclusion.changed,
        gap=gap,
        proof=proof,
        details=conclusion.details,
    )


def _placebos(state: State, conclusion: Conclusion) -> dict[str, np.ndarray]:
    """The first effect at a wrong place, and a wrong effect at its place: the best of each kind that was fitted."""
    if not conclusion.terms:
        return {}
    truth = conclusion.terms[0].hypothesis
    singles = sorted((one for one in state.candidates if len(one.hypotheses) == 1), key=lambda one: one.fit.cost)
    kinds: dict[str, Sequence[Candidate]] = {
        "wrong place": [
            one
            for one in singles
            if one.hypotheses[0].name == truth.name and not set(one.hypotheses[0].places) & set(truth.places)
        ],
        "wrong effect": [
            one
            for one in singles
            if one.hypotheses[0].places == truth.places and one.hypotheses[0].family != truth.family
        ],
    }
    return {f"{label}: {found[0].key}": found[0].fit.vector for label, found in kinds.items() if found}
