"""Finds when within its period the controller of each run ticks, which no log says."""

from dataclasses import replace

import jax
import numpy as np

from envs import segments
from envs.logs import Log
from jaxtune.discovery.least_squares import complement
from jaxtune.discovery.noise_floor import prior_directions
from jaxtune.discovery.problem import Problem, Segments
from jaxtune.discovery.simulation import residuals

_SEGMENTS = 12  # of a run, those whose targets move most


def with_phases(log: Log, problem: Problem, dt: float, signals: tuple[str, ...]) -> Log:
    """Sets every run's phase: the time from its first row to the controller's first tick.

    The nominal model simulates the shortest segments with each phase that the simulation's step can resolve. What the
    nominal parameters could explain is taken out, and the phase that leaves least is taken. A controller that ticks at
    every step has only one.

    Args:
      log: as it was read.
      problem: of the log, with all phases zero.
      dt: step of the simulation in s.
      signals: names of the signals that are compared.
    """
    period = 1.0 / log.runs[0].controller.rate_hz
    phases = np.arange(0.0, period - 0.5 * dt, dt)
    if len(phases) < 2 or "target" not in log.runs[0].signals:
        return log
    directions = prior_directions(problem).directions
    left = []
    for phase in phases:
        pieces = _pieces(log, phase, problem, dt, signals)
        if not left:
            found = residuals(problem, np.concatenate([np.zeros((1, problem.axes)), directions]), pieces)
            slopes, first = np.moveaxis(found[1:] - found[:1], 0, -1), found[0]
            scale = np.sqrt((first**2).mean(axis=(0, 1)))
        now = residuals(problem, np.zeros(problem.axes), pieces)[0] / scale
        left.append([_unexplained(now, slopes / scale[:, None], pieces.run == run) for run in range(len(log.runs))])
    best = phases[np.argmin(left, axis=0)]
    return replace(log, runs=tuple(replace(run, phase_s=float(at)) for run, at in zip(log.runs, best, strict=True)))


def _unexplained(residual: np.ndarray, slopes: np.ndarray, mine: np.ndarray) -> float:
    """Sum of squares of a run's residuals that the nominal parameters cannot explain."""
    columns = slopes[mine].reshape(-1, slopes.shape[-1])
    columns = columns[:, np.abs(columns).max(axis=0) > 0]
    return float((complement(columns)(residual[mine].ravel()) ** 2).sum())


def _pieces(log: Log, phase: float, problem: Problem, dt: float, signals: tuple[str, ...]) -> Segments:
    """The liveliest short segments of every run, cut with one phase for all."""
    runs = [replace(run, phase_s=float(phase)) for run in log.runs]
    cut = segments.cut(runs, problem.horizons[0], dt, problem.bin_rows / log.rate_hz)
    moves = np.abs(np.diff(cut.segments.target, axis=1)).sum(axis=(1, 2))
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
