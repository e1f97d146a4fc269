"""Questions to a model: how far off it is on some splits, in floor units."""

from collections.abc import Mapping

import numpy as np

from jaxtune.discovery.candidate import Candidate
from jaxtune.discovery.noise_floor import Floor
from jaxtune.discovery.problem import Problem

_WORSE, _WORSE_FLOORS = 1.1, 0.2  # on sealed: what withdraws a model


def rms(at: Floor, residual: np.ndarray) -> np.ndarray:
    """Root mean squares [components] of residuals [features] in floor units; one is what a perfect model would have."""
    return np.sqrt((at.unflatten(residual) ** 2).mean(axis=(0, 1)))


def usual(at: Floor, candidate: Candidate) -> np.ndarray:
    """Root mean squares [components] on `train` and `select` in floor units, without the worst segments of each.

    Which segments these are is in `Counts.usual`. A model whose worst component is near one is at the floor: the logs
    hold nothing more to find.
    """
    residual = np.concatenate([candidate.fit.residual, candidate.select])
    return np.sqrt(at.counts.usual(at.counts.mean_squares(residual)))


def position_gap(problem: Problem, root_mean_squares: np.ndarray) -> float:
    """Picks the worst position of root mean squares [components]: the gap that is reported, in floor units."""
    positions = np.array([signal == "q" for signal, _ in problem.cells])
    return float(root_mean_squares[positions].max())


def is_worse(gap: Mapping[str, float]) -> bool:
    """Says whether a model is worse than the better of nominal and null, by more than a tenth and 0.2 floor units.

    Args:
      gap: of `before` (nominal), `null` and `after`, in floor units; one that is no number is the worst.
    """
    before, null, after = (float(np.nan_to_num(gap[name], nan=np.inf)) for name in ("before", "null", "after"))
    better = min(before, null)
    return after > _WORSE * better and after > better + _WORSE_FLOORS
