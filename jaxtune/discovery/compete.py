"""Fits of the shortlist, each hypothesis beside everything that is free already, until few are left (step 6).

A contest has three rounds: all are fitted at the main horizon from the best of several starts; the best few are fitted
there again with fresh slopes; and these at every other horizon, from where they stand.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from jaxtune.discovery.fit import (
    Fit,
    Free,
    best_point,
    evaluate_groups,
    hand_over,
    polish,
    probing_step,
    refine,
    taken_over,
)
from jaxtune.discovery.noise_floor import NoiseFloor
from jaxtune.discovery.problem import Hypothesis, Problem, are_distinct, pair_of
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import Score
from jaxtune.discovery.simulation import Evaluate

_ROUNDS_MORE = 2  # of a fit that starts from the one at the main horizon: it is nearly there


@dataclass(frozen=True)
class Contest:
    """The outcome of a contest: the finalists, best first, their fits at all horizons, and which hypotheses broke
    it."""

    hypotheses: tuple[Hypothesis, ...]
    fits: Mapping[float, Mapping[str, Fit]]
    """By horizon and hypothesis' key: the model with the hypothesis in it."""
    not_finite: tuple[str, ...]
    """Keys of those that broke the simulation, and took no further part."""


@dataclass(frozen=True)
class Start:
    """Where the fit of a hypothesis begins.

    Losses of delays, limits and play have several minima, so that a fit tries several points and starts at the best.
    """

    hypothesis: Hypothesis
    points: Sequence[np.ndarray]
    """[parameters] each: the best one is taken."""
    absolute: bool = False
    """Points are seen from the nominal model. Else from where the model stands, if the hypothesis takes over a
    parameter that has moved already."""
    like: Fit | None = None
    """A fit of the same hypothesis at another horizon, where everything else starts."""


def starts_of_singles(hypotheses: Sequence[Hypothesis], scores: Mapping[str, Score]) -> list[Start]:
    """Starts each hypothesis from what the screen found, and from less and more of it.

    A secant at one size misjudges effects such as backlash, whose slope depends on the size. These start from the sizes
    that the screen looked at too.
    """
    starts = []
    for hypothesis in hypotheses:
        found = scores[hypothesis.key].coordinates
        sizes_matter = len(hypothesis.probes) > 1 and hypothesis.bounds[0, 0] >= 0
        others = list(hypothesis.probes) if sizes_matter else []
        starts.append(Start(hypothesis, [found, 0.4 * found, 2.5 * found, *others]))
    return starts


def starts_of_pairs(settings: Settings, problem: Problem, contest: Contest) -> list[Start]:
    """Joins the finalists of a contest two by two; each pair starts from where its parts stood alone.

    Two effects of which neither passes alone, since the other one's gap drowns it, may pass together.
    """
    fits = contest.fits[problem.main_horizon] if contest.hypotheses else {}
    couples = combinations(contest.hypotheses[: settings.paired], 2)
    return [
        Start(pair_of(one, two), [np.concatenate([fits[one.key].own(one), fits[two.key].own(two)])], absolute=True)
        for one, two in couples
        if are_distinct(one, two)
    ]


def compete(
    settings: Settings, problem: Problem, floor: NoiseFloor, bases: Mapping[float, Fit], starts: Sequence[Start]
) -> Contest:
    """Fits hypotheses to `train` and keeps the finalists, by the loss at the main horizon.

    Args:
      settings: rounds, and how many become finalists.
      problem: names the main horizon.
      floor: the noise floor.
      bases: the model without them, by horizon.
      starts: the hypotheses and where they begin.
    """
    main, evaluate = problem.main_horizon, floor[problem.main_horizon].residuals["train"]
    fits = fit_beside(bases[main], starts, evaluate, settings.rounds) if starts else []
    found = {start.hypothesis.key: fit for start, fit in zip(starts, fits, strict=True) if fit.finite}
    finite = [start.hypothesis for start in starts if start.hypothesis.key in found]
    not_finite = tuple(start.hypothesis.key for start in starts if start.hypothesis.key not in found)
    finalists = sorted(finite, key=lambda h: found[h.key].linear.loss)[: settings.finalists]
    if not finalists:
        return Contest((), {}, not_finite)
    # Learnt slopes are good enough to choose finalists; intervals and bagged refits need secants.
    polished = polish([found[h.key] for h in finalists], evaluate, settings.rounds)
    best = {h.key: fit for h, fit in zip(finalists, polished, strict=True)}
    finalists.sort(key=lambda h: best[h.key].linear.loss)
    everywhere = {main: {h.key: best[h.key] for h in finalists}}
    again = [Start(h, [best[h.key].own(h)], absolute=True, like=best[h.key]) for h in finalists]
    for horizon, base in bases.items():
        if horizon != main:
            fits = fit_beside(base, again, floor[horizon].residuals["train"], _ROUNDS_MORE)
            everywhere[horizon] = {h.key: fit for h, fit in zip(finalists, fits, strict=True)}
    return Contest(tuple(finalists), everywhere, not_finite)


def fit_beside(base: Fit, starts: Sequence[Start], evaluate: Evaluate, rounds: int) -> list[Fit]:
    """Fits each hypothesis with everything that is free in a model, each in a model of its own.

    Args:
      base: the model without them.
      starts: the hypotheses and where they begin.
      evaluate: residuals of vectors.
      rounds: of refinement.

    Returns:
      A fit for every start. Its last coordinates are the hypothesis' own.
    """
    begun = begin(base, starts, evaluate)
    return refine(begun, evaluate, rounds)


def begin(base: Fit, starts: Sequence[Start], evaluate: Evaluate) -> list[Fit]:
    """Puts each hypothesis into the model, at the best of its points, with secants there.

    A point is as good as the misfit that is left once the nominal parameters have answered it.

    Args:
      base: the model without them.
      starts: one for every fit.
      evaluate: residuals of vectors.

    Returns:
      A fit for every start. Its last coordinates are the hypothesis' own.
    """
    kept, points = [], []
    for start in starts:
        hypothesis = start.hypothesis
        # Beside the nominal coordinate for the same parameter, the hypothesis' own would be the same direction twice.
        fit, stood = hand_over(base, taken_over(base.free, hypothesis), hypothesis)
        if start.like:
            fit = replace(fit, coordinates=start.like.coordinates[: len(fit.coordinates)])
        kept.append(fit)
        seen = [point if start.absolute else stood + point for point in start.points]
        points.append([np.clip(point, *hypothesis.bounds.T) for point in seen])
    hypotheses = [start.hypothesis for start in starts]
    places = list(zip(kept, hypotheses, points, strict=True))
    found = evaluate_groups(evaluate, [[fit.vector + p @ h.directions for p in group] for fit, h, group in places])
    best = [best_point(fit, residuals) for fit, residuals in zip(kept, found, strict=True)]
    at = [(group[index], residuals[index]) for group, residuals, index in zip(points, found, best, strict=True)]
    steps = [probing_step(hypothesis, point) for hypothesis, (point, _) in zip(hypotheses, at, strict=True)]
    moved = evaluate_groups(
        evaluate,
        [
            [fit.vector + (point + step) @ h.directions for step in np.diag(size)]
            for fit, h, (point, _), size in zip(kept, hypotheses, at, steps, strict=True)
        ],
    )
    return [
        replace(
            fit,
            free=fit.free.and_then(Free(h.directions, h.prior, h.bounds, np.zeros(len(h.prior), bool))),
            coordinates=np.concatenate([fit.coordinates, point]),
            residual=residual,
            jacobian=np.concatenate([fit.jacobian, np.nan_to_num((shifted - residual) / size[:, None]).T], axis=1),
            finite=bool(np.isfinite(residual).all() and np.isfinite(shifted).all()),
        )
        for fit, h, (point, residual), size, shifted in zip(kept, hypotheses, at, steps, moved, strict=True)
    ]
