"""The biped BITeno: its model, the walking task of the paper and the gait that the task rewards.

`Biteno` is one robot, pure and unbatched; `jaxtune.mjx.TrainingBatch` makes a batch of them for PPO. The robot that
discovery corrected is in `envs.corrected`.
"""

from envs.biteno.env import Biteno
from envs.biteno.task import Drive, Motion, State, TaskConfig

__all__ = ["Biteno", "Drive", "Motion", "State", "TaskConfig"]
