"""The noise floor: how far simulation and measurement may differ where nothing is missing in the model.

It is measured on simulated null logs: another engine moves the nominal robot, with parameters drawn from the prior and
the measured log's noise. What is left of their residuals after the nominal parameters were fitted holds noise,
rounding, the error of the state that a segment starts from, and the gap between engines, in one number for every
component of every signal and every moment of a segment. All other modules work on residuals divided by it ("floor
units"): one floor unit is as far off as a perfect model would be.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.fit import Fit, Free, refine
from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.simulation import Evaluate, evaluator, residuals, secants

_ROUNDS = 6  # of a fit: a tenth off in the parameters, one step would leave so much that it passed for an engine gap
_FURTHEST = 9.0  # prior deviations: with a spread of a tenth, further down a positive parameter would be negative
_LATEST = 2.0  # timing directions are half a controller period, and nothing is later than a whole one
_LEAST_SHARE = 0.25  # of a component's mean floor: else the first rows of a segment would count without end

Say = Callable[[str], None]
"""Told what is being done, for a progress bar or a log file; it has no part in the results."""


@dataclass(frozen=True)
class Floor:
    """The noise floor at one horizon, and what else is known there before the first hypothesis is asked."""

    scale: Mapping[str, np.ndarray]
    """[bins, components] by split: the rms residual where nothing is missing. Splits differ, since the same model is
    further off in some postures than in others."""
    weight: float
    """Share of the bins that count as independent; neighbours in time go together."""
    slopes: np.ndarray
    """[segments, bins, components, directions] secants of the measured log along the prior directions, at the nominal
    model on `train`, in floor units."""
    null_fits: tuple[Fit, ...]
    """The prior directions fitted to `train` of every null log; empty where the floor came from a `Calibration`."""

    def unflatten(self, flat: np.ndarray) -> np.ndarray:
        """Reshapes flat residuals [features, ...] to [segments, bins, components, ...]."""
        return flat.reshape(-1, *self.scale["train"].shape, *flat.shape[1:])


NoiseFloor = Mapping[float, Floor]
"""A floor for every horizon in s."""


@dataclass(frozen=True)
class Calibration:
    """What simulated null logs taught, for other logs of the same robot, the same motion and the same noise.

    To measure it takes as long as a discovery. A benchmark with many logs of one robot measures it once with
    `workflow.calibrate` and hands it to every `workflow.discover`, whose problems then need no null logs.
    """

    floors: dict[float, tuple[Mapping[str, np.ndarray], float]]
    """Floor [bins, components] by split, and the independent share, by horizon."""
    gain: float
    """Gain of the best hypothesis on null logs, 95th percentile: what a hypothesis must exceed."""
    penalty: float
    """Smallest penalty under which no joint of a null log needs a torque of its own."""


def measure(problem: Problem, calibration: Calibration | None, say: Say) -> NoiseFloor:
    """Measures the noise floor at every horizon, or takes it from a calibration.

    Args:
      problem: its null logs are simulated and fitted, unless there is a calibration.
      calibration: floors that are known already.
      say: told about progress.
    """
    floor = {}
    for horizon in problem.horizons:
        say(f"noise floor at {horizon:g} s")
        if calibration is None:
            floor[horizon] = measure_at(problem, horizon)
        else:
            scale, weight = calibration.floors[horizon]
            slopes = prior_slopes(problem, horizon) / scale["train"][..., None]
            floor[horizon] = Floor(scale, weight, slopes, ())
    return floor


def measure_at(problem: Problem, horizon: float) -> Floor:
    """Measures the noise floor at one horizon from the problem's null logs.

    The unit in which a fit weighs residuals is the floor that is looked for. So two rounds with linearised fits find a
    first floor, then full fits in its units find the one that counts. The other splits get theirs from what these fits
    leave there, where nothing was fitted, as in the measured log.
    """
    slopes = prior_slopes(problem, horizon)
    train = [log["train"][horizon] for log in problem.null_logs]
    raw = [residuals(problem, np.zeros(problem.axes), log)[0] for log in train]
    scale, weight = np.sqrt((np.concatenate(raw) ** 2).mean(axis=0)), 1.0
    for _ in range(2):
        left = np.stack([left_by_prior(log / scale, slopes / scale[..., None], weight) for log in raw])
        scale, weight = _rms_floor(scale, left), _independent_share(left)
    fits = [fit_prior(problem, evaluator(problem, log, scale), slopes / scale[..., None], weight) for log in train]
    left = np.stack([fit.residual.reshape(raw[0].shape) for fit in fits])
    fresh, weight = _rms_floor(scale, left), _independent_share(left)
    scales = {"train": fresh}
    for split in problem.data.keys() - scales.keys():
        logs = zip(fits, problem.null_logs, strict=True)
        there = [residuals(problem, fit.vector, log[split][horizon])[0] for fit, log in logs]
        scales[split] = _rms_floor(np.ones_like(fresh), np.stack(there))
    return Floor(
        scale=scales,
        weight=weight,
        slopes=slopes / fresh[..., None],
        null_fits=tuple(_in_units(fit, (scale / fresh).ravel(), weight) for fit in fits),
    )


def prior_slopes(problem: Problem, horizon: float) -> np.ndarray:
    """Takes secants of the measured log's residuals along the prior directions, at the nominal model on `train`.

    Returns:
      [segments, bins, components, directions], in the units of the signals.
    """
    directions = prior_directions(problem).directions
    return secants(problem, np.zeros(problem.axes), directions, problem.data["train"][horizon])


def prior_directions(problem: Problem) -> Free:
    """Lists what is free under every hypothesis: the nominal parameters, and the controller's timing.

    Every direction is one standard deviation of its prior. A null whose nominal parameters could not move would call
    every ordinary tolerance of a mass or a gain a missing effect.
    """
    directions = np.concatenate([np.diag(problem.prior)[problem.prior > 0], problem.timing])
    count = len(directions)
    bounds = np.tile([-_FURTHEST, _FURTHEST], (count, 1))
    # A controller does not act before it is time.
    bounds[count - len(problem.timing) :] = [0.0, _LATEST]
    return Free(directions, np.ones(count), bounds, np.ones(count, bool))


def fit_prior(problem: Problem, evaluate: Evaluate, slopes: np.ndarray, weight: float) -> Fit:
    """Fits the prior directions to a log, from the nominal model on.

    Args:
      problem: what is free.
      evaluate: residuals of vectors on the log.
      slopes: [segments, bins, components, directions] at the nominal model, in floor units. They may be another log's
        of the same motion: a fit corrects them as it goes.
      weight: share of the bins that count as independent.
    """
    free = prior_directions(problem)
    start = Fit(
        free=free,
        coordinates=np.zeros(len(free.sd)),
        residual=evaluate(np.zeros((1, problem.axes)))[0],
        jacobian=slopes.reshape(-1, len(free.sd)),
        weight=weight,
    )
    return refine([start], evaluate, _ROUNDS)[0]


def left_by_prior(residual: np.ndarray, slopes: np.ndarray, weight: float) -> np.ndarray:
    """Residuals [...] that one linear step along the prior directions leaves, by slopes [..., directions].

    A quick estimate of what a fit would leave; it costs no simulation.
    """
    count = slopes.shape[-1]
    linear = Linear(residual.ravel(), slopes.reshape(-1, count), np.zeros(count), np.ones(count), weight)
    return residual + slopes @ linear.step()


def _rms_floor(unit: np.ndarray, left: np.ndarray) -> np.ndarray:
    """The floor [bins, components] from what fits left of null logs, [logs, segments, bins, components] in a unit."""
    fresh = unit * np.sqrt((_every_segment(left) ** 2).mean(axis=0))
    return np.maximum(fresh, _LEAST_SHARE * fresh.mean(axis=0))


def _independent_share(left: np.ndarray) -> float:
    """Independent bins of a segment as a share of all its bins.

    The mean of n independent bins has 1/n of their variance: n is found from how the means of segments scatter.
    """
    residual = _every_segment(left)
    whole = (residual**2).mean(axis=(0, 1))
    of_means = (residual.mean(axis=1) ** 2).mean(axis=0)
    return float(
        np.clip((whole / np.maximum(of_means, 1e-12)).mean() / residual.shape[1], 1.0 / residual.shape[1], 1.0)
    )


def _every_segment(left: np.ndarray) -> np.ndarray:
    """The segments of all logs in one row, [logs * segments, bins, components]."""
    return left.reshape(-1, *left.shape[2:])


def _in_units(fit: Fit, change: np.ndarray, weight: float) -> Fit:
    """A fit whose residuals are multiplied by `change` [bins * components], the old floor over the new one."""
    residual = (fit.residual.reshape(-1, len(change)) * change).ravel()
    return replace(fit, residual=residual, weight=weight)
