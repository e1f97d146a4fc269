"""The quadruped Unitree Go2 on the ground: the example of a robot that is no BITeno.

`simulator` is everything that `--robot go2` is made of: a model, a task and a table of parameters. Write the same for a
robot of your own.
"""

from envs.go2.env import JOINTS, MODEL_PATH, Go2, simulator

__all__ = ["JOINTS", "MODEL_PATH", "Go2", "simulator"]
