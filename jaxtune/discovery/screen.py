"""Which hypotheses deserve a fit (step 5): a score test of every effect at every place.

A fit of the whole library would cost thousands of simulations; a secant for every (axis, size) costs one. The columns
of a hypothesis at several places are sums of those at each. From them the test says by how much the loss would fall
with the hypothesis in the model, after the free coordinates have explained what they can: these are projected out.
Source: Rao's score test, in its Gauss-Newton form.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.fit import Fit, taken_over
from jaxtune.discovery.least_squares import Linear, complement
from jaxtune.discovery.noise_floor import Floor, NoiseFloor, Say
from jaxtune.discovery.problem import Hypothesis, Problem
from jaxtune.discovery.result import Settings
from jaxtune.discovery.state import Columns, State

_VISIBLE = 4.0  # standard deviations
_OUT_OF_SIZE = 3.0  # a secant speaks for sizes up to this multiple of its own
_BATCH = 32  # columns between two reports of progress


@dataclass(frozen=True)
class Score:
    """What a score test says of a hypothesis: its gain, where its fit starts, and whether these logs could show it."""

    gain: float
    """By how much the loss would fall, if residuals were linear."""
    coordinates: np.ndarray
    """[parameters] at which it falls most; the fit starts there."""
    visible: float
    """How many standard deviations the smallest size of interest would move the residuals."""

    @property
    def testable(self) -> bool:
        """True if these logs could show the effect at the smallest size of interest, above noise."""
        return self.visible >= _VISIBLE


def screen(
    settings: Settings, problem: Problem, floor: NoiseFloor, state: State, say: Say
) -> tuple[State, dict[str, Score]]:
    """Tests all hypotheses that were not accepted yet, from where the model stands.

    The first screen also settles what holds for all rounds: which effects are not testable, what each hypothesis
    promises, and what chance gains, unless a calibration has said so.

    Args:
      settings: the level of the threshold.
      problem: the hypotheses and the simulator.
      floor: the noise floor and the fits to null logs.
      state: where the model stands, fitted at the main horizon.
      say: receives a line of text about progress.

    Returns:
      The state with the secants, and a score by hypothesis' key.
    """
    base = state.fits[problem.main_horizon]
    hypotheses = _untried(problem, state)
    columns = secant_columns(floor[problem.main_horizon], base, hypotheses, say)
    state = replace(state, columns=columns)
    if state.screened:
        (found,) = scores(base, columns, hypotheses, [base])
        return state, found
    null_fits = () if state.least_gain else floor[problem.main_horizon].null_fits
    found, *of_null_logs = scores(base, columns, hypotheses, [base, *null_fits])
    testable = {h.name for h in hypotheses if found[h.key].testable}
    names = dict.fromkeys(h.name for h in hypotheses)
    state = replace(
        state,
        promise={key: score.gain for key, score in found.items()},
        not_testable=tuple(name for name in names if name not in testable),
        least_gain=state.least_gain or chance_gain(of_null_logs, settings.level),
    )
    say(f"these logs cannot show: {', '.join(state.not_testable) or 'nothing is beyond them'}")
    return state, found


def secant_columns(at: Floor, fit: Fit, hypotheses: Sequence[Hypothesis], say: Say) -> Columns:
    """Takes the secants of the residuals that the hypotheses are made of, one simulation for each.

    Args:
      at: the floor at the main horizon.
      fit: where the model stands there.
      hypotheses: what is asked about.
      say: receives a line of text about progress.

    Returns:
      [features] by (axis, size), per unit of the coordinate; zero where a simulation is not finite.
    """
    asked = probes(hypotheses)
    steps = np.zeros((len(asked), len(fit.vector)))
    for row, (axis, size) in enumerate(asked):
        steps[row, axis] = size
    columns = {}
    for start in range(0, len(asked), _BATCH):
        say(f"screen {start}/{len(asked)}")
        found = at.residuals["train"](fit.vector + steps[start : start + _BATCH])
        for key, moved in zip(asked[start : start + _BATCH], found, strict=True):
            columns[key] = np.nan_to_num((moved - fit.residual) / key[1], posinf=0.0, neginf=0.0)
    return columns


def scores(
    fit: Fit, columns: Columns, hypotheses: Sequence[Hypothesis], points: Sequence[Fit]
) -> list[dict[str, Score]]:
    """Scores every hypothesis at every point.

    Slopes are those of `fit` for all points, so that a null log costs no simulation: its residuals alone count.

    Args:
      fit: where the columns were taken, with the slopes of the free coordinates.
      columns: secants by (axis, size).
      hypotheses: what is scored.
      points: fits of the same coordinates to the same or to other logs.

    Returns:
      For every point, a score by hypothesis' key.
    """
    taken = [taken_over(fit.free, hypothesis) for hypothesis in hypotheses]
    # What is at its bound cannot make room for anything.
    masks = [[point.at_bounds, *(point.at_bounds | own for own in taken)] for point in points]
    # Many hypotheses share what they take over, mostly nothing; a projection is the dearest part.
    distinct = {mask.tobytes(): mask for row in masks for mask in row}
    projections = {key: complement(_prior_and_slopes(fit, mask)[1]) for key, mask in distinct.items()}
    found = []
    for point, (none, *own) in zip(points, masks, strict=True):
        least = np.sum(projections[none.tobytes()](_prior_and_slopes(point, none)[0]) ** 2)
        scored = {}
        for hypothesis, mask in zip(hypotheses, own, strict=True):
            project = projections[mask.tobytes()]
            value = project(_prior_and_slopes(point, mask)[0])
            scored[hypothesis.key] = _score(hypothesis, columns, project, value, least, fit.weight)
        found.append(scored)
    return found


def chance_gain(of_null_logs: Sequence[Mapping[str, Score]], level: float) -> float:
    """Returns the gain that the best hypothesis exceeds with probability `level` where nothing is missing.

    It is the quantile 1 - level, over null logs, of the largest gain over all hypotheses: the threshold holds for the
    whole library at once.
    """
    best = [max(score.gain for score in scores.values()) for scores in of_null_logs]
    return float(np.quantile(best, 1.0 - level, method="higher"))


def looks_like(
    fit: Fit, columns: Columns, axis: int, hypotheses: Sequence[Hypothesis], share: float
) -> tuple[str, ...]:
    """Names the hypotheses that these logs cannot distinguish from the change of a nominal parameter.

    A hypothesis looks like the change if it explains a share of what the change does to the residuals. What the other
    free coordinates explain is projected out of both first.

    Args:
      fit: the model, whose axis `axis` has changed.
      columns: secants where the model stands; a hypothesis without its columns is skipped.
      axis: index of the nominal parameter.
      hypotheses: what it may be mistaken for.
      share: of the squared change that must be explained.

    Returns:
      Names, best first.
    """
    change = fit.vector[axis]
    own = (fit.free.directions[:, axis] != 0) & fit.free.nominal
    if not own.any():
        return ()
    _, others = _prior_and_slopes(fit, own)
    project = complement(others)
    root, rest = np.sqrt(fit.weight), np.zeros(int((~own).sum()))
    seen = lambda column: project(np.concatenate([root * column, rest]))  # noqa: E731
    wanted = np.sign(change) * seen(fit.jacobian[:, own][:, 0])
    found = {}
    for hypothesis in hypotheses:
        for _, group in groups(hypothesis):
            if not all(key in columns for keys in group for key in keys):
                continue
            mine = np.stack([seen(_column(columns, keys)) for keys in group], axis=1)
            # What can only be added does not explain what was taken away.
            if hypothesis.bounds[0, 0] >= 0 and mine[:, 0] @ wanted < 0:
                continue
            left = complement(mine)(wanted)
            explained = 1.0 - np.sum(left**2) / max(np.sum(wanted**2), 1e-12)
            found[hypothesis.name] = max(found.get(hypothesis.name, 0.0), float(explained))
    return tuple(sorted((name for name in found if found[name] >= share), key=lambda name: -found[name]))


def groups(hypothesis: Hypothesis) -> Iterator[tuple[np.ndarray, list[dict[tuple[int, float], float]]]]:
    """Lists what the screen asks about a hypothesis: for every size, the columns that it is a sum of.

    Parameters that can be probed alone are asked about together, as one group of k directions.

    Yields:
      Sizes [k], and for each of the k directions the share of every (axis, size).
    """
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
    """Lists all (axis, size) whose secants the hypotheses need, each once, in order; places share many of them."""
    return sorted(
        {key for hypothesis in hypotheses for _, group in groups(hypothesis) for keys in group for key in keys}
    )


def _score(
    hypothesis: Hypothesis,
    columns: Columns,
    project: Callable[[np.ndarray], np.ndarray],
    value: np.ndarray,
    least: float,
    weight: float,
) -> Score:
    """The best score over the sizes at which a hypothesis is looked for.

    Args:
      hypothesis: what is scored.
      columns: secants by (axis, size).
      project: projects out what the free coordinates explain that the hypothesis does not take over.
      value: projected residuals, with the prior's rows.
      least: what the free coordinates leave of the loss without the hypothesis.
      weight: share of the features that count as independent.
    """
    best = Score(0.0, np.zeros(len(hypothesis.directions)), 0.0)
    visible = 0.0
    low, high = hypothesis.bounds.T
    for sizes, group in groups(hypothesis):
        column = np.stack([_column(columns, keys) for keys in group], axis=1)
        # The prior's rows do not depend on the hypothesis.
        padding = np.zeros((len(value) - len(column), column.shape[1]))
        slope = project(np.concatenate([np.sqrt(weight) * column, padding]))
        # Of the smallest size of interest, which comes first.
        visible = visible or float(np.abs(sizes * np.sqrt((slope**2).sum(axis=0))).max())
        normal = slope.T @ slope
        # The free coordinates explain all that this effect does.
        if np.trace(normal) < 1e-12:
            continue
        found = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(len(normal)), slope.T @ value)
        full = np.zeros(len(hypothesis.directions))
        full[: len(found)] = found
        one_sided = len(hypothesis.probes) > 1 and low[0] >= 0
        full = np.clip(full, low, np.minimum(high, _OUT_OF_SIZE * sizes.max()) if one_sided else high)
        gain = float(least - np.sum((value + slope @ full[: len(found)]) ** 2))
        if gain > best.gain:
            best = Score(gain, full, 0.0)
    return Score(best.gain, best.coordinates, visible)


def _column(columns: Columns, shares: Mapping[tuple[int, float], float]) -> np.ndarray:
    """The secant [features] along a direction: a sum of columns by their shares."""
    return sum(share * columns[key] for key, share in shares.items())


def _untried(problem: Problem, state: State) -> list[Hypothesis]:
    """Lists the hypotheses that were neither accepted nor dropped so far: what a step may still look at."""
    taken = {term.hypothesis.key for term in state.terms} | set(state.dropped)
    return [hypothesis for hypothesis in problem.hypotheses if hypothesis.key not in taken]


def _prior_and_slopes(fit: Fit, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value [n] and slopes [n, coordinates] of what a fit's loss squares, without the coordinates `own`."""
    linear = fit.linear
    kept = Linear(linear.residual, linear.jacobian[:, ~own], linear.offset[~own], linear.sd[~own], linear.weight)
    return kept.rows()
