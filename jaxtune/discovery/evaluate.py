"""Questions to a model at one horizon: its residuals, the same model fitted again, or fitted without an effect.

All are pure functions of the problem, the noise floor and a fit; the steps of a discovery are made of them.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jaxtune.discovery import decide
from jaxtune.discovery.fit import Fit, Free, fit_at, refine
from jaxtune.discovery.noise_floor import NoiseFloor, fit_prior, prior_directions
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.simulation import Evaluate, evaluator

_OPEN = ("train", "select")  # splits that may be looked at before the proof
_ABLATION_ROUNDS = 3


def residuals_on(problem: Problem, floor: NoiseFloor, horizon: float, split: str) -> Evaluate:
    """Makes the function that simulates vectors [n, axes] on a split and returns residuals [n, features].

    Args:
      problem: the simulator and the segments.
      floor: the noise floor; residuals are in its units.
      horizon: length of the segments in s.
      split: `train`, `select` or `sealed`.
    """
    return evaluator(problem, problem.data[split][horizon], floor[horizon].scale[split])


def fit_null(problem: Problem, floor: NoiseFloor) -> Fit:
    """Fits the prior directions alone to `train` at the main horizon: the model in which nothing is missing.

    Raises:
      ValueError: the nominal model cannot be simulated on these logs.
    """
    horizon = problem.main_horizon
    at = floor[horizon]
    null = fit_prior(problem, residuals_on(problem, floor, horizon, "train"), at.slopes, at.weight)
    if not np.isfinite(null.residual).all():
        raise ValueError(f"model: the nominal one breaks within {horizon:g} s of these logs")
    return null


def stand_at(problem: Problem, floor: NoiseFloor, horizon: float, free: Free, coordinates: np.ndarray) -> Fit:
    """Makes the fit of a model of which only the coordinates are known, as after loading a state.

    Args:
      problem: the simulator and the segments.
      floor: the noise floor.
      horizon: length of the segments in s.
      free: what the coordinates are.
      coordinates: [coordinates] where the model stands.
    """
    return fit_at(free, coordinates, floor[horizon].weight, residuals_on(problem, floor, horizon, "train"))


def refit(problem: Problem, floor: NoiseFloor, horizon: float, fit: Fit, rounds: int) -> Fit:
    """Fits a model again with fresh slopes, at a horizon that may not be the one it was fitted at.

    A round of discovery starts with it. Otherwise the screen would not see what the nominal parameters have taken
    over, and a hypothesis would be credited with what the model without it gains from more rounds.

    Args:
      problem: the simulator and the segments.
      floor: the noise floor.
      horizon: length of the segments in s.
      fit: the model; of its residuals and slopes nothing is used.
      rounds: of refinement.

    Raises:
      ValueError: the model cannot be simulated on these segments.
    """
    fresh = stand_at(problem, floor, horizon, fit.free, fit.coordinates)
    (found,) = refine([fresh], residuals_on(problem, floor, horizon, "train"), rounds)
    if not np.isfinite(found.residual).all():
        raise ValueError(f"model: it breaks within {horizon:g} s of these logs")
    return found


def refit_others(problem: Problem, floor: NoiseFloor, fits: Mapping[float, Fit], rounds: int) -> dict[float, Fit]:
    """Fits the model again at every horizon but the main one, which is taken as it is.

    Args:
      problem: the simulator and the segments.
      floor: the noise floor.
      fits: the model by horizon; where it was never fitted at a horizon, the main one's fit is the start.
      rounds: of refinement.
    """
    main = fits[problem.main_horizon]
    others = [horizon for horizon in problem.horizons if horizon != problem.main_horizon]
    return {problem.main_horizon: main} | {
        horizon: refit(problem, floor, horizon, fits.get(horizon, main), rounds) for horizon in others
    }


def ablate(problem: Problem, floor: NoiseFloor, horizon: float, fit: Fit, hypothesis: Hypothesis) -> Fit:
    """Takes an accepted effect out of a model and fits everything else again.

    The nominal parameter that the effect had taken over becomes free again, at its prior's centre.

    Args:
      problem: the simulator and the segments.
      floor: the noise floor, with the slopes of the prior directions.
      horizon: length of the segments in s.
      fit: the model with the effect.
      hypothesis: the effect.
    """
    own = fit.along(hypothesis)
    evaluate = residuals_on(problem, floor, horizon, "train")
    first, slopes = prior_directions(problem), floor[horizon].slopes.reshape(len(fit.residual), -1)
    kept = fit.free.directions[fit.free.nominal & ~own]
    back = np.array([not any((row == mine).all() for mine in kept) for row in first.directions])
    start = replace(
        fit,
        free=fit.free.only(~own).and_then(first.only(back)),
        coordinates=np.concatenate([fit.coordinates[~own], np.zeros(back.sum())]),
        jacobian=np.concatenate([fit.jacobian[:, ~own], slopes[:, back]], axis=1),
    )
    start = replace(start, residual=evaluate(start.vector[None])[0])
    return refine([start], evaluate, _ABLATION_ROUNDS)[0]


def standard_errors(problem: Problem, floor: NoiseFloor, fit: Fit) -> np.ndarray:
    """Computes the standard errors [coordinates] of a fit at the main horizon (`decide.sandwich`)."""
    features = floor[problem.main_horizon].scale["train"].size  # of a segment
    jacobian = fit.jacobian.reshape(-1, features, fit.jacobian.shape[-1])
    run = problem.data["train"][problem.main_horizon].run
    return decide.sandwich(fit.residual.reshape(-1, features), jacobian, fit.weight, fit.free.sd, run)


def rms(problem: Problem, floor: NoiseFloor, vectors: np.ndarray, splits: tuple[str, ...] = _OPEN) -> np.ndarray:
    """Simulates vectors [n, axes] at the main horizon; returns root mean squares [n, components] in floor units.

    Args:
      problem: the simulator and the segments.
      floor: the noise floor.
      vectors: [n, axes] models.
      splits: which segments, together; all but the sealed ones if not given.
    """
    main = problem.main_horizon
    found = np.concatenate([residuals_on(problem, floor, main, split)(vectors) for split in splits], axis=1)
    return np.stack([np.sqrt((floor[main].unflatten(one) ** 2).mean(axis=(0, 1))) for one in found])


def worst(problem: Problem, floor: NoiseFloor, vector: np.ndarray) -> float:
    """Returns the rms of the worst component of all signals on `train` and `select`, in floor units.

    A model whose worst component is near one is at the floor: the logs hold nothing more to find.
    """
    return float(rms(problem, floor, vector[None])[0].max())


def position_gap(problem: Problem, root_mean_squares: np.ndarray) -> float:
    """Picks the worst position of root mean squares [components]: the gap that is reported, in floor units."""
    positions = np.array([signal == "q" for signal, _ in problem.cells])
    return float(root_mean_squares[positions].max())
