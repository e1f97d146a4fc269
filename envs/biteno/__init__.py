"""The biped BITeno: model, task and gait."""

from envs.biteno.env import Biteno, BraxBiteno, Drive, Motion, State, TaskConfig

__all__ = ["Biteno", "BraxBiteno", "Drive", "Motion", "State", "TaskConfig"]
