"""Discovery on a slider whose truth is known."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from slider import AXES, BOTH, DIRECTION, DRAG, EACH, HYPOTHESES, LEARNED, ONE_SIZE, ROWS, WARPED, WILD, problem

from jaxtune.discovery import finalists, leads, noise_floor, state, step, workflow
from jaxtune.discovery.candidate import Candidate, key_of
from jaxtune.discovery.conclude import _rivals, _with_what_passes
from jaxtune.discovery.evaluate import is_worse
from jaxtune.discovery.evidence import Evidence
from jaxtune.discovery.fit import begin
from jaxtune.discovery.naming import at_fewest_places, moved_forms, renamed, with_refinements
from jaxtune.discovery.result import AcceptedTerm, Settings
from jaxtune.discovery.screen import Lead
from jaxtune.discovery.shares import enough, explained, speak


def discover(truth, seed=0, say=lambda line: None, **kwargs):
    return workflow.discover(problem(truth, seed, **kwargs), say=say)


def measured_floor(asked):
    return noise_floor.measure(asked, lambda text: None)


def test_hidden_friction_is_named_with_its_size():
    result = discover({"coulomb": 0.5, "mass": 0.08, "damping": -0.1})
    assert result.verdict == "named"
    assert [term.hypothesis.name for term in result.terms] == ["coulomb"]
    axis = AXES.index("coulomb")
    assert abs(result.fit.vector[axis] - 0.5) < 0.02
    # Its form may be off by 8 %, beside which noise is small.
    assert 0.04 < result.errors[-1] < 0.05
    # Nominal parameters were found beside it: a tenth of a prior deviation is 0.01.
    assert result.fit.vector[0] == pytest.approx(0.08, abs=0.03)
    assert result.gap["after"] < 1.3 < result.gap["null"] < result.gap["before"]


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_named_where_nothing_is_hidden(seed):
    truth = dict(zip(("mass", "damping"), 0.1 * np.random.default_rng(seed).uniform(-1, 1, 2), strict=True))
    result = discover(truth, seed + 1)
    assert result.verdict == "no_missing_effect"
    assert not result.terms
    assert not result.changed
    assert result.model_is == "null"


def test_a_parameter_far_from_its_prior_is_a_change_and_not_an_effect():
    result = discover({"damping": 1.5})
    assert result.verdict == "parameter_change"
    assert {term.hypothesis.name for term in result.terms} | {AXES[axis] for axis in result.changed} == {"damping"}
    assert result.fit.vector[AXES.index("damping")] == pytest.approx(1.5, abs=0.1)


def test_every_stage_says_how_much_of_the_whole_is_over():
    lines = []
    discover({"coulomb": 0.5}, say=lines.append)
    assert {stage for line in lines if (stage := workflow._stage(line))} == set(workflow._STAGES)
    shares = [workflow.share_done(lines[: count + 1]) for count in range(len(lines))]
    assert shares == sorted(shares)
    assert shares[0] == workflow._STAGES["noise floor"]
    assert shares[-1] == workflow._STAGES["proof"]


def test_the_bar_moves_in_every_further_step():
    step = ["screen 64/128", "answers of the nominal parameters", "fit 11", "4602.3 before"]
    shares = [workflow.share_done(["null", *(step * steps)]) for steps in (1, 2, 3, 4)]
    assert shares == sorted(set(shares))
    assert shares[-1] < workflow._STAGES["evidence"]
    assert workflow.share_done(["4602.3 before"]) == 0.0


@pytest.mark.parametrize(
    ("sizes", "key"), [((0.6, 0.6), "both@one+two"), ((0.9, -0.5), "both@one&two"), ((0.0, 0.7), "both@one&two")]
)
def test_places_have_sizes_of_their_own_only_where_they_differ(sizes, key):
    result = discover(dict(zip(("coulomb", "push"), sizes, strict=True)), hypotheses=BOTH)
    assert result.verdict == "named"
    assert [term.hypothesis.key for term in result.terms] == [key]
    np.testing.assert_allclose(sizes, result.fit.vector[[AXES.index(name) for name in ("coulomb", "push")]], atol=0.03)
    # Both are one suspect.
    assert [one.hypothesis.name for one in result.suspects].count("both") == 1


def test_a_model_pays_for_every_further_size():
    assert (ONE_SIZE.worth, EACH.worth, replace(EACH, places=tuple("abcde")).worth) == (1.0, 1.5, 3.0)
    assert DIRECTION.worth == 0.5


def test_two_effects_are_named_one_after_the_other():
    result = discover({"coulomb": 1.2, "push": 1.2})
    assert {term.hypothesis.name for term in result.terms} == {"coulomb", "push"}
    assert result.proof["others"]["without push@slider"] > result.gap["after"] + 1.0
    assert result.proof["others"]["without coulomb@slider"] > result.gap["after"] + 1.0


def test_a_weak_effect_beside_a_strong_one_at_the_same_joint_stays_in_the_model_but_is_not_named():
    result = discover({"coulomb": 1.2, "push": 0.1})
    assert result.verdict == "named"
    assert [(term.hypothesis.name, term.refines) for term in result.terms] == [
        ("coulomb", None),
        ("push", "coulomb@slider"),
    ]
    assert result.fit.vector[AXES.index("push")] == pytest.approx(0.1, abs=0.03)
    assert result.gap["after"] < 1.3


@pytest.mark.parametrize(
    ("joints", "gain", "refines"),
    [
        ((1, 2), 49.0, "coulomb@slider"),
        ((1, 2), 51.0, None),
        # At one of two joints half as much is as much.
        ((1,), 24.0, "coulomb@slider"),
        ((1,), 26.0, None),
        ((0,), 24.0, None),
        ((0, 1), 24.0, None),
        ((), 24.0, None),
    ],
)
def test_an_effect_refines_a_stronger_one_only_where_it_acts_at_no_other_joint(joints, gain, refines):
    coulomb, push = (next(one for one in HYPOTHESES if one.name == name) for name in ("coulomb", "push"))
    evidence = Evidence(
        gain=100.0,
        confirmed=9.0,
        floors=2.0,
        left=1.0,
        relief=0.0,
        interval=(1.0, 2.0),
        inside=True,
        horizons=3,
        size=1.0,
    )
    strong = AcceptedTerm(replace(coulomb, joints=(1, 2)), evidence, None)
    weak = AcceptedTerm(replace(push, joints=joints), replace(evidence, gain=gain), None)
    assert [term.refines for term in with_refinements([strong, weak], own=0.5)] == [None, refines]


def test_a_form_is_found_with_its_effect_and_is_no_name_of_its_own():
    result = discover({"coulomb": 1.2, "push": 0.6}, forms=(DIRECTION,))
    assert result.verdict == "named"
    (term,) = result.terms
    assert (term.hypothesis.name, [form.form for form in term.forms]) == ("coulomb", ["direction_dependent"])
    # No form of the library is exact, so no parameter is as certain as noise alone would have it.
    for part in (term.hypothesis, *term.forms):
        mine = result.fit.along(part)
        assert (result.errors[mine] >= 0.08 * np.abs(result.fit.coordinates[mine])).all() and mine.any()
    assert result.fit.vector[AXES.index("push")] == pytest.approx(0.6, abs=0.05)
    (form,) = result.suspects[0].forms
    assert (result.suspects[0].hypothesis.name, form.form) == ("coulomb", "direction_dependent")
    # Without the effect its form is gone too.
    assert result.proof["others"]["without coulomb@slider"] > result.gap["after"] + 1.0
    assert result.gap["after"] < 1.3


def test_an_effect_may_have_several_forms():
    result = discover({"coulomb": 1.2, "push": 0.6, "cubic": 6.0}, forms=(DIRECTION, WARPED))
    assert result.verdict == "named"
    (term,) = result.terms
    assert {form.form for form in term.forms} == {"direction_dependent", "warped"}
    assert result.gap["after"] < 1.3


def test_a_form_that_ends_at_its_bound_is_one():
    most = replace(WARPED, bounds=np.array([[0.0, 6.0]]), probes=np.array([[1.0], [6.0]]))
    result = discover({"coulomb": 1.2, "cubic": 6.1}, forms=(most,))
    (term,) = result.terms
    assert [form.form for form in term.forms] == ["warped"]
    assert result.fit.vector[AXES.index("cubic")] == pytest.approx(6.0)


def test_an_effect_in_its_first_form_gets_no_other():
    result = discover({"coulomb": 1.2}, forms=(DIRECTION,))
    assert [(term.hypothesis.name, term.forms) for term in result.terms] == [("coulomb", ())]


def test_the_two_models_that_are_most_believed_differ_in_more_than_form():
    result = discover({"coulomb": 1.2, "cubic": 6.0}, forms=(WARPED,))
    (first, vector), (second, other) = result.rivals
    assert first == "coulomb@slider" != second
    assert not np.allclose(vector, other)
    # A push beside friction is friction that depends on the direction, so it is no rival of that.
    ((only, _),) = discover({"coulomb": 1.2, "push": 0.6}, forms=(DIRECTION,)).rivals
    assert only == "coulomb@slider"


def test_what_hardly_anybody_believes_is_worth_no_experiment():
    found = [
        SimpleNamespace(effects=(effect,), fit=SimpleNamespace(vector=number))
        for number, effect in enumerate((*HYPOTHESES[2:4], HYPOTHESES[3], HYPOTHESES[2]))
    ] + [SimpleNamespace(effects=(), fit=SimpleNamespace(vector=4))]
    # Two forms of the second set of effects are believed together.
    assert [key for key, _ in _rivals(found, np.array([0.9, 0.008, 0.009, 0.0, 0.083]))] == [
        "coulomb@slider",
        "push@slider",
    ]
    assert _rivals(found, np.array([0.3, 0.2, 0.4, 0.05, 0.05]))[0] == ("push@slider", 2)
    assert [key for key, _ in _rivals(found, np.array([0.9, 0.004, 0.005, 0.0, 0.091]))] == ["coulomb@slider"]
    assert _rivals(found, np.array([0.0, 0.004, 0.005, 0.0, 0.991])) == ()


def test_what_no_hypothesis_explains_is_unnamed():
    result = discover({"cubic": 12.0})
    assert result.verdict == "unnamed"
    assert not result.changed
    assert result.where[0]["excess_floor_units"] > 1.0


def test_what_only_a_learned_torque_explains_is_unnamed_and_the_torque_is_saved():
    result = discover({"cubic": 12.0}, residual=LEARNED)
    assert (result.verdict, result.model_is) == ("unnamed", "learned")
    assert result.model[AXES.index("cubic")] == pytest.approx(12.0, abs=1.0)
    assert result.gap["after"] < 1.3 < result.gap["null"]
    assert result.explained_share < 0.8
    assert result.explainable_share > 0.8


def test_what_is_lost_without_a_part_of_the_learned_torque_is_said():
    rows = np.array([[float(axis == name) for axis in AXES] for name in ("push", "cubic")])
    both = replace(EACH, name="learned", directions=rows, bounds=np.array([[-30.0, 30.0]] * 2))
    asked = replace(problem({"cubic": 12.0}, residual=both), residual_parts=("constant", "position"))
    result = workflow.discover(asked)
    assert list(result.learned_parts) == ["position", "constant"]
    # Nothing else explains it, and nothing is constant.
    assert result.learned_parts["position"] > 0.9
    assert result.learned_parts["constant"] < 0.05
    # Of parts that nobody has told apart nothing is said.
    assert discover({"cubic": 12.0}, residual=LEARNED).learned_parts == {}


def test_a_model_that_sealed_runs_contradict_is_withdrawn_and_names_nothing():
    result = discover({"coulomb": 1.2}, sealed={})
    assert result.withdrawn
    assert result.verdict == "unnamed"
    assert result.proposed[AXES.index("coulomb")] == pytest.approx(1.2, abs=0.1)
    assert result.model[AXES.index("coulomb")] == 0.0
    assert result.gap["after"] > result.gap["before"]


@pytest.mark.parametrize(
    ("before", "null", "after", "worse"),
    [
        (5.0, 3.0, 3.2, False),
        (5.0, 3.0, 3.4, True),
        (1.0, 3.0, 1.15, False),
        (1.0, 3.0, 1.25, True),
        (5.0, 3.0, np.nan, True),
        (5.0, np.nan, 4.0, False),
        (np.nan, np.nan, np.nan, False),
    ],
)
def test_a_model_is_worse_by_a_tenth_and_a_fifth_of_a_floor_unit(before, null, after, worse):
    assert is_worse({"before": before, "null": null, "after": after}) is worse


def test_what_does_not_move_the_signals_is_not_testable():
    assert discover({"coulomb": 0.5}).not_testable == ("nothing",)


def test_a_hypothesis_that_breaks_the_simulation_is_not_chosen_and_the_rest_go_on():
    result = discover({"coulomb": 0.5}, hypotheses=(*HYPOTHESES, WILD))
    assert [term.hypothesis.name for term in result.terms] == ["coulomb"]


def test_nominal_parameters_stay_near_their_belief():
    # Damping is 1.5 off, fifteen prior deviations; as long as it is a nuisance it may go three.
    asked = problem({"damping": 1.5})
    _, begun = state.begin(asked, measured_floor(asked))
    np.testing.assert_allclose(begun.null.fit.vector[AXES.index("damping")], 0.3, atol=1e-6)


def test_a_nominal_parameter_that_stops_at_its_bound_is_a_finding():
    asked = problem({"damping": 0.33}, hypotheses=HYPOTHESES[2:])
    result = workflow.discover(asked)
    assert result.verdict == "parameter_change"
    assert {axis: change.deviations for axis, change in result.changed.items()} == {
        AXES.index("damping"): pytest.approx(3.0)
    }
    # Where much is left, as many at their bounds as may not be imitate something else.
    for strained, much, verdict in ((1, 0.0, "unnamed"), (2, 0.0, "parameter_change"), (1, 9.0, "parameter_change")):
        assert workflow.discover(asked, Settings(strained=strained, much=much)).verdict == verdict


@pytest.mark.parametrize("spent, verdict", [(True, "parameter_change"), (False, "unnamed")])
def test_a_model_may_lose_all_that_it_has_of_its_own(spent, verdict):
    # Its damping is a placeholder: the slider has none. Of anything else, a fit that ends at a bound says nothing.
    damping = replace(HYPOTHESES[1], bounds=np.array([[-0.99, 5.0]]), spent=spent)
    result = workflow.discover(problem({"damping": -1.0}, hypotheses=(HYPOTHESES[0], damping, *HYPOTHESES[2:])))
    assert result.verdict == verdict
    assert [term.hypothesis.name for term in result.terms] == ["damping"] * spent
    assert ("damping" in [one.hypothesis.name for one in result.dropped]) is not spent


def test_what_a_model_has_of_its_own_is_taken_away_alone_and_together():
    asked = problem({})
    _, begun = state.begin(asked, measured_floor(asked))
    mass, damping = (replace(one, spent=True) for one in HYPOTHESES[:2])
    small = replace(HYPOTHESES[2], spent=True, bounds=np.array([[-0.1, 5.0]]))
    one_place = replace(damping, places=())
    found = leads.without_own(begun.nominal, [mass, one_place, damping, small, HYPOTHESES[3], EACH], 7.0)
    # The one at most places counts. Of what is little, or no part of the model, nothing is taken.
    assert [(lead.hypotheses, lead.point.tolist(), lead.cost) for lead in found] == [
        ((damping,), [-0.81], 7.0),
        ((mass,), [-0.9], 7.0),
        ((damping, mass), [-0.81, -0.9], 7.0),
    ]


@pytest.mark.parametrize("others, rivals", [((), ()), ((DRAG,), ("drag",))])
def test_what_brakes_as_damping_does_may_be_there_in_its_place(others, rivals):
    # Damping is a parameter and costs less, so beside it a drag gains nothing.
    result = workflow.discover(problem({"drag": 0.33}, hypotheses=(*HYPOTHESES[2:], *others)))
    assert result.verdict == "parameter_change"
    assert [change.confusable_with for change in result.changed.values()] == [rivals]


def test_without_a_name_the_user_gets_the_best_of_all_models_on_validation_runs():
    result = discover({"cubic": 12.0})
    assert result.verdict == "unnamed"
    assert result.gap["after"] <= 1.1 * min(result.gap["before"], result.gap["null"]) + 0.2


def test_a_model_that_held_out_runs_contradict_is_withdrawn():
    asked = problem({"push": 2.0})
    other = problem({"push": -2.0})
    result = workflow.discover(replace(asked, data=dict(asked.data) | {"sealed": other.data["sealed"]}))
    assert result.withdrawn
    assert result.model_is in ("nominal", "null")
    # The names stay, and so does the gap that speaks against them.
    assert [term.hypothesis.name for term in result.terms] == ["push"]
    assert result.gap["after"] > min(result.gap["before"], result.gap["null"])


def test_suspects_are_ranked_by_probability_whatever_the_verdict():
    result = discover({"coulomb": 0.5})
    names = [one.hypothesis.name for one in result.suspects]
    probabilities = [one.probability for one in result.suspects]
    assert names[0] == "coulomb"
    assert probabilities == sorted(probabilities, reverse=True)
    assert probabilities[0] > 0.9
    assert sum(one["probability"] for one in result.details.values()) == pytest.approx(1.0)


def test_a_run_that_was_cut_goes_on_after_its_last_step():
    truth = {"coulomb": 1.2, "push": 1.2}
    saved = []
    result = workflow.discover(problem(truth), save=lambda state: saved.append(json.loads(json.dumps(state))))
    assert len(saved) > 2
    for cut, kept in enumerate(saved[:-1]):
        rest = []
        resumed = workflow.discover(problem(truth), saved=kept, save=rest.append)
        assert json.loads(json.dumps(rest)) == saved[cut + 1 :]
        assert [term.hypothesis.key for term in resumed.terms] == [term.hypothesis.key for term in result.terms]
        np.testing.assert_array_equal(resumed.fit.vector, result.fit.vector)
        assert resumed.gap == result.gap
        assert resumed.details == result.details
        assert resumed.not_testable == result.not_testable
    grown = saved[0] | {"rows": [[0.0, *row] for row in saved[0]["rows"]]}
    found = json.dumps(saved[0]).replace("coulomb@slider", "friction@slider")
    for other in (grown, json.loads(found), {name: value for name, value in saved[0].items() if name != "rows"}):
        with pytest.raises(ValueError, match=r"another version: remove state.json"):
            workflow.discover(problem(truth), saved=other)


def test_a_step_changes_nothing_that_it_is_given():
    asked = problem({"coulomb": 0.6, "push": 0.8})
    floor, before = state.begin(asked, measured_floor(asked))
    kept = state.to_json(before), [at.scale["train"].copy() for at in floor.values()]
    first, info = step.step(Settings(), asked, floor, before)
    assert info.improved
    assert state.to_json(before) == kept[0]
    for at, scale in zip(floor.values(), kept[1], strict=True):
        np.testing.assert_array_equal(at.scale["train"], scale)
    # The same step from the same state is the same step.
    again, _ = step.step(Settings(), asked, floor, before)
    assert state.to_json(again) == state.to_json(first)


def test_a_saved_state_is_the_state_that_was_saved():
    asked = problem({"coulomb": 0.6, "push": 0.8})
    floor, begun = state.begin(asked, measured_floor(asked))
    found, _ = step.step(Settings(), asked, floor, begun)
    saved = json.loads(json.dumps(state.to_json(found)))
    loaded = state.from_json(asked, floor, begun, saved)
    assert json.loads(json.dumps(state.to_json(loaded))) == saved
    for one, other in zip(found.candidates, loaded.candidates, strict=True):
        np.testing.assert_allclose(one.fit.residual, other.fit.residual, atol=1e-3)


def test_an_effect_gives_way_to_another_that_stands_in_its_place_better():
    asked = problem({"coulomb": 1.2, "push": 1.2})
    floor, begun = state.begin(asked, measured_floor(asked))
    first, _ = step.step(Settings(), asked, floor, begun)
    at, wrong = floor[asked.main_horizon], (HYPOTHESES[2], HYPOTHESES[4])
    lead = Lead(wrong, np.array([0.8, 0.1]), begun.nominal.coordinates, 0.0)
    (bad,) = finalists.fit_leads(Settings(), at, begun.nominal, (), [lead], 10.0)
    alone = [one for one in first.candidates if len(one.hypotheses) < 2]
    stuck = replace(first, best=bad, candidates=(*alone, bad), tried=("null", bad.key))
    found, info = step.step(Settings(), asked, floor, stuck)
    assert info.improved
    assert {hypothesis.name for hypothesis in found.best.hypotheses} == {"coulomb", "push"}


def test_where_nothing_joins_and_nothing_replaces_the_search_ends():
    asked = problem({"coulomb": 0.6})
    floor, found = state.begin(asked, measured_floor(asked))
    for _ in range(10):
        found, _ = step.step(Settings(), asked, floor, found)
    assert found.finished
    assert [hypothesis.name for hypothesis in found.best.hypotheses] == ["coulomb"]


def test_the_explained_share_is_of_what_a_learned_torque_explains():
    assert explained(300.0, 300.0, 100.0) == 0.0
    assert explained(300.0, 100.0, 100.0) == 1.0
    assert explained(300.0, 150.0, 100.0) == pytest.approx(0.75)
    # A model can cost more than the null, and nothing may be left to explain.
    assert explained(300.0, 310.0, 100.0) == 0.0
    assert explained(300.0, 300.0, 300.0) == 1.0


@pytest.mark.parametrize(
    ("typical", "usual", "speaks"),
    [
        ([4.1, 2.0, 1.5], [9.5, 8.0, 7.0], True),  # play: where the gears are out of touch it stays far off
        ([4.1, 2.0, 1.5], [9.5, 10.5, 7.0], False),  # typical segments got better at the cost of others
        ([1.4, 1.0, 1.0], [9.5, 8.0, 7.0], False),  # typical ones show nothing
    ],
)
def test_typical_segments_speak_where_others_do_not_pay_for_them(typical, usual, speaks):
    of_usual, of_typical = ([np.array([value]) for value in gaps] for gaps in (usual, typical))
    heard = speak(of_usual, of_typical, Settings().at_floor)
    assert [gaps is of_typical for gaps in heard] == ([False, True] if speaks else [False])


@pytest.mark.parametrize(
    ("left", "share", "whole", "effects", "expected"),
    [
        (1.4, 0.0, 0.0, 0, True),  # at the floor nothing need be explained
        (2.1, 0.6, 0.5, 1, True),
        (2.1, 0.4, 0.4, 1, False),
        (5.0, 0.6, 0.5, 1, False),  # of a large gap more has to be explained
        (5.0, 0.8, 0.5, 1, True),
        (2.1, 1.0, 0.2, 1, False),  # neither effects nor a learned torque explain much
        (5.0, 0.8, 0.5, 2, False),  # two could have made up for something else
        (5.0, 0.86, 0.5, 2, True),
        (5.0, 0.86, 0.5, 3, False),
        (1.4, 0.0, 0.0, 3, True),
    ],
)
def test_effects_that_explain_enough(left, share, whole, effects, expected):
    assert enough(Settings(), left, share, whole, effects) is expected


def test_an_effect_costs_what_chance_gains_on_null_logs():
    asked = problem({})
    floor, begun = state.begin(asked, measured_floor(asked))
    found, _ = step.step(Settings(level=0.05), asked, floor, begun)
    every, _ = step.step(Settings(level=1.0), asked, floor, begun)
    assert found.price >= every.price >= 2.0 * np.log(len(asked.hypotheses))


def test_a_nominal_parameter_that_stops_at_its_bound_is_a_lead_of_its_own():
    asked = problem({"mass": 0.6})
    _, begun = state.begin(asked, measured_floor(asked))
    nominal = [one for one in HYPOTHESES if asked.is_nominal(one)]
    assert {one.name for one in nominal} == {"mass", "damping"}
    (lead,) = leads.stuck(begun.null.fit, nominal, [])
    # Three deviations of a tenth, from where the null stopped: beside it a fit may go on.
    assert [one.name for one in lead.hypotheses] == ["mass"]
    np.testing.assert_allclose(lead.point, [0.3], rtol=1e-6)
    np.testing.assert_array_equal(lead.start, begun.null.fit.coordinates)
    assert leads.stuck(begun.null.fit, nominal, [lead]) == []
    near = problem({"mass": 0.05})
    assert leads.stuck(state.begin(near, measured_floor(near))[1].null.fit, nominal, []) == []


def test_a_form_that_is_an_effect_of_its_own_is_fitted_alone_too():
    coulomb, push = HYPOTHESES[2:4]
    first = Lead((coulomb,), np.array([0.8]), np.zeros(2), 10.0)
    second = Lead((HYPOTHESES[1],), np.array([0.3]), np.zeros(2), 11.0)
    found = leads.shaped([DIRECTION, WARPED], HYPOTHESES, [first, second], 2)
    assert [[h.key for h in lead.hypotheses] for lead in found] == [
        ["coulomb@slider", "coulomb(direction_dependent)@slider"],
        ["push@slider"],
        ["coulomb@slider", "coulomb(warped)@slider"],
    ]
    np.testing.assert_array_equal(found[1].point, DIRECTION.probes[1])
    # One that is fitted anyway needs no second start, and only the first leads get forms.
    known = Lead((push,), np.array([0.3]), np.zeros(2), 12.0)
    assert len(leads.shaped([DIRECTION, WARPED], HYPOTHESES, [first, second, known], 1)) == 2
    assert leads.shaped([DIRECTION], HYPOTHESES, [second, first], 1) == []
    # One that the screen saw in a form is fitted without it too.
    both = Lead((coulomb, DIRECTION), np.array([0.8, 0.3]), np.zeros(2), 10.0)
    (plain,) = leads.shaped([DIRECTION], (), [both], 1)
    assert [h.key for h in plain.hypotheses] == ["coulomb@slider"]
    assert plain.point == pytest.approx([0.8])
    # Where much of a form leaves little of the effect, fits begin there too.
    usual, *others = leads.shaped([replace(WARPED, far=True)], (), [first], 1)
    assert usual.point[0] == 0.8 and all(one.hypotheses == usual.hypotheses for one in others)
    little, much = coulomb.probes[0, 0], WARPED.probes[-2:, 0]
    expected = [(share * little, size) for share in (0.25, 1.0) for size in much]
    np.testing.assert_allclose([one.point for one in others], expected)
    # A form below zero leaves more of it.
    both_ways = replace(WARPED, far=True, probes=np.array([[-0.1], [-0.5], [0.1], [0.5]]))
    _, *others = leads.shaped([both_ways], (), [first], 1)
    np.testing.assert_allclose([one.point for one in others[-2:]], [(0.8 * 1.1, -0.1), (0.8 * 1.5, -0.5)])
    # What may pass for another effect is fitted where that one leads, unless it leads itself.
    passes = replace(DIRECTION, form="beside", like="damping")
    found = leads.shaped([passes], HYPOTHESES, [second], 1)
    assert {tuple(h.key for h in lead.hypotheses) for lead in found} == {("coulomb@slider", "coulomb(beside)@slider")}
    # One start is of the size that is tried of the form.
    np.testing.assert_allclose(found.pop().point, [*coulomb.probes[2], passes.probes.max()])
    sizes = np.array([lead.point[0] for lead in found])
    np.testing.assert_allclose(np.sort(sizes)[::2], coulomb.probes[:, 0])
    # The smaller it is, the farther out.
    np.testing.assert_allclose([lead.point[1] for lead in found], 0.3 * (1.0 + sizes) / sizes)
    assert len(leads.shaped([passes], HYPOTHESES, [second, first], 1)) == 0
    # No coordinate is in a model twice, by a form and by an effect that is there.
    pair = Lead((coulomb, push), np.array([0.8, 0.3]), np.zeros(2), 10.0)
    assert [lead.hypotheses[-1].key for lead in leads.shaped([DIRECTION, WARPED], (), [pair], 1)] == [WARPED.key]
    assert [form.key for form in leads.beside([DIRECTION, WARPED], [push])] == [WARPED.key]


def test_fitted_models_that_cost_least_get_their_forms():
    damping, coulomb, push = HYPOTHESES[1:4]
    asked = problem({"coulomb": 0.8, "cubic": 10.0}, forms=(WARPED,))
    floor, begun = state.begin(asked, measured_floor(asked))
    at, null = floor[asked.main_horizon], begun.null.fit
    first = [Lead((one,), one.probes[1], null.coordinates, null.cost) for one in (damping, coulomb, push)]
    fitted = finalists.fit_leads(Settings(), at, null, (), first, 0.0)
    # The screen may have put the right one last.
    (found,) = leads.shaped_after(null, (), [WARPED], HYPOTHESES, fitted, 1)
    assert key_of(found.hypotheses) == f"{WARPED.key} + {coulomb.key}"
    # It begins where the fit stands.
    alone = next(one for one in fitted if one.key == coulomb.key)
    assert found.point[0] == alone.fit.coordinates[-1]
    np.testing.assert_array_equal(found.start, alone.fit.coordinates[:-1])
    (both,) = finalists.fit_leads(Settings(), at, null, (), [found], 0.0)
    assert both.fit.cost < alone.fit.cost - 10.0
    # What was fitted is not fitted again, and pairs get no forms.
    assert leads.shaped_after(null, (), [WARPED], HYPOTHESES, [*fitted, both], 1) == []
    pair = replace(alone, hypotheses=(coulomb, push))
    assert leads.shaped_after(null, (), [WARPED], HYPOTHESES, [pair], 1) == []


def test_what_may_pass_for_a_named_effect_is_fitted_in_its_place():
    mass, damping = HYPOTHESES[:2]
    passes = replace(DIRECTION, form="beside", like="damping")
    asked = problem({"coulomb": 0.8, "push": 0.4}, forms=(passes,))
    floor, begun = state.begin(asked, measured_floor(asked))
    at, null = floor[asked.main_horizon], begun.null.fit
    # Somehow the search has ended with another effect, and never looked at this one.
    lead = Lead((damping,), np.array([0.5]), null.coordinates, null.cost)
    (wrong,) = finalists.fit_leads(Settings(), at, null, (), [lead], 0.0)
    found = _with_what_passes(Settings(), asked, at, replace(begun, best=wrong))
    assert found.best.key == "coulomb(beside)@slider + coulomb@slider"
    # What may pass for nothing is left as it is.
    (other,) = finalists.fit_leads(Settings(), at, null, (), [replace(lead, hypotheses=(mass,))], 0.0)
    ended = replace(begun, best=other)
    assert _with_what_passes(Settings(), asked, at, ended).best is other


def test_what_was_better_alone_in_a_form_is_fitted_in_a_model_of_several():
    damping, coulomb, push = HYPOTHESES[1:4]
    asked = problem({"coulomb": 0.8, "cubic": 10.0, "push": 0.4}, forms=(WARPED,))
    floor, begun = state.begin(asked, measured_floor(asked))
    at, null = floor[asked.main_horizon], begun.null.fit

    def fitted(*hypotheses):
        point = np.concatenate([one.probes[1] for one in hypotheses])
        lead = Lead(hypotheses, point, null.coordinates, null.cost)
        return finalists.fit_leads(Settings(), at, null, (), [lead], 0.0)[0]

    wrong, alone = fitted(damping, push), fitted(coulomb, WARPED)
    known = replace(begun, best=wrong, candidates=(fitted(damping), alone, wrong))
    assert _with_what_passes(Settings(), asked, at, known).best.key == f"{WARPED.key} + {coulomb.key} + {push.key}"
    # Without that form, or at other places, it says nothing.
    for other in (fitted(coulomb), replace(alone, hypotheses=(replace(coulomb, places=("x",)), WARPED))):
        assert _with_what_passes(Settings(), asked, at, replace(known, candidates=(other, wrong))).best is wrong
    # Nor does one that was worse.
    costs = [(fitted(damping), 10.0), (alone, 11.0)]
    assert leads.known_in_forms(damping, costs, [WARPED], HYPOTHESES) == []
    assert len(leads.known_in_forms(damping, [(alone, 11.0)], [WARPED], HYPOTHESES)) == 1


def test_an_effect_at_several_places_is_fitted_at_some_of_them():
    at_one, at_two = (
        replace(ONE_SIZE, places=(place,), directions=rows[None])
        for place, rows in zip(ONE_SIZE.places, ROWS, strict=True)
    )
    asked = problem({"coulomb": 0.8}, hypotheses=(*HYPOTHESES[:2], at_two, ONE_SIZE, at_one), forms=())
    floor, begun = state.begin(asked, measured_floor(asked))
    at, null = floor[asked.main_horizon], begun.null.fit
    # Somehow the search has never looked at one place alone.
    lead = Lead((ONE_SIZE,), np.array([0.5]), null.coordinates, null.cost)
    (wide,) = finalists.fit_leads(Settings(), at, null, (), [lead], 0.0)
    found = _with_what_passes(Settings(), asked, at, replace(begun, best=wide, candidates=(wide,)))
    assert found.best.key == at_one.key
    assert {one.key for one in found.candidates} == {wide.key, at_one.key, at_two.key}
    # What was fitted is not fitted again.
    again = _with_what_passes(Settings(), asked, at, replace(found, best=wide))
    assert again.candidates == found.candidates


def test_forms_go_with_an_effect_to_some_of_its_places():
    # A size is that of the first place; in units of the second it is twice as large, and a distance half as large.
    wide = replace(ONE_SIZE, name="load", directions=np.array([[1.0, 2.0, 0.0, 0.0]]))
    shape = replace(wide, form="far", directions=np.array([[0.0, 0.0, 1.0, 0.5]]))
    alone = replace(wide, places=("two",), directions=np.array([[0.0, 1.0, 0.0, 0.0]]))
    far = replace(shape, places=("two",), directions=np.array([[0.0, 0.0, 0.0, 1.0]]))
    lead = Lead((wide, shape), np.array([0.3, 0.2]), np.zeros(2), 1.0)
    (found,) = leads.at_some_places(lead, [shape, far], [wide, alone, replace(alone, name="other")])
    assert [h.key for h in found.hypotheses] == [alone.key, far.key]
    np.testing.assert_allclose(found.point, [0.6, 0.1])
    # Nothing where a form is at all places alone, or each place has its own size.
    assert leads.at_some_places(lead, [shape], [alone]) == []
    assert leads.at_some_places(replace(lead, hypotheses=(replace(wide, each=True), shape)), [far], [alone]) == []


def test_a_nominal_parameter_that_moved_is_no_form_of_an_effect():
    free = replace(HYPOTHESES[1], name="coulomb", form="sliding")
    asked = problem({"damping": 0.3}, forms=(free,))
    _, begun = state.begin(asked, measured_floor(asked))
    errors = np.full(2, 0.1)
    assert np.abs(begun.null.fit.coordinates[1]) > 1.0
    assert moved_forms(asked, begun.null.fit, errors, HYPOTHESES[2]) == []
    unknown = replace(asked, prior=asked.prior * np.array([axis != "damping" for axis in AXES]))
    assert moved_forms(unknown, begun.null.fit, errors, HYPOTHESES[2]) == [free]


def test_two_effects_of_which_one_is_a_form_of_the_other_are_one():
    coulomb, push = HYPOTHESES[2:4]
    # As a constant torque is one of dry friction, and not the other way round.
    beside = replace(push, name="coulomb", family=coulomb.family, form="beside")
    asked = problem({"coulomb": 0.8, "push": 0.4}, forms=(beside, WARPED))
    floor, begun = state.begin(asked, measured_floor(asked))

    def names(*group):
        points, evaluate = [np.full(len(group), 0.1)], floor[asked.main_horizon].residuals["train"]
        (fit,) = begin(begun.null.fit, [group], points, [begun.null.fit.coordinates], evaluate)
        return [h.key for h in renamed(asked, Candidate(group, fit, begun.null.select)).hypotheses]

    both = [coulomb.key, "coulomb(beside)@slider"]
    assert names(coulomb, push) == both
    assert names(push, coulomb) == both[::-1]
    # The form stays a form of what gives the name, and another effect stays one.
    assert names(coulomb, push, WARPED) == [*both, WARPED.key]
    assert names(HYPOTHESES[1], push) == [HYPOTHESES[1].key, push.key]
    # In a chain every form keeps its effect.
    damping = HYPOTHESES[1]
    further = replace(coulomb, name="damping", family=damping.family, form="dry")
    asked = replace(asked, forms=(*asked.forms, further))
    assert names(push, coulomb, damping) == [both[1], both[0], damping.key]


def test_an_effect_is_claimed_of_the_joints_that_show_it():
    coulomb, push = (replace(HYPOTHESES[number], places=("a",)) for number in (2, 3))
    shape = replace(DIRECTION, places=("a",))
    wide, at_b = (replace(coulomb, places=places) for places in (("a", "b"), ("b",)))
    wide_push, wider = replace(push, places=("a", "b")), replace(coulomb, places=("c", "d"))

    def chosen(*groups_and_beliefs):
        models = [Candidate(group, None, None) for group, _ in groups_and_beliefs]
        found = at_fewest_places(models[0], models, np.array([belief for _, belief in groups_and_beliefs]))
        return found.hypotheses

    assert chosen(((wide,), 0.7), ((coulomb,), 0.2), ((push,), 0.1)) == (coulomb,)
    # Not where logs speak against it, or show it at the one joint as little as at the other.
    assert chosen(((wide,), 0.7), ((coulomb,), 0.06), ((push,), 0.24)) == (wide,)
    assert chosen(((wide,), 0.5), ((coulomb,), 0.3), ((at_b,), 0.2)) == (wide,)
    # Forms of one model count together, and the cheapest of them is taken.
    assert chosen(((wide,), 0.7), ((coulomb, shape), 0.04), ((coulomb,), 0.04)) == (coulomb, shape)
    # Every effect keeps a place.
    assert chosen(((wide, wide_push), 0.5), ((push, coulomb), 0.5)) == (push, coulomb)
    assert chosen(((wide, wider), 0.5), ((coulomb, at_b), 0.5)) == (wide, wider)
    assert chosen(((wide, push), 0.5), ((coulomb,), 0.5)) == (wide, push)


def with_shape(one):
    """The same hypothesis with a further parameter that no probe has a size of."""
    return replace(
        one,
        directions=np.concatenate([one.directions, WARPED.directions]),
        probes=np.pad(one.probes, ((0, 0), (0, 1))),
        bounds=np.concatenate([one.bounds, WARPED.bounds]),
        prior=np.concatenate([one.prior, WARPED.prior]),
    )


def test_the_larger_part_gives_the_name_where_two_effects_are_forms_of_each_other():
    coulomb, push = HYPOTHESES[2:4]
    other = replace(coulomb, name="push", family="external", form="with_friction")
    asked = problem({"coulomb": 0.4, "push": 0.8}, forms=(DIRECTION, other))
    floor, begun = state.begin(asked, measured_floor(asked))
    evaluate = floor[asked.main_horizon].residuals["train"]

    def model(sizes, *more):
        group = (coulomb, DIRECTION, *more)
        (fit,) = begin(begun.null.fit, [group], [np.array(sizes)], [begun.null.fit.coordinates], evaluate)
        return Candidate(group, fit, begun.null.select)

    assert [h.key for h in renamed(asked, model([0.8, 0.4])).hypotheses] == [coulomb.key, DIRECTION.key]
    swapped = renamed(asked, model([0.4, -0.8]))
    assert [h.key for h in swapped.hypotheses] == ["push@slider", "push(with_friction)@slider"]
    assert [h.key for h in swapped.effects] == [push.key]
    # A further form would have no effect to be a form of, unless the other effect has it too.
    warped = model([0.4, -0.8, 0.1], WARPED)
    assert [h.key for h in renamed(asked, warped).hypotheses] == [coulomb.key, DIRECTION.key, WARPED.key]
    both = replace(asked, forms=(*asked.forms, WARPED, replace(WARPED, name="push", family="external")))
    keys = ["push@slider", "push(with_friction)@slider", "push(warped)@slider"]
    assert [h.key for h in renamed(both, warped).hypotheses] == keys
    # A parameter that only shapes an effect is no size.
    pair, twin = with_shape(DIRECTION), with_shape(push)
    (fit,) = begin(
        begun.null.fit, [(coulomb, pair)], [np.array([0.4, 0.2, 3.0])], [begun.null.fit.coordinates], evaluate
    )
    kept = Candidate((coulomb, pair), fit, begun.null.select)
    shaping = replace(asked, hypotheses=(coulomb, twin), forms=(pair, other))
    assert [h.key for h in renamed(shaping, kept).effects] == [coulomb.key]
    # A form that is no effect with the other one as its form changes no name.
    alone = replace(asked, forms=(DIRECTION,))
    assert [h.key for h in renamed(alone, model([0.4, -0.8])).effects] == [coulomb.key]
