"""What a discovery's files and page say, from a result that is made up."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from rich.console import Console

from envs.effects import LEARNED, LIBRARY
from envs.effects.learned import PARTS
from envs.logs import Controller
from experiments.discovery import next_experiment, report
from experiments.discovery.blind_cases import ARM
from experiments.discovery.blind_drive import Truth
from experiments.discovery.blind_robots import record
from experiments.discovery.excitation import excitation
from experiments.discovery.question import build_question
from experiments.discovery.summary import _effect, _far_off, _torque_sensors, details, free_runs, summarise
from jaxtune.discovery.evidence import Evidence, Thresholds, passes
from jaxtune.discovery.fit import Fit, Free
from jaxtune.discovery.naming import clear_places
from jaxtune.discovery.result import AcceptedTerm, Change, DroppedTerm, Result, Suspect

JOINTS = ("shoulder", "elbow")
GAINS = {"kp": np.array([40.0, 20.0]), "kd": np.array([2.0, 0.8]), "torque_limit_nm": np.array([15.0, 15.0])}
EVIDENCE = Evidence(
    gain=90.0, confirmed=40.0, floors=3.0, left=1.1, relief=0.0, interval=(0.4, 0.6), inside=True, horizons=3, size=1.0
)


@pytest.fixture(scope="module")
def asked():
    spec = mujoco.MjSpec.from_file(str(ARM))
    controller = Controller(kind="pd", rate_hz=1000.0, gains=GAINS)
    motions = excitation(spec, JOINTS, 4, 1.0, 200.0)
    log = record(spec, JOINTS, motions, controller, Truth("coulomb", ("elbow",), 0.5), 0.1, 3)
    log = replace(log, robot=str(ARM))
    return log, build_question(log, spec, (0.05, 0.1, 0.2), null_logs=0)


def found(question, **changes):
    """Dry friction at the elbow, a weaker push beside it, and a damping gain at its bound at the shoulder."""
    axes = question.rig.axes
    at = {(axis.effect, axis.place): number for number, axis in enumerate(axes)}
    every = {hypothesis.key: hypothesis for hypothesis in question.problem.hypotheses}
    coulomb, push = every["coulomb@elbow"], every["constant_push@elbow"]
    gain = at["damping_gain", "shoulder"]
    directions = np.concatenate([np.eye(len(axes))[[gain]], coulomb.directions, push.directions])
    point = np.array([0.3, 0.5, 0.1])
    free = Free(directions, np.ones(3), np.tile([-1.0, 1.0], (3, 1)), np.array([True, False, False]))
    fit = Fit(free, point, np.zeros(0), np.zeros((0, 3)), None)
    nothing = replace(fit, coordinates=np.zeros(3))
    terms = (
        AcceptedTerm(coulomb, EVIDENCE, Thresholds(10.0), confusable_with=("stribeck",)),
        AcceptedTerm(push, replace(EVIDENCE, gain=30.0), Thresholds(10.0), refines="coulomb@elbow"),
    )
    cells = [
        {"signal": signal, "joint": part, "before": 3.0, "null": 2.0, "after": 1.0}
        for signal, part in question.problem.cells
    ]
    where = {"joint": "elbow", "signal": "q", "regime": "reversal", "excess_floor_units": 2.0, "low": 1.0, "high": 3.0}
    result = Result(
        verdict="named",
        terms=terms,
        fit=fit,
        errors=np.array([0.01, 0.02, 0.01]),
        null=nothing,
        proposed=fit.vector,
        model=fit.vector,
        model_is="effects",
        suspects=(Suspect(coulomb, (), 0.9), Suspect(every["viscous@shoulder"], (), 0.7)),
        families={("joint_friction", ("elbow",)): 0.97},
        rivals=(),
        explained_share=0.93,
        explainable_share=0.9,
        learned_parts={("elbow", "joint before"): 0.62, ("shoulder", "speed"): 0.2, ("elbow", "past"): 0.05},
        withdrawn=False,
        where=(where | {"bins": 9},),
        needs_torque={},
        not_testable=("drag",),
        not_finite=(),
        dropped=(DroppedTerm(every["viscous@shoulder"], EVIDENCE, ("confirmed", "clear_of_zero")),),
        changed={gain: Change(3.0, ("drag",))},
        gap={"before": 3.0, "null": 2.0, "after": 1.0},
        proof={"cells": cells, "no_cell_worse": True, "others": {"without coulomb@elbow": 2.5}},
    )
    return replace(result, **changes)


def test_what_is_named_changed_and_neither(asked):
    log, question = asked
    summary = summarise(question, log, Path("logs"), found(question))
    (effect,), (change,), (weaker,) = (summary[key] for key in ("effects", "parameter_changes", "not_named"))
    assert (effect["name"], effect["places"], effect["confusable_with"]) == ("coulomb", ["elbow"], ["stribeck"])
    value = effect["parameters"]["torque_nm"]
    # 1.96 standard errors of 0.02, in the scale of the coordinate.
    assert (value["high"] - value["low"]) / value["value"] == pytest.approx(2 * 1.96 * 0.02 / 0.5, rel=1e-3)
    # A parameter that no hypothesis is about can be at its bound all the same.
    assert (change["name"], change["places"], change["confusable_with"]) == ("damping_gain", ["shoulder"], ["drag"])
    assert change["parameters"]["ratio"]["value"] == pytest.approx(np.exp(0.3), rel=1e-5)
    assert (weaker["name"], weaker["refines"]) == ("constant_push", "coulomb@elbow")
    assert summary["families"] == [{"family": "joint_friction", "places": ["elbow"], "probability": 0.97}]


def test_what_a_placeholder_loses_has_an_interval(asked):
    _, question = asked
    every = {hypothesis.key: hypothesis for hypothesis in question.problem.hypotheses}
    armature = every["armature@elbow"]
    (number,) = np.flatnonzero(armature.directions[0])
    axes = list(question.rig.axes)
    # More than any effect adds is the model's own.
    axes[number] = replace(axes[number], least=-2.0)
    rig = SimpleNamespace(axes=axes, effects=question.rig.effects)
    free = Free(armature.directions, np.ones(1), np.array([[-2.0, 5.0]]), np.array([False]))
    fit = Fit(free, np.array([-1.99]), np.zeros(0), np.zeros((0, 1)), None)
    effect = _effect(
        replace(question, rig=rig), AcceptedTerm(armature, EVIDENCE, Thresholds(10.0)), fit, np.array([0.01])
    )
    got = effect["parameters"]["kg_m2"]
    assert [got[name] / axes[number].scale for name in ("low", "value", "high")] == pytest.approx(
        [-2.0, -1.99, -1.99 + 0.0196]
    )


def test_what_torque_sensors_read_is_said(asked):
    log, question = asked
    assert summarise(question, log, Path("logs"), found(question))["torque_sensors"] == {}
    axes = question.rig.axes
    at = {(axis.effect, axis.place): number for number, axis in enumerate(axes)}
    vector = np.zeros(len(axes))
    vector[at["torque_scale", "elbow"]], vector[at["constant_push", "elbow"]] = np.log(1.25), 0.5
    sensed = np.array([axis.effect in ("torque_scale", "constant_push") for axis in axes])
    read = _torque_sensors(replace(question, sensed=sensed), SimpleNamespace(vector=vector))
    assert list(read) == ["shoulder", "elbow"] and read["shoulder"]["offset_nm"] == 0.0
    # A joint that is pushed needs that much less from its motor, and 1 Nm of this one's is read as 0.8.
    assert read["elbow"]["ratio"] == pytest.approx(0.8)
    scale = axes[at["constant_push", "elbow"]].scale
    assert read["elbow"]["offset_nm"] == pytest.approx(-0.8 * 0.5 * scale, rel=1e-5)
    said = report._sensors({"torque_sensors": read})
    assert "elbow ratio 0.8, offset_nm -" in said and "tilted base" in said
    assert report._sensors({"torque_sensors": {"elbow": {"ratio": 0.9}}}).endswith("elbow ratio 0.9.")
    assert report._sensors({"torque_sensors": {}}) == ""


def test_a_delay_that_is_filtered_has_two_times(asked):
    log, question = asked
    every = {hypothesis.key: hypothesis for hypothesis in question.problem.hypotheses}
    delay = every["sensor_delay@shoulder+elbow"]
    (form,) = [one for one in question.problem.forms if one.form == "filtered" and one.shapes(delay)]
    directions = np.concatenate([delay.directions, form.directions])
    free = Free(directions, np.ones(3), np.tile([-1.0, 1.0], (3, 1)), np.array([False] * 3))
    fit = Fit(free, np.array([0.012, 0.003, 0.4]), np.zeros(0), np.zeros((0, 3)), None)
    terms = (AcceptedTerm(delay, EVIDENCE, Thresholds(10.0), forms=(form,)),)
    result = found(question, terms=terms, fit=fit, errors=np.full(3, 0.001), changed={}, needs_torque={})
    (effect,) = summarise(question, log, Path("logs"), result)["effects"]
    assert effect["parameters"]["seconds"]["value"] == pytest.approx(0.012, rel=1e-5)
    assert effect["parameters"]["filtered.seconds"]["value"] == pytest.approx(0.003, rel=1e-5)
    assert effect["parameters"]["second_stage"]["value"] == pytest.approx(0.4, rel=1e-5)


def test_a_delay_of_targets_is_no_surer_than_a_period_of_their_controller(asked):
    _, question = asked
    every = {hypothesis.key: hypothesis for hypothesis in question.problem.hypotheses}
    sizes = []
    for key in ("command_delay@elbow", "sensor_delay@elbow"):
        own = every[key]
        free = Free(own.directions, np.ones(1), np.array([[0.0, 0.1]]), np.array([False]))
        fit = Fit(free, np.array([0.02]), np.zeros(0), np.zeros((0, 1)), None)
        got = _effect(question, AcceptedTerm(own, EVIDENCE, Thresholds(10.0)), fit, np.array([1e-9]))
        sizes.append((got["parameters"]["seconds"]["high"] - got["parameters"]["seconds"]["low"]) / 2)
    # Targets wait for up to 1 ms until they are taken; readings do not.
    assert sizes == pytest.approx([1.96 * 0.001 / np.sqrt(12.0), 0.0], abs=1e-7)


def test_the_command_that_decides_can_be_typed_as_it_is(tmp_path, asked):
    log, _ = asked
    assert next_experiment._robot_of(log, tmp_path) == f" --robot {ARM}"
    assert next_experiment._robot_of(replace(log, robot="biteno"), tmp_path) == ""
    own = tmp_path / "my logs" / "arm.xml"
    assert next_experiment._robot_of(replace(log, robot=str(own)), own.parent) == ""
    assert next_experiment._robot_of(replace(log, robot=str(own)), tmp_path / "log") == f" --robot '{own}'"


def test_an_answer_without_a_name_asserts_nothing(asked):
    log, question = asked
    summary = summarise(question, log, Path("logs"), found(question, verdict="unnamed", changed={}))
    assert summary["effects"] == summary["parameter_changes"] == []
    assert [(one["name"], one["refines"]) for one in summary["not_named"]] == [
        ("coulomb", None),
        ("constant_push", "coulomb@elbow"),
    ]


def test_whole_runs_are_said_in_the_units_of_their_signal(tmp_path, asked):
    log, question = asked
    result = found(question)
    summary, free = summarise(question, log, Path("logs"), result), free_runs(question, result)
    for signal, key, units in (("q", "rad", "rad or m"), ("tau", "nm", "Nm or N")):
        free["signal"] = signal
        said = details(question, result, free)
        assert said[f"free_run_error_{key}"] == free["error"]
        assert said["free_runs"][0][f"error_{key}"] == free["runs"][0]["error"]
        report.write(tmp_path / "page.html", log, question, result, summary, free)
        console = Console(record=True, width=160)
        report.show(console, question, summary, free)
        for text in ((tmp_path / "page.html").read_text(), console.export_text()):
            assert f"whole runs, mean absolute error in {units}" in text


def test_what_would_show_an_effect_is_said(asked):
    _, question = asked
    assert report._what_would_show(question, "drag") == LIBRARY["drag"].excited_by
    assert report._what_would_show(question, "ground_friction") == "a free base"
    fewer = [one for one in question.problem.hypotheses if one.name != "command_delay"]
    question = replace(question, problem=replace(question.problem, hypotheses=fewer))
    assert report._what_would_show(question, "command_delay") == "a controller that is known"


@pytest.mark.parametrize("withdrawn", [False, True])
def test_page_and_console_say_what_was_found(tmp_path, asked, withdrawn):
    log, question = asked
    result = found(question)
    if withdrawn:
        result = replace(result, verdict="unnamed", withdrawn=True, model_is="null", model=result.null.vector)
    summary, free = summarise(question, log, Path("logs"), result), free_runs(question, result)
    assert {run["split"] for run in details(question, result, free)["free_runs"]} == {"train", "select", "sealed"}
    # What was proposed is simulated, whether or not it was withdrawn.
    assert abs(free["error"]["train"]["after"] - free["error"]["train"]["null"]) > 1e-3
    report.write(tmp_path / "page.html", log, question, result, summary, free)
    page = (tmp_path / "page.html").read_text()
    assert ("was withdrawn" in page) is withdrawn
    assert ("the nominal model with its parameters fitted" in page) is withdrawn
    assert "constant_push" in page
    console = Console(record=True, width=160)
    report.show(console, question, summary, free)
    said = console.export_text()
    assert ("was withdrawn" in said) is withdrawn
    assert "constant_push at elbow, which may only make up for the form of coulomb@elbow" in said
    assert "93% of what can be explained" in said
    why = "validation runs speak against it, and its size may be zero"
    assert f"taken out again: viscous at shoulder, since {why}" in said
    assert "coulomb at elbow 0.90; viscous at shoulder 0.70 (taken out again)" in said
    assert page.count(why) == 2


def test_what_a_saved_learned_torque_depends_on_is_said(tmp_path, asked):
    log, question = asked
    result = replace(found(question), verdict="unnamed", model_is="learned")
    summary, free = summarise(question, log, Path("logs"), result), free_runs(question, result)
    # What hardly matters is left out.
    assert [(one["place"], one["part"]) for one in summary["learned_parts"]] == [
        ("elbow", "joint before"),
        ("shoulder", "speed"),
    ]
    console = Console(record=True, width=400)
    report.show(console, question, summary, free)
    report.write(tmp_path / "page.html", log, question, result, summary, free)
    for text in (console.export_text(), (tmp_path / "page.html").read_text()):
        assert "at elbow the joint before it, in torque or position (62%); at shoulder the speed (20%)" in text
    # Where effects are saved, what a learned torque would have done is of no use.
    assert report._clues(summary | {"model_is": "effects"}) == ""


def test_every_part_of_the_learned_torque_has_words():
    assert set(PARTS) == {parameter.name for parameter in LEARNED.parameters}
    assert set(PARTS.values()) == set(report.PARTS)


def test_names_with_brackets_are_printed_as_they_are(asked):
    log, question = asked
    result = found(question)
    summary, free = summarise(question, log, Path("logs"), result), free_runs(question, result)
    for kind in ("effects", "not_named", "dropped", "suspects"):
        summary[kind] = [one | {"places": [f"[red]{place}" for place in one["places"]]} for one in summary[kind]]
    console = Console(record=True, width=400)
    report.show(console, question, summary, free)
    said = console.export_text()
    assert said.count("[red]elbow") >= 4
    assert said.count("[red]shoulder") == 2


def test_a_model_that_lacks_nothing_and_is_far_off_somewhere_is_doubted():
    # Few segments show it, so its interval reaches zero.
    cell = {"joint": "elbow", "signal": "q", "regime": "fast", "excess_floor_units": 7.4, "low": 0.0}
    result = SimpleNamespace(verdict="no_missing_effect", where=[cell])
    assert _far_off(result) == {"joint": "elbow", "regime": "fast", "excess_floor_units": 7.4}
    summary = {"verdict": result.verdict, "far_off": _far_off(result), "gap": {"after": 1.1}}
    assert "elbow is 7.4 floor units above it" in report._doubt(summary)
    for where in ([], [cell | {"excess_floor_units": 2.0}], [cell | {"signal": "dq"}]):
        assert _far_off(SimpleNamespace(verdict="no_missing_effect", where=where)) is None
    assert _far_off(SimpleNamespace(verdict="unnamed", where=[cell])) is None
    assert report._doubt(summary | {"far_off": None}) == ""


@pytest.mark.parametrize(
    ("verdict", "left", "doubted"),
    [
        ("named", 12.44, True),
        ("parameter_change", 5.0, True),
        ("named", 3.6, False),
        ("unnamed", 12.4, False),
        ("no_missing_effect", 6.0, False),
    ],
)
def test_a_name_that_leaves_much_is_doubted(verdict, left, doubted):
    said = report._doubt({"verdict": verdict, "far_off": None, "gap": {"after": left}})
    assert said == "" if not doubted else f"Yet {left:.1f} floor units are left" in said


def test_every_test_that_an_effect_may_fail_has_words():
    assert set(report.FAILED) == set(passes(EVIDENCE, Thresholds(10.0)))


def test_an_effect_with_a_size_for_each_place_is_told_of_those_that_are_clear(asked):
    _, question = asked
    (each,) = [one for one in question.problem.hypotheses if one.key == "coulomb@shoulder&elbow"]
    free = Free(each.directions, np.ones(2), each.bounds, np.zeros(2, bool))
    fit = Fit(free, np.array([0.01, 0.5]), np.zeros(0), np.zeros((0, 2)), None)
    errors = np.array([0.02, 0.02])
    clear = clear_places(fit, errors, each)
    effect = _effect(question, AcceptedTerm(each, EVIDENCE, Thresholds(10.0), clear=clear), fit, errors)
    assert effect["places"] == ["elbow"]
    assert list(effect["parameters"]) == ["torque_nm.elbow"]
    size = effect["parameters"]["torque_nm.elbow"]
    assert size["low"] < size["value"] < size["high"]
    assert report.brief_keys(question, f"beside {each.key}") == "beside coulomb@each joint"
    # A place with less than a tenth of the largest size makes up for its form, however exact logs are.
    sizes = [(0.04, ("elbow",)), (-0.04, ("elbow",)), (0.06, ("shoulder", "elbow"))]
    for size, told in sizes:
        assert clear_places(replace(fit, coordinates=np.array([size, 0.5])), np.full(2, 1e-4), each) == told
    # One place is told of in any case.
    assert clear_places(fit, np.array([1.0, 1.0]), each) == ("elbow",)
    assert clear_places(fit, errors, replace(each, each=False)) is None
