"""The biped BITeno: model, task and gait."""

from envs.biteno.batch import BraxBiteno
from envs.biteno.corrected import CorrectedBiteno, make
from envs.biteno.env import Biteno, Drive, Motion, State, TaskConfig

__all__ = ["Biteno", "BraxBiteno", "CorrectedBiteno", "Drive", "Motion", "State", "TaskConfig", "make"]
