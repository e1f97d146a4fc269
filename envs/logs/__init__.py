"""Measured logs: a folder of `meta.yaml` and runs, read with every check, or refused with file, row and column.

A log records how a robot was held, how its joints were controlled and what was measured. A run is one continuous
recording: `run_000.csv`, `.npz`, `.parquet`, or a ROS bag. Whatever names, units and signs a log has, `read` returns
those of the model: joint positions and targets in rad, velocities in rad/s, torques in Nm, all about the model's axes.
`units` and `sign` of `meta.yaml` concern these four signals alone. Nothing is dropped, reordered or filled.
"""

from envs.logs.controller import Controller, Impedance
from envs.logs.files import read, read_observed, write
from envs.logs.format import Convention, Log, Run, splits, with_halves_swapped, with_splits
from envs.logs.xl330 import read_any, read_xl330

__all__ = [
    "Controller",
    "Convention",
    "Impedance",
    "Log",
    "Run",
    "read",
    "read_any",
    "read_observed",
    "read_xl330",
    "splits",
    "with_halves_swapped",
    "with_splits",
    "write",
]
