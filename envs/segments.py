"""Cuts logs into segments: short pieces, each simulated from a measured state.

Over a short piece the simulation stays close to the robot. In a long one a wrong effect can compensate for a missing
one. Each segment carries the history before it, so that effects with a memory (delays, lags, backlash) start with what
they would remember. `envs.smoothing` estimates the states of a run, from which segments are made.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import chex
import jax
import numpy as np

from envs.clock import SAME_S, Clock, clock_of
from envs.effects.memory import LONGEST_S, PAST_STEP_S, PAST_TARGET_S
from envs.logs import Run
from envs.readings import aligned, hermite, noise, quantum_of
from envs.smoothing import lateness, slopes, smoothed

__all__ = [
    "HISTORY_S",
    "INPUTS",
    "Cut",
    "Segment",
    "cut",
    "lateness",
    "noise",
    "quantum_of",
    "rows_together",
    "smoothed",
    "whole",
]

COMPARED = ("q", "dq", "tau", "abs_tau", "gravity")
"""Signals that may be compared with a simulation."""

INPUTS = ("target", "between", "feed", "stiffness", "damping", "limit", "emf", "sample")
"""Fields of `Segment` with what the controller is told at every step."""

HISTORY_S = LONGEST_S + 0.02
"""Length of the history before a segment, in s: the longest delay and some time for lags to settle."""

_PAST_S = 2.0  # how far back before the history positions are kept


@chex.dataclass(frozen=True)
class Segment:
    """A piece of a run on the simulation's grid: `before` steps of history, then `after` steps to be simulated.

    The controller's law is `envs.logs.Impedance`'s, with `feed` added to its torque.
    """

    target: jax.Array  # [before + after, joints] rad; a row's target holds until the next row, or leads to it linearly
    # [before + after, joints] rad, from the held target to the linear one, where it is unknown which of them the robot
    # had; else zero
    between: jax.Array
    feed: jax.Array  # [before + after, joints] Nm, torque that was sent directly, where there are no targets
    stiffness: jax.Array  # [before + after, joints] Nm/rad of the controller, zero where it is off
    damping: jax.Array  # [before + after, joints] Nm s/rad
    limit: jax.Array  # [before + after, joints] Nm, of stiffness and damping together
    emf: jax.Array  # [before + after, joints] Nm s/rad, back electromotive force, not limited
    sample: jax.Array  # [before + after] true where the controller reads the joint anew
    # [before + 1 + ahead, 4, joints] rad and rad/s, smoothed, and slopes over longer times, rad/s and rad/s^2. Index
    # `before` is the start; the `LONGEST_S` of steps `ahead` of it is what undoing a sensor's delay needs.
    measured: jax.Array
    # [past, joints] rad, smoothed positions every 10 ms in the 2 s that lead to the first of `measured`. They wind up
    # the bristles of dry friction; in slow motion the history alone is too short for that. At the first of them
    # bristles balance all other torques.
    past: jax.Array
    past_target: jax.Array  # [past targets, joints] rad, at the times `envs.effects.memory.PAST_TARGET_S`
    past_told: jax.Array  # [joints] rad, the target at the first of `past`
    past_feed: jax.Array  # [joints] Nm, torque that was sent directly at the first of `past`
    row_step: jax.Array  # [rows] the last step at or before each row; 0 is the segment's start
    row_share: jax.Array  # [rows] share of a step between that step and the row


@dataclass(frozen=True)
class Cut:
    """Segments of several runs, all of one length, and the measured signals at their rows.

    Simulate `segments` in one batch (`Rig.simulate`) and compare the readings with `signals`.
    """

    segments: Segment
    """[segments, ...] on every field."""
    signals: dict[str, np.ndarray]
    """[segments, rows, components] by name."""
    run: np.ndarray
    """[segments] index of the run that each is from."""
    row: np.ndarray
    """[segments, rows] index of each row in its run."""


@dataclass(frozen=True)
class Estimate:
    """What the readings of a run say at its rows; it takes longer to compute than cutting does."""

    states: np.ndarray
    """[rows, 2, joints] rad and rad/s (`envs.smoothing.smoothed`)."""
    slopes: np.ndarray
    """[rows, 2, joints] rad/s and rad/s^2 (`envs.smoothing.slopes`)."""
    signals: dict[str, np.ndarray]
    """[rows, components] by name (`envs.readings.aligned`)."""


def estimate(run: Run) -> Estimate:
    """Estimates states and signals at the rows of a run."""
    signals = {name: aligned(run, name) for name in COMPARED if name in run.signals}
    return Estimate(smoothed(run), slopes(run), signals)


def cut(
    runs: Sequence[Run],
    horizon_s: float,
    dt: float,
    bin_s: float = 0.01,
    estimates: Sequence[Estimate] | None = None,
) -> Cut:
    """Cuts runs into consecutive segments of one length.

    Args:
      runs: of one robot and one rate.
      horizon_s: length of a segment in s, rounded to whole bins.
      dt: step of the simulation in s.
      bin_s: length of the bins that residuals are averaged over later; a segment is a whole number of them.
      estimates: of the runs, where they were made already.

    Returns:
      The segments and the signals that all runs have, at the times of the rows (`envs.readings.aligned`). `tau` is left
      out if a run has no targets, because its torques were then sent, not measured.

    Raises:
      ValueError: no run is longer than a segment and its history.
    """
    period = float(np.median([np.median(np.diff(run.time)) for run in runs]))
    together = rows_together(period, bin_s)
    rows = max(1, round(horizon_s / period / together)) * together
    # Every segment needs a history, the first one too.
    first = [_after_history(run) for run in runs]
    starts = [np.arange(begin, len(run.time) - rows, rows) for run, begin in zip(runs, first, strict=True)]
    if not any(map(len, starts)):
        longest = max(run.time[-1] - run.time[0] for run in runs)
        raise ValueError(f"runs: the longest has {longest:.3g} s, expected more than {horizon_s + HISTORY_S:.3g} s")
    lengths = np.concatenate([run.time[i + rows] - run.time[i] for run, i in zip(runs, starts, strict=True)])
    row = [own[:, None] + 1 + np.arange(rows) for own in starts]
    names = [name for name in COMPARED if all(name in run.signals for run in runs)]
    if not all("target" in run.signals for run in runs):
        names = [name for name in names if name != "tau"]
    estimates = estimates or [estimate(run) for run in runs]
    return Cut(
        segments=_segments(runs, estimates, starts, row, lengths.max(), dt),
        signals={
            name: np.concatenate([one.signals[name][own] for one, own in zip(estimates, row, strict=True)]).astype(
                np.float32
            )
            for name in names
        },
        run=np.repeat(np.arange(len(runs)), [len(own) for own in starts]),
        row=np.concatenate(row),
    )


def whole(runs: Sequence[Run], dt: float) -> Cut:
    """Takes every run as one segment, from the first state that has a history to the run's end.

    Use it to simulate or draw whole runs. So that all have one shape, the last row of a shorter run is repeated.

    Args:
      runs: of one robot.
      dt: step of the simulation in s.
    """
    first = [_after_history(run) for run in runs]
    most = max(len(run.time) - 1 - start for run, start in zip(runs, first, strict=True))
    row = [
        np.minimum(start + 1 + np.arange(most), len(run.time) - 1)[None] for run, start in zip(runs, first, strict=True)
    ]
    longest = max(run.time[-1] - run.time[start] for run, start in zip(runs, first, strict=True))
    estimates = [estimate(run) for run in runs]
    return Cut(
        segments=_segments(runs, estimates, [np.array([start]) for start in first], row, longest, dt),
        signals={"q": np.concatenate([one.signals["q"][own] for one, own in zip(estimates, row, strict=True)])},
        run=np.arange(len(runs)),
        row=np.concatenate(row),
    )


def _after_history(run: Run) -> int:
    """The first row before which there is a whole history."""
    return int(np.searchsorted(run.time, run.time[0] + HISTORY_S - SAME_S))


def _segments(
    runs: Sequence[Run],
    estimates: Sequence[Estimate],
    starts: Sequence[np.ndarray],
    rows: Sequence[np.ndarray],
    longest_s: float,
    dt: float,
) -> Segment:
    """Makes the segments of all runs, as one with [segments, ...] on every field.

    Args:
      runs: of one robot.
      estimates: of the runs.
      starts: [segments] of every run: the row at which each begins.
      rows: [segments, rows] of every run: the rows at which each is read, later than its start.
      longest_s: the time from a start to the last row read, of the longest segment. Rows are not exactly periodic, and
        all segments get as many steps as the longest.
      dt: step of the simulation in s.
    """
    after = 1 + int(np.ceil((longest_s - SAME_S) / dt))
    every = zip(runs, estimates, starts, rows, strict=True)
    parts = [_of_run(run, one, start, row, after, dt) for run, one, start, row in every]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def rows_together(period_s: float, bin_s: float) -> int:
    """Computes how many rows a bin has, one at least. Residuals are averaged over a bin (`cut`).

    Args:
      period_s: time between rows.
      bin_s: length of a bin.
    """
    return max(1, round(bin_s / period_s))


def _of_run(run: Run, found: Estimate, start: np.ndarray, rows: np.ndarray, after: int, dt: float) -> Segment:
    """Makes the segments of one run, of `after` steps each (`_segments`)."""
    before, ahead = round(HISTORY_S / dt), round(LONGEST_S / dt)
    begin = run.time[start][:, None]
    clock = clock_of(run, dt)
    told = clock.rows[start][:, None] + dt * np.arange(-before, after)
    # A row's values act from its time until the next.
    last = clock.last_row(told)
    target, between = _between_rows(run, run.signals.get("target"), clock, told)
    controller = run.impedance()
    held = {
        "stiffness": controller.stiffness,
        "damping": controller.damping,
        "limit": controller.limit,
        "emf": controller.back_emf,
    }
    # Where the controller's ticks lie between rows is unknown; they are counted from the run's first row.
    ticks = np.floor((told + clock.same_s - clock.rows[0]) * clock.rate_hz)
    at = (run.time[rows] - begin) / dt
    step = np.minimum(np.floor(at + SAME_S / dt).astype(np.int32), after - 1)
    position, velocity = np.moveaxis(found.states, 1, 0)
    fine = begin + dt * np.arange(-before, ahead + 1)
    # The slope of interpolated positions would have several times the noise of the velocities, but not at the rows: a
    # delay of whole rows would then seem likelier than any other.
    speed, acceleration = np.moveaxis(found.slopes, 1, 0)
    rising = [np.gradient(one, run.time, axis=0) for one in (velocity, acceleration)]
    motion = ((position, velocity), (velocity, rising[0]), (speed, acceleration), (acceleration, rising[1]))
    between_rows = [hermite(run.time, *pair, fine)[0] for pair in motion]
    past = begin - HISTORY_S + PAST_STEP_S * np.arange(-round(_PAST_S / PAST_STEP_S), 1)
    told_before = clock.rows[start] - HISTORY_S - _PAST_S
    told_past = told_before[:, None] + _PAST_S + PAST_TARGET_S
    return Segment(
        target=target,
        between=between,
        feed=_between_rows(run, run.sent_torque(), clock, told)[0],
        **{name: values.astype(np.float32)[last] for name, values in held.items()},
        sample=np.diff(ticks, axis=1, prepend=-np.inf) > 0,
        measured=np.stack(between_rows, axis=2).astype(np.float32),
        past=hermite(run.time, position, velocity, past)[0].astype(np.float32),
        past_target=_between_rows(run, run.signals.get("target"), clock, told_past)[0],
        past_told=_between_rows(run, run.signals.get("target"), clock, told_before)[0],
        past_feed=_between_rows(run, run.sent_torque(), clock, told_before)[0],
        row_step=step,
        row_share=np.clip(at - step, 0.0, 1.0).astype(np.float32),
    )


def _between_rows(run: Run, sent: np.ndarray | None, clock: Clock, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns what was sent to the joints at other times, and how far a linear one is from it where that is unknown.

    Args:
      run: the run.
      sent: [rows, joints], targets or torques; zeros where None.
      clock: of the controller.
      times: s, of any shape.

    Returns:
      [*times.shape, joints] each.
    """
    sent = np.zeros(run.signals["q"].shape) if sent is None else sent
    last = clock.last_row(times)
    following = np.minimum(last + 1, len(clock.rows) - 1)
    share = (times - clock.rows[last]) / np.maximum(clock.rows[following] - clock.rows[last], 1e-9)
    further = np.clip(share, 0.0, 1.0)[..., None] * (sent[following] - sent[last])
    held, none = sent[last], np.zeros_like(further)
    by_rows = {"hold": (held, none), "linear": (held + further, none), "unknown": (held, further)}
    return tuple(values.astype(np.float32) for values in by_rows[run.controller.between_rows])
