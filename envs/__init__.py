"""Robots, tasks, targets and the parameters by which a simulator may be wrong."""
