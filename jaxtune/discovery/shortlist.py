"""Which of the screened hypotheses a step fits: a shortlist in which every family and enough names have a chance."""

from collections.abc import Mapping, Sequence

from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.result import Settings
from jaxtune.discovery.screen import Score
from jaxtune.discovery.state import State

_LEAST_GAIN = 4.0  # of the loss; two standard deviations of one coordinate
_MOST_PLACES = 3  # of one name on the shortlist: they tell where; more would crowd out other names


def candidates(settings: Settings, problem: Problem, state: State, scores: Mapping[str, Score]) -> list[Hypothesis]:
    """Chooses the hypotheses that a round fits.

    They sit beside a joint that needs a torque (or may show anywhere), could show in these logs, and promise a share
    of the gain that acceptance takes. Of these the shortlist is taken.

    Args:
      settings: lengths and shares.
      problem: the hypotheses.
      state: the joints in need, and what chance gains.
      scores: by the key of every hypothesis that the step screened.
    """
    index = {joint: number for number, joint in enumerate(problem.push)}
    needing = {index[joint] for joint, need in state.needs_torque.items() if need > 0}
    screened = [h for h in problem.hypotheses if h.key in scores]
    near = [h for h in screened if not needing or not h.joints or needing & set(h.joints)]
    # What is larger than the smallest size of interest may show where that would not.
    near = [h for h in near if scores[h.key].testable or scores[h.key].gain > state.least_gain]
    # A fit finds more than its first step does, but not many times as much.
    near = [h for h in near if scores[h.key].gain > settings.promising * state.least_gain]
    return shortlist(scores, near, settings.shortlist)


def shortlist(scores: Mapping[str, Score], hypotheses: Sequence[Hypothesis], count: int) -> list[Hypothesis]:
    """Takes the best `count` hypotheses and the best of each family, at most three places of one name, best first."""
    ranked = sorted(hypotheses, key=lambda h: -scores[h.key].gain)
    ranked = [h for h in ranked if scores[h.key].gain > _LEAST_GAIN]
    chosen, seen, names = [], set(), {}
    for hypothesis in ranked:
        first = hypothesis.family not in seen
        if names.get(hypothesis.name, 0) >= _MOST_PLACES:
            continue
        if first or len(chosen) < count:
            chosen.append(hypothesis)
            seen.add(hypothesis.family)
            names[hypothesis.name] = names.get(hypothesis.name, 0) + 1
    return chosen
