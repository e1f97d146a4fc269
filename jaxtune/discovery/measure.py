"""Residuals in floor units: how far simulation and measurement may differ where nothing is missing.

The floor is the residual of healthy logs after their nominal parameters were fitted again: noise, rounding, the error
of the state a segment starts from, and the gap between engines, all in one number for every component of every signal
and every moment of a segment.
"""

from dataclasses import dataclass

import numpy as np

from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.problem import Problem, Residuals, Segments

_LEAST_SHARE = 0.25  # of a component's mean floor; the first rows of a segment would count without end


@dataclass(frozen=True)
class Gauge:
    """How residuals of one horizon are read."""

    floor: np.ndarray
    """[bins, components]"""
    weight: float
    """Share of the bins that count as independent."""
    jacobian: dict[str, np.ndarray]
    """[segments, bins, components, nominal axes] by split, in floor units per prior standard deviation, at the null."""
    healthy: tuple[dict[str, np.ndarray], ...]
    """Residuals of every healthy log by split, in floor units, before any fit."""


def jacobian(measure: Residuals, vector: np.ndarray, directions: np.ndarray, segments: Segments) -> np.ndarray:
    """Secants of the residuals along directions [k, axes], [segments, bins, components, k]."""
    found = measure(np.concatenate([vector[None], vector + directions]), segments)
    return np.moveaxis(found[1:] - found[:1], 0, -1)


def nominal_directions(problem: Problem) -> np.ndarray:
    """A prior standard deviation along every nominal axis, [nominal axes, axes]."""
    return np.diag(problem.prior)[problem.prior > 0]


def gauge(problem: Problem, measure: Residuals, horizon: float, say=lambda done: None) -> Gauge:
    """Measures the floor at one horizon."""
    splits = ("train", "select")
    zero = np.zeros(problem.axes)
    directions = nominal_directions(problem)
    slopes, raw = {}, []
    for split in splits:
        slopes[split] = jacobian(measure, zero, directions, problem.data[split][horizon])
        say(split)
    for log in problem.healthy:
        raw.append({split: measure(zero, log[split][horizon])[0] for split in splits})
        say("healthy")
    pooled = np.concatenate([log["train"] for log in raw])
    floor = np.sqrt((pooled**2).mean(axis=0))
    weight = 1.0
    for _ in range(2):
        left = [_refitted(log["train"] / floor, slopes["train"] / floor[..., None], weight) for log in raw]
        weight = independent_share(np.concatenate(left))
        fresh = floor * np.sqrt((np.concatenate(left) ** 2).mean(axis=0))
        floor = np.maximum(fresh, _LEAST_SHARE * fresh.mean(axis=0))
    return Gauge(
        floor=floor,
        weight=weight,
        jacobian={split: slope / floor[..., None] for split, slope in slopes.items()},
        healthy=tuple({split: values / floor for split, values in log.items()} for log in raw),
    )


def _refitted(residual: np.ndarray, slope: np.ndarray, weight: float) -> np.ndarray:
    count = slope.shape[-1]
    flat = slope.reshape(-1, count)
    linear = Linear(residual.ravel(), flat, np.zeros(count), np.ones(count), weight)
    return residual + slope @ linear.step()


def independent_share(residual: np.ndarray) -> float:
    """Independent bins of a segment as a share of all, from how their mean scatters: [segments, bins, components]."""
    whole = (residual**2).mean(axis=(0, 1))
    of_means = (residual.mean(axis=1) ** 2).mean(axis=0)
    return float(np.clip((whole / np.maximum(of_means, 1e-12)).mean() / residual.shape[1], 1.0 / residual.shape[1], 1.0))
