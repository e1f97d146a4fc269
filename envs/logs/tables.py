"""Reads and writes tables of numbers (CSV, NPZ, Parquet); refuses a bad cell with its file, row and column.

Rows are counted from 1, without the header. Columns that nobody uses may hold what they like.
"""

import csv
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet

from envs.logs.containment import TooLarge, check_archive, check_size

_CELL_BYTES, _SHORTEST_CELL = 8, 2  # of a number in memory, and of one with its comma in a text
_LONGEST_CELL = 32  # bytes of a number with its comma in a text; longer cells count as several


def check_time(path: Path, name: str, time: np.ndarray) -> None:
    """Refuses time stamps that do not strictly increase.

    Args:
      path: of the file, for the message.
      name: of the column, for the message.
      time: [rows] s.

    Raises:
      ValueError: names the first row that is not later than the one before.
    """
    late = np.append(False, np.diff(time) <= 0)
    refuse_first(path, name, time, late, lambda row: f"more than {float(time[row - 1])!r} in the row before")


def check_values(path: Path, signal: str, name: str, values: np.ndarray) -> None:
    """Refuses values that a signal cannot have.

    Flags are 0 or 1, phases 0 to 1 cycle; the supply and torques without a sign are not negative.

    Args:
      path: of the file, for the message.
      signal: name of the signal in the format.
      name: of the column in the file, for the message.
      values: [rows].

    Raises:
      ValueError: names the first row with such a value.
    """
    if signal in ("enabled", "contact"):
        refuse_first(path, name, values, (values != 0) & (values != 1), "0 or 1")
    elif signal == "phase":
        refuse_first(path, name, values, (values < 0) | (values > 1), "0 to 1 cycle")
    elif signal in ("volts", "abs_tau"):
        refuse_first(path, name, values, values < 0, "a number that is not negative")


def refuse_first(path: Path, name: str, values: np.ndarray, bad: np.ndarray, expected) -> None:
    """Raises an error about the first bad row of a column, if there is one.

    Args:
      path: of the file, for the message.
      name: of the column, for the message.
      values: [rows].
      bad: [rows], True where a value is refused.
      expected: what was expected instead, or a function of the row (from 0) that says it.

    Raises:
      ValueError: names file, row (from 1), column, the value and what was expected.
    """
    if bad.any():
        row = int(np.argmax(bad))
        wanted = expected(row) if callable(expected) else expected
        raise ValueError(f"{path}, row {row + 1}, column '{name}': got {float(values[row])!r}, expected {wanted}")


def _cells(path: Path) -> int:
    """Counts the cells of a CSV, with those of the header."""
    counts = np.zeros(3, int)
    with path.open("rb") as file:
        while chunk := file.read(2**20):
            counts += [chunk.count(mark) for mark in (b",", b"\n", b"\r")]
    # Lines may end in either or both.
    return int(counts[0] + counts[1:].max())


def _read_csv(path: Path, used: Callable[[str], bool]) -> dict[str, np.ndarray | None]:
    try:
        check_size(path, _CELL_BYTES // _SHORTEST_CELL * path.stat().st_size)
    except TooLarge:
        check_size(path, _CELL_BYTES * max(_cells(path), path.stat().st_size // _LONGEST_CELL))
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            names = [name.strip() for name in next(csv.reader(file, strict=True), [])]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: {error}") from error
    if len(names) == 1 and (";" in names[0] or "\t" in names[0]):
        raise ValueError(f"{path}: got columns between semicolons or tabs, expected commas")
    for name in names:
        if not name or names.count(name) > 1:
            raise ValueError(f"{path}, column '{name}': expected a name that is there once")
    if not names:
        raise ValueError(f"{path}: is empty")
    types = dict.fromkeys(names, pyarrow.float64())
    try:
        return {name: values.to_numpy() for name, values in _parse_csv(path, types).items()}
    except pyarrow.ArrowInvalid:
        types |= {name: pyarrow.string() for name in names if not used(name)}
    try:
        return {name: _numbers(values) for name, values in _parse_csv(path, types).items()}
    except pyarrow.ArrowInvalid as error:
        # Arrow's message does not name row and column.
        return _read_csv_by_row(path, names, used, error)


def _parse_csv(path: Path, types: dict[str, pyarrow.DataType]) -> dict[str, pyarrow.ChunkedArray]:
    # No text counts as a missing value, so that an empty cell or "NA" is refused instead of becoming a NaN.
    options = pyarrow.csv.ConvertOptions(column_types=types, null_values=[], strings_can_be_null=False)
    # An empty line is a row without cells, which is refused too.
    parse = pyarrow.csv.ParseOptions(ignore_empty_lines=False)
    # Names without the spaces that a header may have around them.
    read = pyarrow.csv.ReadOptions(column_names=list(types), skip_rows=1)
    table = pyarrow.csv.read_csv(path, read_options=read, convert_options=options, parse_options=parse)
    return {name: table[name] for name in types}


def _numbers(values: pyarrow.ChunkedArray) -> np.ndarray | None:
    try:
        texts = pyarrow.types.is_string(values.type)
        trimmed = pyarrow.compute.utf8_trim_whitespace(values) if texts else values
        return trimmed.cast(pyarrow.float64()).to_numpy()
    except pyarrow.ArrowInvalid:
        return None


def _read_csv_by_row(
    path: Path, names: list[str], used: Callable[[str], bool], error: Exception
) -> dict[str, np.ndarray | None]:
    """Reads a CSV row by row, slowly, to find the row and column of an error."""
    read, rows = [index for index, name in enumerate(names) if used(name)], []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            next(reader)
            for cells in reader:
                if len(cells) != len(names):
                    raise ValueError(
                        f"{path}, row {len(rows) + 1}: got {len(cells)} cells, expected {len(names)}"
                    ) from error
                rows.append([_cell(path, len(rows) + 1, names[index], cells[index]) for index in read])
    except (UnicodeDecodeError, csv.Error) as worse:
        raise ValueError(f"{path}, row {len(rows) + 1}: {worse}") from worse
    table = np.array(rows, float).reshape(len(rows), len(read))
    return dict.fromkeys(names) | {names[index]: values for index, values in zip(read, table.T, strict=True)}


def _cell(path: Path, row: int, name: str, text: str) -> float:
    try:
        if "_" in text:  # Python's own thousands separator
            raise ValueError
        return float(text)
    except ValueError:
        raise ValueError(f"{path}, row {row}, column '{name}': got '{text}', expected a number") from None


def _array(arrays: np.lib.npyio.NpzFile, name: str, used: Callable[[str], bool]) -> np.ndarray | bytes | None:
    try:
        return arrays[name]
    except ValueError:  # an array of objects
        if used(name):
            raise
        return None


def _read_npz(path: Path, used: Callable[[str], bool]) -> dict[str, np.ndarray | None]:
    check_archive(path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            columns = {name: _array(arrays, name, used) for name in arrays.files}
    except Exception as error:  # a damaged archive fails in many ways
        raise ValueError(f"{path}: {type(error).__name__}: {error}") from error
    observation = columns.get("obs")
    if isinstance(observation, np.ndarray) and observation.ndim == 2:
        del columns["obs"]
        columns |= {f"obs.{number}": values for number, values in enumerate(observation.T)}
    rows, found = None, {}
    for name, values in columns.items():
        # NumPy returns members of an archive that are not arrays as bytes.
        if not isinstance(values, np.ndarray):
            wrong = f"got {type(values).__name__}, expected an array"
        elif values.ndim != 1 or values.dtype.kind not in "fiub":
            wrong = f"got shape {values.shape} of {values.dtype}, expected one row of numbers"
        elif rows not in (None, len(values)):
            wrong = f"got {len(values)} rows, expected {rows}"
        else:
            wrong = None
            rows = len(values) if used(name) else rows
        if wrong and used(name):
            raise ValueError(f"{path}, column '{name}': {wrong}")
        found[name] = None if wrong else values.astype(float)
    return {name: None if values is None or len(values) != rows else values for name, values in found.items()}


def _read_parquet(path: Path, used: Callable[[str], bool]) -> dict[str, np.ndarray | None]:
    try:
        # What a table holds stands in its footer; the pages of a column of equal values are tiny.
        held = pyarrow.parquet.read_metadata(path)
        schema = held.schema.to_arrow_schema()
        names, kinds = schema.names, dict(zip(schema.names, schema.types, strict=True))
        packed = sum(held.row_group(number).total_byte_size for number in range(held.num_row_groups))
        size = max(packed, held.num_rows * held.num_columns * _CELL_BYTES)
    except (pyarrow.ArrowException, OSError) as error:
        raise ValueError(f"{path}: {type(error).__name__}: {error}") from error
    check_size(path, size)
    columns: dict[str, np.ndarray | None] = dict.fromkeys(kinds)
    for name in names:
        if not name or names.count(name) > 1:
            raise ValueError(f"{path}, column '{name}': expected a name that is there once")
    numbers = [name for name, kind in kinds.items() if any(is_a(kind) for is_a in _NUMBERS)]
    for name in kinds.keys() - numbers:
        if used(name):
            raise ValueError(f"{path}, column '{name}': got {kinds[name]}, expected numbers")
    try:
        # Texts are left out: a dictionary of a single one may stand for gigabytes. So may rows that the footer hides.
        file, batches = pyarrow.parquet.ParquetFile(path, page_checksum_verification=True), []
        for batch in file.iter_batches(columns=numbers):
            batches.append(batch)
            if sum(one.num_rows for one in batches) > held.num_rows:
                raise ValueError(f"{path}: got more rows than its footer says, {held.num_rows}")
        table = pyarrow.Table.from_batches(batches, pyarrow.schema([schema.field(name) for name in numbers]))
        table.validate(full=True)
    except (pyarrow.ArrowException, OSError) as error:
        raise ValueError(f"{path}: {type(error).__name__}: {error}") from error
    for name, values in zip(table.column_names, table.columns, strict=True):
        if used(name) and values.null_count:
            row = int(np.argmax(values.is_null().to_numpy()))
            raise ValueError(f"{path}, row {row + 1}, column '{name}': is empty, expected a number")
        columns[name] = None if values.null_count else values.to_numpy().astype(float)
    return columns


def _write_csv(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    pyarrow.csv.write_csv(pyarrow.table(dict(columns)), path)


def _write_npz(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    np.savez(path, **columns)


def _write_parquet(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    pyarrow.parquet.write_table(pyarrow.table(dict(columns)), path, write_page_checksum=True)


_NUMBERS = (pyarrow.types.is_floating, pyarrow.types.is_integer, pyarrow.types.is_boolean)
READERS = {".csv": _read_csv, ".npz": _read_npz, ".parquet": _read_parquet}
"""Readers by suffix: from a path, and a function that says whether a column of that name is used, to columns [rows] by
name. A column that is not used is None where it is not all numbers."""
WRITERS = {".csv": _write_csv, ".npz": _write_npz, ".parquet": _write_parquet}
"""Writers by suffix: of columns [rows] by name to a path."""
