"""All plots of the commands, as functions from results to a PNG file or a matplotlib figure.

Functions that take a `path` write the file. The others return a figure, which `embedded` puts into a page.
"""

from experiments.common.plots.base import embedded
from experiments.common.plots.discovery import accepted_terms, confusion, heat_map, suspicions, traces
from experiments.common.plots.tuning import misfits, power, recovery, rounds, sim2sim, sweep, training, transfer
from experiments.common.plots.walking import gait, gaps

__all__ = [
    "accepted_terms",
    "confusion",
    "embedded",
    "gait",
    "gaps",
    "heat_map",
    "misfits",
    "power",
    "recovery",
    "rounds",
    "sim2sim",
    "suspicions",
    "sweep",
    "traces",
    "training",
    "transfer",
]
