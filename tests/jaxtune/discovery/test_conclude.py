"""Which joints an answer names, and which model is saved where no effect gets a name."""

from dataclasses import replace

import numpy as np
import pytest
from slider import problem

from jaxtune.discovery import conclude, noise_floor, state, step
from jaxtune.discovery.candidate import cost
from jaxtune.discovery.result import Settings


@pytest.fixture(scope="module")
def stepped():
    asked = problem({"coulomb": 0.5})
    floor, begun = state.begin(asked, noise_floor.measure(asked, lambda text: None))
    found, _ = step.step(Settings(), asked, floor, begun)
    return asked, floor, found


def test_the_model_that_costs_least_on_validation_runs_is_saved(stepped):
    asked, floor, found = stepped
    at = floor[asked.main_horizon]
    assert next(iter(conclude._by_select(asked, at, found, found.best, found.null))) == "effects"
    # Worse in one segment, as all models would be that none explains, and better in all others.
    odd = at.unflatten(found.best.select).copy()
    odd[0] = 1.05 * at.unflatten(found.null.select)[0]
    best = replace(found.best, select=odd.ravel())
    assert next(iter(conclude._by_select(asked, at, found, best, found.null))) == "effects"


def test_a_model_that_breaks_in_one_segment_is_not_saved(stepped):
    asked, floor, found = stepped
    at = floor[asked.main_horizon]
    broken = at.unflatten(found.best.select).copy()
    broken[0] *= 1e4
    best = replace(found.best, select=broken.ravel())
    costs = [cost(at, (at.unflatten(one.select) ** 2).sum(axis=1)) for one in (best, found.null)]
    # The cost alone does not mind.
    assert costs[0] < costs[1]
    assert next(iter(conclude._by_select(asked, at, found, best, best))) in ("null", "nominal")


def test_the_answer_names_the_joints_that_show_an_effect(stepped):
    asked, floor, found = stepped
    (coulomb,) = found.best.effects
    # Another joint that stays below what the effect needs: the same simulations.
    wide = replace(found.best, hypotheses=(replace(coulomb, places=("slider", "other")),))
    begun = replace(found, best=wide, candidates=(wide, *found.candidates))
    (term,) = conclude.conclude(Settings(), asked, floor, begun, lambda text: None).terms
    assert term.hypothesis.places == ("slider",)


def test_of_models_that_are_believed_alike_one_that_predicts_whole_runs_is_taken(stepped):
    asked, floor, found = stepped
    at = floor[asked.main_horizon]
    (coulomb,) = found.best.effects
    # Under another name it costs the same, and a vector that is a little off tells which of them was asked for.
    other = replace(found.best, hypotheses=(replace(coulomb, name="other"),))
    moved = replace(other, fit=replace(other.fit, coordinates=1.0001 * other.fit.coordinates))
    begun = replace(found, candidates=(*found.candidates, moved))

    def taken(errors):
        least = found.best.fit.vector.tobytes()
        asked_for = replace(asked, whole_runs=lambda vectors: np.array([errors[v.tobytes() == least] for v in vectors]))
        return conclude._by_whole_runs(Settings(), asked_for, at, begun).best

    assert taken({True: 0.1, False: 0.05}) is moved
    # A little better may be chance.
    assert taken({True: 0.1, False: 0.09}) is found.best
    assert taken({True: 0.1, False: np.nan}) is found.best
    # The null is not believed at all.
    begun = found
    assert taken({True: 0.1, False: 0.01}) is found.best
