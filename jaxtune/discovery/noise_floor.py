"""The noise floor: how far simulation and measurement may differ where nothing is missing in the model.

It is measured on simulated null logs: another engine moves the nominal robot, with parameters drawn from the prior and
the measured log's noise. Their nominal parameters are fitted. The residuals that are left hold noise, rounding, the
error of the state that a segment starts from, and the gap between engines. Their rms, for every component of every
signal and every moment of a segment, is the floor. All other modules work on residuals divided by it: a residual of one
floor unit is as large as that rms, which even a model in which nothing is missing leaves.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from jaxtune.discovery.fit import Fit, Free, fit_prior
from jaxtune.discovery.least_squares import Linear
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.simulation import Evaluate, flat_residuals, residuals, secants

_FURTHEST = 9.0  # prior deviations: with a spread of a tenth, further down a positive parameter would be negative
_LATEST = 2.0  # timing directions are half a controller period, and nothing is later than a whole one
_LEAST_SHARE = 0.25  # of a component's mean floor: else the first rows of a segment would count without end

Say = Callable[[str], None]
"""Told what is being done, for a progress bar or a log file; it has no part in the results."""


@dataclass(frozen=True, kw_only=True)
class Floor:
    """The measured log at one horizon in floor units: how to simulate it, and what is known before any hypothesis.

    The steps of a discovery see the log and the simulator through it alone.
    """

    horizon: float
    """Length of the segments in s."""
    scale: Mapping[str, np.ndarray]
    """[bins, components] by split: the rms residual where nothing is missing. Splits differ, since the same model is
    further off in some postures than in others."""
    weight: float
    """Share of the bins that count as independent; neighbours in time go together."""
    residuals: Mapping[str, Evaluate]
    """By split: simulates vectors [n, axes] and returns residuals [n, features] in floor units."""
    secants: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """`secants(vector [axes], directions [k, axes])`: differences of the residuals on `train`, [segments, bins,
    components, k], in the signals' units."""
    prior: Free
    """The prior directions, which are free under every hypothesis."""
    null_fits: tuple[Fit, ...] = ()
    """The prior directions fitted to `train` of every null log; empty where the floor came from a `Calibration`."""

    @cached_property
    def slopes(self) -> np.ndarray:
        """Secants along the prior directions from the nominal model, in floor units.

        They are simulated at the first use: with a calibration, most horizons never need them.

        Returns:
          [segments, bins, components, directions]
        """
        nominal = np.zeros(self.prior.directions.shape[1])
        return self.secants(nominal, self.prior.directions) / self.scale["train"][..., None]

    def unflatten(self, flat: np.ndarray) -> np.ndarray:
        """Reshapes flat residuals [features, ...], which fits work on, to [segments, bins, components, ...]."""
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
    """Gain (fall of the loss) that the best hypothesis exceeds on null logs with probability `Settings.level`."""
    penalty: float
    """Smallest weight of the group lasso (`localise.free_torque`) at which no joint of a null log gets a torque."""


def measure(problem: Problem, calibration: Calibration | None, say: Say) -> NoiseFloor:
    """Measures the noise floor at every horizon, or takes it from a calibration.

    Args:
      problem: its null logs are simulated and fitted, unless there is a calibration.
      calibration: floors that are known already.
      say: receives a line of text about progress.
    """
    floor = {}
    for horizon in problem.horizons:
        say(f"noise floor at {horizon:g} s")
        floor[horizon] = measure_at(problem, horizon, calibration.floors[horizon] if calibration else None)
    return floor


def measure_at(problem: Problem, horizon: float, known: tuple[Mapping[str, np.ndarray], float] | None = None) -> Floor:
    """Measures the noise floor at one horizon from the problem's null logs, unless its scale and weight are known."""
    prior = prior_directions(problem)
    scale, weight, null_fits = (*known, ()) if known else _from_null_logs(problem, horizon, prior)
    segments = {split: data[horizon] for split, data in problem.data.items()}
    return Floor(
        horizon=horizon,
        scale=scale,
        weight=weight,
        residuals={split: partial(flat_residuals, problem, segments[split], scale[split]) for split in segments},
        secants=partial(secants, problem, segments["train"]),
        prior=prior,
        null_fits=null_fits,
    )


def prior_directions(problem: Problem) -> Free:
    """Lists what is free under every hypothesis: the nominal parameters, and the controller's timing.

    Every direction is one standard deviation of its prior. A null whose nominal parameters could not move would call
    every ordinary tolerance of a mass or a gain a missing effect.
    """
    # Entries of the prior that are zero are axes of effects, which the nominal model has not.
    directions = np.concatenate([np.diag(problem.prior)[problem.prior > 0], problem.timing])
    count = len(directions)
    bounds = np.tile([-_FURTHEST, _FURTHEST], (count, 1))
    # A controller does not act before it is time.
    bounds[count - len(problem.timing) :] = [0.0, _LATEST]
    return Free(directions, np.ones(count), bounds, np.ones(count, bool))


def prior_slopes(problem: Problem, horizon: float) -> np.ndarray:
    """Takes secants of the measured log's residuals along the prior directions, at the nominal model on `train`.

    Returns:
      [segments, bins, components, directions], in the units of the signals.
    """
    directions = prior_directions(problem).directions
    return secants(problem, problem.data["train"][horizon], np.zeros(problem.axes), directions)


def left_by_prior(residual: np.ndarray, slopes: np.ndarray, weight: float) -> np.ndarray:
    """Residuals [...] that one linear step along the prior directions leaves, by slopes [..., directions].

    A quick estimate of what a fit would leave; it costs no simulation.
    """
    count = slopes.shape[-1]
    linear = Linear(residual.ravel(), slopes.reshape(-1, count), np.zeros(count), np.ones(count), weight)
    return residual + slopes @ linear.step()


def _from_null_logs(
    problem: Problem, horizon: float, prior: Free
) -> tuple[dict[str, np.ndarray], float, tuple[Fit, ...]]:
    """Floor by split, independent share, and the fits to the null logs.

    The unit in which a fit weighs residuals is the floor that is looked for. So two rounds with linearised fits find a
    first floor, then full fits in its units find the one that counts. The other splits get theirs from what these fits
    leave there, where nothing was fitted, as in the measured log.
    """
    simulate, slopes = partial(residuals, problem), prior_slopes(problem, horizon)
    train = [log["train"][horizon] for log in problem.null_logs]
    raw = [simulate(np.zeros(problem.axes), log)[0] for log in train]
    unit, weight = np.sqrt((np.concatenate(raw) ** 2).mean(axis=0)), 1.0
    # The first unit holds what the nominal parameters are off, which the second no longer does.
    for _ in range(2):
        left = np.stack([left_by_prior(log / unit, slopes / unit[..., None], weight) for log in raw])
        unit, weight = _rms_floor(unit, left), _independent_share(left)
    evaluate = [partial(flat_residuals, problem, log, unit) for log in train]
    fits = [fit_prior(prior, residuals_of, slopes / unit[..., None], weight) for residuals_of in evaluate]
    left = np.stack([fit.residual.reshape(raw[0].shape) for fit in fits])
    scale, weight = {"train": _rms_floor(unit, left)}, _independent_share(left)
    # Nothing is fitted there: the fit to `train` is taken as it is.
    for split in problem.data.keys() - scale.keys():
        logs = zip(fits, problem.null_logs, strict=True)
        there = [simulate(fit.vector, log[split][horizon])[0] for fit, log in logs]
        scale[split] = _rms_floor(np.ones_like(unit), np.stack(there))
    return scale, weight, tuple(_in_units(fit, (unit / scale["train"]).ravel(), weight) for fit in fits)


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
