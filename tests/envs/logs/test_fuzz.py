"""Damaged logs: an error that names the file, or what the file says; never a hang, never a wrong number in silence.

Bags have no checksums to speak of: what is read of a damaged one is a log, and no more can be said. Each test damages a
log 300 times; 2,000 times with `pytest --hypothesis-profile thorough`.
"""

import csv
import io

import numpy as np
import pytest
import test_bags
import test_files
from hypothesis import given
from hypothesis import strategies as st

from envs import logs

NAMES = list(test_files.columns())
SUFFIXES = (".csv", ".npz", ".parquet")
CELLS = [
    "",
    " ",
    "nan",
    "inf",
    "-",
    "1e999",
    "1_0",
    "0x10",
    '"',
    '"1"',
    "1;2",
    "1,2",
    "é",
    "\x00",
    "1.5.2",
    "--1",
    "true",
]


def read(folder):
    """The run of a log, or None where it was refused by name; anything else is a failure."""
    try:
        (run,) = logs.read(folder).runs
    except ValueError as error:
        assert str(folder) in str(error), "it does not say where"
        return None
    for values in (run.time, *run.signals.values(), *run.other.values()):
        assert np.isfinite(values).all()
        assert len(values) == len(run.time)
    assert (np.diff(run.time) > 0).all()
    return run


def flat(run):
    """Columns by name."""
    found = {"t": run.time} | dict(run.other)
    for signal, values in run.signals.items():
        found |= {f"{signal}.{joint}": column for joint, column in zip(test_files.JOINTS, values.T, strict=True)}
    return found


# Where, what it becomes or how much is cut, of bytes.
damage = st.one_of(
    st.tuples(st.just("flip"), st.floats(0, 1, exclude_max=True), st.integers(1, 255)),
    st.tuples(st.just("cut"), st.floats(0, 1, exclude_max=True), st.integers(1, 50)),
    st.tuples(st.just("end"), st.floats(0, 1, exclude_max=True), st.just(0)),
    st.tuples(st.just("again"), st.floats(0, 1, exclude_max=True), st.integers(1, 50)),
    st.tuples(st.just("zero"), st.floats(0, 1, exclude_max=True), st.integers(1, 50)),
)


def damaged(content, hits):
    """Bytes after some damage."""
    for kind, place, size in hits:
        at = int(place * len(content))
        if kind == "flip":
            content = content[:at] + bytes([content[at] ^ size]) + content[at + 1 :]
        elif kind == "cut":
            content = content[:at] + content[at + size :]
        elif kind == "end":
            content = content[:at]
        elif kind == "again":
            content = content[:at] + content[at : at + size] + content[at:]
        else:
            content = content[:at] + bytes(min(size, len(content) - at)) + content[at + size :]
        if not content:
            break
    return content


@pytest.fixture(scope="module", params=SUFFIXES)
def whole(request, tmp_path_factory):
    """A log of one run, its file, its bytes and its columns."""
    first = test_files.put(tmp_path_factory.mktemp("first") / "log")
    folder = tmp_path_factory.mktemp("whole") / "log"
    logs.write(logs.read(first), folder, request.param)
    (path,) = folder.glob("run_*")
    return folder, path, path.read_bytes(), test_files.columns()


@given(hits=st.lists(damage, min_size=1, max_size=3))
def test_damaged_tables(whole, hits):
    folder, path, content, columns = whole
    path.write_bytes(damaged(content, hits))
    run = read(folder)
    if run is None:
        return
    if path.suffix == ".csv":
        columns = as_text_says(path.read_bytes())
        assert flat(run).keys() == columns.keys()
    # A checksum guards each number; what names a column is not always guarded, and then others may be left out.
    for name, values in flat(run).items():
        if name in columns:
            np.testing.assert_array_equal(values, columns[name])


def as_text_says(content):
    """Columns of a CSV file by the plainest reader there is, without those of unknown names that are no numbers."""
    names, *rows = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
    columns = {}
    for name, cells in zip(names, zip(*rows, strict=True), strict=True):
        try:
            columns[name] = np.array(list(map(float, cells)))
        except ValueError:
            assert name not in NAMES
            continue
        if name not in NAMES and not np.isfinite(columns[name]).all():
            del columns[name]
    return columns


edits = st.lists(
    st.tuples(
        st.sampled_from(["replace", "drop", "double", "swap"]),
        st.integers(0, test_files.ROWS),
        st.integers(0, len(NAMES) - 1),
        st.sampled_from(CELLS),
    ),
    min_size=1,
    max_size=3,
)


@given(changes=edits)
def test_damaged_cells(tmp_path, changes):
    folder = tmp_path / "log"
    table = test_files.columns()
    rows = [list(NAMES), *([repr(float(table[name][row])) for name in NAMES] for row in range(test_files.ROWS))]
    for kind, row, column, text in changes:
        cells = rows[row]
        column = min(column, len(cells) - 1)
        if kind == "replace":
            cells[column] = text
        elif kind == "drop" and len(cells) > 1:
            del cells[column]
        elif kind == "double":
            cells.insert(column, cells[column])
        else:
            cells[column], cells[-1] = cells[-1], cells[column]
    test_files.put(folder)
    (folder / "run_000.csv").write_text("\n".join(map(",".join, rows)) + "\n", encoding="utf-8")
    run = read(folder)
    if run is not None:
        expected = as_text_says((folder / "run_000.csv").read_bytes())
        assert flat(run).keys() == expected.keys()
        for name, values in flat(run).items():
            np.testing.assert_array_equal(values, expected[name])


@given(hits=st.lists(damage, min_size=1, max_size=3))
def test_damaged_meta(tmp_path, hits):
    folder = tmp_path / "log"
    test_files.put(folder)
    path = folder / "meta.yaml"
    path.write_bytes(damaged(path.read_bytes(), hits))
    run = read(folder)
    if run is not None:
        np.testing.assert_array_equal(run.time, test_files.columns()["t"])


@pytest.fixture(scope="module", params=test_bags.KINDS)
def bag(request, tmp_path_factory):
    """A log of one bag, its file and its bytes."""
    folder = test_bags.write(tmp_path_factory.mktemp("bag") / "log", request.param, test_bags.recording(0.2))
    (path,) = [p for p in folder.rglob("*") if p.suffix in (".bag", ".mcap", ".db3")]
    return folder, path, path.read_bytes()


@given(hits=st.lists(damage, min_size=1, max_size=3))
def test_damaged_bags(bag, hits):
    folder, path, content = bag
    path.write_bytes(damaged(content, hits))
    read(folder)
