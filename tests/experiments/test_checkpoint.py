"""Files of a run survive a kill at any moment, a full disk and a flipped bit, or say what is wrong."""

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from faults import Killed, killed_at

from experiments.common import checkpoint, files
from experiments.common.config import PRESETS
from experiments.walking import policies
from experiments.walking.learner import Learner
from experiments.walking.robots import kind

ROBOT = f"{Path(__file__).parents[1] / 'sled.py'}:simulator"
CONFIG = {"hidden": [8]}


def state(value):
    return {"kernel": jnp.full((3, 2), value), "steps": jnp.asarray(7), "none": jnp.zeros((0,))}


def test_a_checkpoint_is_the_old_or_the_new_one_whenever_it_is_killed(monkeypatch, tmp_path):
    checkpoint.save(tmp_path, state(1.0), CONFIG)
    moment, found = 2, []
    while killed_at(monkeypatch, moment, lambda: checkpoint.save(tmp_path, state(2.0), CONFIG)):
        kernel = checkpoint.load(tmp_path, state(0.0), CONFIG)["kernel"]
        found.append(float(kernel[0, 0]))
        assert (kernel == found[-1]).all()
        # The next save finds what was left behind.
        checkpoint.save(tmp_path, state(1.0), CONFIG)
        assert len(list(tmp_path.glob("state*"))) == 1
        moment += 1
    assert set(found) == {1.0, 2.0}
    assert len(found) > 10
    assert checkpoint.load(tmp_path, state(0.0), CONFIG)["kernel"][0, 0] == 2.0


def test_a_state_of_other_shapes_is_refused(tmp_path):
    checkpoint.save(tmp_path, state(1.0), CONFIG)
    wider = state(0.0) | {"kernel": jnp.zeros((4, 2))}
    with pytest.raises(ValueError, match=r"\['kernel'\] has shape \(3, 2\) there, expected \(4, 2\)"):
        checkpoint.load(tmp_path, wider, CONFIG)


def test_json_is_the_old_or_the_new_one_whenever_it_is_killed(monkeypatch, tmp_path):
    path = tmp_path / "summary.json"
    files.write_json(path, {"value": 1})
    moment, found = 2, []
    while killed_at(monkeypatch, moment, lambda: files.write_json(path, {"value": 2})):
        found.append(files.read_json(path)["value"])
        moment += 1
    # Killed before and after: the draft's fsync, the renaming, the folder's fsync.
    assert found == [1, 1, 1, 2, 2, 2]


def test_a_full_disk_leaves_the_old_file_and_no_draft(monkeypatch, tmp_path):
    path = tmp_path / "summary.json"
    files.write_json(path, {"value": 1})

    def full(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        files.write_json(path, {"value": 2})
    assert files.read_json(path) == {"value": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_a_state_that_does_not_fit_on_the_disk_is_not_begun(monkeypatch, tmp_path):
    checkpoint.save(tmp_path, state(1.0), CONFIG)
    before = sorted(path.name for path in tmp_path.iterdir())
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=30))
    with pytest.raises(OSError, match=r"No space left on device: .*state_2") as refused:
        checkpoint.save(tmp_path, state(2.0), CONFIG)
    assert refused.value.errno == errno.ENOSPC
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert (checkpoint.load(tmp_path, state(0.0), CONFIG)["kernel"] == 1.0).all()


def test_a_flipped_bit_anywhere_in_a_checkpoint_is_noticed(tmp_path):
    checkpoint.save(tmp_path, state(1.0), CONFIG)
    saved = [path for path in (tmp_path / "state_1").rglob("*") if path.is_file() and path.stat().st_size]
    assert len(saved) > 3
    for path in saved:
        content = path.read_bytes()
        path.write_bytes(bytes([content[0] ^ 4]) + content[1:])
        with pytest.raises(ValueError, match="is damaged: its checksum"):
            checkpoint.load(tmp_path, state(0.0), CONFIG)
        path.write_bytes(content)
    assert checkpoint.load(tmp_path, state(0.0), CONFIG)["kernel"][0, 0] == 1.0
    shutil.rmtree(tmp_path / "state_1")
    with pytest.raises(ValueError, match="is damaged"):
        checkpoint.load(tmp_path, state(0.0), CONFIG)


@pytest.mark.parametrize("content", ["", "{", '{"config": nothing}', "[]"])
def test_an_emptied_or_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "config.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"config.json: is damaged: "):
        checkpoint.open_run(tmp_path, CONFIG)


def test_what_others_keep_in_the_folder_stays(tmp_path):
    (tmp_path / "statements").mkdir()
    (tmp_path / "state.json").write_text("{}")
    checkpoint.save(tmp_path, state(1.0), CONFIG)
    checkpoint.save(tmp_path, state(2.0), CONFIG)
    assert {path.name for path in tmp_path.iterdir()} == {"statements", "state.json", "state_2", "config.json"}


def test_a_number_that_is_not_finite_is_named():
    checkpoint.check_finite("policy", state(1.0))
    broken = {"layers": [state(1.0), state(1.0) | {"kernel": jnp.array([1.0, jnp.nan])}]}
    with pytest.raises(ValueError, match=r"policy: got a number that is not finite in \['layers'\]\[1\]\['kernel'\]"):
        checkpoint.check_finite("policy", broken)


def test_a_checkpoint_of_the_first_version_is_read(tmp_path):
    checkpoint.save(tmp_path, state(3.0), CONFIG)
    (tmp_path / "state_1").rename(tmp_path / "state")
    (tmp_path / "config.json").write_text(json.dumps({"config": CONFIG, "versions": {}}))
    assert checkpoint.load(tmp_path, state(0.0), CONFIG)["kernel"][0, 0] == 3.0


# Two processes, and folders


def test_a_piece_has_one_process_until_that_one_ends(tmp_path):
    piece = tmp_path / "results" / "ours_0.json"
    holder = (
        f"from experiments.common import checkpoint as c; from pathlib import Path; import time\n"
        f"with c.lock(Path({str(piece)!r})): print('held', flush=True); time.sleep(600)"
    )
    process = subprocess.Popen([sys.executable, "-c", holder], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match=r"out: another process works on .*ours_0.json"), checkpoint.lock(piece):
            pass
        with checkpoint.lock(piece.with_name("spm_0.json")):
            pass
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    with checkpoint.lock(piece):
        pass


def test_of_two_runs_that_begin_at_once_one_is_refused(tmp_path):
    gate, outcomes = threading.Barrier(2), []

    def begin(seed):
        gate.wait()
        try:
            checkpoint.open_run(tmp_path / "run", {"seed": seed})
            outcomes.append(seed)
        except ValueError as error:
            outcomes.append(str(error))

    threads = [threading.Thread(target=begin, args=(seed,)) for seed in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (winner,) = [one for one in outcomes if isinstance(one, int)]
    (refused,) = [one for one in outcomes if isinstance(one, str)]
    assert f"config.seed is {winner} there, expected {1 - winner}" in refused
    checkpoint.open_run(tmp_path / "run", {"seed": winner})


def test_a_folder_that_cannot_be_is_refused_before_any_work(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(
            ValueError, match=r"out: got .*, where nothing can be written: (File exists|Not a directory)"
        ):
            checkpoint.open_run(out, CONFIG)
        with pytest.raises(ValueError, match="where nothing can be written"):
            policies.trained(jax.random.PRNGKey(0), None, 1, out)


# A training that was interrupted


@pytest.fixture(scope="module")
def learner():
    robot = kind(ROBOT)
    return Learner(replace(PRESETS["smoke"], chunk=1), robot.chosen("mass"), kind=robot)


@pytest.mark.slow
def test_a_training_that_was_killed_ends_as_if_it_had_not_been(learner, monkeypatch, tmp_path):
    key, updates = jax.random.PRNGKey(3), 4
    whole, curve = policies.trained(key, learner, updates, tmp_path / "whole")
    monkeypatch.setattr(policies, "_KEEP_S", 0.0)
    save, saved = checkpoint.save, []

    def save_and_die(path, *args):
        save(path, *args)
        saved.append(path)
        if len(saved) == 2:
            raise Killed

    monkeypatch.setattr(checkpoint, "save", save_and_die)
    out = tmp_path / "cut"
    with pytest.raises(Killed):
        policies.trained(key, learner, updates, out)
    assert not (out / "config.json").exists()
    with pytest.raises(ValueError, match=r"config.key"):
        policies.trained(jax.random.PRNGKey(4), learner, updates, out)
    with pytest.raises(ValueError, match=r"updates: got 1, but .*training holds a training of 2"):
        policies.trained(key, learner, 1, out)
    played = []
    train = learner.train
    monkeypatch.setattr(learner, "train", lambda *args: played.append(1) or train(*args))
    again, longer = policies.trained(key, learner, updates, out)
    # Compiled once, and two of four updates are left: saved twice in the training, once each, and at the end.
    assert len(saved) == 2 + 2 + 1
    for got, expected in zip(jax.tree.leaves(again), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(got, expected)
    drop = lambda lines: [{name: line[name] for name in line if name != "seconds"} for line in lines]  # noqa: E731
    assert drop(longer) == drop(curve)
    assert not (out / "training").exists()
    assert json.loads((out / "config.json").read_text())["state"] == "state_1"
