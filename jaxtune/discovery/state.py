"""The state of a discovery between two steps, and how it is saved.

A step never changes a state: it returns another one. Every step goes on from what was saved of the step before,
simulated again, so a run that was interrupted finds the same numbers as one that was not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxtune.discovery.candidate import Candidate, cheapest_of_each
from jaxtune.discovery.curves import Library
from jaxtune.discovery.fit import Fit, Free, fit_at, refine
from jaxtune.discovery.noise_floor import NoiseFloor, with_systematic_share
from jaxtune.discovery.problem import Problem
from jaxtune.discovery.result import Settings

_NULL_ROUNDS = 8
_BESIDE = 4  # numbers of a saved coordinate beside its direction: standard deviation, two bounds, nominal or not


@dataclass(frozen=True, kw_only=True)
class State:
    """What a discovery knows after a step; the next step needs nothing else."""

    nominal: Fit
    """The nominal model, with the slopes of the prior directions, and other unknowns where the null first had them."""
    null: Candidate
    """The nominal model with its nominal parameters and other unknowns fitted, and no effect."""
    best: Candidate
    """The model that costs least."""
    candidates: tuple[Candidate, ...]
    """All models that were fitted, the null among them."""
    finished: bool = False
    """True where no further step is to be taken."""
    tried: tuple[str, ...] = ()
    """Keys of the models beside which others were looked for."""
    screened: bool = False
    """True once the library was screened, and the fields below are settled."""
    price: float = 0.0
    """Cost of every effect: the gain that the best hypothesis exceeds on null logs with probability
    `Settings.level`."""
    penalty: float = 0.0
    """Smallest weight of the group lasso (`localise.free_torque`) at which no joint of a null log gets a torque."""
    not_testable: tuple[str, ...] = ()
    """Names of effects that these logs could not show at the smallest size of interest."""
    where: tuple[Mapping[str, Any], ...] = ()
    """Cells above the floor before any effect was added; see `localise.cells`."""
    needs_torque: Mapping[str, float] = field(default_factory=dict)
    """Norm over all segments of the torque that `localise.free_torque` gives every joint beside the model as it stands,
    in floor units; zero where the joint needs none."""
    not_finite: tuple[str, ...] = ()
    """Keys of models that broke the simulation."""
    library: Library | None = None
    """How the nominal model changes with every effect; it is not saved, but simulated again."""
    ablated: tuple[Candidate, ...] = ()
    """The best model without each of its effects, once nothing joins it any more; not saved, but fitted again."""

    def replaced(self, old: Candidate, new: Candidate) -> "State":
        """Puts a better fit of the same model in the place of the old one."""
        swap = lambda one: new if one is old else one  # noqa: E731
        return replace(
            self, null=swap(self.null), best=swap(self.best), candidates=tuple(swap(one) for one in self.candidates)
        )

    def with_candidates(self, fitted: Sequence[Candidate]) -> "State":
        """Adds fitted models; of two with the same effects the one that costs less stays."""
        return replace(self, candidates=cheapest_of_each((*self.candidates, *fitted)))

    def with_seen(self, settings: Settings, problem: Problem, testable: frozenset[str], chances: np.ndarray) -> "State":
        """Settles what holds for all steps: what these logs cannot show, and what chance gains (`screen.seen`)."""
        names = dict.fromkeys(hypothesis.name for hypothesis in problem.hypotheses)
        chance = float(np.quantile(chances, 1.0 - settings.level, method="higher"))
        return replace(
            self,
            screened=True,
            not_testable=tuple(name for name in names if name not in testable),
            # Of many hypotheses one is better by chance, however few null logs there are to show it.
            price=max(chance, 2.0 * float(np.log(max(len(problem.hypotheses), 1)))),
        )


def begin(problem: Problem, floor: NoiseFloor) -> tuple[NoiseFloor, State]:
    """Fits the null and makes the first state; also settles how much evidence a misfit holds, from what it leaves.

    Args:
      problem: names the main horizon.
      floor: the noise floor.

    Raises:
      ValueError: the nominal model cannot be simulated on these logs.
    """
    at = floor[problem.main_horizon]
    zero = np.zeros(len(at.prior.sd))
    residual = at.residuals["train"](at.prior.directions[:1] * 0.0)[0]
    if not np.isfinite(residual).all():
        raise ValueError(f"model: the nominal one breaks within {at.horizon:g} s of these logs")
    nominal = Fit(at.prior, zero, residual, at.slopes, at.counts)
    first = refine([nominal], at.residuals["train"], 2)[0]
    floor = with_systematic_share(floor, at, first.residual)
    at = floor[problem.main_horizon]
    nominal = replace(nominal, counts=at.counts)
    (fit,) = refine([nominal], at.residuals["train"], _NULL_ROUNDS)
    # Nobody believes that the other unknowns are zero, and some of them, such as the travel of bristles, change how all
    # the rest acts. So effects are looked for where they are about right.
    settled = np.where(np.arange(len(zero)) < len(zero) - len(problem.unknowns), 0.0, fit.coordinates)
    nominal = fit_at(at.prior, settled, at.counts, at.residuals["train"])
    (fit,) = refine([replace(fit, jacobian=nominal.jacobian)], at.residuals["train"], _NULL_ROUNDS)
    null = Candidate((), fit, at.residuals["select"](fit.vector[None])[0])
    return floor, State(nominal=nominal, null=null, best=null, candidates=(null,))


def to_json(state: State) -> dict[str, Any]:
    """Turns a state into numbers, texts, lists and dictionaries of them.

    Of fits only the coordinates are kept: their residuals are found by simulating again, and steps that need slopes
    take them. Most models have most of what is free in common, so that is kept once.
    """
    rows: dict[tuple, int] = {}
    numbers = [[rows.setdefault(row, len(rows)) for row in _rows(one.fit.free)] for one in state.candidates]
    return {
        "rows": [list(row) for row in rows],
        "candidates": [
            {
                "hypotheses": [hypothesis.key for hypothesis in one.hypotheses],
                "free": mine,
                "coordinates": one.fit.coordinates.tolist(),
            }
            for one, mine in zip(state.candidates, numbers, strict=True)
        ],
        "best": state.best.key,
        "finished": state.finished,
        "screened": state.screened,
        "tried": list(state.tried),
        "price": state.price,
        "penalty": state.penalty,
        "not_testable": list(state.not_testable),
        "where": list(state.where),
        "needs_torque": dict(state.needs_torque),
        "not_finite": list(state.not_finite),
    }


def from_json(
    problem: Problem, floor: NoiseFloor, begun: State, saved: Mapping[str, Any], restored: Sequence[Candidate] = ()
) -> State:
    """Restores the state that `to_json` turned into `saved`, for the same problem and noise floor.

    Args:
      problem: names the main horizon.
      floor: the noise floor.
      begun: what is not saved (`begin`).
      saved: by `to_json`.
      restored: models of an earlier state that this function made; these are not simulated again.

    Raises:
      ValueError: another version saved it.
    """
    by_key = {hypothesis.key: hypothesis for hypothesis in (*problem.hypotheses, *problem.forms)}
    known = {"rows", "screened"} <= saved.keys()
    if known:
        # The library may have grown since, or names may have changed.
        known = {len(row) for row in saved["rows"]} == {problem.axes + _BESIDE}
        known &= {key for one in saved["candidates"] for key in one["hypotheses"]} <= by_key.keys()
    if not known:
        raise ValueError("the saved state is of another version: remove state.json to begin anew")
    at = floor[problem.main_horizon]
    rows = np.array(saved["rows"])
    frees = [_free(rows[one["free"]]) for one in saved["candidates"]]
    points = [np.array(one["coordinates"]) for one in saved["candidates"]]
    known = {one.fit.vector.tobytes(): (one.fit.residual, one.select) for one in restored}

    def candidate(hypotheses: Sequence[str], free: Free, point: np.ndarray) -> Candidate:
        vector = point @ free.directions
        # Each alone, since rounding depends on what is simulated beside it.
        train, select = known.get(vector.tobytes()) or (
            at.residuals[split](vector[None])[0] for split in ("train", "select")
        )
        fit = Fit(free, point, train, np.zeros((len(train), len(point))), at.counts)
        return Candidate(tuple(by_key[key] for key in hypotheses), fit, select)

    candidates = tuple(
        candidate(one["hypotheses"], free, point)
        for one, free, point in zip(saved["candidates"], frees, points, strict=True)
    )
    return replace(
        begun,
        candidates=candidates,
        null=next(one for one in candidates if not one.hypotheses),
        best=next(one for one in candidates if one.key == saved["best"]),
        finished=saved["finished"],
        tried=tuple(saved["tried"]),
        screened=saved["screened"],
        price=saved["price"],
        penalty=saved["penalty"],
        not_testable=tuple(saved["not_testable"]),
        where=tuple(saved["where"]),
        needs_torque=saved["needs_torque"],
        not_finite=tuple(saved["not_finite"]),
    )


def _rows(free: Free) -> list[tuple[float, ...]]:
    """All that is known of each coordinate, in one row."""
    return [tuple(row) for row in np.column_stack(free.parts()).tolist()]


def _free(rows: np.ndarray) -> Free:
    """The coordinates of some rows."""
    return Free(rows[:, :-_BESIDE], rows[:, -4], rows[:, -3:-1], rows[:, -1].astype(bool))
