"""Scores of the benchmarks of discovery: what counts as right, and what is listed as wrong."""

import pytest

from experiments.common.rates import wilson
from experiments.discovery.scores import page, score, tally, wrong


def named(name, family="joint_friction", places=("elbow",), others=(), low=0.4, high=0.6):
    parameters = {"torque_nm": {"value": 0.5 * (low + high), "low": low, "high": high}}
    entry = {"name": name, "family": family, "places": list(places), "confusable_with": list(others)}
    return entry | {"parameters": parameters}


def answer(effects=(), changes=(), verdict="named", after=1.0, **more):
    gap = {"before": 20.0, "null": 10.0, "after": after}
    return {
        "verdict": verdict, "effects": list(effects), "parameter_changes": list(changes), "gap": gap, "seconds": 1.0,
        "where": [{"joint": "elbow"}, {"joint": "shoulder"}],
    } | more  # fmt: skip


def hidden(name, severity=15.0, places=("elbow",), value=0.5, family="joint_friction"):
    entry = {"name": name, "family": family, "places": list(places), "value": value}
    return entry | {"asked": severity, "severity": severity}


def truth(*effects, kind="single"):
    return {"kind": kind, "effects": list(effects)}


EMPTY = truth(kind="empty")


def value(rows, measure):
    return {line["measure"]: line for line in tally(rows)}[measure]["value"]


def test_wilson_interval():
    # None of 40: z^2 / (40 + z^2) = 3.8416 / 43.8416.
    low, high = wilson(0, 40)
    assert low == 0.0
    assert high == pytest.approx(0.0876, abs=1e-4)
    assert wilson(20, 40) == pytest.approx((0.352, 0.648), abs=1e-3)
    assert wilson(0, 0) == (0.0, 1.0)


def test_names_families_sets_and_places_count_apart():
    right = score(truth(hidden("coulomb")), answer([named("coulomb")]))
    kin = score(truth(hidden("coulomb")), answer([named("stribeck", others=("coulomb",))]))
    lost = score(truth(hidden("coulomb", places=("shoulder",))), answer([named("backlash", "transmission")]))
    armature = hidden("armature", family="transmission")
    change = score(truth(armature), answer((), [named("armature", "transmission")], "parameter_change"))
    assert [right[key] for key in ("name", "family", "in_set", "place")] == [True] * 4
    assert [kin[key] for key in ("name", "family", "in_set", "place")] == [False, True, True, True]
    assert [lost[key] for key in ("name", "family", "in_set", "place")] == [False] * 4
    assert change["name"]
    rows = [right, kin, lost]
    assert value(rows, "top-1 name, 5 floor units and more") == pytest.approx(1 / 3)
    assert value(rows, "top-1 family, 5 floor units and more") == pytest.approx(2 / 3)
    assert value(rows, "truth in the reported set, 5 and more") == pytest.approx(2 / 3)
    assert value(rows, "mean size of the reported set") == pytest.approx(4 / 3)
    assert value(rows, "null over after at 15 floor units (median)") == 10.0
    assert [wrong(row) for row in rows] == [None, "wrong name", "wrong name"]


def test_how_far_a_gap_is_closed_is_counted_apart_where_sealed_runs_show_it():
    shown = score(truth(hidden("coulomb")), answer([named("coulomb")]))
    gentle = score(truth(hidden("coulomb")), answer([named("coulomb")], gap={"before": 9.0, "null": 1.5, "after": 1.0}))
    rows = [shown, gentle, gentle]
    assert value(rows, "null over after at 15 floor units (median)") == 1.5
    assert value(rows, "null over after where sealed runs show 5 floor units (median)") == 10.0


def test_where_nothing_is_hidden_a_name_is_a_false_alarm():
    rows = [
        score(EMPTY, answer(verdict="no_missing_effect")),
        score(EMPTY, answer([named("drag", "external")])),
        score(EMPTY, answer((), [named("armature", "transmission")], "parameter_change")),
        score(EMPTY | {"kind": "linear"}, answer(verdict="unnamed")),
    ]
    assert value(rows, "names something where nothing is hidden") == 0.5
    assert value(rows, "`no_missing_effect` where nothing is hidden") == 0.25
    assert [wrong(row) for row in rows] == [None, "something is named", "something is named", "unsure"]


def test_outside_the_library_only_unnamed_is_right():
    rows = [
        score(truth(hidden("cogging", family=None), kind="outside"), answer(verdict="unnamed")),
        score(truth(hidden("cogging", places=("shoulder",), family=None), kind="outside"), answer(verdict="unnamed")),
        score(truth(hidden("cogging", family=None), kind="outside"), answer([named("stribeck")])),
    ]
    assert value(rows, "`unnamed` outside the library") == pytest.approx(2 / 3)
    assert value(rows, "joint of the largest gap right where `unnamed`") == 0.5


def test_of_several_effects_all_have_to_be_named_and_no_others():
    pair = truth(hidden("coulomb"), hidden("payload", places=("upper",), family="inertia"), kind="pair")
    both = score(pair, answer([named("payload", "inertia", ("upper",)), named("coulomb")]))
    one = score(pair, answer([named("coulomb")]))
    more = score(pair, answer([named("coulomb"), named("payload", "inertia", ("upper",)), named("drag", "external")]))
    elsewhere = score(pair, answer([named("coulomb"), named("payload", "inertia", ("lower",))]))
    assert [row["all_named"] for row in (both, one, more, elsewhere)] == [True, False, True, False]
    assert [row["extra"] for row in (both, one, more, elsewhere)] == [False, False, True, True]
    assert value([both, one, more, elsewhere], "pairs: both named") == 0.5
    # Two names that have changed places are two wrong ones.
    swapped = score(pair, answer([named("coulomb", places=("upper",)), named("payload", "inertia", ("elbow",))]))
    assert not swapped["all_named"]


def test_a_wrong_name_beside_the_right_one_is_an_extra_one():
    row = score(truth(hidden("coulomb")), answer([named("coulomb")], [named("armature", "transmission")]))
    assert row["name"]
    assert row["extra"]
    assert not score(truth(hidden("coulomb")), answer([named("drag", "external")]))["extra"]


def test_intervals_count_where_name_and_place_are_right_and_a_true_number_exists():
    inside = score(truth(hidden("coulomb")), answer([named("coulomb")]))
    outside = score(truth(hidden("coulomb", value=0.7)), answer([named("coulomb")]))
    none = score(truth(hidden("coulomb", value=None)), answer([named("coulomb")]))
    elsewhere = score(truth(hidden("coulomb", places=("shoulder",))), answer([named("coulomb")]))
    assert [row["covered"] for row in (inside, outside, none, elsewhere)] == [True, False, None, None]
    assert value([inside, outside, none, elsewhere], "95 % interval holds the truth") == 0.5


def test_harm_is_to_be_worse_than_nominal_and_null():
    # The better of the two leaves 10.
    gaps = {10.9: False, 11.1: True, 30.0: True, 1.0: False}
    rows = [score(truth(hidden("coulomb")), answer([named("coulomb")], after=after)) for after in gaps]
    assert [row["harm"] for row in rows] == list(gaps.values())
    small = answer([named("coulomb")]) | {"gap": {"before": 1.0, "null": 1.0, "after": 1.15}}
    assert not score(truth(hidden("coulomb")), small)["harm"]


def test_a_withdrawn_model_names_nothing():
    row = score(truth(hidden("coulomb")), answer(verdict="unnamed", withdrawn=True))
    assert row["named"] is None
    assert not row["name"]
    assert value([row], "withdrawn after the look at sealed") == 1.0


def test_a_case_that_failed_is_wrong_whatever_it_hides():
    failed = {"verdict": "failed", "message": "ValueError: no", "effects": [], "parameter_changes": [], "seconds": 1.0}
    rows = [score(one, failed) for one in (truth(hidden("coulomb")), EMPTY, truth(hidden("cogging"), kind="outside"))]
    assert value(rows, "top-1 name, 5 floor units and more") == 0.0
    assert value(rows, "`no_missing_effect` where nothing is hidden") == 0.0
    assert value(rows, "names something where nothing is hidden") == 1.0
    assert value(rows, "`unnamed` outside the library") == 0.0
    assert all(wrong(row) == "failed: ValueError: no" for row in rows)


def test_effects_that_could_not_be_made_severe_are_not_counted():
    weak = hidden("coulomb") | {"severity": 8.0}
    assert score(truth(hidden("coulomb")), answer())["reached"]
    assert tally([score(truth(weak), answer([named("coulomb")]))])[0]["measure"] != "top-1 name, 5 floor units and more"


def test_the_page_lists_failures_with_their_files():
    rows = [
        score(truth(hidden("coulomb")), answer([named("coulomb")])) | {"case": "case_000"},
        score(truth(hidden("viscous")), answer([named("drag", "external")])) | {"case": "case_001"},
    ]
    text = page({"size": "field", "seed": 3}, 2, rows, tally(rows))
    assert "--size field --seed 3" in text
    assert "| case_001 | viscous (elbow) | 15.0 | drag | 20.0, 10.0, 1.0 | wrong name |" in text
    assert "case_000" not in text
