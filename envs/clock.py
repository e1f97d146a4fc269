"""What the time stamps of a log say of its controller's clock, which of them only jitter, and when rows were read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from envs.logs import Run
from envs.readings import noise_of, stale

SAME_S = 2e-6
"""Times in s that differ by less are the same: time stamps are rounded, those of a wall clock to 0.2 us."""

_WHOLE = 0.01  # how far rows may be from a whole number of ticks, as a share
_NEAR = 9  # rows
_WINDOW = 51  # rows, over which jitter averages out
_SMOOTHER = 0.7  # least fall of the roughness of some joint's positions, as a share of its mean square
_AGREED = 0.25  # most that is left of the roughness of joints that had no say in when rows were read
_SLOW_S, _JUDGED = 0.004, 5000  # longest time between rows that are moved; how many of them decide
_HALF_S, _ROUNDS, _PACE = 0.01, 8, 0.8  # half width of local cubics, how often rows are moved, and how far of the way
_LATE, _APART = 0.5, 0.2  # a usual move, and the least time between two rows, as shares of the usual one
_KINK = 16.0  # times the usual mean square that a cubic leaves


@dataclass(frozen=True)
class Clock:
    """When a controller has what the rows of a run say.

    Attributes:
      rows: [rows] s.
      rate_hz: of its ticks, the first of which is at the first row.
      same_s: times that differ by less are the same.
    """

    rows: np.ndarray
    rate_hz: float
    same_s: float

    def last_row(self, times: np.ndarray) -> np.ndarray:
        """The last row at or before each time."""
        return np.clip(np.searchsorted(self.rows, times + self.same_s, side="right") - 1, 0, len(self.rows) - 1)


def clock_of(run: Run, dt: float) -> Clock:
    """Reads the controller's clock off time stamps.

    Rows that are a whole number of ticks apart go with the ticks, and only their stamps jitter. These are put on a line
    then, since a row that seems a little late would miss its tick. Rows that are not, or are off the line by half a
    tick and more, have what their stamps say. So have those of an unknown controller, whose targets follow from
    readings (`envs.following`).

    Args:
      run: the run.
      dt: step of the simulation in s; ticks are whole steps apart.
    """
    rate_hz, (even, row_s) = run.controller.rate_hz, _line(run.time)
    ticks = 0 if run.controller.kind == "unknown" else round(row_s * rate_hz)
    if ticks >= 1 and abs(row_s * rate_hz / ticks - 1.0) < _WHOLE and _off(run.time, even) < 0.5 / rate_hz:
        # The line's slope is not exact either.
        return Clock(even, ticks / row_s, 0.25 * dt)
    return Clock(run.time, rate_hz, SAME_S)


def evened(runs: Sequence[Run], seen: Sequence[Run]) -> tuple[Run, ...]:
    """Puts the time stamps of a log on lines where positions say that their jitter is of the stamps alone.

    A joint at 3 rad/s that was stamped 0.15 ms late seems to be off by 0.45 mrad. Positions are much smoother on a line
    then. Rows that were really read late are not, and keep their stamps, as do those of a clock that wanders slowly, of
    which smoothness says nothing. All runs are judged together, as one program recorded them, and those in which
    little moves say little.

    Args:
      runs: of one robot and one program.
      seen: those that may decide; without sealed ones.

    Returns:
      The runs, on lines or as they are.
    """
    moved = [(run, even) for run in seen if (even := _evened(run)) is not run]
    if not moved:
        return tuple(runs)
    before, after = (
        sum(len(run.time) * _roughness(run.time, run.signals["q"]).mean(axis=0) for run in stamped)
        for stamped in zip(*moved, strict=True)
    )
    return tuple(map(_evened, runs)) if np.any(after < _SMOOTHER * before) else tuple(runs)


def _evened(run: Run) -> Run:
    """The run on a line, if its stamps are off it from row to row alone."""
    if len(run.time) < 3 * _NEAR:
        return run
    even, _ = _line(run.time)
    return replace(run, time=even - even[0]) if _only_jitters(run.time, even) else run


def retimed(runs: Sequence[Run], seen: Sequence[Run]) -> tuple[Run, ...]:
    """Moves time stamps to when rows were read, where the joints agree on that.

    A program that polls a robot stamps what may be a period old, and no line goes through such stamps. But all joints
    of a row were read at once. If a joint at 3 rad/s is 0.6 mrad ahead of its own motion, another one at 1 rad/s is
    0.2 mrad ahead: the row was read 0.2 ms after its stamp. Half of the joints say when, and the others tell whether
    their positions are smoother then. Lateness that changes slowly does not show. In slow rows motion cannot be told
    from it, so they stay.

    Args:
      runs: of one robot and one program.
      seen: those that may decide; without sealed ones.

    Returns:
      The runs; those that were moved with the noise of what they read, which stamps had hidden.
    """
    before, after = np.sum([_judged(run) for run in seen], axis=0)
    if not after < _AGREED * before:
        return tuple(runs)
    return tuple(_moved(run) for run in runs)


def _judged(run: Run) -> tuple[float, float]:
    """Roughness of joints at the stamps, and where the other half of the joints says that rows were read."""
    time, position = (values[:_JUDGED] for values in _fresh(run))
    sd = noise_of(run, "q")
    order = np.argsort(-np.ptp(position, axis=0) / sd)
    halves = [half for half in (order[::2], order[1::2]) if len(half)]
    if not _tells(time) or len(halves) < 2:
        return 0.0, 0.0
    found = np.zeros(2)
    for half, others in (halves, halves[::-1]):
        read = _read(time, position[:, half], sd[half])
        # Fast joints show most of it. What a joint at rest has is noise, and the same at both times.
        found += [np.median(_roughness(at, position[:, others]), axis=0).sum() for at in (time, read)]
    return float(found[0]), float(found[1])


def _tells(time: np.ndarray) -> bool:
    """Whether rows are many and fast enough to tell motion from lateness."""
    return len(time) >= 3 * _NEAR and float(np.median(np.diff(time))) <= _SLOW_S


def _moved(run: Run) -> Run:
    (time, position), noise = _fresh(run), noise_of(run, "q")
    if not _tells(time):
        return run
    parts = np.array_split(np.arange(len(time)), max(1, round(len(time) / _JUDGED)))
    read = np.concatenate([_read(time[rows], position[rows], noise) for rows in parts])
    at = _rising(run.time + np.interp(run.time, time, read - time))
    known = dict(run.known)
    for name in {"q", "dq"} & set(run.signals):
        # What is left of nine rows by six terms is a third of their noise; the median of such is 0.79 of the mean.
        sd = np.sqrt(3.0 / 0.79 * np.median(_roughness(at, run.signals[name]), axis=0))
        said = run.fact(name, "noise_sd")
        known[name] = {**run.known.get(name, {}), "noise_sd": np.where(np.isfinite(said), said, sd)}
    return replace(run, time=at, known=known)


def _fresh(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Times [rows] and positions [rows, joints] of rows that no joint repeats."""
    keep = ~stale(run, "q").any(axis=1)
    return run.time[keep], run.signals["q"][keep]


def _read(time: np.ndarray, position: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """When rows [rows] were read, by how far positions [rows, joints] of a noise [joints] are off local cubics."""
    period = float(np.median(np.diff(time)))
    half = max(3, round(_HALF_S / period))
    if len(time) <= 2 * half:
        return time
    near = np.clip(np.arange(len(time)), half, len(time) - 1 - half)[:, None] + np.arange(-half, half + 1)
    width, at = half * period, time
    for _ in range(_ROUNDS):
        powers = ((at[near] - at[:, None]) / width)[..., None] ** np.arange(4)
        across = powers.swapaxes(1, 2)
        fit = np.linalg.solve(across @ powers + 1e-9 * np.eye(4), across @ position[near])
        ahead, speed = (position - fit[:, 0]) / sd, fit[:, 1] / width / sd
        # Where nothing moves nobody knows. A state that is polled is no more than a period old.
        shift = (speed * ahead).sum(axis=1) / ((speed**2).sum(axis=1) + (_LATE * period) ** -2.0)
        at = _rising(np.clip(at + _PACE * shift, time - period, time + period))
    # About a kink of the motion no cubic fits, whenever rows were read.
    left = (ahead**2).sum(axis=1)[near].mean(axis=1)
    return _rising(np.where(left > _KINK * np.median(left), time, at))


def _rising(time: np.ndarray) -> np.ndarray:
    """Times that rise: a row that would be read before the last one is just after it."""
    least = _APART * float(np.median(np.diff(time))) * np.arange(len(time))
    return np.maximum.accumulate(time - least) + least


def _line(time: np.ndarray) -> tuple[np.ndarray, float]:
    """The times nearest to stamps [rows] that are on a line, and the time between two rows; some may be missing."""
    rows, period = np.arange(len(time)), float(np.median(np.diff(time)))
    # Stamps may be late, so the earliest of the next ones says where a row is; a hole moves all of them.
    behind = np.concatenate([time - period * rows, np.full(_WINDOW - 1, np.inf)])
    level = np.lib.stride_tricks.sliding_window_view(behind, _WINDOW).min(axis=1)
    missing = np.maximum(np.round(np.diff(level, prepend=level[0]) / period), 0.0)
    count = rows + np.cumsum(missing)
    row_s, first = np.polyfit(count, time, 1)
    return first + row_s * count, float(row_s)


def _off(time: np.ndarray, even: np.ndarray) -> float:
    """How far stamps are from a line, but for one in a hundred."""
    return float(np.quantile(np.abs(time - even), 0.99))


def _only_jitters(time: np.ndarray, even: np.ndarray) -> bool:
    """Tells whether stamps are off a line from row to row, and hardly in the mean of many rows."""
    off, window = time - even, min(_WINDOW, len(time))
    slow = np.median(np.lib.stride_tricks.sliding_window_view(off, window), axis=1)
    fast = off[window // 2 :][: len(slow)] - slow
    return bool(np.quantile(np.abs(slow), 0.99) < 0.5 * np.quantile(np.abs(fast), 0.9))


def _roughness(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Mean squares of what polynomials of degree 5 through few rows leave of positions [rows, joints].

    Returns:
      [groups of rows, joints].
    """
    begin = np.arange(0, len(time) - _NEAR, _NEAR)
    near = begin[:, None] + np.arange(_NEAR)
    at = time[near] - time[near].mean(axis=1, keepdims=True)
    basis, _ = np.linalg.qr(np.stack([(at / np.ptp(at)) ** power for power in range(6)], axis=-1))
    values = position[near]
    return ((values - basis @ (basis.swapaxes(-1, -2) @ values)) ** 2).mean(axis=1)
