import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from experiments import selftest
from experiments.common import plots
from experiments.walking.robots import BITENO, kind
from jaxtune.selftest import Rate, SelfTest, Tuned

LEGS = BITENO.chosen("legs6")


def test_other_cases_are_all_parameters_that_nobody_tunes():
    cases = selftest.other_cases(BITENO, LEGS, ())
    assert cases["torque_scale=0.75"] == {"torque_scale": 0.75}
    # Three quarters of the way to the bound of 10 ms.
    assert cases["action_delay_s=0.0075"] == {"action_delay_s": 0.0075}
    named = {name for values in cases.values() for name in values}
    assert not named & set(LEGS)
    # Tied masses change what is tuned already.
    assert "thigh_mass" not in named
    assert "trunk_mass" in named


def test_a_self_test_may_be_of_the_robot_as_it_is():
    assert selftest.other_cases(BITENO, LEGS, ("none",)) == {}


def test_a_row_for_all_overlaps_every_row_of_its_field():
    robot = kind("go2")
    assert robot.entries["strength"].targets is None
    named = {name for values in selftest.other_cases(robot, robot.chosen("base_mass"), ()).values() for name in values}
    assert named == set(robot.entries) - {"base_mass"}
    every = replace(robot.entries["base_mass"], targets=None)
    assert not {"calf_mass", "hip_mass"} & {*selftest.other_cases(robot, {"masses": every}, ())}
    assert selftest.other_cases(robot, {"masses": every}, ()).keys() < selftest.other_cases(robot, {}, ()).keys()


def test_a_multiplier_that_may_only_grow_is_another_one_above():
    entry = BITENO.entries["foot_friction"]
    assert entry.log
    assert selftest._different(replace(entry, bounds=(0.2, 5.0))) == 0.75
    assert selftest._different(replace(entry, bounds=(0.9, 5.0))) == 0.9
    assert selftest._different(replace(entry, bounds=(1.0, 2.0))) == pytest.approx(4 / 3)
    assert selftest._different(replace(entry, bounds=(1.0, 1.1))) == 1.1


def test_other_cases_may_be_given_and_a_pattern_stands_for_tuned_parameters():
    cases = selftest.other_cases(BITENO, LEGS, ("*_thigh_mass=2,foot_friction=0.5", "torque_scale=0.9"))
    assert cases == {
        "*_thigh_mass=2,foot_friction=0.5": {"left_thigh_mass": 2.0, "right_thigh_mass": 2.0, "foot_friction": 0.5},
        "torque_scale=0.9": {"torque_scale": 0.9},
    }


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("torque_scale", "others: got 'torque_scale', expected name=value"),
        ("torque=0.5", "others: got 'torque', expected some of foot_friction"),
        ("*_wheel=0.5", r"others: got '\*_wheel', expected some of foot_friction"),
        ("torque_scale=5", "parameter 'torque_scale': got 5.0, expected 0.3 to 2"),
    ],
)
def test_a_case_that_cannot_be_is_named(option, message):
    with pytest.raises(ValueError, match=message):
        selftest.other_cases(BITENO, LEGS, (option,))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robots": 0}, "robots: got 0"),
        ({"gates": -1}, "gates: got -1"),
        ({"whole": -1}, "whole: got -1, expected 0 or more"),
        ({"tunings": 0}, "tunings: got 0"),
        ({"states": True}, "states: got true, expected whole robots"),
        ({"episodes": (5, 0)}, "episodes: got 0"),
        ({"level": 1.5}, "level: got 1.5"),
        ({"level": 0.999}, "level: got 0.999, expected 0.99 or less with 99 simulated sets"),
        ({"radius": 0.0}, "radius: got 0.0"),
    ],
    ids=str,
)
def test_options_are_checked_before_anything_runs(options, message):
    with pytest.raises(ValueError, match=message):
        selftest.check(selftest.Args(**options))


REPORT = SelfTest(
    level=0.95,
    gates=2,
    alarms=Rate(2, 40),
    outside={"mass": Rate(38, 40)},
    noticed={"mass": Rate(39, 40)},
    others={"torque_scale=0.75": Rate(40, 40)},
    identified={"colour": Rate(1, 40), "mass": Rate(40, 40)},
    error={"colour": float("nan"), "mass": 0.02},
    interval={"colour": float("nan"), "mass": 0.07},
    covered=Rate(36, 40),
    tuned={
        "inside the distribution": (
            Tuned(verdicts={"accept": 3}, held=Rate(3, 3), covered=Rate(2, 3), error={"colour": 0.1, "mass": 0.02}),
        )
    },
    unusable={"torque_scale=0.75": 3},
)


def test_tables_say_what_was_counted(monkeypatch):
    console = Console(record=True, width=160)
    monkeypatch.setattr(selftest, "console", console)
    selftest.show({5: REPORT})
    text = console.export_text()
    assert re.search(r"mass, one radius outside +│ 1.00 +│ 0.020 +│ 0.070 +│ 0.95 \(0.83 to 0.99\) +│ 0.97", text)
    assert re.search(r"colour, one radius outside +│ 0.0\d +│ - +│ - +│ bounds leave no room", text)
    assert "all true values in their intervals: 0.90" in text
    assert "tuning 1, inside the distribution: 3 accept, truth in the distribution: 3 of 3" in text
    assert "in its intervals: 2 of 3" in text
    assert "torque_scale=0.75: 3 sets are not comparable or not finite, and are not counted" in text


def test_the_plot_has_a_row_for_every_case(tmp_path):
    plots.power(tmp_path / "power.png", {5: REPORT, 10: REPORT}, 0.05)
    assert (tmp_path / "power.png").stat().st_size > 5000


def test_parameters_that_the_walk_does_not_show_are_named_with_what_helps():
    weak = replace(REPORT, outside={"mass": Rate(20, 40), "friction": Rate(10, 40)})
    more = replace(REPORT, outside={"mass": Rate(36, 40), "friction": Rate(30, 40)})
    mass, friction = selftest.lacking({5: weak, 10: more})
    assert mass == "mass: 10 episodes show it in 80% and more"
    assert "friction: outside by one radius, it is noticed in less than 80% with 5, 10 episodes" in friction
    assert selftest.lacking({5: REPORT}) == []
    # More episodes of robots that fall at once tell no more.
    (falls,) = selftest.lacking({5: replace(REPORT, outside={"mass": Rate(3, 10)}, unusable={"mass": 30})})
    assert "most sets cannot be compared" in falls and "--episodes" not in falls


def test_parts_are_computed_once_and_a_damaged_one_is_named(tmp_path):
    calls = []

    def compute():
        calls.append(1)
        return {"rejected": np.array([[1.0, float("nan")]]), "identifiable": np.array([True])}

    first, second = (selftest.Parts(tmp_path / "parts") for _ in range(2))
    wanted = {"rejected": [[1.0, None]], "identifiable": [True]}
    assert first.keep("gate_0", compute) == second.keep("gate_0", compute) == wanted
    assert (len(calls), first.computed, second.computed) == (1, 1, 0)
    assert first.seconds == second.seconds > 0.0
    for text, message in (("{}", "is damaged: got nothing, expected seconds and part"), ("{", "is damaged")):
        (tmp_path / "parts" / "gate_0.json").write_text(text)
        with pytest.raises(ValueError, match=f"gate_0.json: {message}"):
            second.keep("gate_0", compute)


def test_parts_of_another_policy_table_case_or_robot_are_others():
    robot, policy, cases = replace(BITENO, digest="1a"), {"mean": np.zeros(3)}, {"weak": {"torque_scale": -0.1}}
    same = selftest.digest(robot, policy, LEGS, cases)
    assert same == selftest.digest(replace(robot), {"mean": np.zeros(3)}, BITENO.chosen("legs6"), cases)
    others = [
        selftest.digest(robot, {"mean": np.ones(3)}, LEGS, cases),
        selftest.digest(robot, policy, dict(reversed(LEGS.items())), cases),
        selftest.digest(robot, policy, LEGS, {"weak": {"torque_scale": -0.2}}),
        selftest.digest(replace(robot, digest="1b"), policy, LEGS, cases),
    ]
    assert len({same, *others}) == 5
