"""Targets: where measured episodes come from.

A target is the robot to which a simulator is tuned; `protocol` has its interface. `mjx`, `mujoco_c` and `bullet` are
simulated robots that hide their parameters, each in another engine; `host` is what the last two share. `recorded` makes
episodes of the same form from logs of a robot that walked.
"""
