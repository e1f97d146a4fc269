"""Commands that are killed at any moment end, given again, as if they had not been: real processes, real kills."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from experiments.discovery.field.bench import FieldBench

ROOT = Path(__file__).parents[2]
ROBOT = f"{ROOT / 'tests' / 'sled.py'}:simulator"
# A checkpoint after every chunk of updates, not every minute.
TRAIN = "from experiments.walking import policies; policies._KEEP_S = 0.0; from experiments import train as command"
SIM2SIM = "from experiments import sim2sim as command"
SIM2REAL = "from experiments import sim2real as command"
DISCOVER = "from experiments import discover as command"
STUB = "from experiments import robot_stub as command"


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Programs are compiled once for all processes of this file."""
    return {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("cache"))}


def start(imports, options, environment):
    code = f"import sys; {imports}; from experiments.common.cli import run; run(command.main, command.Args)"
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code, *options],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def end(process):
    error = process.communicate()[1].decode()
    assert process.returncode == 0, error


def killed(imports, options, environment, begun, kills, rng):
    """Runs a command, killed so many times at random once `begun` says that it works, and then to its end."""
    for _ in range(kills):
        process = start(imports, options, environment)
        while process.poll() is None and not begun():
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 2.0))
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    end(start(imports, options, environment))


def same(found, expected):
    """Whether two results are equal but for what depends on the clock."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for name in expected.keys() - {"seconds", "versions", "out", "args"}:
            same(found[name], expected[name])
    elif isinstance(expected, list):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            same(*pair)
    else:
        assert found == expected


def read(path):
    return json.loads(path.read_text())


def check_train(environment, tmp_path, kills, updates=60):
    options = ["--robot", ROBOT, "--preset", "smoke", "--updates", str(updates), "--out"]
    end(start(TRAIN, [*options, str(tmp_path / "whole")], environment))
    out = tmp_path / "killed"
    kept = out / "training" / "config.json"
    killed(TRAIN, [*options, str(out)], environment, kept.exists, kills, np.random.default_rng(kills))
    same(read(out / "curve.json"), read(tmp_path / "whole" / "curve.json"))
    ours, theirs = (read(place / "config.json") for place in (out, tmp_path / "whole"))
    assert ours["config"] == theirs["config"]
    assert not (out / "training").exists()
    # What it does is what the other does, to the last bit.
    export = "from experiments import export as command"
    networks = []
    for place in (out, tmp_path / "whole"):
        to = place / "exported"
        end(
            start(
                export, ["--robot", ROBOT, "--preset", "smoke", "--policy", str(place), "--out", str(to)], environment
            )
        )
        with np.load(to / "policy.npz", allow_pickle=False) as stored:
            networks.append({name: stored[name] for name in stored.files})
    for name, values in networks[0].items():
        np.testing.assert_array_equal(values, networks[1][name])


@pytest.mark.slow
def test_a_training_that_is_killed_five_times(environment, tmp_path):
    check_train(environment, tmp_path, kills=5, updates=120)


def test_a_training_that_is_killed_once(environment, tmp_path):
    check_train(environment, tmp_path, kills=1)


@pytest.mark.slow
def test_a_comparison_that_is_killed_five_times(environment, tmp_path):
    options = ["--preset", "smoke", "--methods", "ours", "spm", "--out"]
    end(start(SIM2SIM, [*options, str(tmp_path / "whole")], environment))
    out = tmp_path / "killed"
    begun = (out / "metrics.jsonl").exists
    killed(SIM2SIM, [*options, str(out)], environment, begun, 5, np.random.default_rng(5))
    same(read(out / "summary.json"), read(tmp_path / "whole" / "summary.json"))
    lines = [
        [json.loads(line) for line in (place / "metrics.jsonl").read_text().splitlines()]
        for place in (out, tmp_path / "whole")
    ]
    same(*lines)


@pytest.mark.slow
def test_a_transfer_that_is_killed_five_times(environment, tmp_path):
    options = ["--preset", "smoke", "--rounds", "2", "--walk-s", "0.8", "--force", "--timeout-s", "600", "--out"]
    robot = start(STUB, ["--folder", str(tmp_path)], environment)
    try:
        end(start(SIM2REAL, [*options, str(tmp_path / "whole")], environment))
        out = tmp_path / "killed"
        begun = (out / "round_000" / "prediction.json").exists
        killed(SIM2REAL, [*options, str(out)], environment, begun, 5, np.random.default_rng(5))
    finally:
        os.killpg(robot.pid, signal.SIGKILL)
        robot.communicate()
    same(read(out / "summary.json"), read(tmp_path / "whole" / "summary.json"))


@pytest.mark.slow
def test_a_discovery_that_is_killed_five_times(environment, tmp_path):
    bench = FieldBench(tmp_path / "bench", "field_smoke", 0, 0.1)
    log = bench.write(next(case for case in bench.cases if case.effects))
    options = ["--logs", str(log), "--trust-log", "--out"]
    end(start(DISCOVER, [*options, str(tmp_path / "whole")], environment))
    out = tmp_path / "killed"
    begun = (out / "state.json").exists
    killed(DISCOVER, [*options, str(out)], environment, begun, 5, np.random.default_rng(5))
    for name in ("summary.json", "details.json"):
        same(read(out / name), read(tmp_path / "whole" / name))
    for name in ("model.xml", "effects.json"):
        assert (out / "model" / name).read_text() == (tmp_path / "whole" / "model" / name).read_text()
