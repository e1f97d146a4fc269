"""Which of the fitted models is believed, and how far (step 7).

Models are compared by their cost on `train` and `select` (validation) together, prior included, plus a price for every
effect: what chance gains on null logs. A model is believed in the share of resampled logs in which it costs least, each
model with the weight exp(-cost / 2): pseudo-Bayesian model averaging with a bootstrap (Yao et al., 2018).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxtune.discovery.candidate import Candidate, finite, key_of, squares, total_cost, units_of
from jaxtune.discovery.noise_floor import Floor
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.resample import times_drawn
from jaxtune.discovery.result import AcceptedTerm, Settings, Suspect


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


def believed(candidates: Sequence[Candidate], probabilities: np.ndarray) -> list[Suspect]:
    """Lists every effect of the candidates with the probability that it is there, most likely first.

    Its forms are those of the most likely model that has it, as is whether every place has a size of its own.
    """
    found: dict[tuple[str, tuple[str, ...]], Suspect] = {}
    for index in np.argsort(-probabilities, kind="stable"):
        candidate, probability = candidates[index], float(probabilities[index])
        for hypothesis in candidate.effects:
            key = hypothesis.name, hypothesis.places
            known = found.get(key, Suspect(hypothesis, candidate.forms_of(hypothesis), 0.0))
            found[key] = replace(known, probability=known.probability + probability)
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
    term: AcceptedTerm,
    settings: Settings,
) -> tuple[str, ...]:
    """Names the effects that may as well be there in the place of one of the best candidate's.

    They stand in models that do without the effect's name and are believed, or explain most of what the effect does.

    Args:
      at: the floor at the main horizon.
      candidates: all models, the null among them.
      probabilities: [candidates] of `posterior`.
      best: the model that is reported.
      term: one of its effects.
      settings: shares from which on a name counts.

    Returns:
      Names, most likely first.
    """
    others = {other.key for other in best.hypotheses if other is not term.hypothesis}
    least = total_cost(at, best, 0.0)
    # A model without the effect may break a segment; the null does not.
    null = max(total_cost(at, one, 0.0) for one in candidates if not one.hypotheses)
    nothing = min(least + term.evidence.gain, null)
    # The others were fitted without forms.
    plain = [total_cost(at, one, 0.0) for one in candidates if one.key == key_of(best.effects)]
    least = plain[0] if plain and plain[0] < nothing else least
    found: dict[str, float] = {}
    for candidate, probability in zip(candidates, probabilities, strict=True):
        if term.hypothesis.name in [h.name for h in candidate.effects] or len(candidate.effects) > len(best.effects):
            continue
        explained = (nothing - total_cost(at, candidate, 0.0)) / max(nothing - least, 1e-9)
        for other in candidate.effects:
            if other.key not in others and explained > settings.same:
                found[other.name] = max(found.get(other.name, 0.0), explained)
            elif other.key not in others and probability > settings.possible:
                found[other.name] = max(found.get(other.name, 0.0), float(probability))
    return tuple(sorted(found, key=lambda name: -found[name]))[: settings.rivals]
