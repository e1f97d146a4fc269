"""The stand-in robot while it is suspended; its walks are in test_export.py."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs import logs
from envs.biteno import constants
from envs.logs import Controller
from experiments import excite, robot_stub
from experiments.robot.surrogate import Body, Robot

EXACT = Body(encoder_rad=1e-9, velocity_noise_rad_s=0.0, transport_s=0.0, motor_lag_s=0.0)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Targets that a robot is to play."""
    place = tmp_path_factory.mktemp("robot") / "hung"
    excite.main(excite.Args(out=place / "targets", runs=4, seconds=1.0))
    return place


@pytest.fixture(scope="module")
def targets(place):
    return logs.read(place / "targets", measured=False).runs[0]


def played(targets, body):
    return Robot(body, suspended=True).play(targets, np.random.default_rng(0)).signals


def test_it_finds_targets_and_answers_with_a_log(place):
    robot_stub.main(robot_stub.Args(folder=place.parent, idle_s=1.0))
    targets, log = logs.read(place / "targets", measured=False), logs.read(place / "log")
    assert log.base == "fixed"
    assert [run.split for run in log.runs] == [run.split for run in targets.runs]
    for index, (one, other) in enumerate(zip(targets.runs, log.runs, strict=True)):
        # It is the same robot at every call, with noise of its own in every run.
        again = Robot(Body(), suspended=True).play(one, np.random.default_rng((0, index)))
        np.testing.assert_allclose(other.time, one.time)
        for signal in ("q", "dq", "target", "enabled"):
            np.testing.assert_allclose(other.signals[signal], again.signals[signal], atol=1e-9)


def test_its_sensors_are_those_of_its_walks(targets):
    body = Body()
    signals = played(targets, body)
    steps = signals["q"] / body.encoder_rad
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    quiet = played(targets, replace(body, velocity_noise_rad_s=0.0))
    # Both come to the same joints, but for what noise does through the controller.
    assert 0.8 * body.velocity_noise_rad_s < np.std(signals["dq"] - quiet["dq"]) < 1.5 * body.velocity_noise_rad_s


def test_its_motors_are_those_of_its_walks(targets):
    exact = played(targets, EXACT)["q"]
    assert np.abs(played(targets, replace(EXACT, motor_lag_s=0.02))["q"] - exact).max() > 0.02
    assert np.abs(played(targets, replace(EXACT, no_load_rad_s=1.0))["q"] - exact).max() > 0.02


def test_joints_follow_and_speeds_are_theirs(targets):
    signals = played(targets, EXACT)
    moved = np.abs(signals["target"] - signals["target"][0]).max(axis=1) > 0.05
    on = targets.signals["enabled"] > 0
    error = np.abs(signals["q"] - signals["target"])[moved & on]
    assert np.median(error) < 0.1
    slope = np.gradient(signals["q"], targets.time, axis=0)[2:-2]
    # Targets jump, and so do accelerations: not everywhere is the slope over two rows the speed between them.
    assert np.abs(slope - signals["dq"][2:-2]).mean() < 0.05 * np.abs(slope).mean()


def test_a_late_target_acts_as_one_that_was_sent_later(targets):
    rows = round(0.01 * 500)
    # Whenever that is.
    late = played(replace(targets, time=targets.time + 7.0), replace(EXACT, transport_s=0.01))["q"]
    target = targets.signals["target"]
    sent = {"target": np.concatenate([np.repeat(target[:1], rows, axis=0), target[:-rows]])}
    np.testing.assert_allclose(
        late, played(replace(targets, signals=dict(targets.signals) | sent), EXACT)["q"], atol=1e-6
    )
    assert np.abs(late - played(targets, EXACT)["q"]).max() > 0.02


def test_motors_that_are_off_hold_no_posture(targets):
    off = {"enabled": np.zeros(len(targets.time)), "target": np.tile(constants.STAND_RAD, (len(targets.time), 1))}
    signals = played(replace(targets, signals=off), EXACT)
    np.testing.assert_allclose(signals["q"][0], constants.STAND_RAD, atol=1e-6)
    assert np.abs(signals["q"][-1] - signals["q"][0]).max() > 0.1


def test_targets_for_another_controller_are_refused(targets):
    for kind, rate in (("servo", 1000.0), ("pd", 300.0)):
        other = Controller(kind=kind, rate_hz=rate, gains=targets.controller.gains)
        with pytest.raises(ValueError, match=rf"run_000: controller: got {kind} at {rate:g} Hz, expected pd"):
            played(replace(targets, controller=other), EXACT)


def test_it_refuses_other_robots_targets(tmp_path):
    arm, place = Path(excite.__file__).parent / "arm.xml", tmp_path / "hung"
    excite.main(excite.Args(out=place / "targets", robot=str(arm), runs=4, seconds=1.0))
    robot_stub.main(robot_stub.Args(folder=tmp_path, idle_s=1.0))
    assert "joints: got ('shoulder', 'elbow'), expected ('left_abad'" in (place / "refused.txt").read_text()
    assert not (place / "log").exists()


def test_targets_are_no_log(place):
    with pytest.raises(ValueError, match=r"q\.left_abad"):
        logs.read(place / "targets")


def test_a_log_without_targets_cannot_be_played(place, tmp_path):
    measured = logs.read(place / "targets", measured=False)
    runs = [replace(run, signals={"q": run.signals["target"], "tau": run.signals["target"]}) for run in measured.runs]
    logs.write(replace(measured, runs=tuple(runs)), tmp_path / "log")
    with pytest.raises(ValueError, match=r"target\.left_abad"):
        logs.read(tmp_path / "log", measured=False)


@pytest.mark.parametrize(
    ("request_text", "policy", "named"),
    [
        ("[]", b"", "episodes: got None, expected a positive integer"),
        ('{"episodes": 2.0, "seconds": 1, "seed": 0}', b"", "episodes: got 2.0"),
        ('{"episodes": 2, "seconds": NaN, "seed": 0}', b"", "seconds: got nan, expected a positive number"),
        ('{"episodes": 2, "seconds": 1, "seed": -1}', b"", "seed: got -1"),
        ("{", b"", "Expecting property name"),
        ('{"episodes": 2, "seconds": 1, "seed": 0}', b"PK\x03\x04 cut off", "policy.npz"),
    ],
)
def test_what_it_cannot_walk_with_it_refuses(tmp_path, request_text, policy, named):
    place = tmp_path / "round_000"
    (place / "policy").mkdir(parents=True)
    (place / "policy" / "policy.npz").write_bytes(policy)
    (place / "request.json").write_text(request_text)
    robot_stub.main(robot_stub.Args(folder=tmp_path, idle_s=1.0))
    assert named in (place / "refused.txt").read_text()


def test_it_ends_with_the_process_that_started_it(tmp_path):
    place = tmp_path / "round_000"
    place.mkdir()
    (place / "request.json").write_text("[]")
    robot_stub.main(robot_stub.Args(folder=tmp_path, idle_s=1.0, parent=os.getpid()))
    assert not (place / "refused.txt").exists()
    robot_stub.main(robot_stub.Args(folder=tmp_path, idle_s=1.0, parent=os.getppid()))
    assert (place / "refused.txt").exists()
