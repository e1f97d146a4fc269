"""Which effects of a model give it a name: the larger of two that are alike, at the joints where logs show them, and
none that refines a stronger one."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from jaxtune.discovery.candidate import Candidate, key_of
from jaxtune.discovery.fit import Fit, taken_over
from jaxtune.discovery.problem import Hypothesis, Problem, acts_within
from jaxtune.discovery.result import AcceptedTerm

_CLEAR = 2.0  # standard errors
_LITTLE = 0.1  # of the largest size of an effect, below which it is not claimed of a place
_ODDS = 10.0  # against the model with fewer places, up to which it is taken


def renamed(problem: Problem, candidate: Candidate) -> Candidate:
    """Makes a form of an effect that may be one of another, and lets the larger part give the name to both.

    Dry friction and stiction may each be a form of the other, as may delay and filter.

    Args:
      problem: the hypotheses and their forms.
      candidate: a model.

    Returns:
      The same model, with another name for some of its parts.
    """
    candidate = _joined(problem, candidate)
    other_names: dict[str, Hypothesis] = {}
    for effect in candidate.effects:
        forms = candidate.forms_of(effect)
        for form in (one for one in forms if _size(candidate, one) > _size(candidate, effect)):
            for twin in (h for h in problem.hypotheses if np.array_equal(h.directions, form.directions)):
                # What it is then a form of has to have all of its forms.
                theirs = {one.key: _like(problem, twin, effect if one is form else one) for one in forms}
                if all(theirs.values()):
                    other_names |= {effect.key: twin} | theirs
    return _with_names(candidate, other_names)


def at_fewest_places(best: Candidate, candidates: Sequence[Candidate], probabilities: np.ndarray) -> Candidate:
    """Picks the model with the same effects at the fewest places, if it is believed nearly as much as the best one.

    A limit that one joint reaches is as well explained by one that all joints have, since the others stay below it.
    What logs do not show at a joint is not claimed of it. Where two such models are believed, logs do not say which
    joint it is, and the best model stays.

    Args:
      best: the cheapest model.
      candidates: all models, the cheapest first, the best one among them.
      probabilities: [candidates] of `belief.posterior`.

    Returns:
      One of the candidates.
    """
    believed: dict[str, float] = {}
    cheapest: dict[str, Candidate] = {}
    for one, probability in zip(candidates, probabilities, strict=True):
        if _within(one, best):
            # In whichever form.
            key = key_of(one.effects)
            believed[key] = believed.get(key, 0.0) + float(probability)
            cheapest.setdefault(key, one)
    most = believed[key_of(best.effects)]
    fewer = [one for key, one in cheapest.items() if believed[key] >= most / _ODDS]
    least = min(map(_places, fewer))
    found = [one for one in fewer if _places(one) == least < _places(best)]
    return found[0] if len(found) == 1 else best


def _within(one: Candidate, other: Candidate) -> bool:
    """Says whether a model has the effects of another one, each at some of its places."""

    def holds(many: Hypothesis, few: Hypothesis) -> bool:
        return many.name == few.name and set(few.places) <= set(many.places)

    # Effects of one name in one model share no place, so each holds one at the most.
    pairs = [(many, few) for many in other.effects for few in one.effects if holds(many, few)]
    return len(pairs) == len(one.effects) == len(other.effects) == len({many.key for many, _ in pairs})


def _places(candidate: Candidate) -> int:
    return sum(len(effect.places) for effect in candidate.effects)


def _joined(problem: Problem, candidate: Candidate) -> Candidate:
    """Makes one effect of two where the other one, with its forms, is a form of the first."""
    other_names: dict[str, Hypothesis] = {}
    hosts: set[str] = set()
    for effect, host in permutations(candidate.effects, 2):
        parts = {one.key: _like(problem, host, one) for one in (effect, *candidate.forms_of(effect))}
        # What has taken in another effect stays, and what was taken in takes in none.
        if effect.key not in hosts | set(other_names) and host.key not in other_names and all(parts.values()):
            other_names |= parts
            hosts.add(host.key)
    return _with_names(candidate, other_names)


def _with_names(candidate: Candidate, other_names: Mapping[str, Hypothesis]) -> Candidate:
    return replace(candidate, hypotheses=tuple(other_names.get(one.key, one) for one in candidate.hypotheses))


def _like(problem: Problem, effect: Hypothesis, part: Hypothesis) -> Hypothesis | None:
    """The form of an effect that moves what a part of a model moves."""
    forms = (one for one in problem.forms if one.shapes(effect))
    return next((one for one in forms if np.array_equal(one.directions, part.directions)), None)


def _size(candidate: Candidate, part: Hypothesis) -> float:
    """The largest coordinate of a part of a model; one that only shapes it, such as a speed, is no size."""
    sized = (part.probes != 0).any(axis=0)
    return float(np.abs(candidate.fit.coordinates[candidate.fit.along(part)])[sized].max())


def clear_places(fit: Fit, errors: np.ndarray, effect: Hypothesis) -> tuple[str, ...] | None:
    """The places at which an effect with a size for each is clear of zero, the clearest in any case; None for others.

    Where logs are exact, a little of it makes up at other places for the form of a large one. So a place has to have a
    tenth of the largest size, in the units of the places.

    Args:
      fit: of the model.
      errors: [coordinates] standard errors.
      effect: of the model.
    """
    if not effect.each:
        return None
    own = fit.along(effect)
    size = np.abs(fit.coordinates[own])
    distance = size / errors[own]
    clear = ((distance > _CLEAR) & (size >= _LITTLE * size.max())) | (distance == distance.max())
    return tuple(place for place, yes in zip(effect.places, clear, strict=True) if yes)


def with_refinements(terms: Sequence[AcceptedTerm], own: float) -> list[AcceptedTerm]:
    """Marks effects that may only refine a stronger one at the same joints, because no form of the library is exact.

    What is left of a large effect in another form than the robot's can be several floor units, and other effects of
    the same joint fit that well. So a weaker effect there stays in the model, but says nothing about the robot. Of one
    at several joints, such as a delay, counts what it gains at as many of them.

    Args:
      terms: the strongest first.
      own: `Settings.own`.
    """
    marked: list[AcceptedTerm] = []
    for term in terms:
        over = [
            one.hypothesis.key
            for one in marked
            if one.refines is None
            and acts_within(_shown(term), _shown(one))
            and term.evidence.gain < own * one.evidence.gain * _share_of_joints(_shown(term), _shown(one))
        ]
        marked.append(replace(term, refines=over[0] if over else None))
    return marked


def _shown(term: AcceptedTerm) -> Hypothesis:
    """The hypothesis of a term at the joints where it is clear of zero."""
    effect = term.hypothesis
    if term.clear is None:
        return effect
    # On joints alone sizes are each place's own.
    shown = zip(effect.joints, effect.places, strict=True)
    return replace(effect, joints=tuple(joint for joint, place in shown if place in term.clear))


def _share_of_joints(few: Hypothesis, many: Hypothesis) -> float:
    return len(set(few.joints)) / len(set(many.joints))


def moved_forms(problem: Problem, fit: Fit, errors: np.ndarray, effect: Hypothesis) -> list[Hypothesis]:
    """Forms of an effect that are free under every hypothesis, and clear of zero in the fit.

    Nominal parameters are none: they are never quite what the model says.
    """
    clear = np.abs(fit.coordinates) > _CLEAR * errors
    mine = [form for form in problem.forms if form.shapes(effect) and not problem.is_nominal(form)]
    return [form for form in mine if (taken_over(fit.free, form) & clear).any()]
