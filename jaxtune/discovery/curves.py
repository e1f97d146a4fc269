"""How the residuals of a model change with every axis alone: what the screen interpolates in.

Each effect is simulated at each single place at a few sizes, on a part of the segments. Limits, delays and play have no
slope at zero, and their best size is found among these. Between sizes residuals are interpolated, and effects at
several places are sums of those at each. An effect that may show in one form alone, such as friction that sets in over
a small travel, is simulated in that form too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.fit import Fit
from jaxtune.discovery.noise_floor import Floor, Say
from jaxtune.discovery.problem import Hypothesis
from jaxtune.discovery.profile import Changes

_SEGMENTS = 40  # that are simulated: half of them spread over all, half with the largest residuals

Group = tuple[Hypothesis, ...]
"""What is screened as one: a hypothesis, alone or with forms of it, each at its first size."""


_Key = tuple[int, ...]
"""An axis, alone or with the axes of forms at the same place."""


@dataclass(frozen=True)
class Curves:
    """How the residuals change with each axis alone."""

    sizes: dict[_Key, np.ndarray]
    """Sizes [nodes], rising and with zero."""
    first: dict[_Key, int]
    """Number of the first node in `changes`; the others follow."""
    changes: np.ndarray
    """[nodes of all axes, features]"""

    def at(self, group: Group, points: np.ndarray) -> Changes:
        """Interpolates between nodes: how a group changes the residuals at points [n, parameters]."""
        (hypothesis, *_), which, weights = group, [], []
        coordinates = points[:, : len(hypothesis.directions)] @ hypothesis.directions
        # Shape parameters have no curve: they mean nothing without a size.
        for key in (one for one in _keys(group) if one in self.sizes):
            sizes = self.sizes[key]
            which.append(self.first[key] + np.arange(len(sizes)))
            weights.append(np.stack([np.interp(coordinates[:, key[0]], sizes, unit) for unit in np.eye(len(sizes))], 1))
        return Changes(np.concatenate(which), np.concatenate(weights, axis=1))


def _keys(group: Group) -> list[_Key]:
    """The keys of the curves of a group."""
    hypothesis, *forms = group
    if not forms:
        return [(int(axis),) for axis in np.flatnonzero((hypothesis.directions != 0).any(axis=0))]
    # Places are in the same order on the axes of every effect.
    rows = (one.directions if one.each else one.directions[:1] for one in group)
    return list(zip(*(np.flatnonzero(row.any(axis=0)).tolist() for row in rows), strict=True))


@dataclass(frozen=True)
class Library:
    """How the nominal model changes with every axis, from the first screen."""

    segments: np.ndarray
    """Indices of those of `train` that were simulated."""
    curves: Curves


def groups_of(hypotheses: Sequence[Hypothesis], forms: Sequence[Hypothesis]) -> list[Group]:
    """Lists what is screened: every hypothesis alone, and with each of its forms that asks for that."""
    found: list[Group] = [(one,) for one in hypotheses]
    for one in hypotheses:
        own = {form.form: form for form in forms if form.shapes(one)}
        found += [(one, form) for form in own.values() if form.screened]
        # The other form is no small one then, but as large as may be expected.
        found += [
            (one, form, replace(own[form.beside], probes=own[form.beside].prior[None]))
            for form in own.values()
            if form.beside in own
        ]
    return found


def simulate_library(at: Floor, nominal: Fit, groups: Sequence[Group], say: Say) -> Library:
    """Simulates every axis of the hypotheses alone, from the nominal model.

    Args:
      at: the floor at the main horizon.
      nominal: the nominal model.
      groups: of all hypotheses.
      say: receives a line of text about progress.
    """
    chosen = spread_segments(at, nominal)
    return Library(chosen, simulate_curves(at, on_segments(at, nominal, chosen), chosen, groups, say))


def probes_of(group: Group) -> np.ndarray:
    """Points [probes, parameters] of the hypothesis of a group, with the first size of each of its forms."""
    hypothesis, *forms = group
    return np.concatenate(
        [hypothesis.probes, *(np.tile(form.probes[0], (len(hypothesis.probes), 1)) for form in forms)], axis=1
    )


def spread_segments(at: Floor, base: Fit) -> np.ndarray:
    """Chooses segments of `train`, rising: half of them evenly spread, half of them where the model is worst."""
    energy = (at.unflatten(base.residual) ** 2).sum(axis=(1, 2))
    half = min(_SEGMENTS, len(energy)) // 2
    even = np.linspace(0, len(energy) - 1, half).round().astype(int)
    worst = [index for index in np.argsort(-energy) if index not in set(even.tolist())]
    return np.sort(np.concatenate([even, worst[: min(_SEGMENTS, len(energy)) - half]]).astype(int))


def on_segments(at: Floor, fit: Fit, chosen: np.ndarray) -> Fit:
    """Restricts residuals and slopes of a fit to some segments of `train`."""
    residual = at.unflatten(fit.residual)[chosen].ravel()
    jacobian = at.unflatten(fit.jacobian)[chosen].reshape(len(residual), -1)
    return replace(fit, residual=residual, jacobian=jacobian)


def simulate_curves(at: Floor, some: Fit, chosen: np.ndarray, groups: Sequence[Group], say: Say) -> Curves:
    """Simulates every axis of the hypotheses alone, at a few sizes.

    Args:
      at: the floor at the main horizon.
      some: the model, on the chosen segments.
      chosen: indices of the segments of `train`.
      groups: whose axes are simulated.
      say: receives a line of text about progress.

    Returns:
      Curves; zero where a simulation is not finite.
    """
    nodes = {key: np.array(sorted([0.0, *values])) for key, values in _sizes(groups).items()}
    keys = [(key, size) for key, values in nodes.items() for size in values]
    # Of a form every node has the first size.
    first = {
        axis: form.probes[0, 0] * form.directions[0, axis]
        for _, *forms in groups
        for form in forms
        for axis in np.flatnonzero(form.directions[0])
    }
    moves = np.zeros((len(keys), len(some.vector)))
    for move, ((axis, *of_form), size) in zip(moves, keys, strict=True):
        move[axis], move[of_form] = size, [first[one] for one in of_form]
    # Curves of one form begin alike, and others where nothing moves.
    moves, which = np.unique(moves, axis=0, return_inverse=True)
    moved, changes = (moves != 0).any(axis=1), np.zeros((len(moves), len(some.residual)), np.float32)
    (changes[moved],) = at.on_some(chosen).changes(
        [some.vector], [some.residual], [moves[moved]], lambda done, count: say(f"screen {done}/{count}")
    )
    firsts = np.cumsum([0, *(len(values) for values in nodes.values())]).tolist()
    return Curves(nodes, dict(zip(nodes, firsts, strict=False)), changes[which.ravel()])


def _sizes(groups: Sequence[Group]) -> dict[_Key, list[float]]:
    """The sizes at which every axis is simulated: those of the group at its place alone, if there is one."""
    found: dict[_Key, set[float]] = {}
    for group in sorted(groups, key=lambda group: len(group[0].places)):
        mine: dict[_Key, set[float]] = {}
        for row in group[0].probes @ group[0].directions:
            for key in (one for one in _keys(group) if row[one[0]]):
                mine.setdefault(key, set()).add(float(row[key[0]]))
        for key, sizes in mine.items():
            found.setdefault(key, sizes)
    return {key: sorted(sizes) for key, sizes in found.items()}
