"""The log doctor does not take rest for repeated rows, nor turning points for signals that are cut off."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from envs.diagnosis import diagnose_log
from envs.diagnosis.clipping import clipped, clipped_alike
from envs.diagnosis.repeats import repeated
from envs.diagnosis.structure import structure
from envs.logs import Controller, Run, read, read_xl330

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
GAINS = {"kp": np.ones(2), "kd": np.ones(2), "torque_limit_nm": np.full(2, 5.0)}
RATE_HZ = 200.0
QUANTUM = 0.0015
JOINTS = ("one", "two")


def run_of(position, quantum=QUANTUM, rate=RATE_HZ, name="run_000"):
    """A run of positions [rows, joints], rounded, without noise."""
    return Run(
        name=name,
        condition=name,
        split=None,
        controller=Controller(kind="pd", rate_hz=1000.0, gains=GAINS),
        time=np.arange(len(position)) / rate,
        signals={"q": np.round(position / quantum) * quantum},
    )


def moving(seconds=5.0, rate=RATE_HZ, amplitude=0.5):
    """Two joints that swing at 0.7 and 1.1 Hz."""
    time = np.arange(round(seconds * rate)) / rate
    return amplitude * np.sin(2 * np.pi * np.array([0.7, 1.1]) * time[:, None])


def resting():
    """Two joints that go together from one posture to the next and stand still there, each for a second."""
    levels = 0.4 * np.random.default_rng(0).uniform(-1, 1, (8, 2))
    after = np.linspace(0, 1, round(RATE_HZ))[:, None]
    share = np.minimum(after / 0.3, 1.0)
    smooth = share**2 * (3 - 2 * share)
    return np.concatenate([one + (two - one) * smooth for one, two in pairwise(levels)])


def creeping():
    """Triangles at whose corners both joints stick for half a second."""
    time = np.arange(round(8 * RATE_HZ)) / RATE_HZ
    phase = np.abs((time / 2.0) % 2.0 - 1.0)
    return np.stack([np.clip(1.6 * phase - 0.3, 0, 1), np.clip(1.2 * phase - 0.1, 0, 1)], axis=1) * 0.05


@pytest.mark.parametrize("position", [moving(), resting(), creeping(), moving(rate=50.0)])
def test_joints_that_move_stand_or_stick_repeat_no_rows(position):
    assert not repeated(run_of(position)).any()


@pytest.mark.parametrize("count", [1, 3, 20])
def test_rows_repeated_while_joints_move_are_marked(count):
    position = moving()
    run = run_of(np.concatenate([position[:280], np.repeat(position[279:280], count, axis=0), position[280:]]))
    assert np.flatnonzero(repeated(run)).tolist() == list(range(279, 279 + count))


def test_a_constant_reading_of_speed_says_that_rows_repeat():
    run = run_of(resting())
    speed = np.gradient(run.signals["q"], run.time, axis=0)
    frozen = np.arange(len(speed)) >= 1200
    q = np.where(frozen[:, None], run.signals["q"][1200], run.signals["q"])
    stuck = replace(run, signals={"q": q, "dq": np.where(frozen[:, None], 0.5, speed)})
    still = replace(run, signals={"q": q, "dq": np.where(frozen[:, None], 0.0, speed)})
    assert repeated(stuck)[1200:].all()
    assert not repeated(still)[1200:].any()


def test_rows_that_repeat_among_noise_are_marked_at_rest_too():
    rng = np.random.default_rng(0)
    position = 0.004 * rng.normal(size=(1000, 2))
    position[500:504] = position[499]
    assert np.flatnonzero(repeated(run_of(position))).tolist() == [499, 500, 501, 502]


@pytest.mark.parametrize("position", [moving(), resting(), creeping(), moving(amplitude=0.03)])
def test_turning_points_and_rest_are_no_cut_offs(position):
    assert clipped(run_of(position), JOINTS) == []
    assert clipped_alike([run_of(position), run_of(position[::-1], name="run_001")], JOINTS) == {
        "run_000": [],
        "run_001": [],
    }


def test_a_signal_that_is_cut_off_is_named():
    position = moving()
    position[:, 1] = np.minimum(position[:, 1], 0.36)
    (found,) = clipped(run_of(position), JOINTS)
    assert (found.signal, found.joints) == ("q", ("two",))
    assert found.size == pytest.approx(0.36, abs=QUANTUM)


def test_a_single_stay_counts_where_another_run_ends_at_the_same_value():
    once = np.linspace(-0.5, 1.5, round(2 * RATE_HZ))
    position = np.stack([0.8 * np.sin(np.pi * once), 0.3 * once], axis=1)
    cut = np.minimum(position, 0.6)
    one, two, other = (run_of(each, name=f"run_00{i}") for i, each in enumerate((cut, 1.2 * cut, 0.9 * position)))
    two = replace(two, signals={"q": np.minimum(two.signals["q"], one.signals["q"].max())})
    assert clipped(one, JOINTS) == []
    found = clipped_alike([one, two, other], JOINTS)
    assert {name: [one.joints for one in each] for name, each in found.items()} == {
        "run_000": [("one",)],
        "run_001": [("one",)],
        "run_002": [],
    }


def test_a_clock_with_two_paces_has_no_holes():
    run = run_of(moving())
    rng = np.random.default_rng(0)
    slow = rng.uniform(size=len(run.time)) < 0.05
    steps = np.where(slow, rng.uniform(5.2e-3, 6.0e-3, len(slow)), rng.uniform(3.4e-3, 4.0e-3, len(slow)))
    assert structure(replace(run, time=np.cumsum(steps)))[0] == []
    steps[400] = 0.03
    assert [one.kind for one in structure(replace(run, time=np.cumsum(steps)))[0]] == ["clock jump"]


def recorded(name):
    if not (DATA / name).exists():
        pytest.skip(f"the recordings of {name} are not there")
    return read_xl330(DATA / name) if name == "xl330_pendulum" else read(DATA / name)


@pytest.mark.parametrize(
    ("name", "rows"),
    # Two rows truly repeat: before and after one all twelve joints of the Go2 move on, and at the other the servo does.
    [("so101_sage", {}), ("go2_hung", {"run_001": 1}), ("xl330_pendulum", {"run_kp200_lift_and_drop": 1})],
)
def test_of_real_robots_only_what_is_so_is_said(name, rows):
    log = recorded(name)
    said = {run.name: int(repeated(run).sum()) for run in log.runs}
    assert {run: count for run, count in said.items() if count} == rows
    found = clipped_alike(log.runs, log.joints)
    assert not any(found.values())
    assert not any(clipped(run, log.joints) for run in log.runs)
    kinds = {one.kind for run in log.runs for one in structure(run)[0]}
    assert kinds <= {"low rate", "duplicated rows"}


def test_a_servo_that_follows_late_is_not_said_to_be_delayed_where_dynamics_cannot_tell():
    log = recorded("so101_sage")
    found = diagnose_log(replace(log, runs=log.runs[1:3]))
    # Velocities lag positions by one row, as the recording's own description says.
    assert {(one.kind, one.signal) for each in found.values() for one in each} == {
        ("low rate", "t"),
        ("quantised", "q"),
        ("late", "dq"),
    }
