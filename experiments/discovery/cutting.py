"""Cuts logs into the segments that discovery works on, by split (train, select, sealed) and horizon."""

from collections.abc import Sequence

import jax
import numpy as np

from envs import segments
from envs.logs import Log, splits
from envs.regimes import regimes
from jaxtune.discovery.problem import Segments

BIN_S = 0.01
"""Time in s over which residuals are averaged."""

_LEAST_SEGMENTS = 3  # of a split: a bootstrap needs a few to draw from


def cut_log(log: Log, dt: float, signals: Sequence[str], horizons: Sequence[float]) -> dict[str, dict[float, Segments]]:
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
    labels = [regimes(run) for run in log.runs]
    data: dict[str, dict[float, Segments]] = {split: {} for split in names}
    for horizon in horizons:
        # All runs at once, so that segments have one shape and programs compile once.
        cut = segments.cut(log.runs, horizon, dt, BIN_S)
        label = np.stack([labels[run][rows] for run, rows in zip(cut.run, cut.row, strict=True)])
        for split in names:
            mine = np.array([log.runs[run].name in names[split] for run in cut.run])
            if mine.sum() < _LEAST_SEGMENTS:
                raise ValueError(
                    f"runs: '{split}' has {mine.sum()} segment(s) of {horizon:g} s, expected {_LEAST_SEGMENTS} or "
                    "more: record longer runs or more of them, or choose shorter horizons"
                )
            data[split][horizon] = Segments(
                inputs=jax.tree.map(lambda leaf, mine=mine: leaf[mine], cut.segments),
                signals={name: cut.signals[name][mine] for name in signals},
                steps=cut.segments.target.shape[1] - round(segments.HISTORY_S / dt),
                run=cut.run[mine],
                regimes=label[mine],
            )
    return data
