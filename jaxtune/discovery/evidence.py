"""Whether each effect of a model is proved, against the same model without it (step 7)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.candidate import (
    Candidate,
    cost,
    finite,
    measures,
    runs_of,
    squares,
    total_cost,
    units_of,
)
from jaxtune.discovery.fit import Fit, refine, without
from jaxtune.discovery.noise_floor import Floor, NoiseFloor
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.resample import standard_errors

_ABLATION_ROUNDS = 3
_SEGMENTS = 8  # of a run that may speak alone


@dataclass(frozen=True)
class Evidence:
    """What speaks for an effect against the same model without it, whose other coordinates were fitted again."""

    gain: float
    """Fall of the cost on `train` and `select`."""
    confirmed: float
    """Fall of the cost on `select` alone, where nothing was fitted, prior included."""
    floors: float
    """Root of the largest fall of a single component's mean square, in floor units. It is that of all segments of
    `train` and `select` but a few (`Counts.usual`), of typical ones (`Counts.variances`), or of a run, since few
    motions may show an effect: where it is largest against what it has to reach."""
    left: float
    """Rms of the same component with the effect, in floor units, of the same segments. What is left at other joints
    says nothing about an effect."""
    relief: float
    """Fall of what the prior says against the other coordinates: without the effect they imitate it."""
    interval: tuple[float, float]
    """95 % interval of the coordinate that is clearest of zero, of the effect or of its forms: where damping is free
    under every hypothesis, friction with the square of speed is what may be missing."""
    inside: bool
    """True if all sizes are inside their bounds; of sizes for each place, the one that is clearest of zero. A model may
    lose all that it has (`Hypothesis.spent`): dampings and rotors of many are placeholders."""
    horizons: int
    """Number of horizons at which `train` and `select` cost less with it, prior included."""
    size: float
    """Its largest parameter, divided by the smallest size of interest."""


@dataclass(frozen=True)
class Thresholds:
    """What the evidence has to exceed (`gain`) or to reach (the others)."""

    gain: float
    """Fall of the cost that the best hypothesis reaches on null logs with probability `Settings.level`."""
    against: float = 0.05
    """Share of the gain by which the cost may rise on `select`, which may hold no motion that shows the effect."""
    floors: float = 1.0
    of_left: float = 0.5
    """What `floors` has to reach as a share of `left`: where much is left, a small gain is of another form of an effect
    that is there already."""
    relief: float = 9.0
    """In the place of `floors`: a parameter that need not be three deviations off."""
    inside: bool = True
    """Whether the fit may not stand at a bound."""
    horizons: int = 2
    size: float = 0.1


def weigh_evidence(
    problem: Problem,
    floor: NoiseFloor,
    candidate: Candidate,
    hypothesis: Hypothesis,
    fitted: Mapping[str, Candidate],
) -> tuple[Evidence, Candidate]:
    """Collects what speaks for one effect of a candidate: compares it with the best model without the effect.

    Args:
      problem: the runs of the segments.
      floor: the noise floor.
      candidate: the model with the effect, with fresh slopes.
      hypothesis: the effect.
      fitted: models that were fitted already, by key.

    Returns:
      The evidence, and the model without the effect.
    """
    at = floor[problem.main_horizon]
    ablated = or_known(ablate(at, candidate, hypothesis), fitted)
    now, before = squares(at, candidate), squares(at, ablated)
    held_out = len(problem.data["train"][at.horizon].run)
    fit, parts = candidate.fit, (hypothesis, *candidate.forms_of(hypothesis))
    errors = standard_errors(fit, units_of(problem, at, now)[:held_out])
    clear = [_clearest(fit, errors, part) for part in parts]
    (_, clearest, _, _), (_, _, value, error) = clear[0], max(clear)
    values, (low, high) = fit.coordinates[fit.along(hypothesis)], hypothesis.bounds.T
    inside = ((low < values) | hypothesis.spent) & (values < high)
    # What only shapes an effect says nothing where it ends: a filter may have one stage.
    inside |= ~(hypothesis.probes != 0).any(axis=0)
    # Drag of the square of speed alone has none in proportion to speed.
    whole = [part for part in parts if part is hypothesis or part.alone]
    inside |= (len(whole) > 1) & (low == 0) & (values < high)
    relief = ablated.fit.penalty - fit.penalty
    mean_squares = [finite(one) / at.counts.bins for one in (before, now)]
    falls = [_largest_fall(*(measure(one) for one in mean_squares)) for measure in measures(at)]
    falls += _falls_of_runs(*mean_squares, runs_of(problem, at), at.counts.usual(mean_squares[1]))
    floors, left = max(falls, key=lambda pair: pair[0] / max(Thresholds.floors, Thresholds.of_left * pair[1]))
    evidence = Evidence(
        gain=total_cost(at, ablated, 0.0) - total_cost(at, candidate, 0.0),
        confirmed=cost(at, before[held_out:]) - cost(at, now[held_out:]) + relief,
        floors=floors,
        left=left,
        relief=relief,
        interval=(value - 1.96 * error, value + 1.96 * error),
        # Of several places one may have nothing of it, or less than nothing.
        inside=bool(inside[clearest] if hypothesis.each else inside.all()),
        horizons=_horizons_better(floor, candidate.fit, ablated.fit),
        size=max(_in_smallest(fit.coordinates[fit.along(part)], part.probes) for part in whole),
    )
    return evidence, ablated


def passes(evidence: Evidence, thresholds: Thresholds) -> dict[str, bool]:
    """Tests the evidence; an effect stays in the model if all tests, which are returned by name, are passed."""
    low, high = evidence.interval
    return {
        # With thousands of residuals every mimic of an engine gap is significant; null logs say what chance gains.
        "beyond_chance": evidence.gain > thresholds.gain,
        # Select may hold no motion that shows the effect, but it must not speak against it.
        "confirmed": evidence.confirmed > -thresholds.against * evidence.gain,
        # What nominal parameters can imitate shows in how far they must go, and not in the residuals.
        "matters": evidence.floors >= max(thresholds.floors, thresholds.of_left * evidence.left)
        or evidence.relief >= thresholds.relief,
        # A fit that ran into a bound stands in for another effect.
        "inside_bounds": evidence.inside or not thresholds.inside,
        "clear_of_zero": low > 0 or high < 0,
        # Long segments let a wrong effect compensate, short ones are blind to slow bias: two must agree.
        "horizons": evidence.horizons >= thresholds.horizons,
        # Where logs are very exact, much less than anybody looks for makes up for the form of another effect.
        "of_interest": evidence.size >= thresholds.size,
    }


def ablate(at: Floor, candidate: Candidate, hypothesis: Hypothesis) -> Candidate:
    """Takes an effect with its forms out of a candidate and fits the rest again.

    Args:
      at: the floor at the main horizon.
      candidate: the model with the effect.
      hypothesis: the effect.
    """
    gone = [hypothesis, *candidate.forms_of(hypothesis)]
    others = tuple(other for other in candidate.hypotheses if all(other is not one for one in gone))
    start, evaluate = candidate.fit, at.residuals["train"]
    for one in gone:
        start = without(start, one, at.prior, at.slopes)
    start = replace(start, residual=evaluate(start.vector[None])[0])
    (fit,) = refine([start], evaluate, _ABLATION_ROUNDS)
    return Candidate(others, fit, at.residuals["select"](fit.vector[None])[0])


def or_known(candidate: Candidate, fitted: Mapping[str, Candidate]) -> Candidate:
    """A candidate, or the same model where it was fitted already and costs less.

    A fit that was not finished would be evidence for the effect that was taken out.

    Args:
      candidate: from `ablate`.
      fitted: models by key.
    """
    known = fitted.get(candidate.key)
    return known if known and known.fit.cost <= candidate.fit.cost else candidate


def _clearest(fit: Fit, errors: np.ndarray, part: Hypothesis) -> tuple[float, int, float, float]:
    """The coordinate of an effect or form that is clearest of zero: by how many errors, its number, it and its error.

    A parameter without a probe of its own means nothing alone.
    """
    along = fit.along(part)
    values, errors = fit.coordinates[along], errors[along]
    distance = np.where((part.probes != 0).any(axis=0), np.abs(values) / errors, 0.0)
    number = int(distance.argmax())
    return float(distance[number]), number, float(values[number]), float(errors[number])


def _in_smallest(values: np.ndarray, probes: np.ndarray) -> float:
    """The largest of parameters [parameters], each divided by its smallest probe; one without a probe is no size."""
    smallest = np.where(probes != 0, np.abs(probes), np.inf).min(axis=0)
    return float((np.abs(values) / smallest).max())


def _largest_fall(before: np.ndarray, now: np.ndarray, least: np.ndarray | None = None) -> tuple[float, float]:
    """Of mean squares [components]: the root of the largest fall, and that of what is left there, or of `least`."""
    where = int((before - now).argmax())
    left = now[where] if least is None else max(now[where], least[where])
    return float(np.sqrt(max(before[where] - now[where], 0.0))), float(np.sqrt(left))


def _falls_of_runs(before: np.ndarray, now: np.ndarray, run: np.ndarray, left: np.ndarray) -> list[tuple[float, float]]:
    """The same of every run with enough segments, without the two in which most falls: one or two are no evidence.

    What is left is no less than `left` [components], of all segments: a quiet run does not excuse the others.
    """
    found = []
    for number in np.unique(run):
        here = run == number
        if here.sum() >= _SEGMENTS:
            kept = np.argsort(before[here] - now[here], axis=0)[:-2]
            was, remains = (np.take_along_axis(one[here], kept, axis=0).mean(axis=0) for one in (before, now))
            found.append(_largest_fall(was, remains, left))
    return found


def _horizons_better(floor: NoiseFloor, fit: Fit, other: Fit) -> int:
    """Number of horizons at which `train` and `select` cost less with a model than with the other one."""
    better = 0
    for at in floor.values():
        both = [at.residuals[split](np.stack([fit.vector, other.vector])) for split in ("train", "select")]
        costs = [cost(at, (at.unflatten(one) ** 2).sum(axis=1)) for one in np.concatenate(both, axis=1)]
        better += costs[0] + fit.penalty < costs[1] + other.penalty
    return better
