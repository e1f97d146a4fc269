"""A robot that answers through logs: what it is asked for, what is refused, and a run that is stopped at any point."""

import importlib
import io
import json
import shutil
import signal
import sys
import time
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import ROBOT
from rich.console import Console

import experiments
from envs.diagnosis import Finding
from experiments import robot_stub, sim2real, sim2real_bench, train
from experiments.common import checkpoint, cli
from experiments.common.files import as_json, from_json
from experiments.robot import exchange, report, rounds, transfer
from experiments.robot.fall_risk import fall_risk, surprise
from experiments.robot.records import Prediction, Round
from experiments.robot.rounds import Rounds, Terms
from experiments.robot.simulated import SimulatedRobot
from experiments.robot.surrogate import Body, Robot
from experiments.walking import robots
from experiments.walking.policies import starting_policy
from experiments.walking.robots import kind

TERMS = Terms(walk_s=0.8, force=True, timeout_s=0.0, seed=0)
ARGS = sim2real.Args(preset="smoke", terms=TERMS, rounds=2)
# A robot of one joint, for what is the same with any: it compiles and walks in less time.
SLED = replace(ARGS, robot=ROBOT, parameters="mass,damping", terms=replace(TERMS, walk_s=1.2))


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("method", "magic", "ours, spm, dr"),
        ("preset", "huge", "smoke, cpu, gpu"),
        ("parameters", "left_arm_mass", "foot_friction"),
        ("rounds", 0, "got 0, expected 1"),
        ("epochs", -3, "got -3, expected 1"),
        ("radius", -0.1, "-0.1"),
        ("noise", float("nan"), "nan"),
        ("start", ("trunk_mass",), "name=value"),
        ("start", ("trunk_mass=9",), "0.2 to 5"),
        ("walk_s", 0.5, "got 0.5, expected 0.8"),
        ("max_fall_rate", 1.5, "got 1.5, expected 0 to 1"),
        ("timeout_s", float("inf"), "inf"),
    ],
)
def test_bad_input_is_named(field, value, named, monkeypatch):
    monkeypatch.setattr(jax, "jit", lambda *_, **__: pytest.fail("compiled something"))
    own = field in ("walk_s", "max_fall_rate", "timeout_s")
    args = replace(ARGS, terms=replace(TERMS, **{field: value})) if own else replace(ARGS, **{field: value})
    with pytest.raises(ValueError, match=field) as error:
        transfer.check(args)
    assert named in str(error.value)


def test_masses_start_where_the_options_say():
    _, _, entries, start = transfer.check(replace(ARGS, start=("trunk_mass=0.5", "shank_mass=2")))
    assert start == {name: {"trunk_mass": 0.5, "shank_mass": 2.0}.get(name, 1.0) for name in entries}


def test_a_log_that_does_not_come_is_named_when_time_is_up(tmp_path):
    with pytest.raises(ValueError, match=r"log: no log after 0 s, expected one as .*request\.json asks for"):
        exchange.wait(tmp_path, 0.0)


def test_a_refusal_is_passed_on(tmp_path):
    (tmp_path / "refused.txt").write_text("battery is empty\n")
    with pytest.raises(ValueError, match=r"refused\.txt: battery is empty"):
        exchange.wait(tmp_path, 60.0)


def test_a_log_counts_when_it_is_whole(tmp_path, monkeypatch):
    """Run by run it grows; `meta.yaml` comes, and is written a second time; nothing changes after that."""
    log, looks = tmp_path / "log", []

    def sleep(seconds):
        looks.append(seconds)
        log.mkdir(exist_ok=True)
        if len(looks) < 3:
            (log / f"run_{len(looks)}.csv").write_text("t\n")
        elif len(looks) < 5:
            (log / "meta.yaml").write_text("robot: biteno\n" * len(looks))
            (tmp_path / "refused.txt").write_text("another one was asked before")

    monkeypatch.setattr(exchange.time, "sleep", sleep)
    # A log that is there is waited for, however little time there is, and counts more than a refusal.
    monkeypatch.setattr(exchange.time, "monotonic", count().__next__)
    exchange.wait(tmp_path, 3.5)
    # Last changed in the fourth pause; the fifth look has seen it so, and three more.
    assert len(looks) == 7


def test_a_log_that_never_rests_is_refused(tmp_path, monkeypatch):
    log, looks = tmp_path / "log", []

    def sleep(seconds):
        looks.append(seconds)
        log.mkdir(exist_ok=True)
        (log / "meta.yaml").write_text("robot: biteno\n")
        (log / "run_000.csv").write_text("t\n" * len(looks))

    monkeypatch.setattr(exchange.time, "sleep", sleep)
    monkeypatch.setattr(exchange.time, "monotonic", lambda: float(len(looks)))
    with pytest.raises(ValueError, match="log: still changes 60 s after the timeout"):
        exchange.wait(tmp_path, 5.0)
    assert len(looks) == 66


MISFIT = {"times": 4.2, "phases": [1.0, None, 5.0]}
EXCESSES = ("cover", "lost", "misfit", "beyond")


def line(verdicts, measured, predicted, explained=0.5, cut_short=0, suspected=()):
    """A round as `summary.json` has it, read back."""
    numbers = {"return": 4.0, "power_w": 12.0}
    moved = {"trunk_mass": {"before": 0.5, "after": 0.9, "low": 0.8, "high": 1.0}}
    moved["foot_friction"] = {"before": 1.0, "after": 1.0, "low": None, "high": None}
    calls = {name: [0.3] * len(verdicts) for name in ("radius", "threshold", "p_value", "uncovered", *EXCESSES)}
    # What could not be computed is null.
    calls["novelty"] = [None if verdict == "not_finite" else 0.3 for verdict in verdicts]
    calls |= {"elbo": [-30.0] * len(verdicts), "comparable": [True] * len(verdicts)}
    known = {"trunk_mass": True, "foot_friction": False}
    by_name = {
        "step": {},
        "interval": {},
        "training": {},
        "misfits": {} if verdicts and verdicts[-1] == "accept" else {"gyro[1]": MISFIT},
        "update_loss": 0.1,
        "fit_p_value": 0.4,
        "misfit_p_value": 0.5,
        "replay_p_value": None,
        "past_p_value": None,
        "pooled": False,
        "replayed": False,
        "measured_falls": 0,
        "not_finite": 0,
    }
    walks = {
        "fall_rate": measured,
        "episodes": 5,
        "seconds": 31.0,
        "suspected": list(suspected),
        "cut_short": cut_short,
        **numbers,
    }
    simulated = {"episodes": 100, **numbers}
    found = {
        "round": 0,
        "predicted": {"fall_rate": 0.0, **simulated},
        "measured": walks,
        "tuning": {
            "verdicts": verdicts,
            "moved": moved,
            "identifiable": known,
            "weak": ["trunk_mass"],
            "together": [{"weights": {"trunk_mass": 1.0, "thigh_mass": 0.4}, "error": 0.03}],
            "compared_s": 2.5,
            "explained": {"fall_rate": explained, **simulated},
            **calls,
            **by_name,
        },
        "next": {"fall_rate": predicted, **simulated},
        "expected_falls": 0.4,
    }
    return from_json(Round, found)


def falls(*args, **kwargs):
    one = line(*args, **kwargs)
    return fall_risk(one.next_predicted, one.measured, one.tuning)


def surprise_of(one):
    return surprise(one.measured, one.tuning.explained)


def test_records_are_read_back_as_they_were_written():
    one = line(["widen", "not_finite"], 0.8, 0.1, suspected=[{"sentence": "q is late", "runs": ["run_000"]}])
    written = json.loads(json.dumps(as_json(one)))
    assert written["predicted"]["return"] == 4.0
    assert written["tuning"]["moved"]["foot_friction"]["low"] is None
    assert written["measured"]["suspected"] == [{"sentence": "q is late", "runs": ["run_000"]}]
    assert written.keys() == {"round", "predicted", "measured", "tuning", "next", "expected_falls"}
    assert from_json(Round, written) == one


def test_what_simulation_does_not_cover_is_expected_again():
    assert falls(["widen", "accept"], 0.6, 0.1) == 0.1
    for verdict in ("unexplained", "radius_exhausted", "not_finite", "not_comparable"):
        assert falls(["widen", verdict], 0.8, 0.1) == 0.8
        # Where simulation is worse than what was measured, it is believed.
        assert falls(["widen", verdict], 0.2, 0.9) == 0.9
    # Nobody looked: no call, and the gate that is open.
    assert falls([], 0.8, 0.1) == 0.8
    unread = line(["accept"], 0.8, 0.1)
    unread = replace(unread, tuning=replace(unread.tuning, p_value=(None,)))
    assert unread.tuning.verdict is None
    assert fall_risk(unread.next_predicted, unread.measured, unread.tuning) == 0.8
    # Nothing has been measured.
    assert fall_risk(unread.next_predicted) == 0.1


def test_falls_that_the_tuned_simulator_does_not_know_are_expected_again():
    # Four of five fall, and of 100 simulated walks of the same policy ten: 5 * 0.108^4 * 0.892 + 0.108^5.
    assert surprise_of(line(["accept"], 0.8, 0.0, explained=0.1)) == pytest.approx(6.2e-4, rel=0.02)
    assert falls(["accept"], 0.8, 0.0, explained=0.1) == 0.8
    # Three of five where a fifth falls: few walks would allow it, and that is no reason to walk on.
    assert surprise_of(line(["accept"], 0.6, 0.0, explained=0.2)) == pytest.approx(0.063, rel=0.02)
    assert falls(["accept"], 0.6, 0.0, explained=0.2) == 0.6
    # One of five is none where five of a hundred fall: 1 - (1 - 6 / 102)^5 = 0.26.
    assert falls(["accept"], 0.2, 0.0, explained=0.05) == 0.0
    # And where it is one, a fifth is a fifth, which is allowed.
    assert falls(["accept"], float(np.float32(0.2)), 0.0, explained=0.01) == TERMS.max_fall_rate
    # What ends before its time may have been a fall.
    assert falls(["accept"], 0.2, 0.0, explained=0.01, cut_short=2) == pytest.approx(0.6)
    assert falls(["accept"], 0.0, 0.0, explained=0.9) == 0.0


def test_the_page_says_what_matters_and_runs_nothing_of_the_log(tmp_path):
    suspected = [{"sentence": "q of <script>alert(1)</script> is cut off", "runs": ["<b>"]}]
    one = line(["widen", "accept"], measured=0.4, predicted=0.1, suspected=suspected)
    page = tmp_path / "report.html"
    report.write(page, [one], TERMS)
    text = page.read_text()
    assert "<script>" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt; is cut off (&lt;b&gt;)" in text
    assert "Not identifiable from this log, and not moved: foot_friction." in text
    assert "0.800 to 1.000" in text
    assert "should not walk again" in text
    assert "experiments.discover" not in text
    assert "by signal and phase" not in text
    report.write(page, [one, line(["unexplained"], 0.4, 0.1)], replace(TERMS, max_fall_rate=0.4))
    text = page.read_text()
    assert "experiments.excite" in text
    assert "gyro[1] 4.2" in text
    assert text.count('<img src="data:image/png') == 2
    assert "experiments.discover" in text
    assert "--model FOUND/model" in text
    assert "may walk again" in text
    assert "So far it has walked 10 times,\nand 4 of these walks ended in a fall" in text
    assert "end too early" not in text
    report.write(page, [line(["unexplained"], 0.4, 0.1)], TERMS, robot="go2")
    assert "experiments.excite --robot ROBOT.xml" in page.read_text()
    assert "--model" not in page.read_text()
    badly = replace(one, tuning=replace(one.tuning, fit_p_value=0.05, misfits=line(["widen"], 0.4, 0.1).tuning.misfits))
    assert badly.tuning.doubtful
    assert not one.tuning.doubtful
    report.write(page, [badly], TERMS)
    assert "fits badly all the same" in page.read_text()
    assert "(p 0.05)" in page.read_text()
    assert "gyro[1] 4.2" in page.read_text()
    # None of five logs is rejected, but five together are.
    weak = replace(one, tuning=replace(one.tuning, misfit_p_value=0.06))
    report.write(page, [weak] * 5, TERMS)
    assert "the logs of all rounds together are" in page.read_text()
    report.write(page, [weak], TERMS)
    assert "together are" not in page.read_text()
    report.write(page, [line(["not_comparable"], 1.0, 0.1, cut_short=3)], TERMS)
    text = page.read_text()
    assert "a policy that stands longer" in text
    assert "records of 3 walks end too early" in text
    report.write(page, [line([], 0.4, 0.1)], TERMS)
    assert "This method does not check" in page.read_text()


@pytest.mark.parametrize(("pooled", "said"), [(True, "joined with those of earlier rounds"), (False, "contradicts")])
def test_the_page_says_whether_earlier_rounds_count(pooled, said, tmp_path):
    one = line(["accept"], measured=0.1, predicted=0.1)
    page, output = tmp_path / "report.html", io.StringIO()
    report.write(page, [one], TERMS)
    assert "earlier rounds" not in page.read_text()
    one = replace(one, tuning=replace(one.tuning, pooled=pooled, past_p_value=0.01))
    report.write(page, [one], TERMS)
    report.show(Console(file=output, width=200), [one])
    for text in (page.read_text(), output.getvalue()):
        assert said in text
        assert "(p 0.01)" in text


@pytest.fixture(scope="module")
def programs():
    programs = transfer.compile_programs(ARGS)
    # Compiling it takes longer than all that is tried with this robot; the sled trains.
    programs.train = lambda key, state: (state, {})
    return programs


def answering(monkeypatch, robot):
    """Has a robot answer at once, in this process."""

    def wait(place, timeout_s):
        if not (place / "log").exists():
            robot_stub.answer(place, robot, 0)

    monkeypatch.setattr(rounds, "wait", wait)


@pytest.fixture
def answered(monkeypatch):
    answering(monkeypatch, Robot(Body()))


def states(out, programs, index, args):
    """The state that a round begins with."""
    learner = programs.learner
    like = programs.machines[args.method].init(
        learner.init(jax.random.PRNGKey(0)), learner.dist(transfer.check(args)[3], 0.2), rounds.tuner.knobs()
    )
    return checkpoint.load(out / f"round_{index:03d}" / "start", like, {})


@pytest.fixture(scope="module")
def sled(tmp_path_factory):
    """Options of a run with a policy, its programs, and the robot that walks."""
    policy = tmp_path_factory.mktemp("sled") / "policy"
    train.main(train.Args(robot=ROBOT, preset="smoke", out=policy))
    args = replace(SLED, policy=str(policy))
    return args, transfer.compile_programs(args), SimulatedRobot(kind(ROBOT), ("mass=1.3",))


class Stopped(Exception):
    """The run was killed."""


@pytest.mark.parametrize("method", [pytest.param("dr", marks=pytest.mark.slow), "ours"])
def test_a_run_stopped_after_every_file_is_the_same_run(method, sled, tmp_path, monkeypatch):
    args, programs, robot = sled
    args = replace(args, method=method)
    answering(monkeypatch, robot)
    whole = transfer.play(replace(args, out=tmp_path / "whole"), programs)
    args = replace(args, out=tmp_path / "stopped")
    left = []

    def stopping(function):
        def one(*args, **kwargs):
            if not left:
                raise Stopped
            left.pop()
            return function(*args, **kwargs)

        return one

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", stopping(checkpoint.save))
        patch.setattr(rounds, "write_json", stopping(rounds.write_json))
        for stops in range(40):
            # Some files come two or three at a time, and are made again if the last one is not there.
            left[:] = [None] * (1 + stops % 3)
            try:
                pieces = transfer.play(args, programs)
                break
            except Stopped:
                continue
    # Of 17 files; two in a call, in the mean.
    assert 7 <= stops < 39
    assert json.dumps(as_json(pieces)) == json.dumps(as_json(whole))
    for index in range(3):
        one, other = (states(tmp_path / name, programs, index, args) for name in ("whole", "stopped"))
        jax.tree.map(np.testing.assert_array_equal, one, other)
    assert (args.out / "round_001" / "report.html").exists()
    # And more rounds may be asked for later.
    assert transfer.play(replace(args, rounds=3), programs)[:2] == pieces


@pytest.fixture
def first(programs, tmp_path):
    """A run that has not begun, by its terms; of the method whose rounds take least time."""
    policy, start = starting_policy("walk", programs.learner), transfer.check(ARGS)[3]
    return lambda terms: Rounds(tmp_path, terms, programs, "dr", policy, start, 0.2)


def test_no_walks_are_requested_if_too_many_falls_are_expected(first, answered, tmp_path, monkeypatch):
    prediction = Prediction(mean_return=0.0, fall_rate=0.25, power_w=1.0, episodes=4)
    monkeypatch.setattr(Rounds, "_predicted", lambda self, index, state: prediction)
    careful, place = replace(TERMS, force=False), tmp_path / "round_000"
    place.mkdir()
    # Requested by an earlier call under other conditions.
    (place / "request.json").write_text("{}")
    with pytest.raises(ValueError, match=r"round 0: no walks are requested: 25% .* expected at most 20%"):
        first(careful).play(0, None)
    assert not (place / "request.json").exists()
    assert first(TERMS).play(0, None).expected_falls >= 0.25
    # A walk that was walked already may be learnt from.
    (place / "tuning.json").unlink()
    first(careful).play(0, None)
    assert (place / "tuning.json").exists()


def test_every_walk_that_was_asked_for_is_counted(first, answered, tmp_path):
    """A run that nobody asked for, or that is not there, would change what the robot is said to have done."""
    run, place = first(TERMS), tmp_path / "round_000"
    run._request(0, run._start(0, lambda: run._first))
    request = place / "request.json"
    asked = request.read_text()
    request.write_text(json.dumps(json.loads(asked) | {"episodes": 3}))
    robot_stub.answer(place, Robot(Body()), 0)
    with pytest.raises(ValueError, match=r"log: got 3 run\(s\), expected the 2 walks that .*request\.json asks for"):
        run.play(0, None)
    request.write_text(asked)
    shutil.rmtree(place / "log")
    assert run.play(0, None).measured.episodes == 2


def test_a_run_goes_on_in_the_model_that_it_began_with(programs, answered, tmp_path):
    model = tmp_path / "model"
    shutil.copytree(Path(sim2real.__file__).parent / "results" / "stand_in" / "found" / "model", model)
    args = replace(ARGS, out=tmp_path / "run", rounds=1, model=model, method="dr")
    assert transfer.play(args, programs) == transfer.play(args, programs)
    text = (model / "model.xml").read_text()
    (model / "model.xml").write_text(text.replace("<mujoco", "<mujoco ", 1))
    with pytest.raises(ValueError, match="model_sha256"):
        transfer.play(args, programs)


def test_a_folder_in_which_another_process_works_is_refused(programs, tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "Rounds", lambda *_, **__: pytest.fail("it was begun"))
    args = replace(ARGS, out=tmp_path / "run")
    with pytest.raises(pytest.fail.Exception, match="it was begun"):
        transfer.play(args, programs)
    with checkpoint.lock(args.out / "summary.json"), pytest.raises(ValueError, match="another process works on"):
        transfer.play(args, programs)


def test_errors_are_printed_as_they_are(monkeypatch, capsys):
    @dataclass
    class NoArgs:
        """A command without options."""

    def main(args):
        raise ValueError("got position[knee], expected `pip install 'jaxtune[onnx]'` [/x]")

    monkeypatch.setattr(sys, "argv", ["program"])
    monkeypatch.setattr(cli, "_errors", Console(width=200, stderr=True))
    with pytest.raises(SystemExit) as ended:
        cli.run(main, NoArgs)
    assert ended.value.code == 2
    printed = capsys.readouterr()
    assert "error: got position[knee], expected `pip install 'jaxtune[onnx]'` [/x]" in printed.err
    assert not printed.out


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (OSError(28, "No space left on device", "runs/summary.json"), 2, "error: runs/summary.json: No space left on"),
        (PermissionError(13, "Permission denied", "runs"), 2, "error: runs: Permission denied"),
        (KeyboardInterrupt(), 130, "stopped; to go on or begin anew: python -m "),
    ],
)
def test_errors_of_the_system_and_ctrl_c_are_one_line(monkeypatch, capsys, error, code, line):
    @dataclass
    class Seed:
        """A command with an option."""

        seed: int = 0

    def main(args):
        raise error

    monkeypatch.setattr(sys, "argv", ["program", "--seed", "3"])
    monkeypatch.setattr(cli, "_errors", Console(width=200, stderr=True))
    with pytest.raises(SystemExit) as ended:
        cli.run(main, Seed)
    assert ended.value.code == code
    printed = capsys.readouterr().err
    assert printed.startswith(line)
    assert printed.count("\n") == 1
    assert code == 2 or printed.endswith(" --seed 3\n")


def test_ctrl_c_ends_a_command_without_a_word_while_it_is_imported(monkeypatch):
    standard = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(sys, "orig_argv", ["python", "-W", "ignore", "-m", "experiments.train", "--seed", "3"])
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        importlib.reload(experiments)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
        monkeypatch.setattr(sys, "argv", ["program"])
        cli.run(lambda args: None, dataclass(type("Nothing", (), {"__doc__": "Does nothing."})))
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        # Whoever imports the package in a program of their own keeps what they have.
        monkeypatch.setattr(sys, "orig_argv", ["python", "-m", "theirs"])
        importlib.reload(experiments)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, standard)


def test_progress_is_a_line_a_minute_where_there_is_no_terminal(monkeypatch):
    output = io.StringIO()
    monkeypatch.setattr(cli, "console", Console(file=output, width=100))
    monkeypatch.setattr(cli, "_LINE_S", 0.05)
    with cli.bars() as progress:
        progress.update(progress.add_task("done", total=1), completed=1)
        task = progress.add_task("training", total=100)
        for _ in range(2):
            progress.advance(task, 10)
            time.sleep(0.01)
        deadline = time.monotonic() + 10.0
        while "min: training 20/100" not in output.getvalue() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert "min: training 20/100, 0 min left" in output.getvalue()
        assert "min: done" not in output.getvalue()


def test_what_an_earlier_call_did_says_nothing_of_the_pace():
    with cli.bars() as progress:
        task = progress.add_task("runs", total=10)
        for done in range(1, 4):
            cli.count(progress, task, done, kept=True)
        assert progress.tasks[0].completed == 3
        assert progress.tasks[0].time_remaining is None
        for done in (4, 5):
            time.sleep(0.05)
            cli.count(progress, task, done, kept=False)
        # Five steps are left, of at least 50 ms each.
        assert progress.tasks[0].speed <= 1 / 0.05


def test_a_log_that_means_something_else_is_not_learnt_from(first, answered, tmp_path, monkeypatch):
    turned = Finding("flipped sign", "q", ("left_knee",), -1.0, "q: left_knee turns the other way")
    late = Finding("late", "dq", (), 10.0, "dq: what was measured is 10 ms late")
    found = {"run_000": [turned, late], "run_001": [late]}
    monkeypatch.setattr(robots, "diagnose_log", lambda log: found)
    # In half of the runs is not in most.
    assert first(TERMS).play(0, None).measured.suspected[0].runs == ("run_000", "run_001")
    (tmp_path / "round_000" / "tuning.json").unlink()
    found["run_001"] = [turned]
    with pytest.raises(ValueError, match="left_knee turns the other way"):
        first(TERMS).play(0, None)
    assert not (tmp_path / "round_000" / "tuning.json").exists()
    first(replace(TERMS, trust_log=True)).play(0, None)
    assert (tmp_path / "round_000" / "tuning.json").exists()


def test_a_log_of_another_policy_is_not_learnt_from(first, answered, programs, tmp_path):
    run = first(TERMS)
    state = run._start(0, lambda: run._first)
    other = programs.learner.init(jax.random.PRNGKey(3))
    run._request(0, state.replace(policy=state.policy.replace(learner=other.learner)))
    with pytest.raises(ValueError, match=r"actions differ from what this round's policy does by \d+% of their size"):
        run.play(0, None)


def test_simulated_episodes_repeat_what_the_log_says(first, answered, programs, monkeypatch):
    run, seen = first(TERMS), []
    tune = run._tune

    def spy(key, state, measured):
        seen.append((state, measured))
        return tune(key, state, measured)

    monkeypatch.setattr(run, "_tune", spy)
    run.play(0, None)
    (state, measured), steps = seen[0], programs.learner.preset.episode_steps
    assert measured.obs.shape == (2, steps, 40)
    params = {name: jnp.full(4, value) for name, value in state.dist.centre.items()}
    found = jax.jit(programs.learner.simulate)(jax.random.PRNGKey(5), state.policy, params)
    assert found.obs.shape == (4, steps, 40)
    for episode in range(4):
        recorded = measured.obs[episode % 2]
        # Commands, and the clock.
        np.testing.assert_allclose(found.obs[episode, :, 3:6], recorded[:, 3:6], atol=1e-6)
        np.testing.assert_allclose(found.obs[episode, :, 36:], recorded[:, 36:], atol=1e-4)
    # Both are on their way at the first step: they have done something before it.
    assert np.abs(found.obs[:, 0, 24:30]).min() > 0
    assert np.abs(measured.obs[:, 0, 24:30]).min() > 0


def test_the_stand_in_is_as_heavy_as_is_said(tmp_path):
    args = sim2real_bench.Args(out=tmp_path, preset="smoke", mass=0.5, walk_s=0.8)
    sim2real_bench.check(args)
    start = {name: transfer.check(sim2real_bench.transfer_of(args, name, 1))[3] for name in sim2real_bench.METHODS}
    half = {"trunk_mass": 0.5, "abductor_mass": 0.5, "thigh_mass": 0.5, "shank_mass": 0.5, "foot_friction": 1.0}
    assert start["ours"] == start["spm"] == start["dr"] == half
    assert start["oracle"] == {**dict.fromkeys(half, 1.0), "foot_friction": 0.75}
    for wrong in ({"methods": ("magic",)}, {"seeds": ()}, {"rounds": 0}, {"mass": 9.0}):
        with pytest.raises(ValueError, match=next(iter(wrong)) if "mass" not in wrong else "start: got 'trunk_mass=9'"):
            sim2real_bench.check(replace(args, **wrong))
