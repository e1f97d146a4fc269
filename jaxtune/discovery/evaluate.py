"""Questions to a model at one horizon: how far off it is, the same model fitted again, or fitted without an effect.

All are pure functions of the floor at that horizon and a fit; the steps of a discovery are made of them.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jaxtune.discovery.fit import Fit, fit_at, fit_prior, refine
from jaxtune.discovery.noise_floor import Floor, NoiseFloor
from jaxtune.discovery.problem import Hypothesis, Problem

_OPEN = ("train", "select")  # splits that may be looked at before the proof
_ABLATION_ROUNDS = 3


def fit_null(at: Floor) -> Fit:
    """Fits the prior directions alone to `train`: the model in which nothing is missing.

    Raises:
      ValueError: the nominal model cannot be simulated on these logs.
    """
    null = fit_prior(at.prior, at.residuals["train"], at.slopes, at.weight)
    if not np.isfinite(null.residual).all():
        raise ValueError(f"model: the nominal one breaks within {at.horizon:g} s of these logs")
    return null


def refit(at: Floor, fit: Fit, rounds: int) -> Fit:
    """Fits a model again with fresh slopes, at a horizon that may not be the one it was fitted at.

    A step of a discovery starts with it. Otherwise the screen would not see what the nominal parameters have taken
    over, and a hypothesis would be credited with what the model without it gains from more rounds.

    Raises:
      ValueError: the model cannot be simulated on these segments.
    """
    # Of the old fit no residual and no slope is kept: both may be another horizon's, or many steps old.
    fresh = fit_at(fit.free, fit.coordinates, at.weight, at.residuals["train"])
    (found,) = refine([fresh], at.residuals["train"], rounds)
    if not np.isfinite(found.residual).all():
        raise ValueError(f"model: it breaks within {at.horizon:g} s of these logs")
    return found


def refit_others(floor: NoiseFloor, fits: Mapping[float, Fit], main: float, rounds: int) -> dict[float, Fit]:
    """Fits the model again at every horizon but the main one, which is taken as it is.

    Args:
      floor: the noise floor.
      fits: the model by horizon; where it was never fitted at a horizon, the main one's fit is the start.
      main: the main horizon in s.
      rounds: of refinement.
    """
    others = {
        horizon: refit(at, fits.get(horizon, fits[main]), rounds) for horizon, at in floor.items() if horizon != main
    }
    return {main: fits[main]} | others


def ablate(at: Floor, fit: Fit, hypothesis: Hypothesis) -> Fit:
    """Takes an accepted effect out of a model and fits everything else again.

    The nominal parameter that the effect had taken over becomes free again, at its prior's centre.
    """
    own = fit.along(hypothesis)
    slopes = at.slopes.reshape(len(fit.residual), -1)
    kept = fit.free.directions[fit.free.nominal & ~own]
    # Directions of the prior that the model has not: the effect had taken them over.
    back = np.array([not any((row == mine).all() for mine in kept) for row in at.prior.directions])
    start = replace(
        fit,
        free=fit.free.only(~own).and_then(at.prior.only(back)),
        coordinates=np.concatenate([fit.coordinates[~own], np.zeros(back.sum())]),
        jacobian=np.concatenate([fit.jacobian[:, ~own], slopes[:, back]], axis=1),
    )
    start = replace(start, residual=at.residuals["train"](start.vector[None])[0])
    return refine([start], at.residuals["train"], _ABLATION_ROUNDS)[0]


def rms(at: Floor, vectors: np.ndarray, splits: tuple[str, ...] = _OPEN) -> np.ndarray:
    """Simulates vectors [n, axes] on some splits together; returns root mean squares [n, components] in floor units.

    One is what a perfect model would have. The sealed segments are left out unless they are asked for.
    """
    found = np.concatenate([at.residuals[split](vectors) for split in splits], axis=1)
    return np.stack([np.sqrt((at.unflatten(one) ** 2).mean(axis=(0, 1))) for one in found])


def worst(at: Floor, vector: np.ndarray) -> float:
    """Returns the rms of the worst component of all signals on `train` and `select`, in floor units.

    A model whose worst component is near one is at the floor: the logs hold nothing more to find.
    """
    return float(rms(at, vector[None])[0].max())


def position_gap(problem: Problem, root_mean_squares: np.ndarray) -> float:
    """Picks the worst position of root mean squares [components]: the gap that is reported, in floor units."""
    positions = np.array([signal == "q" for signal, _ in problem.cells])
    return float(root_mean_squares[positions].max())
