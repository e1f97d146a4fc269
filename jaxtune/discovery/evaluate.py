"""Questions to a model: how far off it is on some splits, in floor units."""

import numpy as np

from jaxtune.discovery.decide import Candidate
from jaxtune.discovery.noise_floor import Floor
from jaxtune.discovery.problem import Problem


def rms(at: Floor, residual: np.ndarray) -> np.ndarray:
    """Root mean squares [components] of residuals [features] in floor units; one is what a perfect model would have."""
    return np.sqrt((at.unflatten(residual) ** 2).mean(axis=(0, 1)))


def worst(at: Floor, candidate: Candidate) -> float:
    """Returns the rms of the worst component of all signals on `train` and `select`, in floor units.

    A model whose worst component is near one is at the floor: the logs hold nothing more to find.
    """
    return float(rms(at, np.concatenate([candidate.fit.residual, candidate.select])).max())


def position_gap(problem: Problem, root_mean_squares: np.ndarray) -> float:
    """Picks the worst position of root mean squares [components]: the gap that is reported, in floor units."""
    positions = np.array([signal == "q" for signal, _ in problem.cells])
    return float(root_mean_squares[positions].max())
