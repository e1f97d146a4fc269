"""Rehearses targets on simulated robots before a real one plays them: where do they lead it, and where does it fall?"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from envs.logs import Controller, Run
from envs.null_logs import Robot, play
from experiments.discovery.excitation import Unplayable
from experiments.discovery.target_runs import TargetRun, scaled

_ROBOTS = 4  # drawn from the prior, since no model is exact, and a swing least of all
_MOST_TICKS = 60_000  # of a controller in a run, each of which is a step in Python
_FASTEST = 1e3  # rad/s or m/s, of a robot that does not fly apart


def run_of(one: TargetRun, controller: Controller) -> Run:
    """Makes a run of targets, with the controller that plays them."""
    return Run(
        name=one.name,
        condition=one.condition,
        split=one.split,
        controller=scaled(controller, one.gain),
        time=one.time,
        signals={"target": one.target, "enabled": one.enabled},
    )


def rehearsal(
    spec: mujoco.MjSpec, joints: Sequence[str], controller: Controller, seconds: float
) -> Callable[[TargetRun], np.ndarray] | None:
    """Makes the function that says where a run leads robots, [robots, n, joints] rad, as `excitation` takes it.

    Args:
      spec: of the nominal robot.
      joints: names, in the order of the targets' columns.
      controller: that will play the runs.
      seconds: length of a run in s.

    Returns:
      The function, which raises `Unplayable` if a simulated robot flies apart. None where runs cannot be rehearsed: a
      servo's torque depends on its supply, which is not known before, and long ones would take minutes.
    """
    if controller.kind != "pd" or seconds * controller.rate_hz > _MOST_TICKS:
        return None
    robots = [Robot.drawn(spec, joints, np.random.default_rng(seed)) for seed in range(_ROBOTS)]
    # No sensor has been seen yet.
    robots = [replace(robot, noisy=False) for robot in robots]

    def rehearse(one: TargetRun) -> np.ndarray:
        run = run_of(one, controller)
        # It starts where its targets do.
        run = replace(run, signals=run.signals | {"q": one.target})
        states = np.stack([motion.states for motion in play([(robot, run) for robot in robots], joints)])
        if not (np.abs(states[:, :, 1]) < _FASTEST).all():
            raise Unplayable("kp, kd: got gains with which the simulated robot flies apart, expected smaller ones")
        return states[:, :, 0]

    return rehearse
