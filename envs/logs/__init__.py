"""Measured logs: a folder of `meta.yaml` and runs, read with every check, or refused with file, row and column.

A log says how a robot was held, how its joints were controlled and what was recorded; a run is one continuous recording
(`run_000.csv` or `run_000.npz`). Whatever units, signs and column names a log has, what is read has the model's: rad,
Nm, s, the model's axes, our names. Nothing is dropped, reordered or filled.
"""

from envs.logs.files import read, write
from envs.logs.format import Controller, Log, Run, splits

__all__ = ["Controller", "Log", "Run", "read", "splits", "write"]
