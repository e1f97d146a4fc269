"""A robot that answers through logs: what is asked of it, what is refused, and a run that is stopped at any point."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from envs.diagnosis import Finding
from experiments import checkpoint, doctor, robot_stub, rounds, sim2real, sim2real_report
from experiments.rounds import Run, Simulator, Terms
from experiments.train import starting_policy

TERMS = Terms(walk_s=0.8, force=True, timeout_s=0.0, seed=0)
ARGS = sim2real.Args(preset="smoke", terms=TERMS, rounds=2)


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
        sim2real.check(args)
    assert named in str(error.value)


def test_masses_start_where_they_are_told_to():
    _, entries, start = sim2real.check(replace(ARGS, start=("trunk_mass=0.5", "shank_mass=2")))
    assert start == {name: {"trunk_mass": 0.5, "shank_mass": 2.0}.get(name, 1.0) for name in entries}


def test_no_log_is_told_in_time(tmp_path):
    with pytest.raises(ValueError, match=r"log: no log after 0 s, expected one as .*request\.json asks for"):
        rounds.wait(tmp_path, 0.0)


def test_a_refusal_is_passed_on(tmp_path):
    (tmp_path / "refused.txt").write_text("battery is empty\n")
    with pytest.raises(ValueError, match=r"refused\.txt: battery is empty"):
        rounds.wait(tmp_path, 60.0)


def test_a_log_counts_when_it_is_whole(tmp_path, monkeypatch):
    """Run by run it grows; `meta.yaml` comes, then one more run; nothing changes after that."""
    log, looks = tmp_path / "log", []

    def sleep(seconds):
        looks.append(seconds)
        log.mkdir(exist_ok=True)
        if len(looks) < 3:
            (log / f"run_{len(looks)}.csv").write_text("t\n")
        elif len(looks) < 5:
            (log / "meta.yaml").write_text("robot: biteno\n" * len(looks))

    monkeypatch.setattr(rounds.time, "sleep", sleep)
    rounds.wait(tmp_path, 1e6)
    # Complete after the fourth look; the fifth has seen it once, the sixth again.
    assert len(looks) == 5


def line(verdicts, measured, predicted):
    numbers = {"return": 4.0, "power_w": 12.0}
    moved = {"trunk_mass": {"before": 0.5, "after": 0.9, "low": 0.8, "high": 1.0}}
    moved["foot_friction"] = {"before": 1.0, "after": 1.0, "low": None, "high": None}
    calls = {name: [0.3] * len(verdicts) for name in ("radius", "novelty", "threshold", "p_value", "uncovered")}
    known = {"trunk_mass": True, "foot_friction": False}
    return {
        "round": 0,
        "predicted": {"fall_rate": 0.0, "episodes": 100, **numbers},
        "measured": {"fall_rate": measured, "episodes": 5, "seconds": 31.0, "suspected": [], **numbers},
        "tuning": {"verdicts": verdicts, "moved": moved, "identifiable": known, **calls},
        "next": {"fall_rate": predicted, "episodes": 100, **numbers},
        "expected_falls": 0.4,
    }


def test_what_simulation_does_not_cover_is_expected_again():
    for verdict, expected in (("accept", 0.1), ("unexplained", 0.8), ("radius_exhausted", 0.8), ("not_finite", 0.8)):
        told = line(["widen", verdict], measured=0.8, predicted=0.1)
        assert rounds.expected_falls(told["next"], [told]) == expected
    # Nobody looked; nothing has been measured; simulation is worse than what was measured.
    assert rounds.expected_falls({"fall_rate": 0.1}, [line([], 0.8, 0.1)]) == 0.1
    assert rounds.expected_falls({"fall_rate": 0.3}, []) == 0.3
    assert rounds.expected_falls({"fall_rate": 0.9}, [line(["unexplained"], 0.2, 0.9)]) == 0.9


def test_the_page_says_what_matters_and_runs_nothing_of_the_log(tmp_path):
    told = line(["widen", "accept"], measured=0.4, predicted=0.1)
    told["measured"]["suspected"] = [{"sentence": "q of <script>alert(1)</script> is cut off", "runs": ["<b>"]}]
    page = tmp_path / "report.html"
    sim2real_report.write(page, [told], TERMS)
    text = page.read_text()
    assert "<script>" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt; is cut off (&lt;b&gt;)" in text
    assert "Not identifiable from this log, and left alone: foot_friction." in text
    assert "0.800 to 1.000" in text
    assert "should not walk again" in text
    assert "experiments.discover" not in text
    sim2real_report.write(page, [told, line(["unexplained"], 0.4, 0.1)], replace(TERMS, max_fall_rate=0.4))
    text = page.read_text()
    assert "experiments.excite" in text
    assert "experiments.discover" in text
    assert "may walk again" in text
    assert "10 walks, of\nwhich 4 ended in a fall" in text


@pytest.fixture(scope="module")
def learner():
    return sim2real.simulator(ARGS)


@pytest.fixture
def answered(monkeypatch):
    """A robot that answers at once, in this process."""
    robot = robot_stub.Robot(robot_stub.Body())

    def wait(place, timeout_s):
        if not (place / "log").exists():
            robot_stub.answer(place, robot, 0)

    monkeypatch.setattr(rounds, "wait", wait)


def states(out, learner, index):
    like = learner.machines["ours"].init(
        learner.loop.init(jax.random.PRNGKey(0)), learner.loop.dist(sim2real.check(ARGS)[2], 0.2), rounds.tuner.knobs()
    )
    return checkpoint.load(out / f"round_{index:03d}" / "start", like, {})


class Stopped(Exception):
    """The run was killed."""


def test_a_run_stopped_after_every_file_is_the_same_run(learner, answered, tmp_path, monkeypatch):
    whole = sim2real.play(replace(ARGS, out=tmp_path / "whole"), learner)
    args = replace(ARGS, out=tmp_path / "stopped")
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
        stops = 0
        while True:
            left = [None]
            try:
                pieces = sim2real.play(args, learner)
                break
            except Stopped:
                stops += 1
    # Learner and start of three rounds, and of two the request, the tuned state, three JSON files.
    assert stops >= 14
    assert json.dumps(pieces) == json.dumps(whole)
    for index in range(3):
        one, other = (states(tmp_path / name, learner, index) for name in ("whole", "stopped"))
        jax.tree.map(np.testing.assert_array_equal, one, other)
    assert (args.out / "round_001" / "report.html").exists()
    # And more rounds may be asked for later.
    assert sim2real.play(replace(args, rounds=3), learner)[:2] == pieces


@pytest.fixture
def first(learner, tmp_path):
    """A run that has not begun, by its terms."""
    loop = learner.loop
    policy, dist = starting_policy("walk", loop), loop.dist(sim2real.check(ARGS)[2], 0.2)
    return lambda terms: Run(tmp_path, terms, learner, "ours", policy, dist)


def test_who_would_fall_is_not_asked_to_walk(first, answered, tmp_path, monkeypatch):
    monkeypatch.setattr(Run, "_foreseen", lambda self, index, state: {"fall_rate": 0.25, "return": 0.0, "power_w": 1.0})
    with pytest.raises(ValueError, match=r"round 0: the robot is not asked to walk: 25% .* and 20% may"):
        first(replace(TERMS, force=False)).round(0, [])
    assert not (tmp_path / "round_000" / "request.json").exists()
    assert first(TERMS).round(0, [])["expected_falls"] >= 0.25


def test_a_log_that_means_something_else_is_not_learnt_from(first, answered, tmp_path, monkeypatch):
    turned = Finding("flipped sign", "q", ("left_knee",), -1.0, "q: left_knee turns the other way")
    late = Finding("late", "dq", (), 10.0, "dq: what was measured is 10 ms late")
    found = {"run_000": [turned, late], "run_001": [late]}
    monkeypatch.setattr(doctor, "examine", lambda log: found)
    # In half of the runs is not in most.
    assert first(replace(TERMS, force=False)).round(0, [])["measured"]["suspected"][0]["runs"] == ["run_000", "run_001"]
    (tmp_path / "round_000" / "tuning.json").unlink()
    found["run_001"] = [turned]
    with pytest.raises(ValueError, match="left_knee turns the other way"):
        first(replace(TERMS, force=False)).round(0, [])
    assert not (tmp_path / "round_000" / "tuning.json").exists()
    assert first(TERMS).round(0, [])["tuning"]["verdicts"]


def test_simulated_episodes_repeat_what_the_robot_was_asked_for(learner):
    loop = learner.loop
    policy, dist = starting_policy("walk", loop), loop.dist(sim2real.check(ARGS)[2], 0.2)
    steps, key = loop.preset.episode_steps, jax.random.PRNGKey(5)
    command = jax.random.uniform(key, (2, steps, 3))
    asked = rounds.recorded.Asked(command=command, phase=jax.numpy.array([[0.1, 0.6], [0.7, 0.2]]))
    params = {name: jax.numpy.full(5, value) for name, value in dist.centre.items()}
    found = jax.jit(loop.simulate)(key, policy.replace(asked=asked), params)
    for episode in range(5):
        np.testing.assert_allclose(
            found.obs[episode, :, 3:6], command[episode % 2] * np.array([2.0, 2.0, 0.25]), atol=1e-6
        )
        angle = 2 * np.pi * (asked.phase[episode % 2] + 0.0175 * np.arange(steps)[:, None])
        np.testing.assert_allclose(found.obs[episode, :, 36::2], np.sin(angle), atol=1e-4)
    assert isinstance(learner, Simulator)
