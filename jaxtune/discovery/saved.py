"""What a run that was interrupted needs to go on from its last accepted effect."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from jaxtune.discovery import decide
from jaxtune.discovery.accept import Rung
from jaxtune.discovery.fit import ROUNDS_MORE, Fit
from jaxtune.discovery.problem import Hypothesis


def state(discovery) -> dict:
    """What a run that goes on needs to know."""
    result, fits = discovery.result, [discovery.fits[horizon] for horizon in discovery.problem.horizons]

    def own(fit: Fit, hypothesis: Hypothesis) -> list[float]:
        return fit.coordinates[fit.along(hypothesis)].tolist()

    return {
        "rungs": [
            {
                "key": rung.hypothesis.key,
                "evidence": asdict(rung.evidence),
                "thresholds": asdict(rung.thresholds),
                "alike": list(rung.alike),
                "coordinates": [own(fit, rung.hypothesis) for fit in fits],
            }
            for rung in result.rungs
        ],
        "where": result.where,
        "not_testable": result.not_testable,
        "not_finite": result.not_finite,
        "dropped": result.dropped,
        "healthy_gain": discovery.least_gain,
        "penalty": discovery.penalty,
    }


def resume(discovery, state: Mapping[str, Any]) -> None:
    """Stands where another run stood when it said this."""
    by_key = {hypothesis.key: hypothesis for hypothesis in discovery.problem.hypotheses}
    for saved in state["rungs"]:
        hypothesis = by_key[saved["key"]]
        for horizon, coordinates in zip(discovery.problem.horizons, saved["coordinates"], strict=True):
            starts = {hypothesis.key: [np.array(coordinates)]}
            discovery.fits[horizon] = discovery.fit([hypothesis], starts, horizon, ROUNDS_MORE, absolute=True)[0]
        evidence = {**saved["evidence"], "interval": tuple(saved["evidence"]["interval"])}
        discovery.result.rungs.append(
            Rung(
                hypothesis,
                decide.Evidence(**evidence),
                decide.Thresholds(**saved["thresholds"]),
                tuple(saved["alike"]),
            )
        )
    discovery.result.where, discovery.result.not_testable = state["where"], state["not_testable"]
    discovery.result.not_finite, discovery.least_gain = state["not_finite"], state["healthy_gain"]
    discovery.result.dropped, discovery.penalty = state["dropped"], state["penalty"]
    discovery.looked = True
