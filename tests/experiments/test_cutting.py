"""From logs as they are to a question: splits, horizons, what is compared, and what is refused."""

from dataclasses import replace
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from envs import segments
from envs.corrected import save
from envs.diagnosis.structure import structure
from envs.logs import Controller, Log, Run, splits, write
from envs.models import suspended
from envs.null_logs import Robot, as_recorded, play
from experiments.discovery import playback
from experiments.discovery.blind_cases import ARM
from experiments.discovery.cutting import HORIZONS_S, cut_log, fitting_horizons, split_in_time
from experiments.discovery.measured import drop_useless, read_logs, velocity_filter_s
from experiments.discovery.question import build_question

MEASURED = Path(__file__).parents[3] / "shared" / "data"
JOINTS = ("shoulder", "elbow")
PD = {"kp": np.array([40.0, 20.0]), "kd": np.array([2.0, 0.8]), "torque_limit_nm": np.array([15.0, 15.0])}
SERVO = {"gain": np.array([5.0, 5.0]), "kt": np.array([0.5, 0.5]), "resistance_ohm": np.array([0.5, 0.5])}


@pytest.fixture(scope="module")
def spec():
    return mujoco.MjSpec.from_file(str(ARM))


@pytest.fixture(scope="module")
def played(spec):
    """Twelve seconds of one motion at 50 rows a second, with velocities and torques that were measured."""
    time = 3.0 + np.arange(600) / 50.0
    target = 0.4 * np.sin(2 * np.pi * time[:, None] * [0.7, 1.1])
    zero = np.zeros_like(target)
    controller = Controller(kind="pd", rate_hz=500.0, gains=PD, between_rows="linear")
    known = {name: {"noise_sd": np.full(2, 0.01)} for name in ("dq", "tau", "abs_tau")}
    signals = {"q": zero, "dq": zero, "tau": zero, "abs_tau": zero, "target": target}
    run = Run(
        name="run_000",
        condition="sines",
        split=None,
        controller=controller,
        time=time,
        signals=signals,
        other={"heat": np.arange(600.0)},
        known=known | {"q": {"noise_sd": np.full(2, 1e-4)}},
    )
    model = suspended(spec)
    model.opt.timestep, model.opt.disableflags = 0.0005, model.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    robot = Robot(model, True, np.random.default_rng(0))
    run = as_recorded(robot, run, play([(robot, run)], JOINTS)[0])
    return Log(robot="arm.xml", base="fixed", rate_hz=50.0, joints=JOINTS, policy=None, runs=(run,))


def folder(tmp_path, log, mjcf=None):
    write(log, tmp_path / "log")
    (tmp_path / "log" / "arm.xml").write_text(ARM.read_text() if mjcf is None else mjcf)
    return (tmp_path / "log",)


def with_signals(log, **changes):
    signals = {name: values for name, values in {**log.runs[0].signals, **changes}.items() if values is not None}
    return replace(log, runs=(replace(log.runs[0], signals=signals),))


def with_holes(lengths, holes, **facts):
    """A log of runs of 500 rows a second, each without the rows of its holes: (first row, rows) of each run."""
    controller, runs = Controller(kind="pd", rate_hz=500.0, gains=PD), []
    for number, (length, missing) in enumerate(zip(lengths, holes, strict=True)):
        time = np.delete(0.002 * np.arange(length), [row + k for row, rows in missing for k in range(rows)])
        q = np.sin(5.0 * time)[:, None] * [0.5, 0.4]
        signals = {"q": q + 1e-4 * np.random.default_rng(number).normal(size=q.shape), "target": q}
        own = {name: values[number] for name, values in facts.items()}
        one = {"name": f"run_{number}", "condition": f"run_{number}", "split": None} | own
        runs.append(Run(controller=controller, time=time, signals=signals, **one))
    return Log(robot="arm.xml", base="fixed", rate_hz=500.0, joints=JOINTS, policy=None, runs=tuple(runs))


@pytest.mark.parametrize("missing, begins", [(5, [0, 605]), (10, [0]), (20, [0])])
def test_a_run_is_cut_where_a_few_rows_are_missing(tmp_path, missing, begins):
    # 10 ms, and 22 and 42 ms, in which somebody should look at the recording.
    recorded = with_holes([1500] * 3, [[(600, missing)]] * 3)
    # The doctor says which of them need no mending.
    (finding,) = structure(recorded.runs[0])[0]
    assert finding.kind == "missing rows"
    assert ("discover cuts the run there" in finding.sentence) == (len(begins) > 1)
    log, _ = read_logs(folder(tmp_path, recorded))
    mine = [run for run in log.runs if run.condition == "run_0"]
    np.testing.assert_allclose([run.time[0] for run in mine], 0.002 * np.array(begins))
    assert len({run.name for run in log.runs}) == len(log.runs) == 3 * len(begins)
    assert ["jump by up to 20 ms in run_0, run_1, run_2" in note for note in log.notes] == [True] * (len(begins) - 1)
    for run in log.runs:
        assert all(len(values) == len(run.time) for values in run.signals.values())
    # All pieces of a run are in one split.
    parts = {split: {run.condition for run in runs} for split, runs in splits(log).items()}
    assert parts.keys() == {"train", "select", "sealed"}
    assert sorted(map(sorted, parts.values())) == [["run_0"], ["run_1"], ["run_2"]]


def test_a_piece_takes_no_other_runs_name(tmp_path):
    names = ("run_walk", "run_walk_1", "run_walk_0")
    asked = with_holes(
        [1500] * 3, [[(600, 5)], [], []], name=names, condition=names, split=("train", "sealed", "select")
    )
    log, _ = read_logs(folder(tmp_path, asked))
    assert [(run.name, run.split) for run in log.runs] == [
        ("run_walk_2", "train"),
        ("run_walk_3", "train"),
        ("run_walk_0", "select"),
        ("run_walk_1", "sealed"),
    ]


def test_little_is_left_out_at_holes_and_it_is_said(tmp_path):
    # Of the first run 0.2 s; the second has a hole every 0.4 s, and is left to the doctor.
    log = with_holes([3000, 3000, 3000], [[(600, 5), (700, 5)], [(200 * k, 5) for k in range(1, 14)], []])
    log, _ = read_logs(folder(tmp_path, log))
    assert [run.name for run in log.runs] == ["run_0_0", "run_0_1", "run_1", "run_2"]
    assert [note for note in log.notes if note.endswith("without 0.19 s")] != []


def test_runs_of_one_condition_are_split_in_time_before_they_are_cut(tmp_path):
    log, _ = read_logs(folder(tmp_path, with_holes([5000], [[(4700, 5)]])))
    assert [(run.split, round(run.time[0] - log.runs[0].time[0])) for run in log.runs] == [
        ("train", 0),
        ("select", 5),
        ("sealed", 8),
        ("sealed", 9),
    ]


def test_one_condition_is_split_in_time(tmp_path, played):
    log, _ = read_logs(folder(tmp_path, played))
    assert len(log.notes) == 1
    assert "cut in time" in log.notes[0]
    parts = {split: run for split, (run,) in splits(log).items()}
    begin = [(run.time[0] - 3.0) / 12.0 for run in parts.values()]
    np.testing.assert_allclose(begin, [0.0, 0.5, 0.75], atol=0.01)
    # Where a part begins, the one before has ended by the history of a segment.
    train, select, sealed = parts.values()
    for before, after in ((train, select), (select, sealed)):
        assert segments.HISTORY_S <= after.time[0] - before.time[-1] <= segments.HISTORY_S + 0.04
    for run in parts.values():
        rows = np.searchsorted(played.runs[0].time, run.time)
        np.testing.assert_array_equal(run.signals["q"], played.runs[0].signals["q"][rows])
        np.testing.assert_array_equal(run.other["heat"], rows)


def test_logs_that_can_be_split_by_condition_are_not_cut(played):
    runs = tuple(replace(played.runs[0], name=f"run_{i}", condition=str(i)) for i in range(3))
    three = replace(played, runs=runs)
    assert split_in_time(three) is three
    # Nor are those that say how they are to be split, although it leaves no test.
    said = replace(played, runs=(replace(runs[0], split="train"),))
    assert split_in_time(said) is said


def test_a_run_too_short_to_be_cut_is_named(played):
    run = played.runs[0]
    signals = {name: values[:30] for name, values in run.signals.items()}
    short = replace(run, time=run.time[:30], signals=signals, other={})
    with pytest.raises(ValueError, match="run_000: got 1 rows for 'select', expected 8"):
        split_in_time(replace(played, runs=(short,)))


@pytest.mark.parametrize(("rate_hz", "least"), [(50.0, (0.08, 0.24, 0.72)), (100.0, HORIZONS_S), (500.0, HORIZONS_S)])
def test_horizons_follow_the_rows(played, rate_hz, least):
    time = np.arange(100) / rate_hz
    log = replace(played, runs=(replace(played.runs[0], time=time),))
    np.testing.assert_allclose(fitting_horizons(log), least, rtol=1e-6)
    asked = (4 / rate_hz, 12 / rate_hz, 36 / rate_hz)
    assert fitting_horizons(log, asked) == asked
    with pytest.raises(ValueError, match=r"horizons: got .* s, expected .* s or more, which are 4 of"):
        fitting_horizons(log, (2 / rate_hz, *asked))


def test_what_was_measured_is_compared_and_the_rig_reads_it(played, spec):
    log = split_in_time(played)
    question = build_question(log, spec, null_logs=1)
    problem = question.problem
    assert problem.horizons == pytest.approx((0.08, 0.24, 0.72))
    assert set(problem.components) == {"q", "dq", "tau", "abs_tau"}
    assert question.notes == log.notes
    data = problem.data["train"][problem.main_horizon]
    null = problem.null_logs[0]["train"][problem.main_horizon]
    for name, of in data.inputs.items():
        assert (getattr(null.inputs, name) is of) == (name not in ("measured", "past")), name
    values = np.asarray(problem.values(np.zeros((1, problem.axes))))[0].astype(np.float32)
    play = jax.jit(jax.vmap(problem.simulate, in_axes=(None, None, 0, None)))
    read = play(problem.system, values, data.inputs, data.steps)
    for name, size in {"q": 1e-3, "dq": 0.02, "tau": 0.02, "abs_tau": 0.02}.items():
        error = np.sqrt(((read[name] - data.signals[name]) ** 2).mean())
        assert error < size, name
        assert data.signals[name].std() > 20 * size, name
    np.testing.assert_allclose(read["abs_tau"], np.abs(read["tau"]), rtol=1e-6)


def test_torques_that_were_sent_are_not_compared(played, spec):
    log = split_in_time(with_signals(played, target=None, abs_tau=None))
    assert set(build_question(log, spec, null_logs=0).problem.components) == {"q", "dq"}


def test_filters_that_the_log_declares_are_heeded_and_said(played):
    (run,) = played.runs
    known = {"dq": {"filter_hz": np.array([np.nan, 20.0])}, "q": {"filter_hz": np.array([40.0, 40.0])}}
    declared = split_in_time(replace(played, runs=(replace(run, known=known),)))
    assert velocity_filter_s(declared) == pytest.approx(1.0 / (40.0 * np.pi))
    assert velocity_filter_s(played) == 0.0
    log, notes = drop_useless(declared)
    assert notes == (
        "q was filtered at 40 Hz, as the log says; the delay is taken out",
        "dq was filtered at 20 Hz, as the log says, and is not used",
    )
    assert all(set(run.signals) == {"q", "tau", "abs_tau", "target"} for run in log.runs)


def test_readings_that_a_bus_repeated_are_said(played, spec):
    held = played.runs[0].signals["q"][np.arange(600) // 2 * 2]
    log = split_in_time(with_signals(played, q=held, dq=None, tau=None, abs_tau=None))
    notes = build_question(log, spec, null_logs=0).notes
    assert len(notes) == 2
    assert notes[1].endswith("of the readings of q repeat an older one; they are interpolated")


def test_a_servos_supply_is_a_column_or_a_number(played, spec):
    servo = Controller(kind="servo", rate_hz=500.0, gains=SERVO)
    log = split_in_time(replace(played, runs=(replace(played.runs[0], controller=servo),)))
    with pytest.raises(ValueError, match=r"column 'volts' is missing, and so is controller\.volts of the servo"):
        build_question(log, spec, null_logs=0)
    fixed = replace(servo, gains=SERVO | {"volts": np.array([8.0, 8.0])})
    log = replace(log, runs=tuple(replace(run, controller=fixed) for run in log.runs))
    problem = build_question(log, spec, null_logs=0).problem
    np.testing.assert_allclose(problem.data["train"][problem.main_horizon].inputs.limit, 8.0, rtol=1e-6)


def test_the_constants_of_a_servos_motor_are_free(played, spec):
    servo = Controller(kind="servo", rate_hz=500.0, gains=SERVO | {"volts": np.array([8.0, 8.0])})
    free = {}
    for controller in (played.runs[0].controller, servo):
        log = split_in_time(replace(played, runs=(replace(played.runs[0], controller=controller),)))
        question = build_question(log, spec, null_logs=0)
        prior = zip(question.rig.axes, question.problem.prior, strict=True)
        free[controller.kind] = {axis.effect: sd for axis, sd in prior if sd > 0 and axis.place == "elbow"}
    # A servo damps with its motor alone.
    assert free["pd"].keys() - free["servo"].keys() == {"damping_gain"}
    assert {name: free["servo"][name] for name in free["servo"].keys() - free["pd"].keys()} == {
        "torque_scale": 0.07,
        "back_emf": 0.1,
    }


def test_joints_that_nobody_reads_are_named_with_what_to_do(played, spec):
    log = split_in_time(replace(played, joints=("shoulder",)))
    with pytest.raises(ValueError, match=r"joints: got a log without elbow, .* take their <joint> out of the MJCF"):
        build_question(log, spec, null_logs=0)


GRIPPER = """
        <body name="left" pos="0.02 0 -0.25">
          <joint name="left" type="slide" axis="1 0 0"/><geom size="0.01" mass="0.2"/>
        </body>
        <body name="right" pos="-0.02 0 -0.25">
          <joint name="right" type="slide" axis="-1 0 0"/><geom size="0.01" mass="0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="left" joint2="right"/></equality>
  <actuator><motor joint="left"/></actuator>
</mujoco>"""


def test_a_gripper_that_is_not_logged_is_held_from_log_to_saved_model(tmp_path, played):
    """Its mass counts, in all simulators, and the corrected model still has its joints."""
    bare = ARM.read_text()
    logs = folder(tmp_path, played, bare[: bare.index("</body>")] + GRIPPER)
    log, spec = read_logs(logs)
    assert "not logged, so taken to be held where the model puts them: left, right" in log.notes
    question = build_question(log, spec, null_logs=2)
    assert question.rig.joints == JOINTS
    assert question.rig.bodies == ("upper", "lower", "left", "right")
    assert len(question.problem.null_logs) == 2
    playable = playback.playable(spec, log).compile()
    assert playable.njnt == 2
    for model in (suspended(spec, JOINTS), playable):
        assert model.body_subtreemass[0] == pytest.approx(1.2 + 0.6 + 0.4)
    save(tmp_path / "model", question.spec, question.rig, np.zeros(len(question.rig.axes)))
    saved = mujoco.MjModel.from_xml_path(str(tmp_path / "model" / "model.xml"))
    assert [saved.joint(number).name for number in range(saved.njnt)] == [*JOINTS, "left", "right"]


def test_flags_that_switch_physics_off_are_cleared_if_told(tmp_path, played):
    mjcf = ARM.read_text().replace("<option", '<option><flag constraint="disable"/></option><option', 1)
    logs = folder(tmp_path, played, mjcf)
    with pytest.raises(ValueError, match=r"robot: option flag: got constraint disabled.*--clear-flags"):
        read_logs(logs)
    log, spec = read_logs(logs, clear_flags=True)
    assert log.notes[0] == "flags of the model that disabled constraint were cleared"
    assert not spec.option.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT


@pytest.mark.parametrize(
    ("name", "signals", "note"),
    [
        ("xl330_pendulum", {"q"}, "dq lags q"),
        ("so101_sage", {"q", "abs_tau"}, "dq lags q"),
        ("go2_hung", {"q"}, None),
    ],
)
def test_real_logs_become_questions(name, signals, note):
    if not (MEASURED / name).is_dir():
        pytest.skip(f"no recordings at {MEASURED / name}")
    question = build_question(*read_logs((MEASURED / name,)), null_logs=0)
    assert set(question.problem.components) == signals
    assert [text.startswith(note) for text in question.notes] == ([True] if note else [])
    # Nothing of them is taken for stale.
    assert not any("repeat" in text for text in question.notes)


def test_segments_in_which_runs_were_told_the_same_are_repeats(played):
    (one,) = played.runs
    other = replace(one, signals={**one.signals, "target": 0.5 * one.signals["target"]})
    splits_of = {"again": (one, one), "other": (one, other), "alone": (one,)}
    splits_named = dict(zip(splits_of, ("train", "select", "sealed"), strict=True))
    runs = [
        replace(run, name=f"{condition}_{number}", condition=condition, split=splits_named[condition])
        for condition, mine in splits_of.items()
        for number, run in enumerate(mine)
    ]
    found = cut_log(replace(played, runs=tuple(runs)), 0.001, ("q",), (0.24,))
    again = found["train"][0.24]
    for group in np.unique(again.repeats[again.repeats >= 0]):
        first, second = np.flatnonzero(again.repeats == group)
        assert again.run[first] != again.run[second]
        np.testing.assert_array_equal(again.signals["q"][first], again.signals["q"][second])
    # Of many segments some are left out, in pairs.
    assert (again.repeats >= 0).all()
    assert (found["select"][0.24].repeats < 0).all()
    assert (found["sealed"][0.24].repeats < 0).all()


def test_segments_that_begin_elsewhere_or_without_motors_are_no_repeats(played):
    (one,) = played.runs
    on = np.ones(len(one.time))
    one = replace(one, signals={**one.signals, "enabled": on})
    off = replace(one, signals={**one.signals, "enabled": np.where(one.time < 9.0, on, 0.0)})
    elsewhere = replace(one, signals={**one.signals, "q": one.signals["q"] + [0.3, 0.0]})
    named = lambda run, number, split: replace(run, name=f"{split}_{number}", condition=split, split=split)  # noqa: E731
    runs = [named(one, 0, "train"), named(off, 1, "train"), named(one, 0, "select"), named(elsewhere, 1, "select")]
    found = cut_log(replace(played, runs=(*runs, named(one, 0, "sealed"))), 0.001, ("q",), (0.24,))
    train = found["train"][0.24]
    for group in np.unique(train.repeats[train.repeats >= 0]):
        assert (train.repeats == group).sum() == 2
    # Motors are on in the first half alone.
    assert 0.3 < (train.repeats >= 0).mean() < 0.7
    assert (found["select"][0.24].repeats < 0).all()


def test_null_logs_keep_the_segments_of_the_measured_log(played):
    # The two began elsewhere on the robot and alike in simulation; of so many segments some are left out.
    (one,) = played.runs
    named = lambda run, number, split: replace(run, name=f"{split}_{number}", condition=split, split=split)  # noqa: E731
    rest = [named(one, 0, "select"), named(one, 0, "sealed")]
    elsewhere = replace(one, signals={**one.signals, "q": one.signals["q"] + [0.3, 0.0]})
    cut = [
        cut_log(replace(played, runs=(named(one, 0, "train"), named(two, 1, "train"), *rest)), 0.001, ("q",), (0.08,))
        for two in (elsewhere, one)
    ]
    measured, null = (each["train"][0.08] for each in cut)
    assert len(measured.run) < 2 * (12.0 - segments.HISTORY_S) / 0.08 - 10
    np.testing.assert_array_equal(null.run, measured.run)
    np.testing.assert_array_equal(null.inputs.target, measured.inputs.target)
    assert (measured.repeats < 0).all()
    assert (null.repeats >= 0).all()


def test_a_joint_that_stands_still_does_not_keep_runs_from_being_repeats(played):
    (one,) = played.runs
    rng = np.random.default_rng(0)
    runs = []
    for split, count in (("train", 2), ("select", 1), ("sealed", 1)):
        for number in range(count):
            still = 0.2 + 1e-4 * rng.standard_normal(len(one.time))
            position = np.stack([one.signals["q"][:, 0], still], axis=1)
            run = replace(one, signals={"q": position, "target": one.signals["target"]})
            runs.append(replace(run, name=f"{split}_{number}", condition=split, split=split))
    found = cut_log(replace(played, runs=tuple(runs)), 0.001, ("q",), (0.24,))
    assert (found["train"][0.24].repeats >= 0).all()
