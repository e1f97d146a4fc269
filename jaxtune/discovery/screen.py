"""Which hypotheses deserve a fit (step 5): a score test of every effect at every place.

A hypothesis' slopes are secants at the sizes at which it is looked for, from where the model stands; those of several
places are the sum of those of each. What the free coordinates explain is projected out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaxtune.discovery.fit import Fit, given_up
from jaxtune.discovery.least_squares import Linear, complement
from jaxtune.discovery.problem import Hypothesis

_VISIBLE = 4.0  # standard deviations
_OUT_OF_SIZE = 3.0  # a secant speaks for sizes up to this multiple of its own


@dataclass(frozen=True)
class Score:
    """What a score test says of a hypothesis."""

    gain: float
    """By how much the loss falls."""
    coordinates: np.ndarray
    """[parameters] at which it falls most."""
    visible: float
    """How many standard deviations the smallest size of interest would move the residuals."""

    @property
    def testable(self) -> bool:
        """Whether these logs could show it."""
        return self.visible >= _VISIBLE


class Screen:
    """Secants of all hypotheses at one point.

    Args:
      fit: the point, with the slopes of what is free.
      columns: [features] of every (axis, size) that `probes` asked for, per unit of the coordinate.
    """

    def __init__(self, fit: Fit, columns: Mapping[tuple, np.ndarray]):
        self._fit, self._columns = fit, columns
        self._projections = {}

    def scores(self, hypotheses: Sequence[Hypothesis], at: Fit | None = None) -> dict[str, Score]:
        """A score for every hypothesis; at another fit of the same coordinates, if given."""
        return {hypothesis.key: self._score(hypothesis, at) for hypothesis in hypotheses}

    def _score(self, hypothesis: Hypothesis, at: Fit | None) -> Score:
        # What is at its bound cannot make room for anything.
        none = (at or self._fit).at_bounds
        own = none | given_up(self._fit.free, hypothesis)
        project = self._projection(own)
        value = project(_without(at or self._fit, own).rows()[0])
        least = np.sum(self._projection(none)(_without(at or self._fit, none).rows()[0]) ** 2)
        best = Score(0.0, np.zeros(len(hypothesis.directions)), 0.0)
        visible = 0.0
        for sizes, group in groups(hypothesis):
            column = np.stack(
                [sum(share * self._columns[key] for key, share in keys.items()) for keys in group], axis=1
            )
            padding = np.zeros((len(value) - len(column), column.shape[1]))
            slope = project(np.concatenate([np.sqrt(self._fit.weight) * column, padding]))
            # Of the smallest size of interest, which comes first.
            visible = visible or float(np.abs(sizes * np.sqrt((slope**2).sum(axis=0))).max())
            normal = slope.T @ slope
            if np.trace(normal) < 1e-12:
                continue
            found = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(len(normal)), slope.T @ value)
            full = np.zeros(len(hypothesis.directions))
            full[: len(found)] = found
            low, high = hypothesis.bounds.T
            if len(hypothesis.probes) > 1 and low[0] >= 0:
                high = np.minimum(high, _OUT_OF_SIZE * sizes.max())
            full = np.clip(full, low, high)
            gain = float(least - np.sum((value + slope @ full[: len(found)]) ** 2))
            if gain > best.gain:
                best = Score(gain, full, 0.0)
        return Score(best.gain, best.coordinates, visible)

    def like(self, axis: int, change: float, hypotheses: Sequence[Hypothesis], share: float) -> tuple[str, ...]:
        """Names of hypotheses that explain a share of what a change along an axis does, best first.

        What the other free coordinates explain is projected out of both.
        """
        free = self._fit.free.directions
        own = (free[:, axis] != 0) & self._fit.free.nominal
        if not own.any():
            return ()
        project = self._projection(own)
        root, rest = np.sqrt(self._fit.weight), np.zeros(int((~own).sum()))
        seen = lambda column: project(np.concatenate([root * column, rest]))  # noqa: E731
        wanted = np.sign(change) * seen(self._fit.jacobian[:, own][:, 0])
        found = {}
        for hypothesis in hypotheses:
            for _, group in groups(hypothesis):
                if not all(key in self._columns for keys in group for key in keys):
                    continue
                columns = [sum(part * self._columns[key] for key, part in keys.items()) for keys in group]
                columns = np.stack([seen(column) for column in columns], axis=1)
                # What can only be added does not explain what was taken away.
                if hypothesis.bounds[0, 0] >= 0 and columns[:, 0] @ wanted < 0:
                    continue
                left = complement(columns)(wanted)
                explained = 1.0 - np.sum(left**2) / max(np.sum(wanted**2), 1e-12)
                found[hypothesis.name] = max(found.get(hypothesis.name, 0.0), float(explained))
        return tuple(sorted((name for name in found if found[name] >= share), key=lambda name: -found[name]))

    def _projection(self, own: np.ndarray):
        """Onto what the coordinates cannot explain that a hypothesis does not take over."""
        key = own.tobytes()
        if key not in self._projections:
            self._projections[key] = complement(_without(self._fit, own).rows()[1])
        return self._projections[key]


def _without(fit: Fit, own: np.ndarray) -> Linear:
    """A fit's surroundings without some of its coordinates."""
    linear = fit.linear
    return Linear(linear.residual, linear.jacobian[:, ~own], linear.offset[~own], linear.sd[~own], linear.weight)


def shortlist(scores: Mapping[str, Score], hypotheses: Sequence[Hypothesis], count: int) -> list[Hypothesis]:
    """The best `count`, and the best of each family."""
    ranked = sorted(hypotheses, key=lambda h: -scores[h.key].gain)
    ranked = [h for h in ranked if scores[h.key].gain > 4.0]
    chosen, seen, names = [], set(), {}
    for hypothesis in ranked:
        first = hypothesis.family not in seen
        # Three places of one name tell where; more would crowd out other names.
        if names.get(hypothesis.name, 0) >= 3:
            continue
        if first or len(chosen) < count:
            chosen.append(hypothesis)
            seen.add(hypothesis.family)
            names[hypothesis.name] = names.get(hypothesis.name, 0) + 1
    return chosen


def groups(hypothesis: Hypothesis):
    """For every size at which it is looked for: sizes [k], and its (axis, size) and shares for each of k directions."""
    free = [index for index in range(len(hypothesis.directions)) if (hypothesis.probes[:, index] != 0).any()]
    together = len(free) > 1
    rows = [hypothesis.probes.max(axis=0)] if together else hypothesis.probes
    for probe in rows:
        yield (
            np.array([probe[index] for index in free]),
            [
                {
                    (int(axis), float(probe[index])): float(hypothesis.directions[index, axis])
                    for axis in np.flatnonzero(hypothesis.directions[index])
                }
                for index in free
            ],
        )


def probes(hypotheses: Sequence[Hypothesis]) -> list[tuple[int, float]]:
    """All (axis, size) whose secants the hypotheses need."""
    return sorted(
        {key for hypothesis in hypotheses for _, group in groups(hypothesis) for keys in group for key in keys}
    )
