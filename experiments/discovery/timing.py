"""Finds what no log says of its controller: when it ticks, and how its targets go on between two rows."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np

from envs import segments
from envs.logs import Log
from jaxtune.discovery.least_squares import complement
from jaxtune.discovery.noise_floor import prior_directions
from jaxtune.discovery.problem import Problem, Segments
from jaxtune.discovery.simulation import residuals

_SEGMENTS = 12  # of a run


def with_timing(log: Log, problem: Problem, dt: float, signals: tuple[str, ...]) -> Log:
    """Sets what a log does not say of its controller's times: every run's phase, and how targets go on between rows.

    A run's phase is the time from its first row to the controller's first tick. The nominal model simulates the
    shortest segments with each phase that the simulation's step can resolve, with targets that are held and with ones
    that move on. What the nominal parameters could explain is taken out, and what leaves least is taken: the phase for
    every run alone, the other for all runs together.

    Args:
      log: as it was read.
      problem: of the log, with all phases zero.
      dt: step of the simulation in s.
      signals: names of the signals that are compared.
    """
    first = log.runs[0].controller
    phases = np.arange(0.0, 1.0 / first.rate_hz - 0.5 * dt, dt)
    modes = ("hold", "linear") if first.between_rows == "unknown" else (first.between_rows,)
    if len(phases) * len(modes) < 2 or "target" not in log.runs[0].signals:
        return log
    told = {(mode, phase): _told(log, mode, [phase] * len(log.runs)) for mode in modes for phase in phases}
    directions = prior_directions(problem).directions
    pieces = _pieces(next(iter(told.values())), problem, dt, signals)
    found = residuals(problem, np.concatenate([np.zeros((1, problem.axes)), directions]), pieces)
    scale = np.sqrt((found[0] ** 2).mean(axis=(0, 1)))
    slopes = np.moveaxis(found[1:] - found[:1], 0, -1) / scale[:, None]
    left = {}
    for key, one in told.items():
        pieces = _pieces(one, problem, dt, signals)
        now = residuals(problem, np.zeros(problem.axes), pieces)[0] / scale
        left[key] = np.array([_unexplained(now, slopes, pieces.run == run) for run in range(len(log.runs))])
    least = {mode: np.min([left[mode, phase] for phase in phases], axis=0).sum() for mode in modes}
    mode = min(least, key=least.get)
    return _told(log, mode, phases[np.argmin([left[mode, phase] for phase in phases], axis=0)])


def _told(log: Log, mode: str, phases: Sequence[float]) -> Log:
    """The log with these phases of its runs, and targets that go on in this mode."""
    runs = [
        replace(run, phase_s=float(phase), controller=replace(run.controller, between_rows=mode))
        for run, phase in zip(log.runs, phases, strict=True)
    ]
    return replace(log, runs=tuple(runs))


def _unexplained(residual: np.ndarray, slopes: np.ndarray, mine: np.ndarray) -> float:
    """Sum of squares of a run's residuals that the nominal parameters cannot explain."""
    columns = slopes[mine].reshape(-1, slopes.shape[-1])
    columns = columns[:, np.abs(columns).max(axis=0) > 0]
    return float((complement(columns)(residual[mine].ravel()) ** 2).sum())


def _pieces(log: Log, problem: Problem, dt: float, signals: tuple[str, ...]) -> Segments:
    """The short segments of every run in which the robot is fastest; the same ones, whatever its controller's times."""
    runs = log.runs
    cut = segments.cut(runs, problem.horizons[0], dt, problem.bin_rows / log.rate_hz)
    moves = np.abs(np.diff(cut.segments.measured[:, :, 0], axis=1)).sum(axis=(1, 2))
    chosen = []
    for number in range(len(runs)):
        mine = np.flatnonzero(cut.run == number)
        chosen.append(np.sort(mine[np.argsort(-moves[mine])[:_SEGMENTS]]))
    kept = np.concatenate(chosen)
    return Segments(
        inputs=jax.tree.map(lambda leaf: leaf[kept], cut.segments),
        signals={name: cut.signals[name][kept] for name in signals},
        steps=cut.segments.target.shape[1] - round(segments.HISTORY_S / dt),
        run=cut.run[kept],
        regimes=np.zeros((len(kept), cut.row.shape[1], 1), int),
    )
