"""The stand-in robot where it hangs; its walks are in test_export.py."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs import logs
from envs.biteno import constants
from envs.logs import Controller
from experiments import excite, robot_stub
from experiments.robot_stub import Body, Robot

EXACT = Body(encoder_rad=1e-9, velocity_noise_rad_s=0.0, transport_s=0.0, motor_lag_s=0.0)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Targets that a robot is to play."""
    place = tmp_path_factory.mktemp("robot") / "hung"
    excite.main(excite.Args(out=place / "targets", runs=4, seconds=1.0))
    return place


@pytest.fixture(scope="module")
def asked(place):
    return logs.read(place / "targets", measured=False).runs[0]


def played(asked, body):
    return Robot(body, base="fixed").play(asked, np.random.default_rng(0)).signals


def test_it_answers_with_a_log(place):
    assert robot_stub.hang(place, Robot(Body(), base="fixed"), 0) == [False] * 4
    asked, log = logs.read(place / "targets", measured=False), logs.read(place / "log")
    assert log.base == "fixed"
    assert [run.split for run in log.runs] == [run.split for run in asked.runs]
    for one, other in zip(asked.runs, log.runs, strict=True):
        np.testing.assert_allclose(other.time, one.time)
        np.testing.assert_allclose(other.signals["target"], one.signals["target"], atol=1e-6)
        assert other.signals["q"].shape == other.signals["dq"].shape == one.signals["target"].shape


def test_joints_follow_and_speeds_are_theirs(asked):
    signals = played(asked, EXACT)
    moved = np.abs(signals["target"] - signals["target"][0]).max(axis=1) > 0.05
    on = asked.signals["enabled"] > 0
    error = np.abs(signals["q"] - signals["target"])[moved & on]
    assert np.median(error) < 0.1
    slope = np.gradient(signals["q"], asked.time, axis=0)[2:-2]
    # Targets jump, and so do accelerations: not everywhere is the slope over two rows the speed between them.
    assert np.abs(slope - signals["dq"][2:-2]).mean() < 0.05 * np.abs(slope).mean()


def test_what_is_late_is_what_was_sent_later(asked):
    rows = round(0.01 * 500)
    # Whenever that is.
    late = played(replace(asked, time=asked.time + 7.0), replace(EXACT, transport_s=0.01))["q"]
    target = asked.signals["target"]
    sent = {"target": np.concatenate([np.repeat(target[:1], rows, axis=0), target[:-rows]])}
    np.testing.assert_allclose(late, played(replace(asked, signals=dict(asked.signals) | sent), EXACT)["q"], atol=1e-6)
    assert np.abs(late - played(asked, EXACT)["q"]).max() > 0.02


def test_motors_that_are_off_hold_nothing(asked):
    off = {"enabled": np.zeros(len(asked.time)), "target": np.tile(constants.STAND_RAD, (len(asked.time), 1))}
    signals = played(replace(asked, signals=off), EXACT)
    np.testing.assert_allclose(signals["q"][0], constants.STAND_RAD, atol=1e-6)
    assert np.abs(signals["q"][-1] - signals["q"][0]).max() > 0.1


def test_it_has_no_servo(asked):
    servo = Controller(kind="servo", rate_hz=1000.0, gains={})
    with pytest.raises(ValueError, match="run_000: controller: got servo, expected pd"):
        played(replace(asked, controller=servo), EXACT)


def test_it_plays_no_other_robots_targets(tmp_path):
    arm = Path(excite.__file__).parent / "arm.xml"
    excite.main(excite.Args(out=tmp_path / "targets", robot=str(arm), runs=4, seconds=1.0))
    with pytest.raises(ValueError, match=r"joints: got .*shoulder.*, expected .*left_abad"):
        robot_stub.hang(tmp_path, Robot(Body(), base="fixed"), 0)
    assert not (tmp_path / "log").exists()


def test_targets_are_no_log(place):
    with pytest.raises(ValueError, match=r"q\.left_abad"):
        logs.read(place / "targets")
