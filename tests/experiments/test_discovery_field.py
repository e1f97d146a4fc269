"""The field benchmark: engines agree, every effect acts in every generator, and a case's log tells nothing."""

import ast
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs import effects
from envs.logs import read, splits
from experiments.common import checkpoint
from experiments.discovery import benchmark, field
from experiments.discovery.field import motions, outside, robots, sizes, writing
from experiments.discovery.field.bench import FieldBench
from experiments.discovery.field.cases import FIELD_SIZES, GENERATORS, FieldCase, cases
from experiments.discovery.field.forms import Line
from experiments.discovery.field.plants import PLANTS
from experiments.discovery.field.playing import whole

NEEDS = {"bullet": "pybullet", "pinocchio": "pinocchio"}


@pytest.fixture(params=GENERATORS)
def generator(request):
    if request.param in NEEDS:
        pytest.importorskip(NEEDS[request.param], reason="the engine is an extra")
    return request.param


@pytest.fixture
def short(monkeypatch):
    """All topologies with four runs of 0.6 s."""
    brief = {name: replace(one, runs=4, seconds=0.6) for name, one in robots.TOPOLOGIES.items()}
    monkeypatch.setattr(robots, "TOPOLOGIES", brief)


def scene(generator, topology="arm2", kind="single", seed=4):
    case = FieldCase(0, kind, ("coulomb",), (8.0,), topology, generator)
    return writing.Scene(case, 0.1, np.random.default_rng(seed))


def test_nothing_of_the_library_is_imported():
    for path in Path(field.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not any(name.startswith(("envs.effects", "envs.chain", "envs.rig", "jaxtune")) for name in names)


def test_families_are_those_of_the_library():
    # But for how the base is mounted.
    mine = {name: row for name, row in effects.LIBRARY.items() if not row.needs and row.on != "robot"}
    suspended = {name: row.family for name, row in mine.items()}
    assert suspended == sizes.FAMILY
    assert {name for name, row in mine.items() if row.on == "body"} == set(sizes.ON_BODY)


@pytest.mark.parametrize("topology", ["arm3", "biped"])
def test_engines_move_the_same_body_alike(generator, topology):
    rng = np.random.default_rng(3)
    robot = robots.rounded(robots.draw(robots.TOPOLOGIES[topology], rng))
    # An inertia that is turned against the link's axes.
    robot = robot.with_at(
        "inertia", 2, robot.inertia[2] + 1e-4 * np.array([[2, 0.3, 0.1], [0.3, 1, 0.2], [0.1, 0.2, 1]])
    )
    heavy = robot.with_at("mass", 1, 2.0 * robot.mass[1])
    q, v = rng.uniform(-0.5, 0.5, (2, len(robot.joints))), rng.uniform(-1, 1, (2, len(robot.joints)))
    torque = rng.uniform(-0.3, 0.3, q.shape)
    ends = []
    for name in ("mujoco_c", generator):
        plant = PLANTS[name]([robot, heavy], np.array([1, 0]), q, v)
        for _ in range(round(0.2 / plant.dt)):
            plant.step(torque)
        ends.append(plant.q.copy())
    # It moves by half a radian, and steps of half a millisecond leave a thousandth of that.
    assert np.abs(ends[0] - q).max() > 0.1
    np.testing.assert_allclose(ends[1], ends[0], atol=2e-3)


def test_two_thirds_of_the_formulas_are_not_the_librarys(generator):
    forms = {name: form for name, form in writing.forms(generator).items() if name not in outside.OUTSIDE}
    assert set(forms) == set(sizes.FAMILY)
    assert sum(form.differs for form in forms.values()) >= 2 / 3 * len(forms)


def test_every_effect_moves_the_robot_and_more_of_it_further(generator, short):
    drawn = scene(generator)
    (plain,) = drawn.generator.play([drawn.real], drawn.script, whole(1, drawn.script, [0])).q
    for effect in drawn.forms if generator == "mujoco_c" else sizes.FAMILY:
        low, high = sizes.bounds(effect, drawn.real, 1, drawn.meter.scales(1))
        chosen = np.exp(np.array([0.7 * np.log(low) + 0.3 * np.log(high), np.log(high)]))
        real, hidden = drawn.with_effects([writing.Placed(effect, (1,))], chosen, 1)
        played = drawn.generator.play(real, drawn.script, whole(2, drawn.script, [0]), hidden).q
        little, much = np.sqrt(((played - plain) ** 2).mean(axis=(1, 2)))
        assert much > 1e-4, effect
        assert little < much, effect


def test_without_an_effect_the_severity_is_none(generator, short):
    drawn = scene(generator)
    assert drawn.meter.severities(drawn.meter.play([drawn.real]))[0] < 0.05
    assert (drawn.meter.floor_rad > 0.5 * drawn.sensors.quantum_rad / np.sqrt(12)).all()


def test_wrong_masses_are_not_severe(short):
    drawn = scene("mujoco_c", "arm3")
    heavy = drawn.real.with_at("mass", 2, 1.1 * drawn.real.mass[2])
    heavy = heavy.with_at("inertia", 2, 1.1 * drawn.real.inertia[2])
    # What a prior deviation explains hardly counts; an offset of the mass, which no model is off by, does.
    shifted = [heavy.with_at("com", 2, heavy.com[2] + [shift, 0.0, 0.0]) for shift in (1e-3, 0.03)]
    alone, little, strange = drawn.meter.severities(drawn.meter.play([heavy, *shifted]))
    assert little < 1.5 * alone
    assert strange > 5 * alone


def test_every_number_of_a_nominal_model_is_off(short):
    drawn = scene("mujoco_c", "arm3")
    for name in ("mass", "inertia", "armature", "damping", "friction", "kp", "kd", "com"):
        real, nominal = (np.asarray(getattr(one, name)) for one in (drawn.real, drawn.nominal))
        assert (real[nominal != 0] != nominal[nominal != 0]).all()
        if name == "com":
            assert (real != nominal).all() and np.abs(real - nominal).max() <= 3e-3
        else:
            assert np.abs(np.log(real[nominal != 0] / nominal[nominal != 0])).max() <= 0.151


def test_a_delay_line_returns_what_was_there():
    line, times = Line(0.05, 0.001), np.arange(100.0)
    late = [line(np.full((2, 3), time), np.array([[0.02], [0.0]])) for time in times]
    np.testing.assert_array_equal(np.stack(late)[:, 0, 0], np.maximum(times - 20, 0))
    np.testing.assert_array_equal(np.stack(late)[:, 1, 2], times)


def test_motions_stay_where_a_robot_can_go():
    for name, topology in robots.TOPOLOGIES.items():
        for seed in range(5):
            drawn = motions.draw(topology, np.random.default_rng(seed))
            assert len(drawn) == topology.runs, name
            assert len({motion.condition for motion in drawn}) == topology.runs
            assert max(np.abs(motion.target).max() for motion in drawn) < 2.0
            stated = {motion.split for motion in drawn} - {""}
            assert stated in (set(), {"train", "select", "sealed"})


def test_cases_hold_what_is_promised():
    size = FIELD_SIZES["field"]
    drawn = cases(size, 3)
    kinds = [case.kind for case in drawn]
    assert {kind: kinds.count(kind) for kind in set(kinds)} == {
        "single": 60, "weak": 20, "pair": 16, "triple": 8, "empty": 50, "linear": 10, "outside": 20
    }  # fmt: skip
    singles = [case.effects[0] for case in drawn if case.kind == "single"]
    assert all(singles.count(name) >= 2 for name in sizes.FAMILY)
    for case in drawn:
        assert len({sizes.FAMILY.get(name, name) for name in case.effects}) == len(case.effects)
    assert {case.topology for case in drawn} == set(robots.TOPOLOGIES)
    assert all(sum(case.generator == name for case in drawn) > 50 for name in GENERATORS)
    assert cases(size, 3) == drawn != cases(size, 4)


def test_a_log_is_as_a_user_writes_it_and_says_nothing_of_the_truth(tmp_path, short):
    case = FieldCase(5, "single", ("coulomb",), (8.0,), "arm2", "mujoco_c")
    folder = writing.write_case(case, 0.1, 3, tmp_path / "one")
    log = read(folder)
    truth = json.loads((tmp_path / "one" / "sealed" / "case_005.json").read_text())
    (effect,) = truth["effects"]
    assert 8.0 / 1.4 < effect["severity"] < 8.0 * 1.4
    assert effect["family"] == "joint_friction"
    assert set(effect["places"]) <= set(log.joints) == {"shoulder", "elbow"}
    assert {split: len(runs) > 0 for split, runs in splits(log).items()} == dict.fromkeys(
        ("train", "select", "sealed"), True
    )
    for run in log.runs:
        np.testing.assert_allclose(np.diff(run.time), 1 / 200, rtol=1e-9)
        assert np.abs(run.signals["q"]).max() < 3.0
    written = "".join(path.read_text(errors="ignore") for path in folder.rglob("*") if path.suffix in (".yaml", ".xml"))
    assert not any(word in written for word in ("coulomb", "severity", "mujoco_c"))
    late = read(writing.write_case(replace(case, late_stamps=True), 0.1, 3, tmp_path / "late"))
    delays = np.concatenate([run.time - np.arange(len(run.time)) / 200 for run in late.runs])
    assert 1e-5 < np.std(delays) < 4e-4 and np.abs(delays).max() > 3 * np.std(delays)
    assert all((np.diff(run.time) > 0).all() for run in late.runs)
    # It is written again, and is the same, if only the truth was kept.
    shutil.rmtree(folder)
    again = read(writing.write_case(case, 0.1, 3, tmp_path / "one"))
    np.testing.assert_array_equal(again.runs[1].signals["q"], log.runs[1].signals["q"])


def test_runs_of_a_robot_that_wanders_are_played_by_robots_that_differ_in_friction_alone(short):
    drawn, same = scene("mujoco_c", kind="wandering"), scene("mujoco_c")
    trace = drawn.play([])
    assert same.wandered == []
    assert len({tuple(robot.friction) for robot in drawn.wandered}) == len(drawn.motions)
    for run, robot in enumerate(drawn.wandered):
        back = replace(robot, friction=drawn.real.friction, damping=drawn.real.damping)
        np.testing.assert_equal(vars(back), vars(drawn.real))
        alone = drawn.generator.play([robot], drawn.script, whole(1, drawn.script, [run]))
        np.testing.assert_allclose(trace.q[run], alone.q[0], atol=1e-9)


def test_a_value_is_relative_to_the_nominal_model():
    drawn = scene("mujoco_c")
    placed = writing.Placed("coulomb", (1,), 0.5)
    assert writing._value(placed, drawn) == pytest.approx(0.5 + drawn.real.friction[1] - drawn.nominal.friction[1])
    ratio = writing.Placed("link_mass", (0,), 1.5)
    assert writing._value(ratio, drawn) == pytest.approx(1.5 * drawn.real.mass[0] / drawn.nominal.mass[0])


def test_a_case_that_fails_is_recorded_and_the_next_one_goes_on(tmp_path, monkeypatch):
    bench = FieldBench(tmp_path, "field_smoke", 3, 0.1)
    asked = []

    def fails(logs):
        asked.append(logs)
        raise ValueError("no floor")

    monkeypatch.setattr(benchmark, "read_logs", fails)
    monkeypatch.setattr(FieldBench, "write", lambda self, case: tmp_path / "log")
    assert bench.answer(bench.cases[0])["verdict"] == "failed"
    assert bench.answer(bench.cases[0])["message"] == "ValueError: no floor"
    assert len(asked) == 1


def test_a_case_that_another_process_answers_is_refused_and_not_failed(tmp_path, monkeypatch):
    bench = FieldBench(tmp_path, "field_smoke", 3, 0.1)
    monkeypatch.setattr(FieldBench, "write", lambda self, case: pytest.fail("it was begun"))
    first, second = bench.cases[:2]
    with (
        checkpoint.lock(tmp_path / "answers" / benchmark.name_of(first)),
        pytest.raises(ValueError, match="another process works on"),
    ):
        bench.answer(first)
    assert not (tmp_path / "answers" / benchmark.name_of(first)).exists()
    # Another case is nobody's.
    with pytest.raises(pytest.fail.Exception, match="it was begun"):
        bench.answer(second)
