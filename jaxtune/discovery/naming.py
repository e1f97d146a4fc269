"""Which effects of a model give it a name: the larger of two that are alike, and none that refines a stronger one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxtune.discovery.candidate import Candidate
from jaxtune.discovery.fit import Fit, taken_over
from jaxtune.discovery.problem import Hypothesis, Problem, acts_within
from jaxtune.discovery.result import AcceptedTerm

_CLEAR = 2.0  # standard errors


def renamed(problem: Problem, candidate: Candidate) -> Candidate:
    """Lets the larger part give the name where two effects may each be a form of the other, such as delay and filter.

    Args:
      problem: the hypotheses and their forms.
      candidate: a model.

    Returns:
      The same model, with another name for some of its parts.
    """
    other_names: dict[str, Hypothesis] = {}
    for effect in candidate.effects:
        # A further form would be one of the old name.
        for form in candidate.forms_of(effect) if len(candidate.forms_of(effect)) == 1 else ():
            twins = [h for h in problem.hypotheses if np.array_equal(h.directions, form.directions)]
            shapes = [
                other
                for other in problem.forms
                if np.array_equal(other.directions, effect.directions) and any(other.shapes(twin) for twin in twins)
            ]
            if shapes and _size(candidate, form) > _size(candidate, effect):
                other_names |= {effect.key: twins[0], form.key: shapes[0]}
    return replace(candidate, hypotheses=tuple(other_names.get(one.key, one) for one in candidate.hypotheses))


def _size(candidate: Candidate, part: Hypothesis) -> float:
    """The largest coordinate of a part of a model; one that only shapes it, such as a speed, is no size."""
    sized = (part.probes != 0).any(axis=0)
    return float(np.abs(candidate.fit.coordinates[candidate.fit.along(part)])[sized].max())


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
            and acts_within(term.hypothesis, one.hypothesis)
            and term.evidence.gain < own * one.evidence.gain * _share_of_joints(term.hypothesis, one.hypothesis)
        ]
        marked.append(replace(term, refines=over[0] if over else None))
    return marked


def _share_of_joints(few: Hypothesis, many: Hypothesis) -> float:
    return len(set(few.joints)) / len(set(many.joints))


def moved_forms(problem: Problem, fit: Fit, errors: np.ndarray, effect: Hypothesis) -> list[Hypothesis]:
    """Forms of an effect that are free under every hypothesis, and clear of zero in the fit."""
    clear = np.abs(fit.coordinates) > _CLEAR * errors
    return [form for form in problem.forms if form.shapes(effect) and (taken_over(fit.free, form) & clear).any()]
