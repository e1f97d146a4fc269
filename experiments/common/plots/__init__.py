"""Every picture the experiments draw."""

from experiments.common.plots.base import embedded
from experiments.common.plots.discovery import confusion, heat_map, ladder, suspicions, traces
from experiments.common.plots.tuning import rounds, sim2sim, sweep, training, transfer
from experiments.common.plots.walking import gait, gaps

__all__ = [
    "confusion",
    "embedded",
    "gait",
    "gaps",
    "heat_map",
    "ladder",
    "rounds",
    "sim2sim",
    "suspicions",
    "sweep",
    "traces",
    "training",
    "transfer",
]
