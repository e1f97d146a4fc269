"""Which of the fitted models is believed, how far, and whether each of its effects is proved (step 7).

Models are compared by their cost on `train` and `select` (validation) together, prior included, plus a price for every
effect: what chance gains on null logs. A model is believed in the share of resampled logs in which it costs least, each
model with the weight exp(-cost / 2): pseudo-Bayesian model averaging with a bootstrap (Yao et al., 2018).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.fit import Fit, refine, without
from jaxtune.discovery.noise_floor import Floor, NoiseFloor
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.resample import standard_errors, times_drawn, units
from jaxtune.discovery.result import Settings, Suspect

_ABLATION_ROUNDS = 3
_FAR = 1e9  # sum of squares
_SEGMENTS = 8  # of a run that may speak alone

Measure = Callable[[np.ndarray], np.ndarray]
"""Mean squares [components] from those of all segments, [segments, components]."""


@dataclass(frozen=True)
class Candidate:
    """A model with some effects in it, fitted on `train` and simulated on `select`, both at the main horizon."""

    hypotheses: tuple[Hypothesis, ...]
    """Its effects; none in the null."""
    fit: Fit
    select: np.ndarray
    """[features]: residuals on `select` in floor units."""

    @property
    def key(self) -> str:
        """The keys of its effects in one word, such as `coulomb@elbow + payload@forearm`; `null` without any."""
        return key_of(self.hypotheses)

    @property
    def effects(self) -> tuple[Hypothesis, ...]:
        """Its effects without their forms."""
        return tuple(hypothesis for hypothesis in self.hypotheses if not hypothesis.form)

    def forms_of(self, effect: Hypothesis) -> tuple[Hypothesis, ...]:
        """Its forms of one of its effects."""
        return tuple(hypothesis for hypothesis in self.hypotheses if hypothesis.shapes(effect))

    def price(self, of_effect: float) -> float:
        """Returns what its hypotheses cost; a form costs half, as there are few to choose from."""
        return of_effect * (len(self.hypotheses) + len(self.effects)) / 2


def key_of(hypotheses: Sequence[Hypothesis]) -> str:
    """The key of a model with these effects."""
    return " + ".join(sorted(hypothesis.key for hypothesis in hypotheses)) or "null"


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
    """95 % interval of the coordinate that is clearest of zero."""
    inside: bool
    """True if all coordinates are inside their bounds."""
    horizons: int
    """Number of horizons at which `train` and `select` cost less with it, prior included."""


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


def squares(at: Floor, candidate: Candidate) -> np.ndarray:
    """Sums the squares of a candidate's residuals over bins: [segments, components], of `train`, then of `select`."""
    both = np.concatenate([candidate.fit.residual, candidate.select])
    return (at.unflatten(both) ** 2).sum(axis=1)


def measures(at: Floor) -> tuple[Measure, Measure]:
    """How far off a model is in all segments but a few (`Counts.usual`), and in typical ones (`Counts.variances`)."""
    return at.counts.usual, at.counts.variances


def total_cost(at: Floor, candidate: Candidate, price: float) -> float:
    """Returns the cost of a candidate on `train` and `select`, with its prior and a price for every effect."""
    of_segments = squares(at, candidate)
    return _cost(at, of_segments) + candidate.fit.penalty + candidate.price(price)


def posterior(problem: Problem, at: Floor, candidates: Sequence[Candidate], price: float, seed: int = 0) -> np.ndarray:
    """Computes how far every candidate is believed, [candidates], from logs that are resampled.

    Args:
      problem: the runs of the segments.
      at: the floor at the main horizon.
      candidates: what is compared, best first; the null should be among them.
      price: of every effect.
      seed: of the draws.
    """
    all_squares = [squares(at, candidate) for candidate in candidates]
    times = times_drawn(units_of(problem, at, all_squares[0]), seed=seed)
    costs = []
    for candidate, mine in zip(candidates, all_squares, strict=True):
        of_segments = at.counts.cost(finite(mine) / at.counts.bins)
        costs.append(times @ of_segments + candidate.fit.penalty + candidate.price(price))
    weights = np.exp(-0.5 * (np.array(costs) - np.min(costs, axis=0)))
    return (weights / weights.sum(axis=0)).mean(axis=1)


def units_of(problem: Problem, at: Floor, of_segments: np.ndarray) -> np.ndarray:
    """Groups the segments of `train` and `select` into units that are drawn together, [segments]."""
    select = problem.data["select"][at.horizon].run
    return units(_runs(problem, at), of_segments, len(np.unique(select)))


def _runs(problem: Problem, at: Floor) -> np.ndarray:
    """The run of every segment of `train` and `select`, [segments]."""
    return np.concatenate([problem.data[split][at.horizon].run for split in ("train", "select")])


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
    ablated = ablate(at, candidate, hypothesis, fitted)
    now, before = squares(at, candidate), squares(at, ablated)
    held_out = len(problem.data["train"][at.horizon].run)
    own = candidate.fit.along(hypothesis)
    unit = units_of(problem, at, now)[:held_out]
    errors = standard_errors(candidate.fit, unit)[own]
    values, (low, high) = candidate.fit.coordinates[own], hypothesis.bounds.T
    # A parameter without a probe of its own means nothing alone.
    distance = np.where((hypothesis.probes != 0).any(axis=0), np.abs(values) / errors, 0.0)
    clearest = int(distance.argmax())
    relief = ablated.fit.penalty - candidate.fit.penalty
    mean_squares = [finite(one) / at.counts.bins for one in (before, now)]
    falls = [_largest_fall(*(measure(one) for one in mean_squares)) for measure in measures(at)]
    falls += _falls_of_runs(*mean_squares, _runs(problem, at), at.counts.usual(mean_squares[1]))
    floors, left = max(falls, key=lambda pair: pair[0] / max(Thresholds.floors, Thresholds.of_left * pair[1]))
    evidence = Evidence(
        gain=total_cost(at, ablated, 0.0) - total_cost(at, candidate, 0.0),
        confirmed=_cost(at, before[held_out:]) - _cost(at, now[held_out:]) + relief,
        floors=floors,
        left=left,
        relief=relief,
        interval=(
            float(values[clearest] - 1.96 * errors[clearest]),
            float(values[clearest] + 1.96 * errors[clearest]),
        ),
        inside=bool(((low < values) & (values < high)).all()),
        horizons=_horizons_better(floor, candidate.fit, ablated.fit),
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
    }


def ablate(at: Floor, candidate: Candidate, hypothesis: Hypothesis, fitted: Mapping[str, Candidate]) -> Candidate:
    """Takes an effect with its forms out of a candidate and fits the rest again.

    Where that model was fitted already, the one that costs less counts: a fit that was not finished would be evidence
    for the effect.

    Args:
      at: the floor at the main horizon.
      candidate: the model with the effect.
      hypothesis: the effect.
      fitted: models by key.
    """
    gone = [hypothesis, *candidate.forms_of(hypothesis)]
    others = tuple(other for other in candidate.hypotheses if all(other is not one for one in gone))
    start, evaluate = candidate.fit, at.residuals["train"]
    for one in gone:
        start = without(start, one, at.prior, at.slopes)
    start = replace(start, residual=evaluate(start.vector[None])[0])
    (fit,) = refine([start], evaluate, _ABLATION_ROUNDS)
    known = fitted.get(key_of(others))
    if known and known.fit.cost <= fit.cost:
        return known
    return Candidate(others, fit, at.residuals["select"](fit.vector[None])[0])


def believed(candidates: Sequence[Candidate], probabilities: np.ndarray) -> list[Suspect]:
    """Lists every effect of the candidates with the probability that it is there, most likely first.

    Its forms are those of the most likely model that has it.
    """
    found: dict[str, Suspect] = {}
    for index in np.argsort(-probabilities, kind="stable"):
        candidate, probability = candidates[index], float(probabilities[index])
        for hypothesis in candidate.effects:
            known = found.get(hypothesis.key, Suspect(hypothesis, candidate.forms_of(hypothesis), 0.0))
            found[hypothesis.key] = replace(known, probability=known.probability + probability)
    return sorted(found.values(), key=lambda one: -one.probability)


def families(candidates: Sequence[Candidate], probabilities: np.ndarray) -> dict[tuple[str, tuple[str, ...]], float]:
    """Pools equivalents: the probability that an effect of a family is at some places, most likely first.

    Args:
      candidates: all models.
      probabilities: [candidates] of `posterior`.

    Returns:
      Probabilities by family and places.
    """
    found: dict[tuple[str, tuple[str, ...]], float] = {}
    for candidate, probability in zip(candidates, probabilities, strict=True):
        for kind in {(effect.family, effect.places) for effect in candidate.effects}:
            found[kind] = found.get(kind, 0.0) + float(probability)
    return dict(sorted(found.items(), key=lambda one: -one[1]))


def rivals(
    at: Floor,
    candidates: Sequence[Candidate],
    probabilities: np.ndarray,
    best: Candidate,
    hypothesis: Hypothesis,
    settings: Settings,
) -> tuple[str, ...]:
    """Names the effects that may as well be there in the place of one of the best candidate's.

    They stand in models that do without the effect's name and are believed, or explain nearly as much of what the null
    leaves.

    Args:
      at: the floor at the main horizon.
      candidates: all models, the null among them.
      probabilities: [candidates] of `posterior`.
      best: the model that is reported.
      hypothesis: one of its effects.
      settings: shares from which on a name counts.

    Returns:
      Names, most likely first.
    """
    others = {other.key for other in best.hypotheses if other is not hypothesis}
    nothing = max(total_cost(at, one, 0.0) for one in candidates if not one.hypotheses)
    # The others were fitted without forms.
    plain = next((one for one in candidates if one.key == key_of(best.effects)), best)
    most = nothing - total_cost(at, plain, 0.0)
    found: dict[str, float] = {}
    for candidate, probability in zip(candidates, probabilities, strict=True):
        if hypothesis.name in [h.name for h in candidate.effects] or len(candidate.effects) > len(best.effects):
            continue
        explained = (nothing - total_cost(at, candidate, 0.0)) / max(most, 1e-9)
        for other in candidate.effects:
            kin = other.family == hypothesis.family and set(other.places) & set(hypothesis.places)
            if other.key not in others and explained > (settings.akin if kin else settings.same):
                found[other.name] = max(found.get(other.name, 0.0), explained)
            elif other.key not in others and probability > settings.possible:
                found[other.name] = max(found.get(other.name, 0.0), float(probability))
    return tuple(sorted(found, key=lambda name: -found[name]))[: settings.rivals]


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


def finite(of_segments: np.ndarray) -> np.ndarray:
    """Lets a segment whose simulation broke count as one that is far off."""
    return np.nan_to_num(of_segments, nan=_FAR, posinf=_FAR)


def _cost(at: Floor, of_segments: np.ndarray) -> float:
    """Cost of sums of squares [segments, components], without a prior."""
    return float(at.counts.cost(of_segments / at.counts.bins).sum()) if np.isfinite(of_segments).all() else np.inf


def _horizons_better(floor: NoiseFloor, fit: Fit, other: Fit) -> int:
    """Number of horizons at which `train` and `select` cost less with a model than with the other one."""
    better = 0
    for at in floor.values():
        both = [at.residuals[split](np.stack([fit.vector, other.vector])) for split in ("train", "select")]
        costs = [_cost(at, (at.unflatten(one) ** 2).sum(axis=1)) for one in np.concatenate(both, axis=1)]
        better += costs[0] + fit.penalty < costs[1] + other.penalty
    return better
