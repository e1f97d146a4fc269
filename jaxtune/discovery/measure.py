"""Residuals in floor units: how far simulation and measurement may differ where nothing is missing.

The floor is the residual of healthy logs after their nominal parameters were fitted again: noise, rounding, the error
of the state a segment starts from, and the gap between engines, all in one number for every component of every signal
and every moment of a segment.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.fit import Evaluate, Fit, Free, refine
from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.problem import Problem, Residuals, Segments

_ROUNDS = 6  # of a fit: what one step leaves of parameters that are a tenth off would pass for a gap between engines
_FURTHEST = 9.0  # standard deviations: nothing positive is less than nothing
_LEAST_SHARE = 0.25  # of a component's mean floor; the first rows of a segment would count without end


@dataclass(frozen=True)
class Gauge:
    """How residuals of one horizon are read."""

    floor: Mapping[str, np.ndarray]
    """[bins, components] by split: the same model is further off in some postures than in others."""
    weight: float
    """Share of the bins that count as independent."""
    healthy: tuple[Fit, ...]
    """What is free from the start, fitted to the `train` of every healthy log."""


def jacobian(measure: Residuals, vector: np.ndarray, directions: np.ndarray, segments: Segments) -> np.ndarray:
    """Secants of the residuals along directions [k, axes], [segments, bins, components, k]."""
    found = measure(np.concatenate([vector[None], vector + directions]), segments)
    return np.moveaxis(found[1:] - found[:1], 0, -1)


def slopes(problem: Problem, measure: Residuals, horizon: float) -> np.ndarray:
    """Secants along what is free from the start, at the nominal model on `train`: [segments, bins, components, k]."""
    zero = np.zeros(problem.axes)
    return jacobian(measure, zero, nominal_directions(problem), problem.data["train"][horizon])


def nominal_directions(problem: Problem) -> np.ndarray:
    """A prior standard deviation along everything that is free from the start, [directions, axes]."""
    return np.concatenate([np.diag(problem.prior)[problem.prior > 0], problem.timing])


def nominal(problem: Problem) -> Free:
    """What is free from the start."""
    directions = nominal_directions(problem)
    count = len(directions)
    bounds = np.tile([-_FURTHEST, _FURTHEST], (count, 1))
    # Nobody looks or acts before it is time, nor later than a period after.
    bounds[count - len(problem.timing) :] = [0.0, 2.0]
    return Free(directions, np.ones(count), bounds, np.ones(count, bool))


def gauge(
    problem: Problem,
    measure: Residuals,
    horizon: float,
    known: tuple[Mapping[str, np.ndarray], float] | None = None,
) -> Gauge:
    """Measures the floor at one horizon, or takes one that is known: floor and independent share."""
    if known is not None:
        return Gauge(floor=known[0], weight=known[1], healthy=())
    zero, slope = np.zeros(problem.axes), slopes(problem, measure, horizon)
    train = [log["train"][horizon] for log in problem.healthy]
    raw = [measure(zero, log)[0] for log in train]
    floor, weight = np.sqrt((np.concatenate(raw) ** 2).mean(axis=0)), 1.0
    for _ in range(2):
        left = np.stack([refitted(log / floor, slope / floor[..., None], weight) for log in raw])
        floor, weight = _floor(floor, left), independent_share(_every(left))
    fits = [fitted(problem, residuals(measure, log, floor), slope / floor[..., None], weight) for log in train]
    left = np.stack([fit.residual.reshape(raw[0].shape) for fit in fits])
    fresh, weight = _floor(floor, left), independent_share(_every(left))
    change = (floor / fresh).ravel()
    floors = {"train": fresh}
    # Where nothing was fitted, as in the measured log.
    for split in problem.data.keys() - floors.keys():
        there = [measure(fit.vector, log[split][horizon])[0] for fit, log in zip(fits, problem.healthy, strict=True)]
        floors[split] = _floor(np.ones_like(fresh), np.stack(there))
    return Gauge(
        floor=floors,
        weight=weight,
        healthy=tuple(
            replace(fit, residual=(fit.residual.reshape(-1, len(change)) * change).ravel(), weight=weight)
            for fit in fits
        ),
    )


def _floor(unit: np.ndarray, left: np.ndarray) -> np.ndarray:
    """The floor [bins, components] from what is left of healthy logs [logs, segments, bins, components] in a unit."""
    fresh = unit * np.sqrt((_every(left) ** 2).mean(axis=0))
    return np.maximum(fresh, _LEAST_SHARE * fresh.mean(axis=0))


def _every(left: np.ndarray) -> np.ndarray:
    return left.reshape(-1, *left.shape[2:])


def fitted(problem: Problem, evaluate: Evaluate, slope: np.ndarray, weight: float) -> Fit:
    """What is free from the start, fitted to a log.

    Args:
      evaluate: its residuals.
      slope: [segments, bins, components, directions] at the nominal model.
    """
    free = nominal(problem)
    start = Fit(
        free=free,
        coordinates=np.zeros(len(free.sd)),
        residual=evaluate(np.zeros((1, problem.axes)))[0],
        jacobian=slope.reshape(-1, len(free.sd)),
        weight=weight,
    )
    return refine([start], evaluate, _ROUNDS)[0]


def residuals(measure: Residuals, segments: Segments, floor: np.ndarray) -> Evaluate:
    """Residuals [n, features] of vectors [n, axes], in floor units."""
    return lambda vectors: (measure(vectors, segments) / floor).reshape(len(vectors), -1)


def refitted(residual: np.ndarray, slope: np.ndarray, weight: float) -> np.ndarray:
    """Residuals once the nominal parameters have answered, by slopes [..., nominal axes]."""
    count = slope.shape[-1]
    flat = slope.reshape(-1, count)
    linear = Linear(residual.ravel(), flat, np.zeros(count), np.ones(count), weight)
    return residual + slope @ linear.step()


def independent_share(residual: np.ndarray) -> float:
    """Independent bins of a segment as a share of all, from how their mean scatters: [segments, bins, components]."""
    whole = (residual**2).mean(axis=(0, 1))
    of_means = (residual.mean(axis=1) ** 2).mean(axis=0)
    return float(
        np.clip((whole / np.maximum(of_means, 1e-12)).mean() / residual.shape[1], 1.0 / residual.shape[1], 1.0)
    )
