"""What a run that was interrupted needs to go on from its last accepted effect."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from jaxtune.discovery import decide
from jaxtune.discovery.accept import Rung
from jaxtune.discovery.fit import Fit, Free


def state(discovery) -> dict:
    """What a run that goes on needs to know."""
    result, fits = discovery.result, [discovery.fits[horizon] for horizon in discovery.problem.horizons]

    return {
        "rungs": [
            {
                "key": rung.hypothesis.key,
                "evidence": asdict(rung.evidence),
                "thresholds": asdict(rung.thresholds),
                "alike": list(rung.alike),
            }
            for rung in result.rungs
        ],
        "fits": [_stands(fit) for fit in fits],
        "null": _stands(result.null),
        "where": result.where,
        "needs_torque": result.needs_torque,
        "promise": discovery.promise,
        "not_testable": result.not_testable,
        "not_finite": result.not_finite,
        "dropped": result.dropped,
        "healthy_gain": discovery.least_gain,
        "penalty": discovery.penalty,
    }


def _stands(fit: Fit) -> dict:
    """Where a fit stands; residuals and slopes are found anew."""
    names = ("directions", "sd", "bounds", "nominal")
    free = {name: part.tolist() for name, part in zip(names, fit.free.parts(), strict=True)}
    return {"free": free, "coordinates": fit.coordinates.tolist()}


def resume(discovery, state: Mapping[str, Any]) -> None:
    """Stands where another run stood when it said this."""
    result, by_key = discovery.result, {hypothesis.key: hypothesis for hypothesis in discovery.problem.hypotheses}

    def fit(saved: Mapping[str, Any], horizon: float) -> Fit:
        free = Free(**{name: np.array(values) for name, values in saved["free"].items()})
        return discovery.anew(free, np.array(saved["coordinates"]), horizon)

    for horizon, saved in zip(discovery.problem.horizons, state["fits"], strict=True):
        discovery.fits[horizon] = fit(saved, horizon)
    result.null = fit(state["null"], discovery.main)
    for saved in state["rungs"]:
        evidence = decide.Evidence(**{**saved["evidence"], "interval": tuple(saved["evidence"]["interval"])})
        thresholds = decide.Thresholds(**saved["thresholds"])
        result.rungs.append(Rung(by_key[saved["key"]], evidence, thresholds, tuple(saved["alike"])))
    result.where, result.not_testable = state["where"], state["not_testable"]
    result.not_finite, result.dropped = state["not_finite"], state["dropped"]
    result.needs_torque, discovery.promise = state["needs_torque"], state["promise"]
    discovery.least_gain, discovery.penalty = state["healthy_gain"], state["penalty"]
    discovery.looked = True
