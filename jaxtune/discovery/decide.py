"""Whether a hypothesis is accepted, and under which name (step 7).

Finalists are compared on `select` (validation), segment by segment and paired, since segments differ far more than
hypotheses do. All statistics resample blocks of segments (`resample`), since neighbours are not independent.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaxtune.discovery.fit import Fit
from jaxtune.discovery.problem import Hypothesis
from jaxtune.discovery.resample import (
    alike,
    bagged,
    blocks,
    confirmed,
    losses,
    max_t,
    paired,
    standard_errors,
    t_statistic,
)

_EQUAL = 2.0  # standard errors within which two hypotheses are not distinguishable
_ABOUT_BEST = 1.0  # standard errors within which the simplest hypothesis is taken
_PAYS = 1.0  # t below which an effect that was accepted earlier may go


@dataclass(frozen=True)
class Evidence:
    """What speaks for a hypothesis against the model without it: one number or interval for each test of `passes`."""

    gain: float
    """Fall of the loss of the fit, on `train`."""
    t: float
    """On `select`: mean fall of what a segment counts for (`losses`), over its standard error."""
    confirmed: float
    """Fall of the loss on `select`, where nothing was fitted, without the block of segments that gains most; in units
    of what is left."""
    floors: float
    """Root of the largest fall of a single component's mean square, in floor units."""
    interval: tuple[float, float]
    """95 % interval of the coordinate that is clearest of zero; of a pair, of the part that is less clear."""
    inside: bool
    """True if all coordinates are inside their bounds."""
    horizons: int
    """Number of horizons at which it is best, or within a standard error of the best."""
    chosen: float
    """Share of bagged refits in which it, or one that is not distinguishable from it, is best."""


@dataclass(frozen=True)
class Thresholds:
    """What the evidence has to exceed (`t`, `gain`) or to reach (the others) for a hypothesis to be accepted."""

    t: float
    """Max-t threshold over all hypotheses that are compared on `select`, at once."""
    gain: float
    """Gain that the best hypothesis exceeds on null logs with probability `Settings.level`; for a pair, twice that."""
    floors: float = 1.0
    horizons: int = 2
    chosen: float = 0.7


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Finalists side by side, on segments that they were not fitted to; all that a decision needs.

    The model without any of them is compared too: it is what they have to beat.
    """

    hypotheses: Sequence[Hypothesis]
    """The finalists, best on `train` first."""
    base: Fit
    """The model without them, at the main horizon."""
    fits: Mapping[str, Fit]
    """The model with each of them, by key, at the main horizon."""
    before: Mapping[float, np.ndarray]
    """[segments, bins, components] by horizon: residuals on `select` of the model without them."""
    after: Mapping[float, Mapping[str, np.ndarray]]
    """The same with each of them, by horizon and key."""
    runs: Mapping[float, np.ndarray]
    """[segments] of `select`, by horizon: index of each segment's run."""
    run_of_train: np.ndarray
    """[segments] of `train` at the main horizon."""
    main: float
    """The main horizon in s."""


@dataclass(frozen=True)
class Decision:
    """What became of the best finalist: the chosen hypothesis, its evidence and whether it passed every test."""

    hypothesis: Hypothesis
    evidence: Evidence
    thresholds: Thresholds
    tests: Mapping[str, bool]
    """Whether it passed, by test; see `passes`."""
    confusable_with: tuple[str, ...]
    """Names of other effects that fit as well as the best, or explain nearly as much."""

    @property
    def accepted(self) -> bool:
        """True if the hypothesis passed every test, and thus joins the model."""
        return all(self.tests.values())


def decide(comparison: Comparison, least_gain: float, level: float, same: float) -> Decision:
    """Chooses among the finalists, weighs the evidence for the chosen one and tests it.

    The choice is the simplest hypothesis within one standard error of the best (Breiman's rule): a better fit that is
    within chance is no reason for another parameter.

    Args:
      comparison: the finalists on `select`.
      least_gain: gain that chance gives a single hypothesis.
      level: probability of accepting any finalist where nothing is missing.
      same: share of the best gain from which on another name may as well be right.
    """
    main, lost = comparison.main, _lost_everywhere(comparison)
    draws = blocks(np.concatenate([comparison.run_of_train, comparison.runs[main]]))
    about_best, equal = alike(lost, draws, _ABOUT_BEST), alike(lost, draws, _EQUAL)
    simplest = [h for h in comparison.hypotheses if h.key in about_best]
    chosen = min(simplest, key=lambda h: (len(h.directions), comparison.fits[h.key].linear.loss))
    gains = {key: paired(comparison.before[main], after) for key, after in comparison.after[main].items()}
    # Each part of a pair must gain what chance gives.
    least = Thresholds(t=max_t(gains, comparison.runs[main], level), gain=len(chosen.singles) * least_gain)
    evidence = weigh_evidence(comparison, chosen, equal)
    confusable = confusable_names(comparison, chosen, equal, same)
    return Decision(chosen, evidence, least, passes(evidence, least), confusable)


def weigh_evidence(comparison: Comparison, chosen: Hypothesis, equal: Sequence[str]) -> Evidence:
    """Collects what speaks for the chosen hypothesis against the model without it.

    A bagged refit that chooses an equally good hypothesis, or the same name at some of the same places, counts for it:
    it would be the same answer.
    """
    main, fit = comparison.main, comparison.fits[chosen.key]
    before, after, run = comparison.before[main], comparison.after[main][chosen.key], comparison.runs[main]
    share = bagged({key: one.linear for key, one in comparison.fits.items()}, comparison.run_of_train)
    about_best = {
        horizon: alike({key: losses(one) for key, one in found.items()}, blocks(comparison.runs[horizon]), _ABOUT_BEST)
        for horizon, found in comparison.after.items()
    }
    # The prior directions come first, the hypothesis' own coordinates last.
    own, (low, high) = fit.own(chosen), chosen.bounds.T
    errors = standard_errors(fit, comparison.run_of_train)[-len(own) :]
    return Evidence(
        gain=comparison.base.linear.loss - fit.linear.loss,
        t=t_statistic(paired(before, after), run),
        confirmed=confirmed(before, after, run, comparison.base.weight),
        floors=_largest_fall(before, after),
        interval=_interval(chosen, own, errors),
        inside=bool(((low < own) & (own < high)).all()),
        horizons=sum(chosen.key in best for best in about_best.values()),
        chosen=sum(share[h.key] for h in comparison.hypotheses if h.key in equal or _same_answer(h, chosen)),
    )


def confusable_names(comparison: Comparison, chosen: Hypothesis, equal: Sequence[str], same: float) -> tuple[str, ...]:
    """Names the effects, other than the chosen one's, that these logs cannot distinguish from it.

    Args:
      comparison: the finalists.
      chosen: the hypothesis whose name is given.
      equal: keys of those that fit as well as the best.
      same: share of the best gain on `train` from which on a name may as well be right.
    """
    gains = {key: comparison.base.linear.loss - fit.linear.loss for key, fit in comparison.fits.items()}
    nearly = [key for key, gain in gains.items() if gain > same * max(gains.values())]
    mine = {part.name for part in chosen.singles}
    names = [part.name for h in comparison.hypotheses if h.key in (*equal, *nearly) for part in h.singles]
    return tuple(dict.fromkeys(name for name in names if name not in mine))


def passes(evidence: Evidence, thresholds: Thresholds) -> dict[str, bool]:
    """Tests the evidence; a hypothesis is accepted if all tests, which are returned by name, are passed."""
    low, high = evidence.interval
    return {
        # What shows in few segments alone has a large standard error however clear it is in those: it is enough if it
        # gains more where it was not fitted than anything gains on null logs where it was.
        "significant": evidence.t > thresholds.t or evidence.confirmed > thresholds.gain,
        # Significant is not enough: with thousands of residuals every mimic of an engine gap is.
        "beyond_healthy": evidence.gain > thresholds.gain,
        "floor_unit": evidence.floors >= thresholds.floors,
        # A fit that ran into a bound stands in for another effect.
        "inside_bounds": evidence.inside,
        "clear_of_zero": low > 0 or high < 0,
        # Long segments let a wrong effect compensate, short ones are blind to slow bias: two must agree.
        "horizons": evidence.horizons >= thresholds.horizons,
        "bagged": evidence.chosen >= thresholds.chosen,
    }


def no_longer_pays(without: np.ndarray, now: np.ndarray, run: np.ndarray, weight: float, least_gain: float) -> bool:
    """Says whether `select` is explained as well without an effect that was accepted earlier.

    Args:
      without: [segments, bins, components] residuals of the model without the effect.
      now: the same of the model as it stands.
      run: [segments] index of each segment's run.
      weight: share of the bins that count as independent.
      least_gain: gain that chance gives.
    """
    t = t_statistic(paired(without, now), run)
    return t < _PAYS and not confirmed(without, now, run, weight) > least_gain


def _lost_everywhere(comparison: Comparison) -> dict[str, np.ndarray]:
    """What every segment of `train` and `select` counts for at the main horizon, [segments] by key."""
    shape = comparison.before[comparison.main].shape[1:]
    return {
        key: np.concatenate([losses(comparison.fits[key].residual.reshape(-1, *shape)), losses(on_select)])
        for key, on_select in comparison.after[comparison.main].items()
    }


def _same_answer(one: Hypothesis, chosen: Hypothesis) -> bool:
    """Whether a hypothesis has the same name as the chosen one, at some of the same places."""
    return one.name == chosen.name and bool(set(one.places) & set(chosen.places))


def _largest_fall(before: np.ndarray, after: np.ndarray) -> float:
    """Root of the largest fall of a component's mean square, in floor units."""
    fall = (before**2).mean(axis=(0, 1)) - (after**2).mean(axis=(0, 1))
    return float(np.sqrt(max(fall.max(), 0.0)))


def _interval(hypothesis: Hypothesis, values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """95 % interval of the coordinate that tells whether all parts of a hypothesis are there.

    Of several parameters of one part, one must be clear of zero: the clearest counts. A parameter without a probe has
    no meaning alone and cannot be the one. Of two parts the one that is less clear counts.
    """
    clear, start = [], 0
    for part in hypothesis.singles:
        mine = slice(start, start := start + len(part.directions))
        distance = np.where((part.probes != 0).any(axis=0), np.abs(values[mine]) / errors[mine], 0.0)
        clear.append((distance.max(), mine.start + int(distance.argmax())))
    _, index = min(clear)
    return float(values[index] - 1.96 * errors[index]), float(values[index] + 1.96 * errors[index])
