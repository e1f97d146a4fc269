"""The biped BITeno: model, task and gait."""

from envs.biteno.batch import BraxBiteno
from envs.biteno.env import Biteno, Drive, Motion, State, TaskConfig

__all__ = ["Biteno", "BraxBiteno", "Drive", "Motion", "State", "TaskConfig"]
