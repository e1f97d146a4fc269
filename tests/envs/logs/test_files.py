"""Logs: what was written is read, in the model's units and axes; what is damaged is refused by file, row and column."""

import dataclasses

import numpy as np
import pytest
import yaml

from envs import logs

JOINTS = ["hip", "knee"]
META = {
    "robot": "biteno",
    "base": "fixed",
    "rate_hz": 100,
    "joints": JOINTS,
    "controller": {"type": "pd", "kp": 60.0, "kd": [2.0, 1.0], "rate_hz": 1000, "torque_limit_nm": 60.0},
}
ROWS = 5


def columns():
    """Five rows in which every number is another."""
    names = ["t", *(f"{signal}.{joint}" for signal in ("q", "dq", "target", "tau") for joint in JOINTS)]
    table = {name: np.arange(ROWS) + 10.0 * place for place, name in enumerate(names)}
    table["t"] = 0.01 * np.arange(ROWS)
    return table


def put(folder, table=None, meta=(), name="run_000.csv"):
    """Writes a log by hand; a value of None in `meta` takes the key out."""
    folder.mkdir(exist_ok=True)
    merged = {key: value for key, value in {**META, **dict(meta)}.items() if value is not None}
    (folder / "meta.yaml").write_text(yaml.safe_dump(merged))
    table = columns() if table is None else table
    if name.endswith(".npz"):
        np.savez(folder / name, **table)
    else:
        cells = [[x if isinstance(x, str) else repr(float(x)) for x in column] for column in table.values()]
        lines = [",".join(table), *map(",".join, zip(*cells, strict=True))]
        (folder / name).write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("name", ["run_000.csv", "run_000.npz"])
def test_a_log_is_read_as_it_is(tmp_path, name):
    log = logs.read(put(tmp_path / "log", name=name))
    (run,) = log.runs
    table = columns()
    assert (log.robot, log.base, log.rate_hz, log.joints) == ("biteno", "fixed", 100.0, ("hip", "knee"))
    assert (run.name, run.condition, run.split) == ("run_000", "run_000", None)
    np.testing.assert_array_equal(run.time, table["t"])
    assert run.signals.keys() == {"q", "dq", "target", "tau"}
    for signal, values in run.signals.items():
        np.testing.assert_array_equal(values, np.stack([table[f"{signal}.{joint}"] for joint in JOINTS], axis=1))
    np.testing.assert_array_equal(run.controller.gains["kp"], [60.0, 60.0])
    np.testing.assert_array_equal(run.controller.gains["kd"], [2.0, 1.0])


def test_units_signs_and_names_become_the_models(tmp_path):
    table = {("seconds" if name == "t" else name): values for name, values in columns().items()}
    meta = {"units": {"angle": "deg", "torque": "mNm"}, "sign": {"knee": -1}, "columns": {"t": "seconds"}}
    (run,) = logs.read(put(tmp_path / "log", table, meta)).runs
    plain = columns()
    for signal, factor in {"q": np.pi / 180, "dq": np.pi / 180, "target": np.pi / 180, "tau": 1e-3}.items():
        expected = factor * np.stack([plain[f"{signal}.hip"], -plain[f"{signal}.knee"]], axis=1)
        np.testing.assert_allclose(run.signals[signal], expected, rtol=1e-12)


def test_a_run_may_have_its_own_condition_split_and_gains(tmp_path):
    put(tmp_path / "log", name="run_001.npz")
    said = {"condition": "soft", "split": "sealed", "controller": {"kp": 30.0}}
    first, second = logs.read(put(tmp_path / "log", meta={"runs": {"run_001": said}})).runs
    assert (first.name, first.condition, first.split) == ("run_000", "run_000", None)
    assert (second.name, second.condition, second.split) == ("run_001", "soft", "sealed")
    np.testing.assert_array_equal(first.controller.gains["kp"], [60.0, 60.0])
    np.testing.assert_array_equal(second.controller.gains["kp"], [30.0, 30.0])
    np.testing.assert_array_equal(second.controller.gains["kd"], [2.0, 1.0])


def test_columns_that_nobody_knows_are_kept(tmp_path):
    (run,) = logs.read(put(tmp_path / "log", columns() | {"temperature": np.full(ROWS, 30.5)})).runs
    np.testing.assert_array_equal(run.other["temperature"], np.full(ROWS, 30.5))


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_what_was_written_is_read(tmp_path, suffix):
    extra = {f"quat.{part}": np.full(ROWS, 0.5) for part in "wxyz"}
    extra |= {"phase.left": np.linspace(0, 0.9, ROWS), "phase.right": np.linspace(0, 0.9, ROWS)[::-1]}
    extra |= {"enabled": np.array([1.0, 1, 0, 0, 1]), "noise": np.array([1e-17, 1 / 3, 2.0**0.5, -1e30, 0.1])}
    meta = {"policy": {"rate_hz": 100, "action_scale": 0.25, "base": "stand"}, "runs": {"run_000": {"split": "train"}}}
    log = logs.read(put(tmp_path / "log", columns() | extra, meta))
    logs.write(log, tmp_path / "again", suffix)
    again = logs.read(tmp_path / "again")
    assert dataclasses.replace(again, runs=()) == dataclasses.replace(log, runs=())
    for one, other in zip(log.runs, again.runs, strict=True):
        assert (one.name, one.condition, one.split) == (other.name, other.condition, other.split)
        np.testing.assert_array_equal(one.time, other.time)
        for mine, theirs in ((one.signals, other.signals), (one.other, other.other)):
            assert mine.keys() == theirs.keys()
            for name in mine:
                np.testing.assert_array_equal(mine[name], theirs[name])
        for name, gain in one.controller.gains.items():
            np.testing.assert_array_equal(gain, other.controller.gains[name])


def test_a_folder_in_use_is_not_written_to(tmp_path):
    log = logs.read(put(tmp_path / "log"))
    with pytest.raises(ValueError, match="expected an empty folder"):
        logs.write(log, tmp_path / "log")


@pytest.mark.parametrize(
    ("meta", "named"),
    [
        ({"robot": None}, "robot: is missing"),
        ({"robot": "../nothing.xml"}, r"robot: got '../nothing\.xml', expected biteno"),
        ({"base": "floating"}, "base: got 'floating', expected one of fixed, free"),
        ({"rate_hz": 0}, "rate_hz: got 0, expected a positive"),
        ({"rate_hz": True}, "rate_hz: got True"),
        ({"rate_hz": float("nan")}, "rate_hz: got nan"),
        ({"rate_hz": 1000}, "column 't': got 100 rows a second, expected rate_hz, 1000"),
        ({"joints": []}, "joints: got \\[\\]"),
        ({"joints": ["hip", "hip"]}, "joints: .*names that differ"),
        ({"joints": ["hip", 3]}, "joints: got 3, expected a text"),
        ({"controller": {"type": "pid"}}, "controller.type: got 'pid', expected one of pd, servo"),
        ({"controller": {"type": ["pd"]}}, r"controller.type: got \['pd'\]"),
        ({"controller": {"type": "pd", "kp": 1, "rate_hz": 100}}, "controller.kd: is missing"),
        ({"controller": {"type": "pd", "kp": -1, "kd": 0, "rate_hz": 100}}, "controller.kp: got -1"),
        ({"controller": {"type": "pd", "kp": [1], "kd": 0, "rate_hz": 100}}, r"controller.kp: got \[1\], .* or 2"),
        ({"controller": {"type": "pd", "kp": 1, "kd": 0, "ki": 0, "rate_hz": 100}}, "controller.ki: .*kp"),
        ({"sign": {"hip": 2}}, "sign.hip: got 2, expected one of 1, -1"),
        ({"sign": {"hipp": -1}}, "sign.hipp: there is no such key; did you mean 'hip'"),
        ({"units": {"angle": "grad"}}, "units.angle: got 'grad', expected one of rad, deg"),
        ({"columns": {"q.hip": "theta"}}, "column 'theta': is missing"),
        ({"columns": {"q.elbow": "theta"}}, r"columns.q.elbow: there is no such key"),
        ({"columns": {"q.hip": "q.knee", "q.knee": "q.knee"}}, "columns: got .*expected theirs that differ"),
        ({"rate": 5}, "rate: there is no such key; did you mean 'rate_hz'"),
        ({"runs": {"run_007": {}}}, "runs.run_007: there is no such run; found run_000"),
        ({"runs": {"run_000": {"split": "test"}}}, "runs.run_000.split: got 'test', expected one of train"),
        ({"runs": {"run_000": {"spilt": "train"}}}, "runs.run_000.spilt: .*did you mean 'split'"),
        ({"runs": ["run_000"]}, "runs: got .*expected a mapping"),
    ],
)
def test_bad_meta_is_named(tmp_path, meta, named):
    with pytest.raises(ValueError, match=named):
        logs.read(put(tmp_path / "log", meta=meta))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("robot: [", "meta.yaml"),
        ("- robot", "the file: got"),
        ("robot: biteno\nrobot: biteno\n", "'robot' is there twice"),
        ("robot: !!python/object/apply:os.getcwd []\n", "could not determine a constructor"),
    ],
)
def test_meta_that_is_no_meta_is_named(tmp_path, text, named):
    put(tmp_path / "log")
    (tmp_path / "log" / "meta.yaml").write_text(text)
    with pytest.raises(ValueError, match=named):
        logs.read(tmp_path / "log")


def cell(name, row, value):
    table = {key: list(values) for key, values in columns().items()}
    table[name][row - 1] = value
    return table


@pytest.mark.parametrize(
    ("table", "named"),
    [
        (cell("q.knee", 3, "abc"), "run_000.csv, row 3, column 'q.knee': got 'abc', expected a number"),
        (cell("q.knee", 3, ""), "row 3, column 'q.knee': got ''"),
        (cell("q.knee", 3, "1_0"), "row 3, column 'q.knee': got '1_0'"),
        (cell("q.hip", 5, "nan"), "row 5, column 'q.hip': got nan, expected a finite"),
        (cell("tau.hip", 1, "inf"), "row 1, column 'tau.hip': got inf"),
        (cell("t", 4, 0.02), "row 4, column 't': got 0.02, expected more than .*0.02"),
        (cell("t", 2, -1.0), "row 2, column 't': got -1.0"),
        ({k: v for k, v in columns().items() if k != "t"}, "column 't': is missing"),
        ({k: v for k, v in columns().items() if not k.startswith("q.")}, "column 'q.hip': is missing"),
        ({k: v for k, v in columns().items() if k != "dq.knee"}, "column 'dq.knee': is missing, where 'dq.hip'"),
        ({k: v for k, v in columns().items() if k[:2] != "ta"}, "neither 'target.hip' nor 'tau'"),
        (columns() | {"q.elbow": np.zeros(ROWS)}, "column 'q.elbow': is not known; expected q.hip, q.knee"),
        (columns() | {"enabled": np.array([1, 1, 0, 2, 1])}, "row 4, column 'enabled': got 2.0, expected 0 or 1"),
        (columns() | {"volts": np.array([7.0, 7, 7, 7, -7])}, "row 5, column 'volts'"),
        (columns() | {"phase.left": np.full(ROWS, 1.5), "phase.right": np.zeros(ROWS)}, "column 'phase.left': got 1.5"),
        (columns() | {f"gravity.{axis}": np.full(ROWS, 0.1) for axis in "xyz"}, r"row 1, column 'gravity\.\*'"),
        ({k: v[:1] for k, v in columns().items()}, "got 1 row"),
    ],
)
def test_bad_rows_are_named(tmp_path, table, named):
    with pytest.raises(ValueError, match=named):
        logs.read(put(tmp_path / "log", table))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "is empty"),
        ("t,q.hip,q.hip\n0,1,2\n", "column 'q.hip': expected a name that is there once"),
        ("t,q.hip,\n0,1,2\n", "column ''"),
        ("t,q.hip\n0,1\n0.01,2,3\n", "row 2: got 3 cells, expected 2"),
        ("t,q.hip\n0,1\n0.01\n", "row 2: got 1 cells, expected 2"),
        ('t,q.hip\n0,"1\n', "row 1: unexpected end of data"),
    ],
)
def test_a_damaged_csv_is_named(tmp_path, text, named):
    put(tmp_path / "log")
    (tmp_path / "log" / "run_000.csv").write_text(text)
    with pytest.raises(ValueError, match=named):
        logs.read(tmp_path / "log")


def test_a_damaged_npz_is_named(tmp_path):
    path = put(tmp_path / "log", name="run_000.npz") / "run_000.npz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"run_000\.npz"):
        logs.read(tmp_path / "log")
    np.savez(path, **columns() | {"q.hip": np.zeros(3)})
    with pytest.raises(ValueError, match=r"column 'q\.hip': got 3 rows, expected 5"):
        logs.read(tmp_path / "log")
    np.savez(path, **columns() | {"q.hip": np.array([object()] * ROWS)})
    with pytest.raises(ValueError, match="allow_pickle"):
        logs.read(tmp_path / "log")


def test_what_is_no_log_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"meta\.yaml: there is no such file"):
        logs.read(tmp_path)
    (put(tmp_path / "log") / "run_000.csv").unlink()
    with pytest.raises(ValueError, match="no runs"):
        logs.read(tmp_path / "log")
    put(tmp_path / "log")
    put(tmp_path / "log", name="run_000.npz")
    with pytest.raises(ValueError, match="'run_000' is there twice"):
        logs.read(tmp_path / "log")


def many(tmp_path, said):
    for index in range(len(said)):
        put(tmp_path / "log", name=f"run_{index:03d}.csv")
    return logs.read(put(tmp_path / "log", meta={"runs": {f"run_{i:03d}": entry for i, entry in enumerate(said)}}))


def test_splits_keep_conditions_together(tmp_path):
    log = many(tmp_path, [{"condition": name} for name in "aabbccdd"])
    chosen = logs.splits(log)
    held = [{run.condition for run in runs} for runs in chosen.values()]
    assert set.union(*held) == set("abcd")
    assert sum(map(len, held)) == 4
    assert sum(map(len, chosen.values())) == 8
    assert len(held[0]) == 2


def test_splits_are_what_the_log_says_where_it_does(tmp_path):
    said = [{"condition": "a", "split": "sealed"}, {"condition": "b", "split": "train"}, {"condition": "c"}]
    with pytest.raises(ValueError, match="no run is left for 'select'"):
        logs.splits(many(tmp_path, said))
    said[2]["split"] = "select"
    chosen = logs.splits(many(tmp_path, said))
    assert {split: runs[0].condition for split, runs in chosen.items()} == {"train": "b", "select": "c", "sealed": "a"}


def test_too_few_conditions_to_split_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"2 run\(s\) of conditions a, b, expected three"):
        logs.splits(many(tmp_path, [{"condition": "a"}, {"condition": "b"}]))
