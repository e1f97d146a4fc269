"""The servo's recordings become a log."""

import json
from pathlib import Path

import numpy as np
import pytest

from envs import logs
from envs.logs.xl330 import read_xl330

MEASURED = Path(__file__).parents[4] / "shared" / "data" / "xl330_pendulum"


def recording(rows=4, **header):
    entries = [
        {
            "position": 0.1 * row,
            "speed": 1.0,
            "load": 5,
            "input_volts": 7.4,
            "temp": 28,
            "timestamp": 0.005 * row,
            "goal_position": 0.2 * row,
            "torque_enable": row < 3,
        }
        for row in range(rows)
    ]
    return {"mass": 0.49, "length": 0.1, "kp": 400, "vin": 7.4, "trajectory": "sin_sin", "entries": entries} | header


def put(folder, content):
    (folder / "a.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return folder


def test_a_recording_becomes_a_run(tmp_path):
    (run,) = read_xl330(put(tmp_path, recording())).runs
    assert (run.name, run.condition, run.split) == ("run_kp400_sin_sin", "kp400", "sealed")
    np.testing.assert_allclose(run.signals["q"], [[0.0], [0.1], [0.2], [0.3]])
    np.testing.assert_array_equal(run.signals["enabled"], [1.0, 1.0, 1.0, 0.0])
    # 4096 / 2 pi counts a radian x 400 / (256 x 885).
    np.testing.assert_allclose(run.controller.gains["gain"], [1.15096], rtol=1e-5)


def test_a_written_recording_is_a_log(tmp_path):
    (tmp_path / "raw").mkdir()
    log = read_xl330(put(tmp_path / "raw", recording(kp=100)))
    logs.write(log, tmp_path / "log")
    (run,) = logs.read(tmp_path / "log").runs
    np.testing.assert_array_equal(run.signals["q"], log.runs[0].signals["q"])
    assert run.split == "train"


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("{", "a.json: JSONDecodeError"),
        ("[]", "a.json: TypeError"),
        (recording(mass=0.6), "mass: got 0.6, expected 0.49"),
        ({"mass": 0.49}, "KeyError: 'kp'"),
        (recording(entries=[{"timestamp": 0.0}] * 2), "row 1, key 'position': got None"),
        (
            recording(entries=recording()["entries"][::-1]),
            "row 2, column 'timestamp': got 0.01, expected more than 0.015",
        ),
        (recording(entries=[]), "entries: got 0"),
        (recording(entries=5), "entries: got 5, expected list"),
        (recording(entries=[1, 2]), "row 1, key 'timestamp': got None"),
        (recording(kp="400"), "kp: got '400', expected int"),
        (recording(kp=None), "kp: got None"),
        (recording(trajectory=3), "trajectory: got 3, expected str"),
    ],
)
def test_bad_recordings_are_named(tmp_path, content, named):
    with pytest.raises(ValueError, match=named):
        read_xl330(put(tmp_path, content))


def test_two_recordings_of_one_name_are_named(tmp_path):
    (put(tmp_path, recording()) / "b.json").write_text(json.dumps(recording()))
    with pytest.raises(ValueError, match="'run_kp400_sin_sin' is there twice"):
        read_xl330(tmp_path)


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"no \*\.json"):
        read_xl330(tmp_path)


@pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured data are not part of the repository")
def test_the_measured_runs_are_read_and_split():
    log = read_xl330(MEASURED)
    assert len(log.runs) == 16
    chosen = logs.splits(log)
    assert {split: sorted({run.condition for run in runs}) for split, runs in chosen.items()} == {
        "train": ["kp100", "kp800"],
        "select": ["kp200"],
        "sealed": ["kp400"],
    }
    for run in log.runs:
        assert 150 < 1 / np.median(np.diff(run.time)) < 300
        assert np.abs(run.signals["q"]).max() < 2 * np.pi
