"""Logs: what was written is read, in the model's units and axes; what is damaged is refused by file, row and column."""

import dataclasses
import os
import zipfile
from types import SimpleNamespace

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import yaml

from envs import logs
from envs.logs import containment

JOINTS = ["left_hip", "left_knee"]
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
    elif name.endswith(".parquet"):
        pyarrow.parquet.write_table(pyarrow.table(table), folder / name)
    else:
        cells = [[x if isinstance(x, str) else repr(float(x)) for x in column] for column in table.values()]
        lines = [",".join(table), *map(",".join, zip(*cells, strict=True))]
        (folder / name).write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("written", ["6e-05", "6E-5", "+6e-5", "0.6e-4", "6.0e-05"])
def test_a_small_number_is_one_as_python_and_json_write_it(tmp_path, written):
    meta = put(tmp_path, meta={"signals": {"q": {"noise_sd": "SMALL"}}}) / "meta.yaml"
    meta.write_text(meta.read_text().replace("SMALL", written))
    np.testing.assert_allclose(logs.read(tmp_path).runs[0].fact("q", "noise_sd"), 6e-5)


@pytest.mark.parametrize("name", ["run_000.csv", "run_000.npz"])
def test_a_log_is_read_as_it_is(tmp_path, name):
    log = logs.read(put(tmp_path / "log", name=name))
    (run,) = log.runs
    table = columns()
    assert (log.robot, log.base, log.rate_hz, log.joints) == ("biteno", "fixed", 100.0, ("left_hip", "left_knee"))
    assert (run.name, run.condition, run.split) == ("run_000", "run_000", None)
    np.testing.assert_array_equal(run.time, table["t"])
    assert run.signals.keys() == {"q", "dq", "target", "tau"}
    for signal, values in run.signals.items():
        np.testing.assert_array_equal(values, np.stack([table[f"{signal}.{joint}"] for joint in JOINTS], axis=1))
    np.testing.assert_array_equal(run.controller.gains["kp"], [60.0, 60.0])
    np.testing.assert_array_equal(run.controller.gains["kd"], [2.0, 1.0])


def test_units_signs_and_names_become_the_models(tmp_path):
    table = {("seconds" if name == "t" else name): values for name, values in columns().items()}
    meta = {"units": {"angle": "deg", "torque": "mNm"}, "sign": {"left_knee": -1}, "columns": {"t": "seconds"}}
    (run,) = logs.read(put(tmp_path / "log", table, meta)).runs
    plain = columns()
    for signal, factor in {"q": np.pi / 180, "dq": np.pi / 180, "target": np.pi / 180, "tau": 1e-3}.items():
        expected = factor * np.stack([plain[f"{signal}.left_hip"], -plain[f"{signal}.left_knee"]], axis=1)
        np.testing.assert_allclose(run.signals[signal], expected, rtol=1e-12)


def test_slide_joints_are_in_metres_whatever_the_unit_of_angles(tmp_path):
    folder = put(tmp_path / "log", meta={"robot": "arm.xml", "units": {"angle": "deg"}})
    (folder / "arm.xml").write_text(
        """<mujoco><worldbody><body><joint name="left_hip" type="slide"/><geom size=".1"/>
        <body><joint name="left_knee"/><geom size=".1"/></body></body></worldbody></mujoco>"""
    )
    (run,) = logs.read(folder).runs
    for signal in ("q", "dq", "target"):
        expected = np.stack([columns()[f"{signal}.{joint}"] for joint in JOINTS], axis=1) * [1.0, np.pi / 180]
        np.testing.assert_allclose(run.signals[signal], expected, rtol=1e-12)


def test_time_stamps_of_a_wall_clock_begin_at_zero(tmp_path):
    (run,) = logs.read(put(tmp_path / "log", columns() | {"t": 1.7e9 + columns()["t"]})).runs
    np.testing.assert_allclose(run.time, columns()["t"], atol=2.5e-7)
    (run,) = logs.read(put(tmp_path / "log", columns() | {"t": 5.0 + columns()["t"]})).runs
    np.testing.assert_array_equal(run.time, 5.0 + columns()["t"])


def test_swapped_columns_are_swapped_back(tmp_path):
    meta = {"columns": {"q.left_hip": "q.left_knee", "q.left_knee": "q.left_hip"}}
    (run,) = logs.read(put(tmp_path / "log", meta=meta)).runs
    np.testing.assert_array_equal(run.signals["q"][:, 0], columns()["q.left_knee"])
    np.testing.assert_array_equal(run.signals["q"][:, 1], columns()["q.left_hip"])


def test_an_error_names_the_column_as_the_file_does(tmp_path):
    table = columns() | {"time": columns()["t"][::-1]}
    del table["t"]
    with pytest.raises(ValueError, match=r"column 'time': got 0\.03, expected more than 0\.04"):
        logs.read(put(tmp_path / "log", table, {"columns": {"t": "time"}}))


def test_a_robot_may_be_any_mjcf_with_hinges_or_slides(tmp_path):
    arm = """<mujoco><worldbody><body><freejoint name="free"/><geom size=".1"/>
      <body><joint name="left_hip"/><geom size=".1"/><body><joint name="left_knee" type="slide"/><geom size=".1"/>
      </body></body></body></worldbody></mujoco>"""
    folder = put(tmp_path / "log", meta={"robot": "arm.xml"})
    (folder / "arm.xml").write_text(arm)
    assert logs.read(folder).robot == str(folder / "arm.xml")
    with pytest.raises(ValueError, match="has no 'free'; expected left_hip, left_knee"):
        logs.read(put(folder, meta={"robot": "arm.xml", "joints": ["left_hip", "free"]}))
    # A model that the user names may be anywhere.
    (folder / "arm.xml").rename(tmp_path / "elsewhere.xml")
    assert logs.read(put(folder), model=tmp_path / "elsewhere.xml").robot == str(tmp_path / "elsewhere.xml")


OUT = "leads out of the log's folder"


@pytest.mark.parametrize(
    "robot",
    ["../arm.xml", "sub/../../arm.xml", "{absolute}", "link.xml"],
    ids=["up", "down and up", "absolute", "link"],
)
def test_a_model_outside_the_logs_folder_is_refused(tmp_path, robot):
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    robot = robot.format(absolute=tmp_path / "arm.xml")
    folder = put(tmp_path / "log", meta={"robot": robot})
    (folder / "sub").mkdir()
    (folder / "link.xml").symlink_to(tmp_path / "arm.xml")
    with pytest.raises(ValueError, match=rf"meta.yaml: robot: got .*{OUT}.*, or a model that is named on the command"):
        logs.read(folder)


@pytest.mark.parametrize(
    "reference",
    [
        '<include file="../secret.xml"/>',
        '<include file="{absolute}"/>',
        '<include file="link.xml"/>',
        '<asset><mesh file="../secret.stl"/></asset>',
        '<compiler meshdir=".."/><asset><mesh file="secret.stl"/></asset>',
        '<compiler assetdir="/etc"/><asset><texture type="skybox" fileup="passwd"/></asset>',
        '<include file="inner.xml"/>',
        '<include xmlns="x" file="inner.xml"/>',
        '<asset><model name="it" file="inner.xml"/></asset>',
        '<include file="sub/inner.xml"/>',
        '<asset><mesh filename="../secret.stl"/></asset>',
    ],
    ids=[
        "include up",
        "include absolute",
        "include of a link",
        "mesh",
        "meshdir",
        "assetdir",
        "nested",
        "namespace",
        "attached model",
        "nested, in a folder",
        "as in URDF",
    ],
)
def test_files_that_a_logs_model_refers_to_are_in_the_logs_folder(tmp_path, reference):
    (tmp_path / "secret.xml").write_text("<mujoco/>")
    folder = put(tmp_path / "log", meta={"robot": "robot.xml"})
    (folder / "link.xml").symlink_to(tmp_path / "secret.xml")
    inner = '<mujoco><asset><hfield file="{up}secret.png"/></asset></mujoco>'
    (folder / "inner.xml").write_text(inner.format(up="../"))
    (folder / "sub").mkdir()
    (folder / "sub" / "inner.xml").write_text(inner.format(up="../../"))
    model = f"<mujoco>{reference.format(absolute=tmp_path / 'secret.xml')}</mujoco>"
    (folder / "robot.xml").write_text(model)
    with pytest.raises(ValueError, match=rf"robot: got .*{OUT}"):
        logs.read(folder)


@pytest.mark.parametrize(
    "reference",
    [
        '<include file="{pipe}"/>',
        '<asset><model name="it" file="{pipe}"/></asset>',
        '<asset><mesh file="{pipe}"/></asset>',
    ],
    ids=["include", "model", "mesh"],
)
def test_what_would_block_whoever_reads_it_is_not_opened(tmp_path, reference):
    folder = put(tmp_path / "log", meta={"robot": "robot.xml"})
    for pipe, refusal in ((tmp_path / "pipe.obj", OUT), (folder / "pipe.obj", "expected files and folders alone")):
        os.mkfifo(pipe)
        used = reference.format(pipe=os.path.relpath(pipe, folder))
        (folder / "inner.xml").write_text(f"<mujoco>{used if 'include' in used else ''}</mujoco>")
        (folder / "robot.xml").write_text(
            f'<mujoco><include file="inner.xml"/>{"" if "include" in used else used}</mujoco>'
        )
        with pytest.raises(ValueError, match=refusal):
            logs.read(folder)


def test_models_that_include_each_other_are_read_once(tmp_path):
    folder = put(tmp_path / "log", meta={"robot": "robot.xml"})
    for link in ("d", "e"):
        (folder / link).symlink_to(folder)
    (folder / "robot.xml").write_text('<mujoco><include file="d/robot.xml"/><include file="e/robot.xml"/></mujoco>')
    with pytest.raises(ValueError, match=r"robot.xml"):
        logs.read(folder)


def test_comments_that_mujoco_takes_are_taken(tmp_path):
    arm = """<mujoco><!-- ---- arm ---- --><worldbody><body><joint name="left_hip"/><geom size=".1"/>
      <body><joint name="left_knee"/><geom size=".1"/></body></body></worldbody></mujoco>"""
    folder = put(tmp_path / "log", meta={"robot": "robot.xml"})
    (folder / "robot.xml").write_text(arm)
    assert logs.read(folder).robot == str(folder / "robot.xml")
    (folder / "robot.xml").write_text(arm.replace("arm", '<include file="x.xml"/>'))
    with pytest.raises(ValueError, match=r"robot.xml: not well-formed"):
        logs.read(folder)


@pytest.mark.parametrize(
    "model",
    [
        r'<mujoco><include file="..\secret.xml"/></mujoco>',
        "<!DOCTYPE mujoco [<!ENTITY a \"<mujoco><include file='../secret.xml'/></mujoco>\">]><mujoco/>",
    ],
    ids=["backslash", "definition"],
)
def test_what_readers_of_xml_understand_differently_is_refused(tmp_path, model):
    (tmp_path / "secret.xml").write_text("<mujoco/>")
    folder = put(tmp_path / "log", meta={"robot": "robot.xml"})
    (folder / "robot.xml").write_text(model)
    with pytest.raises(ValueError, match=r"robot.xml: got '.*', expected neither backslashes nor definitions"):
        logs.read(folder)


def test_a_link_that_leads_in_a_circle_or_out_of_a_bag_is_refused(tmp_path):
    folder = put(tmp_path / "log")
    (folder / "hidden").mkdir()
    (tmp_path / "secret.db3").write_text("")
    (folder / "hidden" / "x.db3").symlink_to(tmp_path / "secret.db3")
    (folder / "hidden" / "metadata.yaml").write_text("")
    (folder / "run_001").symlink_to(folder / "hidden")
    with pytest.raises(ValueError, match=rf"runs: got .*x.db3, which {OUT}"):
        logs.read(folder)
    (folder / "run_001").unlink()
    (folder / "run_001.csv").symlink_to(folder / "run_001.csv")
    with pytest.raises(ValueError, match=r"run_001.csv"):
        logs.read(folder)


def test_a_model_may_have_files_in_other_folders_of_the_log(tmp_path):
    arm = """<mujoco><compiler meshdir="../meshes"/><include file="../parts/option.xml"/><worldbody>
      <body><joint name="left_hip"/><geom size=".1"/><body><joint name="left_knee"/><geom size=".1"/></body></body>
      </worldbody></mujoco>"""
    folder = put(tmp_path / "log", meta={"robot": "model/arm.xml"})
    for name, text in {"model/arm.xml": arm, "parts/option.xml": "<mujoco><option timestep='0.002'/></mujoco>"}.items():
        (folder / name).parent.mkdir()
        (folder / name).write_text(text)
    assert logs.read(folder).robot == str(folder / "model" / "arm.xml")


def test_a_run_that_is_a_link_out_of_the_folder_is_refused_unread(tmp_path):
    folder = put(tmp_path / "log")
    (tmp_path / "secret.csv").write_text("password\nhunter2\n")
    (folder / "run_001.csv").symlink_to(tmp_path / "secret.csv")
    with pytest.raises(ValueError, match=rf"runs: got .*run_001.csv, which {OUT}") as refused:
        logs.read(folder)
    assert "hunter2" not in str(refused.value)


def test_a_log_is_written_in_its_own_units_and_signs(tmp_path):
    meta = {"units": {"angle": "deg", "torque": "mNm"}, "sign": {"left_knee": -1}}
    facts = {"q": {"quantum": 0.5}, "tau": {"noise_sd": 3.0}}
    log = logs.read(put(tmp_path / "log", meta=meta | {"signals": facts}))
    logs.write(log, tmp_path / "again", ".npz")
    written = yaml.safe_load((tmp_path / "again" / "meta.yaml").read_text())
    assert {key: written[key] for key in meta} == meta
    # Noise and steps have the files' units, and no sign.
    assert written["signals"]["q.left_knee"]["quantum"] == pytest.approx(0.5)
    assert written["signals"]["tau.left_knee"]["noise_sd"] == pytest.approx(3.0)
    with np.load(tmp_path / "again" / "run_000.npz") as found:
        for name, values in columns().items():
            np.testing.assert_allclose(found[name], values, rtol=1e-12, err_msg=name)
    (one,), (other,) = log.runs, logs.read(tmp_path / "again").runs
    for signal, values in one.signals.items():
        np.testing.assert_allclose(other.signals[signal], values, rtol=1e-12)
        for fact in ("quantum", "noise_sd"):
            np.testing.assert_allclose(other.fact(signal, fact), one.fact(signal, fact), rtol=1e-12)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_a_small_file_that_fills_the_memory_is_refused(tmp_path, monkeypatch, suffix):
    folder = put(tmp_path / "log", name=f"run_001{suffix}")
    monkeypatch.setattr(containment, "LARGEST_BYTES", 100)
    with pytest.raises(ValueError, match=rf"run_001{suffix}: got .* GiB unpacked, expected at most"):
        logs.read(folder)


def test_a_csv_counts_by_its_cells(tmp_path, monkeypatch):
    """Its numbers have many digits, so it is smaller in memory than as a text."""
    table = {"t": 0.01 * np.arange(100)} | {f"{name}.left_hip": np.arange(100) / 3 for name in ("q", "target")}
    folder = put(tmp_path / "log", table, {"joints": ["left_hip"], "controller": META["controller"] | {"kd": 2.0}})
    cells = 8 * 3 * 101  # with the header's
    assert (folder / "run_000.csv").stat().st_size > cells
    monkeypatch.setattr(containment, "LARGEST_BYTES", cells)
    assert len(logs.read(folder).runs[0].time) == 100
    monkeypatch.setattr(containment, "LARGEST_BYTES", cells - 1)
    with pytest.raises(ValueError, match=r"run_000.csv: got .* GiB unpacked, expected at most"):
        logs.read(folder)


def test_texts_of_a_table_are_not_read(tmp_path, monkeypatch):
    """A dictionary of one long text may stand for gigabytes."""
    folder = put(tmp_path / "log", columns(), name="run_000.parquet")
    path, reader = folder / "run_000.parquet", pyarrow.parquet.ParquetFile
    texts, seen = pyarrow.array(["long" * 1000] * ROWS).dictionary_encode(), []
    pyarrow.parquet.write_table(pyarrow.parquet.read_table(path).append_column("note", texts), path)

    class Spy(reader):
        def iter_batches(self, **options):
            seen.extend(super().iter_batches(**options))
            return seen

    monkeypatch.setattr(pyarrow.parquet, "ParquetFile", Spy)
    assert len(logs.read(folder).runs[0].time) == ROWS
    assert "note" not in seen[0].schema.names
    # And no more rows than the footer says.
    footer = pyarrow.parquet.read_metadata(path)
    few = SimpleNamespace(
        schema=footer.schema,
        num_rows=ROWS - 1,
        num_columns=footer.num_columns,
        row_group=footer.row_group,
        num_row_groups=1,
    )
    monkeypatch.setattr(pyarrow.parquet, "read_metadata", lambda path: few)
    with pytest.raises(ValueError, match=r"run_000.parquet: got more rows than its footer says, 4"):
        logs.read(folder)


def test_a_table_of_equal_values_counts_unpacked(tmp_path, monkeypatch):
    folder = put(tmp_path / "log")
    path = folder / "run_001.parquet"
    pyarrow.parquet.write_table(pyarrow.table({"t": np.arange(100_000) / 100, "q.left_hip": np.zeros(100_000)}), path)
    rows = 2 * 8 * 100_000
    monkeypatch.setattr(containment, "LARGEST_BYTES", rows - 1)
    assert path.stat().st_size < rows / 1.5
    with pytest.raises(ValueError, match=r"run_001.parquet: got .* GiB unpacked"):
        logs.read(folder)


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
    put(tmp_path / "log", name="run_001.csv")
    put(tmp_path / "log", name="run_002.csv")
    # The second is limited otherwise, the third another kind.
    gains = {"type": "servo", "gain": 1.15, "kt": 0.38, "resistance_ohm": [3.6, 3.5], "rate_hz": 500}
    meta["runs"] |= {
        "run_001": {"controller": {"type": "pd", "kp": 1.0, "kd": 0.0, "rate_hz": 200}},
        "run_002": {"controller": gains, "condition": "servo"},
    }
    log = logs.read(put(tmp_path / "log", columns() | extra, meta))
    assert [run.controller.kind for run in log.runs] == ["pd", "pd", "servo"]
    assert np.isinf(log.runs[1].controller.gains["torque_limit_nm"]).all()
    logs.write(log, tmp_path / "again", suffix)
    again = logs.read(tmp_path / "again")
    assert dataclasses.replace(again, runs=()) == dataclasses.replace(log, runs=())
    for one, other in zip(log.runs, again.runs, strict=True):
        assert (one.controller.kind, one.controller.rate_hz) == (other.controller.kind, other.controller.rate_hz)
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
        ({"joints": ["left_hip", "left_hip"]}, "joints: .*names that differ"),
        ({"joints": ["left_hip", 3]}, "joints: got 3, expected a text"),
        ({"joints": ["left_hip", "left_elbow"]}, "joints: 'biteno' has no 'left_elbow'; expected left_abad, left_hip"),
        ({"robot": "meta.yaml"}, "robot: .*meta.yaml"),
        ({"rate_hz": 10**400}, "rate_hz: got 1000"),
        ({"units": {"angle": ["rad"]}}, r"units.angle: got \['rad'\]"),
        ({"policy": {"rate_hz": "fast"}}, "policy.rate_hz: got 'fast', expected a positive number"),
        ({"policy": {"action_scale": float("-inf")}}, "policy.action_scale: got -inf"),
        ({"policy": {"base": 3}}, "policy.base: got 3, expected a text"),
        ({"controller": {"type": "pid"}}, "controller.type: got 'pid', expected one of pd, servo"),
        ({"controller": {"type": ["pd"]}}, r"controller.type: got \['pd'\]"),
        ({"controller": {"type": "pd", "kp": 1, "rate_hz": 100}}, "controller.kd: is missing"),
        ({"controller": {"type": "pd", "kp": -1, "kd": 0, "rate_hz": 100}}, "controller.kp: got -1"),
        (
            {"controller": {"type": "pd", "kp": 1e290, "kd": 0, "rate_hz": 100}},
            "kp: got 1e.290, expected at most 1e.07",
        ),
        ({"controller": {"type": "pd", "kp": [1], "kd": 0, "rate_hz": 100}}, r"controller.kp: got \[1\], .* or 2"),
        ({"controller": {"type": "pd", "kp": 1, "kd": 0, "ki": 0, "rate_hz": 100}}, "controller.ki: .*kp"),
        ({"sign": {"left_hip": 2}}, "sign.left_hip: got 2, expected one of 1, -1"),
        ({"sign": {"left_hipp": -1}}, "sign.left_hipp: there is no such key; did you mean 'left_hip'"),
        ({"units": {"angle": "grad"}}, "units.angle: got 'grad', expected one of rad, deg"),
        ({"columns": {"q.left_hip": "theta"}}, "column 'theta': is missing"),
        ({"columns": {"q.left_elbow": "theta"}}, r"columns.q.left_elbow: there is no such key"),
        (
            {"columns": {"q.left_hip": "q.left_knee", "q.left_knee": "q.left_knee"}},
            "columns: got .*expected another column of the file for each name",
        ),
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
        ("robot: biteno\nrate_hz: !!int x\n", r"meta\.yaml: invalid literal"),
        ("robot: !!python/object/apply:os.getcwd []\n", "could not determine a constructor"),
    ],
)
def test_meta_that_is_no_meta_is_named(tmp_path, text, named):
    put(tmp_path / "log")
    (tmp_path / "log" / "meta.yaml").write_text(text)
    with pytest.raises(ValueError, match=named):
        logs.read(tmp_path / "log")


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"rate_hz": 1e12}, "meta.yaml: rate_hz: got 1000000000000.0, expected at most 100000"),
        ({"policy": {"rate_hz": 1e9}}, "policy.rate_hz: got 1000000000.0, expected at most 100000"),
        (
            {"controller": META["controller"] | {"rate_hz": 10**9}},
            "controller.rate_hz: got 1000000000, expected at most",
        ),
    ],
    ids=["rows", "policy", "controller"],
)
def test_a_rate_that_no_machine_has_is_refused(tmp_path, meta, message):
    with pytest.raises(ValueError, match=message):
        logs.read(put(tmp_path / "log", meta=meta))


def cell(name, row, value):
    table = {key: list(values) for key, values in columns().items()}
    table[name][row - 1] = value
    return table


@pytest.mark.parametrize(
    ("table", "named"),
    [
        (cell("q.left_knee", 3, "abc"), "run_000.csv, row 3, column 'q.left_knee': got 'abc', expected a number"),
        (cell("q.left_knee", 3, ""), "row 3, column 'q.left_knee': got ''"),
        (cell("q.left_knee", 3, "1_0"), "row 3, column 'q.left_knee': got '1_0'"),
        (cell("q.left_hip", 5, "nan"), "row 5, column 'q.left_hip': got nan, expected a finite"),
        (cell("tau.left_hip", 1, "inf"), "row 1, column 'tau.left_hip': got inf"),
        (cell("t", 4, 0.02), "row 4, column 't': got 0.02, expected more than 0.02 in"),
        (cell("t", 2, -1.0), "row 2, column 't': got -1.0"),
        ({k: v for k, v in columns().items() if k != "t"}, "column 't': is missing"),
        ({k: v for k, v in columns().items() if not k.startswith("q.")}, "column 'q.left_hip': is missing"),
        (
            {k: v for k, v in columns().items() if k != "dq.left_knee"},
            "column 'dq.left_knee': is missing, although 'dq.left_hip' is there",
        ),
        ({k: v for k, v in columns().items() if k[:2] != "ta"}, "neither 'target.left_hip' nor 'tau'"),
        (
            columns() | {"q.left_elbow": np.zeros(ROWS)},
            "column 'q.left_elbow': is not known; expected q.left_hip, q.left_knee",
        ),
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
        ("t,q.left_hip,q.left_hip\n0,1,2\n", "column 'q.left_hip': expected a name that is there once"),
        ("t,q.left_hip,\n0,1,2\n", "column ''"),
        ("t,q.left_hip\n0,1\n0.01,2,3\n", "row 2: got 3 cells, expected 2"),
        ("t,q.left_hip\n0,1\n\n0.02,2\n", "row 2: got 0 cells, expected 2"),
        ("t,q.left_hip\n0,1\n0.01\n", "row 2: got 1 cells, expected 2"),
        ('t,q.left_hip\n0,"1\n', "row 1: unexpected end of data"),
        ("t;q.left_hip\n0;1\n", "got columns between semicolons or tabs, expected commas"),
        ("t, t \n0,1\n", "column 't': expected a name that is there once"),
    ],
)
def test_a_damaged_csv_is_named(tmp_path, text, named):
    put(tmp_path / "log")
    (tmp_path / "log" / "run_000.csv").write_text(text)
    with pytest.raises(ValueError, match=named):
        logs.read(tmp_path / "log")


@pytest.mark.parametrize("more", ["", "note"])
def test_names_of_columns_may_have_spaces_around_them(tmp_path, more):
    table = columns() | ({more: ["walks"] * ROWS} if more else {})
    spaced = {f" {name}  ": values for name, values in table.items()}
    found, wanted = (logs.read(put(tmp_path / name, each)) for name, each in {"a": spaced, "b": columns()}.items())
    for name, values in wanted.runs[0].signals.items():
        np.testing.assert_array_equal(found.runs[0].signals[name], values)


def test_broken_yaml_is_said_in_a_line(tmp_path):
    put(tmp_path / "log")
    (tmp_path / "log" / "meta.yaml").write_text("robot: biteno\njoints: [a\nbase: fixed\n")
    with pytest.raises(ValueError, match="expected ',' or ']'") as error:
        logs.read(tmp_path / "log")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
@pytest.mark.parametrize("bad", ["walking", "nan"])
def test_columns_that_nobody_uses_may_hold_what_they_like(tmp_path, suffix, bad):
    values = np.array(["1.0"] * (ROWS - 1) + [bad])
    if bad == "nan" and suffix != ".csv":
        values = values.astype(float)
    table, name = {"state": values} | columns() | {"fault": np.arange(ROWS)}, f"run_000{suffix}"
    folder = put(tmp_path / "log", table, name=name)
    log = logs.read(folder)
    np.testing.assert_array_equal(log.runs[0].other["fault"], np.arange(ROWS))
    assert "state" not in log.runs[0].other
    assert log.notes == ("run_000: column 'state' was left out: it is not known, and not one finite number a row",)
    # One of the format's names is no such column, however it is written.
    with pytest.raises(ValueError, match="column 'Enabled'"):
        logs.read(put(folder, table | {"Enabled": values}, name=name))


@pytest.mark.parametrize("name", ["reward", " enabled", "enable", "q.left_hip "])
def test_what_is_used_or_misspelt_is_not_left_out(tmp_path, name):
    with pytest.raises(ValueError, match=f"column '{name.strip()}'"):
        logs.read(put(tmp_path / "log", columns() | {name: np.array(["1.0"] * (ROWS - 1) + ["nan"])}))


def test_arrays_of_another_length_are_left_out_where_nobody_uses_them(tmp_path):
    folder = put(tmp_path / "log", name="run_000.npz")
    others = {"images": np.zeros((3, 4)), "stamps": np.zeros(ROWS + 1), "info": np.array([{"robot": 1}] * ROWS)}
    np.savez(folder / "run_000.npz", **others, **columns())
    log = logs.read(folder)
    assert not log.runs[0].other
    assert [name in note for name, note in zip(others, log.notes, strict=True)] == [True] * 3


def test_a_damaged_npz_is_named(tmp_path):
    path = put(tmp_path / "log", name="run_000.npz") / "run_000.npz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"run_000\.npz"):
        logs.read(tmp_path / "log")
    np.savez(path, **columns() | {"q.left_hip": np.zeros(3)})
    with pytest.raises(ValueError, match=r"column 'q\.left_hip': got 3 rows, expected 5"):
        logs.read(tmp_path / "log")
    np.savez(path, **columns() | {"q.left_hip": np.array([object()] * ROWS)})
    with pytest.raises(ValueError, match="allow_pickle"):
        logs.read(tmp_path / "log")


def test_a_short_file_of_billions_of_values_is_refused_in_a_line(tmp_path):
    lines = ["robot:", "  - &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"  - &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]" for level in range(1, 10)]
    path = put(tmp_path / "log", meta={"robot": None}) / "meta.yaml"
    path.write_text("\n".join([*lines, path.read_text()]))
    with pytest.raises(ValueError, match=r"robot: got .*expected a text") as error:
        logs.read(path.parent)
    assert len(str(error.value)) < 1000


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
    (tmp_path / "log" / "run_000.npz").rename(tmp_path / "log" / "run_001.NPZ")
    with pytest.raises(ValueError, match=r"run_001\.NPZ: expected a file that ends in one of \.csv"):
        logs.read(tmp_path / "log")


def many(tmp_path, said):
    for index in range(len(said)):
        put(tmp_path / "log", name=f"run_{index:03d}.csv")
    return logs.read(put(tmp_path / "log", meta={"runs": {f"run_{i:03d}": entry for i, entry in enumerate(said)}}))


@pytest.mark.parametrize(("count", "sizes"), [(3, (1, 1, 1)), (4, (2, 1, 1)), (7, (3, 2, 2)), (8, (4, 2, 2))])
def test_splits_keep_conditions_together(tmp_path, count, sizes):
    log = many(tmp_path, [{"condition": name} for name in 2 * "abcdefgh"[:count]])
    held = [{run.condition for run in runs} for runs in logs.splits(log).values()]
    assert set.union(*held) == set("abcdefgh"[:count])
    assert tuple(map(len, held)) == sizes
    assert sum(map(len, logs.splits(log).values())) == 2 * count


def test_a_condition_in_two_splits_is_named(tmp_path):
    said = [{"condition": "a", "split": "train"}, {"condition": "a", "split": "sealed"}, {"condition": "b"}]
    with pytest.raises(ValueError, match="condition 'a' is in 'train' and in 'sealed'"):
        logs.splits(many(tmp_path, said))


def test_splits_are_what_the_log_says_where_it_does(tmp_path):
    said = [{"condition": "a", "split": "sealed"}, {"condition": "b", "split": "train"}, {"condition": "c"}]
    chosen = logs.splits(many(tmp_path, said))
    assert {split: runs[0].condition for split, runs in chosen.items()} == {"train": "b", "select": "c", "sealed": "a"}
    said[2]["split"] = "train"
    with pytest.raises(ValueError, match="no run is left for 'select'"):
        logs.splits(many(tmp_path, said))


def test_every_split_has_hard_and_soft_motions(tmp_path):
    said = [{"condition": name} for name in "abcdefgh"]
    log = many(tmp_path, said)
    # Positions of the last conditions are further from their targets.
    runs = [
        dataclasses.replace(
            run, signals={**run.signals, "q": run.signals["target"] - 0.1 * (1 + number) * np.array([1.0, 0.5])}
        )
        for number, run in enumerate(log.runs)
    ]
    log = dataclasses.replace(log, runs=tuple(runs))
    held = {split: {run.condition for run in runs} for split, runs in logs.splits(log).items()}
    assert held == {"train": set("hed a".replace(" ", "")), "select": set("gc"), "sealed": set("fb")}
    # What is written into the log stays, whatever becomes of its signals.
    written = logs.with_splits(log)
    soft = dataclasses.replace(
        written, runs=tuple(dataclasses.replace(r, signals=log.runs[0].signals) for r in written.runs)
    )
    assert {split: {run.condition for run in runs} for split, runs in logs.splits(soft).items()} == held


def test_halves_swap_whole_conditions(tmp_path):
    said = [
        {"condition": name, "split": split}
        for name, split in zip("abcdab", 2 * ["train"] + 2 * ["select"] + 2 * ["train"], strict=True)
    ]
    said[3]["split"] = "sealed"
    log = logs.with_halves_swapped(many(tmp_path, said))
    held = {split: {run.condition for run in runs} for split, runs in logs.splits(log).items()}
    assert held == {"train": {"c", "d"}, "select": {"a"}, "sealed": {"b"}}


def test_a_half_of_one_condition_is_not_swapped(tmp_path):
    log = many(tmp_path, [{"condition": name} for name in "abc"])
    with pytest.raises(ValueError, match="'train' has condition a only, expected two or more"):
        logs.with_halves_swapped(log)


def test_too_few_conditions_to_split_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"2 run\(s\) of conditions a, b, expected three"):
        logs.splits(many(tmp_path, [{"condition": "a"}, {"condition": "b"}]))


def test_what_is_no_array_in_an_archive_is_no_column(tmp_path):
    put(tmp_path / "log", name="run_000.npz")
    with zipfile.ZipFile(tmp_path / "log" / "run_000.npz", "a") as archive:
        archive.writestr("notes.npy", "walked well")
    assert "column 'notes' was left out" in logs.read(tmp_path / "log").notes[0]
    with zipfile.ZipFile(tmp_path / "log" / "run_000.npz", "a") as archive:
        archive.writestr("volts.npy", "seven")
    with pytest.raises(ValueError, match=r"run_000\.npz, column 'volts': got bytes, expected an array"):
        logs.read(tmp_path / "log")
