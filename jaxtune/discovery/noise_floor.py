"""The noise floor: how far simulation and measurement may differ where nothing is missing in the model.

It is measured on simulated null logs: another engine moves the nominal robot, with parameters drawn from the prior and
the measured log's noise. Their nominal parameters are fitted. The residuals that are left hold noise, rounding, the
error of the state that a segment starts from, and the gap between engines. What all logs leave alike is subtracted from
the measured residuals too. The rms of the rest, for every component of every signal and every moment of a segment, is
the floor; more if the robot does not repeat itself so well. All other modules work on residuals divided by it: a
residual of one floor unit is as large as that rms, which even a model in which nothing is missing leaves.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial

import jax
import numpy as np

from jaxtune.discovery.fit import Free
from jaxtune.discovery.least_squares import Counts, Linear
from jaxtune.discovery.problem import Problem, Segments
from jaxtune.discovery.simulation import Evaluate, paired_residuals, residuals

FURTHEST = 3.0
"""Prior standard deviations that a nominal parameter may move. One that stops there is a finding, not a nuisance."""

_STEPS = 5  # of the fits to null logs; a tenth off in the parameters, one step would leave an engine gap
_FITTED = 64  # segments of a null log that its fit sees, at most
_FEW = 8  # null logs that scales are measured on, at most
_REPEATED = 8  # repetitions of segments that it takes to tell how far they differ
_BROKEN = 5.0  # times the median rms of null logs, beyond which a simulation may have come apart
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
    counts: Counts
    """How many independent numbers residuals are worth."""
    residuals: Mapping[str, Evaluate]
    """By split: simulates vectors [n, axes] and returns residuals [n, features] in floor units."""
    on_some: Callable[[np.ndarray], Evaluate]
    """The same of `train` on some of its segments, by their indices."""
    prior: Free
    """The prior directions, which are free under every hypothesis."""
    null_residuals: np.ndarray
    """[logs, features]: what fits of the prior directions leave of the null logs' `train`, in floor units."""
    null_coordinates: np.ndarray
    """[logs, directions]: where these fits stand."""

    @cached_property
    def slopes(self) -> np.ndarray:
        """Secants along the prior directions from the nominal model on `train`, [features, directions], simulated at
        the first use."""
        evaluate, nominal = self.residuals["train"], np.zeros(self.prior.directions.shape[1])
        (found,) = evaluate.changes([nominal], evaluate(nominal[None]), [self.prior.directions])
        return found.T

    def unflatten(self, flat: np.ndarray) -> np.ndarray:
        """Reshapes flat residuals [features, ...], which fits work on, to [segments, bins, components, ...]."""
        return flat.reshape(-1, *self.scale["train"].shape, *flat.shape[1:])


NoiseFloor = Mapping[float, Floor]
"""A floor for every horizon in s."""


def prior_directions(problem: Problem) -> Free:
    """Lists what is free under every hypothesis: the nominal parameters, and what neither log nor model says.

    Every direction is one standard deviation of its prior. A null whose nominal parameters could not move would call
    every ordinary tolerance of a mass or a gain a missing effect.
    """
    # Entries of the prior that are zero are axes of effects, which the nominal model has not.
    directions = np.concatenate([np.diag(problem.prior)[problem.prior > 0], problem.unknowns])
    bounds = np.concatenate(
        [np.tile([-FURTHEST, FURTHEST], (np.count_nonzero(problem.prior), 1)), problem.unknown_bounds]
    )
    count = len(directions)
    return Free(directions, np.ones(count), bounds, np.ones(count, bool))


def measure(problem: Problem, say: Say) -> NoiseFloor:
    """Measures the noise floor at every horizon from the problem's null logs.

    The null logs are fitted at the main horizon. Other horizons and splits get their floors from what these fits leave
    there, where nothing was fitted, as in the measured log.

    Args:
      problem: its null logs are simulated and fitted.
      say: receives a line of text about progress.
    """
    prior, main = prior_directions(problem), problem.main_horizon
    say(f"noise floor at {main:g} s")
    coordinates, unit = _fit_null_logs(problem, prior)
    fits = coordinates @ prior.directions
    found = {}
    for horizon in problem.horizons:
        say(f"noise floor at {horizon:g} s")
        # All logs where thresholds come from them too; for a scale a few are enough.
        logs = {split: len(fits) if (split, horizon) == ("train", main) else _FEW for split in problem.data}
        left = {split: _simulated(problem, split, horizon, fits[: logs[split]]) for split in problem.data}
        sound = {split: _sound(values, _spread(problem, split, horizon)) for split, values in left.items()}
        left = {split: values[sound[split]] for split, values in left.items()}
        shared = {split: _shared(values) for split, values in left.items()}
        left = {split: values - shared[split] for split, values in left.items()}
        scale = {split: np.maximum(_rms_floor(values), problem.least_floor) for split, values in left.items()}
        wider = _of_repeats(problem, horizon, scale)
        scale = {split: wider * values for split, values in scale.items()}
        in_units = left["train"] / scale["train"]
        segments = {split: data[horizon] for split, data in problem.data.items()}
        found[horizon] = Floor(
            horizon=horizon,
            scale=scale,
            counts=Counts(
                components=unit.shape[-1],
                bins=in_units.shape[2],
                independent=independent_share(in_units.reshape(-1, *in_units.shape[2:])),
            ),
            residuals={
                split: Evaluate(problem, segments[split], scale[split], shared[split]) for split in problem.data
            },
            on_some=partial(_on_some, problem, segments["train"], scale["train"], shared["train"]),
            prior=prior,
            null_residuals=in_units.reshape(len(in_units), -1),
            null_coordinates=coordinates[: len(sound["train"])][sound["train"]],
        )
    return found


def independent_share(residual: np.ndarray) -> float:
    """Estimates independent bins of a segment as a share of all its bins, from residuals [segments, bins, components].

    The mean of n independent bins has 1/n of their variance: n is found from how the means of segments scatter.
    """
    whole = (residual**2).mean(axis=(0, 1))
    of_means = (residual.mean(axis=1) ** 2).mean(axis=0)
    least = 1.0 / residual.shape[1]
    return float(np.clip((whole / np.maximum(of_means, 1e-12)).mean() * least, least, 1.0))


def with_systematic_share(floor: NoiseFloor, at: Floor, residual: np.ndarray) -> NoiseFloor:
    """Sets how much independent evidence a misfit holds, from what the null leaves of the measured log.

    What a wrong model leaves goes together for longer than noise does, so that the same number of rows says less.

    Args:
      floor: of all horizons.
      at: the one at which the residual was simulated; the others get the same number of segments' worth.
      residual: [features] on `train`.
    """
    share = independent_share(at.unflatten(residual))
    bins = len(at.scale["train"])
    return {
        horizon: replace(
            one,
            counts=replace(one.counts, independent=min(share * bins / one.counts.bins, one.counts.independent)),
        )
        for horizon, one in floor.items()
    }


def _fit_null_logs(problem: Problem, prior: Free) -> tuple[np.ndarray, np.ndarray]:
    """Fits the prior directions to every null log, all side by side; returns coordinates [logs, ...] and the unit.

    The unit in which a fit weighs residuals is the floor that is looked for, so both are found in turn.
    """
    logs, main = len(problem.null_logs), problem.main_horizon
    measured, train = problem.data["train"][main], _merged(problem, "train", main, len(problem.null_logs))
    count = len(measured.run)
    chosen = np.linspace(0, count - 1, min(_FITTED, count)).round().astype(int)
    measured = _some_of(measured, chosen)
    train = _some_of(train, (count * np.arange(logs)[:, None] + chosen).ravel())
    simulate = Evaluate(problem, measured, np.ones(1), np.zeros(1))
    nominal = np.zeros(problem.axes)
    (found,) = simulate.changes([nominal], simulate(nominal[None]), [prior.directions])
    slopes = np.moveaxis(found.reshape(len(found), len(measured.run), -1, len(problem.cells)), 0, -1)
    which = np.repeat(np.arange(logs), len(train.run) // logs)
    coordinates, share = np.zeros((logs, len(prior.sd))), 1.0
    last, known = coordinates, None
    for number in range(_STEPS):
        raw = paired_residuals(problem, coordinates @ prior.directions, train, which, np.arange(len(which)))
        raw = raw.reshape(logs, -1, *raw.shape[1:])
        if known is not None:
            # A step may break the simulation of a log, which then stays where it was.
            broken = ~np.isfinite(raw).all(axis=(1, 2, 3))
            raw = np.where(broken[:, None, None, None], known, raw)
            coordinates = np.where(broken[:, None], last, coordinates)
        # What broke in the nominal model already says nothing.
        raw = np.where(np.isfinite(raw), raw, 0.0)
        last, known = coordinates, raw
        least = np.maximum(problem.least_floor, 1e-9)
        unit = np.maximum(np.sqrt((raw**2).mean(axis=(0, 1))), least)
        # The first unit holds what the nominal parameters are off, which the second no longer does.
        for _ in range(2 if number == 0 else 1):
            steps = [
                _step(prior, point, log / unit, slopes / unit[..., None], share)
                for point, log in zip(coordinates, raw, strict=True)
            ]
            left = np.stack([log + slopes @ step for log, step in zip(raw, steps, strict=True)])
            unit = np.maximum(np.sqrt((left**2).mean(axis=(0, 1))), least)
            share = independent_share((left / unit).reshape(-1, *unit.shape))
        coordinates = np.clip(coordinates + np.stack(steps), *prior.bounds.T)
    return coordinates, unit


def _sound(left: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Tells which null logs [logs, segments, bins, components] decide: those that their own models simulate.

    A simulation that comes apart leaves more than the largest joint moves in the signal [components], and more than
    other logs do.

    Raises:
      ValueError: fewer than two.
    """
    rms = np.sqrt((left**2).mean(axis=(1, 2)))
    found = np.isfinite(rms).all(axis=1)
    if found.any():
        found &= ~(rms > np.maximum(spread, _BROKEN * np.median(rms[found], axis=0))).any(axis=1)
    if found.sum() < 2:
        raise ValueError(
            f"null logs: got {found.sum()} of {len(left)} that the nominal model simulates, expected at least 2; "
            "the model may be unstable at the log's rate and gains"
        )
    return found


def _spread(problem: Problem, split: str, horizon: float) -> np.ndarray:
    """The largest standard deviation of the components of every measured signal, [components]."""
    signals = problem.data[split][horizon].signals
    most = [signals[name].std(axis=(0, 1)) for name in sorted(problem.components)]
    return np.concatenate([np.full(len(each), each.max()) for each in most])


def _step(prior: Free, point: np.ndarray, residual: np.ndarray, slopes: np.ndarray, share: float) -> np.ndarray:
    """The Gauss-Newton step [coordinates] from a point, with residuals [...] and slopes [..., coordinates]."""
    weight = np.full(residual.size, share)
    return Linear(residual.ravel(), slopes.reshape(residual.size, -1), point, prior.sd, weight).step(1e-3, prior.bounds)


def _simulated(problem: Problem, split: str, horizon: float, fits: np.ndarray) -> np.ndarray:
    """Residuals [logs, segments, bins, components] of every null log's own model [logs, axes]."""
    segments = _merged(problem, split, horizon, len(fits))
    which = np.repeat(np.arange(len(fits)), len(segments.run) // len(fits))
    found = paired_residuals(problem, fits, segments, which, np.arange(len(which)))
    return found.reshape(len(fits), -1, *found.shape[1:])


def _merged(problem: Problem, split: str, horizon: float, count: int) -> Segments:
    """The segments of the first null logs behind each other; every log has as many."""
    logs = [log[split][horizon] for log in problem.null_logs[:count]]
    return replace(
        logs[0],
        inputs=jax.tree.map(lambda *leaves: np.concatenate(leaves), *(log.inputs for log in logs)),
        signals={name: np.concatenate([log.signals[name] for log in logs]) for name in logs[0].signals},
        run=np.concatenate([log.run for log in logs]),
        regimes=np.concatenate([log.regimes for log in logs]),
        repeats=None,
    )


def _shared(left: np.ndarray) -> np.ndarray:
    """What all null logs leave alike [segments, bins, components]: the gap between engines in this very motion.

    The mean over logs [logs, ...] is shrunk by the share of it that is chance (James and Stein, 1961).
    """
    mean, chance = left.mean(axis=0), left.var(axis=0, ddof=1) / len(left)
    share = 1.0 - chance.mean(axis=(0, 1)) / np.maximum((mean**2).mean(axis=(0, 1)), 1e-30)
    return np.maximum(share, 0.0) * mean


def _rms_floor(left: np.ndarray) -> np.ndarray:
    """The floor [bins, components] from what fits left of null logs, [logs, segments, bins, components]."""
    fresh = np.sqrt((left**2).mean(axis=(0, 1)))
    return np.maximum(fresh, _LEAST_SHARE * fresh.mean(axis=0))


def _of_repeats(problem: Problem, horizon: float, scale: Mapping[str, np.ndarray]) -> np.ndarray:
    """How many times the floor repetitions of a motion differ from each other, [components]; one at least.

    What differs from one run to the next, such as friction that warms up, no model of one robot explains. The error of
    the model is nearly the same in all of them, and drops out of their differences. Sealed runs are not looked at.
    """
    squares, count = 0.0, 0
    for split in (split for split in problem.data if split != "sealed"):
        segments = problem.data[split][horizon]
        groups = np.full(len(segments.run), -1) if segments.repeats is None else segments.repeats
        if (groups < 0).all():
            continue
        (left,) = residuals(problem, np.zeros(problem.axes), segments) / scale[split]
        for group in np.unique(groups[groups >= 0]):
            mine = left[groups == group]
            squares = squares + ((mine - mine.mean(axis=0)) ** 2).mean(axis=1).sum(axis=0)
            count += len(mine) - 1
    return np.sqrt(np.maximum(squares / count, 1.0)) if count >= _REPEATED else np.ones(len(problem.cells))


def _on_some(
    problem: Problem, segments: Segments, scale: np.ndarray, shared: np.ndarray, chosen: np.ndarray
) -> Evaluate:
    """Makes the function from vectors to residuals on the chosen segments."""
    return Evaluate(problem, _some_of(segments, chosen), scale, shared[chosen])


def _some_of(segments: Segments, chosen: np.ndarray) -> Segments:
    """Takes some segments, by their indices."""
    return replace(
        segments,
        inputs=jax.tree.map(lambda leaf: leaf[chosen], segments.inputs),
        signals={name: values[chosen] for name, values in segments.signals.items()},
        run=segments.run[chosen],
        regimes=segments.regimes[chosen],
        repeats=None,
    )
