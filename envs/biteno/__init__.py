"""The biped BITeno: model, task and gait."""

from envs.biteno.env import Biteno, BraxBiteno, State, TaskConfig

__all__ = ["Biteno", "BraxBiteno", "State", "TaskConfig"]
