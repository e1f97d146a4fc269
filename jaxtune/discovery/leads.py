"""Leads of a screen: which are fitted, in which forms, and where their fits begin."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from jaxtune.discovery.candidate import Candidate, key_of
from jaxtune.discovery.fit import Fit, taken_over
from jaxtune.discovery.problem import Hypothesis, are_distinct
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import Lead, Screen

_MOST_PLACES = 3  # of one name among the leads that are fitted: they tell where; more would crowd out other names
# Of a joint's usual inertia, damping or torque: from which share on the model's own may be a placeholder. And how much
# of that is taken away.
_OWN, _MOST_OWN = 0.2, 0.9


def shortlist(settings: Settings, found: Screen, price: float) -> list[Lead]:
    """Takes the best leads and the best of each family, at most three places of one name, and the best pairs."""
    chosen: list[Lead] = []
    families, names = set(), {}
    # A fit finds more than the screen does, but not many times as much.
    for lead in (one for one in found.leads if found.cost - one.cost > settings.promising * price):
        hypothesis = lead.hypotheses[0]
        if names.get(hypothesis.name, 0) >= _MOST_PLACES:
            continue
        if len(chosen) < settings.shortlist or hypothesis.family not in families:
            chosen.append(lead)
            families.add(hypothesis.family)
            names[hypothesis.name] = names.get(hypothesis.name, 0) + 1
    least = found.leads[0].cost if found.leads else found.cost
    pairs = [pair for pair in found.pairs if least - pair.cost > settings.promising * price]
    return chosen + pairs[: settings.pairs]


def beside(forms: Sequence[Hypothesis], present: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Lists the forms that may stand beside all that is present: a coordinate must not be in a model twice."""
    return [form for form in forms if all(are_distinct(form, other) for other in present)]


def shaped(forms: Sequence[Hypothesis], free: Sequence[Hypothesis], leads: Sequence[Lead], count: int) -> list[Lead]:
    """Adds to the first leads what they are without the form that the screen saw them in, each further form that they
    may have, and what such a form is without them.

    Else what another form of the right effect leaves would be explained by a second effect. And play with a spring
    that turns out to have no play is a spring: a form that is an effect of its own is fitted alone too.

    Args:
      forms: of all effects.
      free: effects that may join the model.
      leads: best first.
      count: leads of one effect that get their forms.
    """
    known = {lead.hypotheses[0].key for lead in leads if sum(not one.form for one in lead.hypotheses) == 1}
    found = []
    for lead in leads[:count]:
        effect, *others = lead.hypotheses
        if others and all(one.form for one in others):
            found.append(replace(lead, hypotheses=(effect,), point=lead.point[: len(effect.directions)]))
        for form in (form for form in beside(forms, lead.hypotheses) if form.shapes(effect)):
            point = _start(form)
            found.append(Lead((*lead.hypotheses, form), np.concatenate([lead.point, point]), lead.start, lead.cost))
            if form.far:
                found += _from_far(lead, form)
            alone = [h for h in free if h.key not in known and np.array_equal(h.directions, form.directions)]
            found += [Lead((h,), point, lead.start, lead.cost) for h in alone]
            known.update(h.key for h in alone)
        if not others:
            found += taken_for(lead, forms, [h for h in free if h.key not in known])
    return found


def _from_far(lead: Lead, form: Hypothesis) -> list[Lead]:
    """Lists further starts with much of a form of a lead's effect: with little of the effect, or with more of it.

    The first are of a form that takes the effect's place. Where limits are not reached costs have no slope, so there
    are several. The others are of one that is below zero, which the effect has to make up for.
    """
    effect, found = lead.hypotheses[0], []
    own = slice(0, len(effect.directions))
    smallest = effect.probes[effect.probes.max(axis=1) > 0][0]
    above, below = form.probes[-2:], form.probes[form.probes.max(axis=1) < 0][-2:]
    starts = [(share * smallest, much) for share in (0.25, 1.0) for much in above]
    starts += [((1.0 - much.min()) * lead.point[own], much) for much in below]
    for size, much in starts:
        point = lead.point.copy()
        point[own] = size
        found.append(Lead((*lead.hypotheses, form), np.concatenate([point, much]), lead.start, lead.cost))
    return found


def shaped_after(
    base: Fit,
    present: Sequence[Hypothesis],
    forms: Sequence[Hypothesis],
    free: Sequence[Hypothesis],
    fitted: Sequence[Candidate],
    count: int,
) -> list[Lead]:
    """Lists forms that were not tried (`shaped`) of the fitted models of one more effect that cost least.

    A fit finds more than the screen does, so these may be others than its first leads.

    Args:
      base: the model beside which they were fitted.
      present: its effects.
      forms: of all effects.
      free: effects that may join it.
      fitted: models with more effects.
      count: how many of them get their forms.
    """
    tried, leads = {one.key for one in fitted}, []
    for one in sorted(fitted, key=lambda one: one.fit.cost):
        group = one.hypotheses[len(present) :]
        if sum(not part.form for part in group) == 1:
            start, keeps = base.coordinates.copy(), ~np.any([taken_over(base.free, part) for part in group], axis=0)
            start[keeps], point = np.split(one.fit.coordinates, [np.count_nonzero(keeps)])
            leads.append(Lead(group, point, start, one.fit.cost))
    found = shaped(forms, free, leads[:count], count)
    return [lead for lead in found if key_of((*present, *lead.hypotheses)) not in tried]


def taken_for(lead: Lead, forms: Sequence[Hypothesis], free: Sequence[Hypothesis]) -> list[Lead]:
    """Lists what may pass for the one effect of a lead (`jaxtune.types.Form.like`), at the same places.

    A load beside a link's centre looks like a shift of that centre, and a load at the centre like neither. A shift
    tells the product of load and distance, and not which is large: loads are tried from small to large, each at the
    distance at which it shifts the centre as far.

    Args:
      lead: with one effect.
      forms: of all effects.
      free: effects that may join the model.
    """
    (effect,), found = lead.hypotheses, []
    for form in (form for form in forms if (form.like, form.places) == (effect.name, effect.places)):
        for host in (h for h in free if form.shapes(h)):
            sizes = host.probes[host.probes.max(axis=1) > 0]
            # Sizes in between too: from farther off a fit may not come.
            starts = [
                (size, lead.point * (1.0 + 1.0 / size.max())) for size in (*sizes, *np.sqrt(sizes[:-1] * sizes[1:]))
            ]
            # What a screen saw may be any shift in that direction.
            starts.append(
                (sizes[len(sizes) // 2], form.probes.max() * lead.point / max(np.abs(lead.point).max(), 1e-9))
            )
            found += [Lead((host, form), np.concatenate(start), lead.start, lead.cost) for start in starts]
    return found


def at_some_places(lead: Lead, forms: Sequence[Hypothesis], free: Sequence[Hypothesis]) -> list[Lead]:
    """Lists the effect of a lead, with its forms, at every smaller set of its places that is a hypothesis.

    Args:
      lead: with one effect and its forms.
      forms: of all effects.
      free: effects that may join the model.
    """
    effect, *shapes = lead.hypotheses
    vector, found = lead.point @ np.concatenate([one.directions for one in lead.hypotheses]), []
    if effect.each:
        return []
    for one in (h for h in free if h.name == effect.name and not h.each and set(h.places) < set(effect.places)):
        names = {form.form: form for form in forms if form.shapes(one)}
        if all(shape.form in names for shape in shapes):
            parts = (one, *(names[shape.form] for shape in shapes))
            rows = np.concatenate([part.directions for part in parts])
            # Each row has its own axes; a size is that of the first place.
            axes = (rows != 0).argmax(axis=1)
            found.append(Lead(parts, vector[axes] / rows[np.arange(len(rows)), axes], lead.start, lead.cost))
    return found


def known_in_forms(
    effect: Hypothesis,
    known: Sequence[tuple[Candidate, float]],
    forms: Sequence[Hypothesis],
    free: Sequence[Hypothesis],
) -> list[Lead]:
    """Lists other effects in some form, at the places of a model's effect, that alone cost less than that one alone.

    Forms are fitted beside the best model's effects. So where a model of several has a wrong one, the right one may
    have been tried in its place without its form, and with it in a step before, alone.

    Args:
      effect: of the model.
      known: fitted models, with what each costs.
      forms: that may join what is left of the model.
      free: effects that may join it.
    """
    may_join = {one.key for one in (*forms, *free)}
    alone = [(one, cost) for one, cost in known if len(one.effects) == 1]
    limit = min((cost for one, cost in alone if one.effects[0].key == effect.key), default=np.inf)
    found = []
    for one, cost in alone:
        (other,) = one.effects
        same = other.places == effect.places and other.key != effect.key
        if same and one.forms_of(other) and cost < limit and {part.key for part in one.hypotheses} <= may_join:
            point = np.concatenate([one.fit.coordinates[one.fit.along(part)] for part in one.hypotheses])
            found.append(Lead(one.hypotheses, point, one.fit.coordinates, cost))
    return found


def _start(form: Hypothesis) -> np.ndarray:
    """The point at which the fit of a form begins, [parameters]."""
    if np.count_nonzero((form.probes != 0).any(axis=0)) > 1:
        # In no direction more than in another.
        return form.probes.mean(axis=0)
    # The least size may be too small to have a slope.
    return form.probes[:2][-1]


def stuck(null: Fit, hypotheses: Sequence[Hypothesis], leads: Sequence[Lead]) -> list[Lead]:
    """Lists the nominal parameters that went as far as they may in the null, each as a lead that lets it go on.

    The screen holds nominal parameters near their belief, from where it may not see that one of them alone is far off.

    Args:
      null: the model without effects.
      hypotheses: about nominal parameters.
      leads: those that are fitted anyway.
    """
    known = {lead.hypotheses[0].key for lead in leads if len(lead.hypotheses) == 1}
    low, high = null.free.bounds.T
    at_bound = (null.coordinates <= low) | (null.coordinates >= high)
    found = []
    for hypothesis in (one for one in hypotheses if len(one.places) == 1 and one.key not in known):
        if at_bound[taken_over(null.free, hypothesis)].any():
            (axis,) = np.flatnonzero(hypothesis.directions[0])
            point = null.vector[axis] / hypothesis.directions[:, axis]
            found.append(Lead((hypothesis,), point, null.coordinates, null.cost))
    return found


def without_own(nominal: Fit, hypotheses: Sequence[Hypothesis], cost: float) -> list[Lead]:
    """Lists leads that take away most of what the model has of its own, such as rotors and damping, alone and together.

    In many models these are placeholders, ten and more times too large. With them nothing moves as it does, so effects
    do not add up, and a screen that changes one at a time does not come to it.

    Args:
      nominal: the nominal model.
      hypotheses: that may join it.
      cost: of the null.
    """
    own = [h for h in hypotheses if h.spent and (h.bounds[:, 0] < -_OWN).any()]
    widest = {(h.name, h.each): h for h in sorted(own, key=lambda h: len(h.places))}
    found = []
    for each in (False, True):
        mine = [h for h in widest.values() if h.each == each]
        for together in (c for count in range(1, len(mine) + 1) for c in combinations(mine, count)):
            point = np.concatenate([_MOST_OWN * h.bounds[:, 0] for h in together])
            found.append(Lead(together, point, nominal.coordinates, cost))
    return found
