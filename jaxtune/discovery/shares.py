"""How much of what the nominal model leaves is explained: gaps above the floor, and which of them may speak."""

from collections.abc import Hashable, Sequence

import numpy as np

from jaxtune.discovery.candidate import Candidate, Measure, finite, squares
from jaxtune.discovery.fit import Fit
from jaxtune.discovery.noise_floor import Floor
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.result import Settings

_PERFECT = 1.0  # floor units


def speak(usual: Sequence[np.ndarray], typical: Sequence[np.ndarray], at_floor: float) -> list[Sequence[np.ndarray]]:
    """Chooses the gaps that may speak for a model's effects.

    A few segments may be far off with the right effect, as those that begin while gears are out of touch. So typical
    ones may speak for it, where they show the gap and the effects do not pay for them with the others.

    Args:
      usual: gaps [positions] of nearly all segments in floor units: of the null, of the model, and with a learned
        torque.
      typical: of typical segments, likewise.
      at_floor: `Settings.at_floor`.
    """
    shown, paid = typical[0].max() > at_floor, energy(usual[1]) > energy(usual[0])
    return [usual, typical] if shown and not paid else [usual]


def explained(null: float, after: float, bound: float) -> float:
    """The share of a misfit that is explained: (null - after) / (null - bound), from 0 to 1; 1 where there is none.

    Args:
      null: misfit of the model without effects.
      after: of the model with them.
      bound: the least that can be reached.
    """
    room = null - bound
    return float(np.clip((null - after) / room, 0.0, 1.0)) if room > 1e-6 else 1.0


def explained_shares(energies: Sequence[float], costs: Sequence[float]) -> tuple[float, float]:
    """The share that effects explain of what they and a learned torque explain together, and of all gaps.

    Of gaps and costs the smaller share counts. In gaps a wrong effect can seem to explain much of an error that it only
    makes smaller; in the cost, a little of a large one.

    Args:
      energies: of the gaps of the null, of the model with effects, and with a learned torque too.
      costs: of the same models.
    """
    both = [explained(null, after, min(after, bound)) for null, after, bound in (energies, costs)]
    return min(both), explained(energies[0], energies[1], 0.0)


def enough(settings: Settings, left: float, share: float, whole: float, effects: int) -> bool:
    """Whether a model explains what there is, well enough to say what is missing, or that nothing is.

    Several effects must leave less than one: each of them could make up for a part of what the library has no name for.

    Args:
      settings: how much is asked.
      left: largest gap that it leaves in floor units.
      share: what its effects explain of the explainable gap, zero without effects.
      whole: what they explain of the whole gap above the floor.
      effects: number of effects that it would name.
    """
    of_one = settings.share_near if left <= settings.near else settings.share
    asked = 1.0 - (1.0 - of_one) / max(effects, 1)
    return left <= settings.at_floor or (share >= asked and whole >= settings.least)


def lost_without(fit: Fit, hypothesis: Hypothesis, parts: Sequence[Hashable]) -> dict[Hashable, float]:
    """How much of what a hypothesis explains is lost without each part of it, with all else fitted anew.

    It is of the fit's linear model, so nothing is simulated. Parts that stand for each other lose little each.

    Args:
      fit: a model with the hypothesis.
      hypothesis: one of it.
      parts: [parameters] the part to which each of its parameters belongs.

    Returns:
      A share of 0 to 1 for each part, the largest first.
    """
    names, part = list(dict.fromkeys(parts)), np.full(len(fit.coordinates), -1)
    for direction, name in zip(hypothesis.directions, parts, strict=True):
        part[(fit.free.directions == direction).all(axis=1) & ~fit.free.nominal] = names.index(name)
    outs = [part >= 0, *(part == number for number in range(len(names)))]
    whole, *lost = fit.linear.without(outs, np.ones(len(part), bool))
    shares = {name: float(np.clip(one / max(whole, 1e-6), 0.0, 1.0)) for name, one in zip(names, lost, strict=True)}
    return dict(sorted(shares.items(), key=lambda one: -one[1]))


def energy(gaps: np.ndarray) -> float:
    """The energy above the floor of gaps [positions] in floor units: the sum of max(gap^2 - 1, 0)."""
    return float(np.maximum(gaps**2 - _PERFECT, 0.0).sum())


def open_gaps(problem: Problem, at: Floor, candidate: Candidate, measure: Measure) -> np.ndarray:
    """Gaps of all positions on `train` and `select` in floor units, [positions], by one of `candidate.measures`."""
    found = np.sqrt(measure(finite(squares(at, candidate)) / at.counts.bins))
    return found[[signal == "q" for signal, _ in problem.cells]]
