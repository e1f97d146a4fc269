"""The verdict, and the proof on sealed segments (steps 9 and 10)."""

import numpy as np

from jaxtune.discovery.fit import Fit

_OPEN = ("train", "select")


def judge(discovery) -> None:
    """The verdict, from what is not sealed.

    From `select` alone it would depend on how the floor of a few postures compares with that of all.
    """
    result, settings, prior = discovery.result, discovery.settings, discovery.problem.prior
    fit = result.fit = discovery.settle(discovery.main)
    result.errors = discovery.errors(fit)
    null, after = (gap(discovery, one.vector) for one in (result.null, fit))
    unexplained = after > settings.at_floor
    if result.rungs and null > 1.0:
        unexplained &= (null**2 - after**2) / (null**2 - 1.0) < settings.share
    if unexplained:
        # Parameters of a model that does not explain the logs mean nothing: none is called changed.
        result.verdict, result.residual = "unnamed", _free_residual(discovery)
        return
    deviations = np.divide(fit.vector, prior, out=np.zeros_like(fit.vector), where=prior > 0)
    error = np.sqrt((result.errors[:, None] ** 2 * fit.free.directions**2).sum(axis=0))
    moved = (np.abs(deviations) > settings.changed) & (np.abs(fit.vector) > 1.96 * error)
    result.changed = {int(axis): float(deviations[axis]) for axis in np.flatnonzero(moved)}
    result.changed_alike = {axis: discovery.mistaken_for(axis) for axis in result.changed}
    if any(not discovery.problem.is_nominal(rung.hypothesis) for rung in result.rungs):
        result.verdict = "named"
    else:
        result.verdict = "parameter_change" if result.changed or result.rungs else "no_missing_effect"


def gap(discovery, vector: np.ndarray) -> float:
    """Root mean square of the worst component of the positions on all that is not sealed, in floor units."""
    return float(_rms(discovery, vector[None], *_OPEN)[0][_positions(discovery)].max())


def worst(discovery, vector: np.ndarray) -> float:
    """Root mean square of the worst component of all signals on all that is not sealed, in floor units."""
    return float(_rms(discovery, vector[None], *_OPEN)[0].max())


def prove(discovery) -> None:
    """Looks at the sealed segments, once: the gap of every cell, ablations and placebos."""
    result = discovery.result
    discovery.say("sealed")
    final = result.residual or result.fit
    named = {"before": np.zeros(discovery.problem.axes), "null": result.null.vector, "after": final.vector}
    others = {
        f"without {rung.hypothesis.key}": discovery.ablated(discovery.main, rung.hypothesis).vector
        for rung in result.rungs
    } | _placebos(discovery)
    rms = dict(
        zip([*named, *others], _rms(discovery, np.stack([*named.values(), *others.values()]), "sealed"), strict=True)
    )
    positions = _positions(discovery)
    result.gap = {name: float(rms[name][positions].max()) for name in named}
    result.proof = {
        "cells": [
            {"signal": signal, "joint": part} | {name: float(rms[name][index]) for name in named}
            for index, (signal, part) in enumerate(discovery.problem.cells)
        ],
        "no_cell_worse": bool((rms["after"] <= rms["null"] + 1.0).all()),
        "others": {name: float(rms[name][positions].max()) for name in others},
    }


def _rms(discovery, vectors: np.ndarray, *splits: str) -> np.ndarray:
    """Root mean squares [vectors, components] in floor units, at the main horizon."""
    found = np.concatenate([discovery.residual(discovery.main, split)(vectors) for split in splits], axis=1)
    return np.stack([np.sqrt((discovery.shaped(one, discovery.main) ** 2).mean(axis=(0, 1))) for one in found])


def _positions(discovery) -> np.ndarray:
    """Components that are positions, [components]."""
    return np.array([signal == "q" for signal, _ in discovery.problem.cells])


def _free_residual(discovery) -> Fit | None:
    """A bounded torque without a name at the joint that needs it most, so that there is a better simulator at least."""
    need, stand_in = discovery.result.needs_torque, discovery.problem.residual
    if not stand_in:
        return None
    worst = [cell["joint"] for cell in discovery.result.where if cell["joint"] in stand_in]
    joint = max(need, key=need.get) if any(need.values()) else next(iter(worst or stand_in))
    hypothesis = stand_in[joint]
    start = {hypothesis.key: [np.zeros(len(hypothesis.directions))]}
    return discovery.fit([hypothesis], start, discovery.main, discovery.settings.rounds)[0]


def _placebos(discovery) -> dict[str, np.ndarray]:
    """The first effect at a wrong place, and a wrong effect at its place: the best of each kind, fitted like it."""
    if not discovery.result.rungs:
        return {}
    truth, hypotheses = discovery.result.rungs[0].hypothesis, discovery.problem.hypotheses
    kinds = {
        "wrong place": [h for h in hypotheses if h.name == truth.name and not set(h.places) & set(truth.places)],
        "wrong effect": [h for h in hypotheses if h.places == truth.places and h.family != truth.family],
    }
    kept, discovery.fits = discovery.fits, {discovery.main: discovery.result.null}
    found = {}
    for label, options in kinds.items():
        if options:
            best = max(options, key=lambda h: discovery.promise.get(h.key, 0.0))
            rounds = 2 * discovery.settings.rounds  # as many as an accepted one had
            (fit,) = discovery.fit([best], {best.key: list(best.probes)}, discovery.main, rounds)
            found[f"{label}: {best.key}"] = fit.vector
    discovery.fits = kept
    return found
