"""Cuts logs into the segments that discovery works on, by split (train, select, sealed) and horizon."""

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace

import jax
import numpy as np

from envs import segments
from envs.logs import Log, Run, splits
from envs.regimes import regimes
from jaxtune.discovery.problem import Segments

Cuts = Mapping[str, Mapping[float, Segments]]
"""Segments by split and horizon."""

BIN_S = 0.01
"""Time in s over which residuals are averaged."""

HORIZONS_S = (0.05, 0.15, 0.45)
"""Default lengths in s of the segments that are simulated, for rows that are fast enough. Short ones stay close to the
measurement; long ones show biases and delays."""

_HORIZON_ROWS = (4, 12, 36)  # least lengths by default; the first is the least of all
_PARTS = {"train": (0.0, 0.5), "select": (0.5, 0.75), "sealed": (0.75, 1.0)}  # of a run that is cut in time
_LEAST_ROWS = 8  # of such a part
_LEAST_SEGMENTS = 3  # of a split: a bootstrap needs a few to draw from
_ALIKE = 0.05  # of the log's range of positions and speeds, by which repetitions of a segment may begin apart
_NEAR = [[2e-3], [0.05]]  # rad or m, and per s, which noise may take a joint that stands still
_ENOUGH, _ENOUGH_S = (40, 128), 20.0  # segments of a split that are simulated, and their length together in s


def row_rate(log: Log) -> float:
    """Returns the rows a second by the time stamps of a log, in Hz."""
    return 1.0 / float(np.median([np.median(np.diff(run.time)) for run in log.runs]))


def fitting_horizons(log: Log, asked: Sequence[float] | None = None) -> tuple[float, ...]:
    """Returns lengths of segments in s that fit the rows of a log.

    Args:
      log: as it was read.
      asked: the lengths; where None, `HORIZONS_S`, or 4, 12 and 36 rows where these are longer.

    Raises:
      ValueError: a length that was asked for has fewer than four rows.
    """
    rate = row_rate(log)
    if asked is None:
        return tuple(max(length, rows / rate) for length, rows in zip(HORIZONS_S, _HORIZON_ROWS, strict=True))
    if round(min(asked) * rate) < _HORIZON_ROWS[0]:
        raise ValueError(
            f"horizons: got {min(asked):g} s, expected {_HORIZON_ROWS[0] / rate:.3g} s or more, which are "
            f"{_HORIZON_ROWS[0]} of {rate:.0f} rows a second"
        )
    return tuple(asked)


def split_in_time(log: Log) -> Log:
    """Cuts every run into three, for train, select and sealed, where a log has too few conditions to be split by them.

    The first half of a run is fitted, the third quarter decides, and the last is the held-out test. Between two parts
    the history of a segment is left out, so that they share no readings.

    Args:
      log: as it was read. One that names splits, or has three conditions, is returned as it is.

    Returns:
      The log, with a note if it was cut.

    Raises:
      ValueError: a run is too short.
    """
    conditions = {run.condition for run in log.runs}
    if len(conditions) >= len(_PARTS) or any(run.split for run in log.runs):
        return log
    note = (
        f"the log has {len(conditions)} condition(s), too few to split by: its runs were cut in time, so the held-out "
        "test is on the same motion, later"
    )
    runs = tuple(_part(run, split) for run in log.runs for split in _PARTS)
    return replace(log, runs=runs, notes=(*log.notes, note))


def _part(run: Run, split: str) -> Run:
    begin, end = (run.time[0] + share * (run.time[-1] - run.time[0]) for share in _PARTS[split])
    later = begin + segments.HISTORY_S if begin > run.time[0] else begin
    rows = (run.time >= later) & (run.time <= end)
    if rows.sum() < _LEAST_ROWS:
        raise ValueError(f"{run.name}: got {rows.sum()} rows for '{split}', expected {_LEAST_ROWS}: record longer runs")
    return replace(
        run,
        name=f"{run.name}_{split}",
        condition=f"{run.condition}_{split}",
        split=split,
        time=run.time[rows],
        signals={name: values[rows] for name, values in run.signals.items()},
        other={name: values[rows] for name, values in run.other.items()},
    )


def told_alike(null: Cuts, measured: Cuts, follows: bool = False) -> Cuts:
    """Lets a null log share what the controller was told with the measured log, of which it is the same.

    A long log is hundreds of megabytes otherwise, for every null log.

    Args:
      null: segments of a simulated null log.
      measured: segments of the log that it imitates.
      follows: whether targets follow from a log's own readings (`envs.following`).
    """
    own_fields = ("measured", "past", *(("target", "past_target", "past_told") if follows else ()))
    return {
        split: {
            horizon: replace(
                own,
                inputs=measured[split][horizon].inputs.replace(**{name: own.inputs[name] for name in own_fields}),
            )
            for horizon, own in lengths.items()
        }
        for split, lengths in null.items()
    }


def _spread(repeats: np.ndarray, horizon: float) -> np.ndarray:
    """Takes segments evenly from those of a split, where there are more than it takes to decide.

    Repeats stay together, because alone they do not show how far runs differ.

    Args:
      repeats: [segments] of `_told_the_same`.
      horizon: their length in s.

    Returns:
      Indices of the segments that are taken, rising.
    """
    total = len(repeats)
    count = min(total, int(np.clip(round(_ENOUGH_S / horizon), *_ENOUGH)))
    _, unit = np.unique(np.where(repeats < 0, np.arange(total) + total, repeats), return_inverse=True)
    units = int(unit.max()) + 1
    taken = np.linspace(0, units - 1, round(count * units / total)).round().astype(int)
    return np.flatnonzero(np.isin(unit, taken))


def cut_log(log: Log, dt: float, signals: Sequence[str], horizons: Sequence[float]) -> Cuts:
    """Cuts a log into segments of each horizon, and labels every row with the motion regime of its joints.

    Each segment is simulated from its measured first state, so that errors do not add up over a whole run.

    Args:
      log: measured or simulated.
      dt: step of the simulation in s.
      signals: names of the signals that are compared.
      horizons: lengths of the segments in s.

    Returns:
      Segments by split and horizon.

    Raises:
      ValueError: a split has too few segments of a length.
    """
    names = {split: {run.name for run in runs} for split, runs in splits(log).items()}
    estimates = [segments.estimate(run) for run in log.runs]
    labels = [regimes(run, one.states) for run, one in zip(log.runs, estimates, strict=True)]
    data: dict[str, dict[float, Segments]] = {split: {} for split in names}
    for horizon in horizons:
        # All runs at once, so that segments have one shape and programs compile once.
        cut = segments.cut(log.runs, horizon, dt, BIN_S, estimates)
        label = np.stack([labels[run][rows] for run, rows in zip(cut.run, cut.row, strict=True)])
        for split in names:
            mine = np.array([log.runs[run].name in names[split] for run in cut.run])
            if mine.sum() < _LEAST_SEGMENTS:
                raise ValueError(
                    f"runs: '{split}' has {mine.sum()} segment(s) of {horizon:g} s, expected {_LEAST_SEGMENTS} or "
                    "more: record longer runs or more of them, or choose shorter horizons"
                )
            mine = np.flatnonzero(mine)
            told = _told_the_same(log, cut.run[mine], cut.row[mine])
            kept = _spread(told, horizon)
            mine, told = mine[kept], told[kept]
            data[split][horizon] = Segments(
                inputs=jax.tree.map(lambda leaf, mine=mine: leaf[mine], cut.segments),
                signals={name: cut.signals[name][mine] for name in signals},
                steps=cut.segments.target.shape[1] - round(segments.HISTORY_S / dt),
                run=cut.run[mine],
                regimes=label[mine],
                repeats=_began_alike(told, log, estimates, cut.run[mine], cut.row[mine]),
            )
    return data


def _told_the_same(log: Log, run: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Groups segments in which several runs of a condition were told the same, which null logs share.

    Args:
      log: of the runs.
      run: [segments] index of each segment's run.
      row: [segments, rows] of that run.

    Returns:
      [segments] the group of each; -1 for those that are alone.
    """
    conditions = [(one.condition, str(one.controller)) for one in log.runs]
    keys = []
    for mine, rows in zip(run, row, strict=True):
        signals = log.runs[mine].signals
        sent = signals["target"][rows] if "target" in signals else signals["tau"][rows]
        on = signals["enabled"][rows] > 0 if "enabled" in signals else np.ones(len(rows), bool)
        keys.append((*conditions[mine], rows[0], sent.round(6).tobytes(), on.tobytes()))
    return _grouped(keys)


def _began_alike(
    told: np.ndarray, log: Log, estimates: Sequence[segments.Estimate], run: np.ndarray, row: np.ndarray
) -> np.ndarray:
    """Splits groups of segments by the states in which they begin, [segments]; other arguments as `_told_the_same`."""
    unsealed = [one.states for one, of in zip(estimates, log.runs, strict=True) if of.split != "sealed"]
    far = np.maximum(_ALIKE * np.ptp(np.concatenate(unsealed), axis=0), _NEAR)
    found, together, keys = np.full(len(told), -1), np.flatnonzero(told >= 0), []
    # Where the parts of each group begin.
    begins: dict[int, list[np.ndarray]] = {}
    for number in together:
        state, known = estimates[run[number]].states[row[number][0]], begins.setdefault(told[number], [])
        part = next((index for index, other in enumerate(known) if (np.abs(state - other) <= far).all()), None)
        if part is None:
            part = len(known)
            known.append(state)
        keys.append((told[number], part))
    found[together] = _grouped(keys)
    return found


def _grouped(keys: Sequence[Hashable]) -> np.ndarray:
    """Numbers equal keys; -1 for those that are there once."""
    times = Counter(keys)
    numbers = {key: number for number, key in enumerate(key for key in times if times[key] > 1)}
    return np.array([numbers.get(key, -1) for key in keys], int)
