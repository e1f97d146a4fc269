"""Commands that are killed at any moment end, given again, as if they had not been: real processes, real kills."""

import contextlib
import json
import os
import signal
import time

import numpy as np
import pytest
from processes import DISCOVER, ROBOT, SIM2REAL, SIM2SIM, STUB, TRAIN, end, networks, read, same, start

from experiments.discovery.field.bench import FieldBench


def killed(imports, options, out, begun, kills, rng):
    """Runs a command, killed so many times at random, and then to its end.

    A kill comes after the file `begun` is there and something was written since the last one: not while it starts.
    """
    hits = 0
    for _ in range(kills):
        before = written(out)
        process = start(imports, options)
        while process.poll() is None and not (begun.exists() and written(out) != before):
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 2.0))
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            hits += 1
        process.communicate()
    # One that was quick may have come to its end.
    assert hits > 0
    end(start(imports, options))


def written(out):
    """When a file of a run was last written. Hidden ones are locks; what vanishes meanwhile is a draft."""
    times = [0]
    for folder, _, names in os.walk(out):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                times.append(0 if name.startswith(".") else os.stat(os.path.join(folder, name)).st_mtime_ns)
    return max(times)


def check_train(tmp_path, kills, updates=20):
    options = ["--robot", ROBOT, "--preset", "smoke", "--updates", str(updates), "--out"]
    end(start(TRAIN, [*options, str(tmp_path / "whole")]))
    out = tmp_path / "killed"
    kept = out / "training" / "config.json"
    killed(TRAIN, [*options, str(out)], out, kept, kills, np.random.default_rng(kills))
    same(read(out / "curve.json"), read(tmp_path / "whole" / "curve.json"))
    ours, theirs = (read(place / "config.json") for place in (out, tmp_path / "whole"))
    assert ours["config"] == theirs["config"]
    assert not (out / "training").exists()
    # What it does is what the other does, to the last bit.
    for ours, theirs in zip(networks(out), networks(tmp_path / "whole"), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_a_training_that_is_killed_five_times(tmp_path):
    check_train(tmp_path, kills=5, updates=120)


def test_a_training_that_is_killed_three_times(tmp_path):
    check_train(tmp_path, kills=3)


@pytest.mark.slow
def test_a_comparison_that_is_killed_five_times(tmp_path):
    options = ["--preset", "smoke", "--methods", "ours", "spm", "--out"]
    end(start(SIM2SIM, [*options, str(tmp_path / "whole")]))
    out = tmp_path / "killed"
    killed(SIM2SIM, [*options, str(out)], out, out / "metrics.jsonl", 5, np.random.default_rng(5))
    same(read(out / "summary.json"), read(tmp_path / "whole" / "summary.json"))
    lines = [
        [json.loads(line) for line in (place / "metrics.jsonl").read_text().splitlines()]
        for place in (out, tmp_path / "whole")
    ]
    same(*lines)


@pytest.mark.slow
def test_a_transfer_that_is_killed_five_times(tmp_path):
    options = ["--preset", "smoke", "--rounds", "2", "--walk-s", "0.8", "--force", "--timeout-s", "600", "--out"]
    robot = start(STUB, ["--folder", str(tmp_path)])
    try:
        end(start(SIM2REAL, [*options, str(tmp_path / "whole")]))
        out = tmp_path / "killed"
        begun = out / "round_000" / "prediction.json"
        killed(SIM2REAL, [*options, str(out)], out, begun, 5, np.random.default_rng(5))
    finally:
        os.killpg(robot.pid, signal.SIGKILL)
        robot.communicate()
    same(read(out / "summary.json"), read(tmp_path / "whole" / "summary.json"))


@pytest.mark.slow
def test_a_discovery_that_is_killed_five_times(tmp_path):
    bench = FieldBench(tmp_path / "bench", "field_smoke", 0, 0.1)
    log = bench.write(next(case for case in bench.cases if case.effects))
    options = ["--logs", str(log), "--trust-log", "--out"]
    end(start(DISCOVER, [*options, str(tmp_path / "whole")]))
    out = tmp_path / "killed"
    killed(DISCOVER, [*options, str(out)], out, out / "state.json", 5, np.random.default_rng(5))
    for name in ("summary.json", "details.json"):
        same(read(out / name), read(tmp_path / "whole" / name))
    for name in ("model.xml", "effects.json"):
        assert (out / "model" / name).read_text() == (tmp_path / "whole" / "model" / name).read_text()
