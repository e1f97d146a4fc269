"""Which effects deserve a fit (step 5): every effect at every place and size, answered by the nominal parameters.

A fit of the whole library would cost thousands of simulations. The screen simulates each effect at each single place at
a few sizes, while the nominal parameters stand where they are believed to be, on a part of the segments. Limits, delays
and play have no slope at zero, and their best size is found among these. Between sizes residuals are interpolated, and
effects at several places are sums of those at each. `profile` then says what every hypothesis would cost, at every
size, if the nominal parameters answered it within their bounds and their prior. So all hypotheses are compared by what
counts in the end, and a pair costs no more simulations than its parts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from jaxtune.discovery.fit import Fit, taken_over
from jaxtune.discovery.least_squares import complement
from jaxtune.discovery.noise_floor import Floor, Say
from jaxtune.discovery.problem import Hypothesis, Problem, are_distinct
from jaxtune.discovery.profile import Profile

_SEGMENTS = 40  # that are simulated: half of them spread over all, half with the largest residuals
_BATCH = 32  # simulations between two reports of progress
_BETWEEN = (0.0, 0.25, 0.5, 0.75)  # of the way from a size to the next, where costs are computed
_VISIBLE = 4.0  # standard deviations
_PARTNERS = 4  # of a hypothesis that are kept

Curves = Mapping[int, tuple[np.ndarray, np.ndarray]]
"""By axis: sizes [nodes], rising and with zero, and how they change the residuals, [nodes, features]."""


@dataclass(frozen=True)
class Lead:
    """One or two hypotheses that may explain the logs, with the point where their fit begins."""

    hypotheses: tuple[Hypothesis, ...]
    point: np.ndarray
    """[parameters] of the hypotheses, one behind the other."""
    start: np.ndarray
    """[coordinates] at which what is free in the model answers them."""
    cost: float
    """What the model with them would cost on the screened segments."""


@dataclass(frozen=True)
class Screen:
    """What the screen of a model found."""

    leads: tuple[Lead, ...]
    """The best lead of every hypothesis, best first."""
    pairs: tuple[Lead, ...]
    """The best pairs, best first; empty unless they were asked for."""
    cost: float
    """What the model costs as it is, on the screened segments."""
    testable: frozenset[str]
    """Names of effects that these logs could show at the smallest size of interest."""
    chance: np.ndarray
    """[logs]: fall of the cost that the best hypothesis reaches on each null log."""


def screen(problem: Problem, at: Floor, base: Fit, hypotheses: Sequence[Hypothesis], *, pairs: int, say: Say) -> Screen:
    """Screens hypotheses beside a model.

    Args:
      problem: the simulator.
      at: the floor at the main horizon.
      base: the model, fitted or nominal, with slopes of all that is free in it.
      hypotheses: what may join it.
      pairs: how many of the best hypotheses are tried with every other one.
      say: receives a line of text about progress.
    """
    chosen = spread_segments(at, base)
    some = on_segments(at, base, chosen)
    curves = simulate_curves(problem, at, some, chosen, hypotheses, say)
    profile = Profile(some)
    (cost,), _ = profile.costs(np.zeros((1, len(some.residual)), np.float32))
    firsts = sorted((_best(some, profile, h, curves) for h in hypotheses), key=lambda lead: lead.cost)
    couples = [pair for lead in firsts[:pairs] for pair in _pairs_with(some, lead, hypotheses, curves)]
    null_residuals = at.unflatten(_tempered(at).T)[chosen].reshape(len(some.residual), -1).T
    testable, chance = _seen(some, hypotheses, curves, null_residuals, at.null_coordinates)
    return Screen(tuple(firsts), _best_pairs(couples), float(cost), testable, chance)


def _tempered(at: Floor) -> np.ndarray:
    """Residuals [logs, features] of the null logs, those of a log beyond the floor divided by its own rms, as in the
    cost."""
    mean_squares = np.stack([at.counts.mean_squares(log) for log in at.null_residuals])
    root = np.sqrt(np.maximum(mean_squares, 1.0))
    return at.null_residuals / np.tile(root, at.null_residuals.shape[1] // root.shape[1])


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


def simulate_curves(
    problem: Problem, at: Floor, some: Fit, chosen: np.ndarray, hypotheses: Sequence[Hypothesis], say: Say
) -> Curves:
    """Simulates every axis of the hypotheses alone, at a few sizes.

    Joints of different kinematic trees do not move each other, since the base is fixed. So an axis of each tree is
    simulated at a time.

    Args:
      problem: the simulator.
      at: the floor at the main horizon.
      some: the model, on the chosen segments.
      chosen: indices of the segments of `train`.
      hypotheses: whose axes are simulated.
      say: receives a line of text about progress.

    Returns:
      Curves; zero where a simulation is not finite.
    """
    evaluate, sizes = at.on_some(chosen), _sizes(hypotheses)
    trees = _trees(problem, hypotheses)
    parts = np.array([_part_tree(problem, part) for _, part in problem.cells])
    queues: dict[int | None, list[tuple[int, float]]] = {}
    for axis, values in sizes.items():
        queues.setdefault(trees.get(axis), []).extend((axis, size) for size in values)
    alone = [((None, key),) for key in queues.pop(None, [])]
    longest = max((len(queue) for queue in queues.values()), default=0)
    packed = [tuple((tree, queue[i]) for tree, queue in queues.items() if i < len(queue)) for i in range(longest)]
    found: dict[tuple[int, float], np.ndarray] = {}
    every = [*alone, *packed]
    for start in range(0, len(every), _BATCH):
        say(f"screen {start}/{len(every)}")
        batch = every[start : start + _BATCH]
        vectors = np.tile(some.vector, (len(batch), 1))
        for row, keys in enumerate(batch):
            for _, (axis, size) in keys:
                vectors[row, axis] += size
        moved = np.nan_to_num(evaluate(vectors) - some.residual, posinf=0.0, neginf=0.0).astype(np.float32)
        for keys, change in zip(batch, moved, strict=True):
            for tree, key in keys:
                mine = np.ones(len(parts)) if tree is None else parts == tree
                found[key] = (change.reshape(-1, len(parts)) * mine.astype(np.float32)).ravel()
    none = np.zeros(len(some.residual), np.float32)
    return {
        axis: (
            np.array(sorted([0.0, *values])),
            np.stack([found.get((axis, size), none) for size in sorted([0.0, *values])]),
        )
        for axis, values in sizes.items()
    }


def change_of(hypothesis: Hypothesis, points: np.ndarray, curves: Curves) -> np.ndarray:
    """Interpolates how a hypothesis changes the residuals at points [n, parameters]; returns [n, features]."""
    found = 0.0
    coordinates = points @ hypothesis.directions
    # Shape parameters have no curve: they mean nothing without a size.
    for axis in (int(one) for one in np.flatnonzero((hypothesis.directions != 0).any(axis=0)) if int(one) in curves):
        sizes, values = curves[axis]
        at = np.clip(coordinates[:, axis], sizes[0], sizes[-1])
        left = np.clip(np.searchsorted(sizes, at, side="right") - 1, 0, len(sizes) - 2)
        share = ((at - sizes[left]) / (sizes[left + 1] - sizes[left])).astype(np.float32)[:, None]
        found = found + (1.0 - share) * values[left] + share * values[left + 1]
    return found


def _best(some: Fit, profile: Profile, hypothesis: Hypothesis, curves: Curves) -> Lead:
    """The point at which a hypothesis costs least beside a model, `some` with its profile."""
    points = _points(some, hypothesis, curves)
    costs, starts = profile.costs(change_of(hypothesis, points, curves))
    costs = costs + ((points / hypothesis.prior) ** 2).sum(axis=1)
    best = int(np.argmin(costs))
    return Lead((hypothesis,), points[best], starts[best], float(costs[best]))


def _points(some: Fit, hypothesis: Hypothesis, curves: Curves) -> np.ndarray:
    """Points [n, parameters] at which a hypothesis is answered: between its sizes, or where its slopes lead to."""
    probes = hypothesis.probes
    several = np.count_nonzero((probes != 0).any(axis=0)) > 1
    if several:
        slopes = change_of(hypothesis, probes, curves) / np.abs(probes).max(axis=1)[:, None]
        _, at = Profile(some, slopes.T).costs(np.zeros((1, len(some.residual)), np.float32))
        points = at[:, len(some.coordinates) :]
        wanted = np.zeros((1, probes.shape[1]))
        wanted[:, : points.shape[1]] = points
        return np.clip(wanted, *hypothesis.bounds.T)
    sizes = np.array(sorted([0.0, *probes[:, 0]]))
    between = [a + share * (b - a) for a, b in pairwise(sizes) for share in _BETWEEN]
    points = np.zeros((len(between), probes.shape[1]))
    points[:, 0] = between
    return points[points[:, 0] != 0]


def _pairs_with(some: Fit, lead: Lead, hypotheses: Sequence[Hypothesis], curves: Curves) -> list[Lead]:
    """The best partners of a lead, whose size may still change a little."""
    (first,) = lead.hypotheses
    change = change_of(first, lead.point[None], curves)[0]
    further = change_of(first, 1.1 * lead.point[None], curves)[0] - change
    moved = replace(some, residual=some.residual + change)
    profile = Profile(moved, further[:, None] if further.any() else None)
    found = []
    for other in hypotheses:
        if not are_distinct(first, other):
            continue
        best = _best(some, profile, other, curves)
        point, start = np.concatenate([lead.point, best.point]), best.start[: len(some.coordinates)]
        found.append(Lead((first, other), point, start, best.cost + ((lead.point / first.prior) ** 2).sum()))
    return sorted(found, key=lambda pair: pair.cost)[:_PARTNERS]


def _best_pairs(pairs: Sequence[Lead]) -> tuple[Lead, ...]:
    """Every pair once, best first."""
    best: dict[frozenset[str], Lead] = {}
    for pair in sorted(pairs, key=lambda pair: pair.cost):
        best.setdefault(frozenset(h.key for h in pair.hypotheses), pair)
    return tuple(best.values())


def _seen(
    some: Fit,
    hypotheses: Sequence[Hypothesis],
    curves: Curves,
    null_residuals: np.ndarray,
    null_coordinates: np.ndarray,
) -> tuple[frozenset[str], np.ndarray]:
    """Names of the effects that these logs could show, and the largest gain [logs] that each null log gives any."""
    root, prior = np.sqrt(some.counts.independent), np.diag(1.0 / some.free.sd)
    slopes = np.concatenate([root * some.jacobian, prior])
    # Many hypotheses share what they take over, mostly nothing.
    taken = {hypothesis.key: taken_over(some.free, hypothesis) for hypothesis in hypotheses}
    masks = {mask.tobytes(): mask for mask in taken.values()}
    projections = {key: complement(slopes[:, ~mask]) for key, mask in masks.items()}
    padded = lambda rows: np.pad(root * rows, ((0, 0), (0, len(prior)))).T  # noqa: E731
    # Nominal parameters that were fitted pull against their prior as hard as the residuals do.
    # Beside a model with effects nobody asks what chance gains.
    alike = null_coordinates.shape[1] == len(prior)
    pulls = null_coordinates / some.free.sd if alike else np.zeros((len(null_coordinates), len(prior)))
    values = np.concatenate([root * null_residuals, pulls], axis=1).T
    left = {key: project(values) for key, project in projections.items()}
    seen, chance = set(), np.zeros(len(null_residuals))
    for hypothesis in hypotheses:
        project, logs = (found[taken[hypothesis.key].tobytes()] for found in (projections, left))
        mine = project(padded(change_of(hypothesis, hypothesis.probes, curves)))
        length = np.sqrt((mine**2).sum(axis=0))
        sizes = np.abs(hypothesis.probes).max(axis=1)
        if length[np.argmin(sizes)] >= _VISIBLE:
            seen.add(hypothesis.name)
        falls = mine.T @ logs / np.maximum(length, 1e-9)[:, None]
        chance = np.maximum(chance, (np.minimum(falls, 0.0) ** 2).max(axis=0))
    return frozenset(seen), chance


def _sizes(hypotheses: Sequence[Hypothesis]) -> dict[int, list[float]]:
    """The sizes at which every axis is simulated: those of the hypothesis at its place alone, if there is one."""
    found: dict[int, set[float]] = {}
    for hypothesis in sorted(hypotheses, key=lambda h: len(h.places)):
        mine: dict[int, set[float]] = {}
        for row in hypothesis.probes @ hypothesis.directions:
            for axis in np.flatnonzero(row):
                mine.setdefault(int(axis), set()).add(float(row[axis]))
        for axis, sizes in mine.items():
            found.setdefault(axis, sizes)
    return {axis: sorted(sizes) for axis, sizes in found.items()}


def _trees(problem: Problem, hypotheses: Sequence[Hypothesis]) -> dict[int, int]:
    """The kinematic tree of every axis whose effect stays within one; others are left out."""
    found = {}
    for hypothesis in hypotheses:
        trees = {int(problem.trees[joint]) for joint in hypothesis.joints}
        if len(hypothesis.places) == 1 and len(trees) == 1:
            for axis in np.flatnonzero((hypothesis.directions != 0).any(axis=0)):
                found[int(axis)] = next(iter(trees))
    return found


def _part_tree(problem: Problem, part: str) -> int:
    """The kinematic tree of a component of a signal; -1 for one that belongs to no joint."""
    joints = problem.components["q"]
    return int(problem.trees[joints.index(part)]) if part in joints else -1
