"""The biped BITeno: its model, the walking task of the paper and the gait that the task rewards.

`Biteno` is one robot, pure and unbatched; `BraxBiteno` is a batch of them behind Brax's interface, for PPO. The robot
that discovery corrected is in `envs.corrected`.
"""

from envs.biteno.batch import BraxBiteno
from envs.biteno.env import Biteno, Drive, Motion, State, TaskConfig

__all__ = ["Biteno", "BraxBiteno", "Drive", "Motion", "State", "TaskConfig"]
