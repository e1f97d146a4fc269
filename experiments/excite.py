"""Writes targets in which missing effects are distinguishable: `python -m experiments.excite --robot MODEL --out DIR`.

What is written is a log without measurements. Play its targets on the robot, suspended or clamped, and put what was
measured beside them; `experiments.discover` then reads the log. `experiments.discovery.excitation` says what the motion
is made of.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from envs import models
from envs.logs import Controller, Log, Run, write
from experiments.common.cli import console, run
from experiments.discovery.excitation import excitation, scaled


@dataclass(frozen=True, kw_only=True)
class Args:
    """Writes targets for a log in which missing effects are distinguishable."""

    out: Path
    """Folder of the log: meta.yaml, and a run_*.csv of times, targets and motor switches for every run."""
    robot: str = "biteno"
    """biteno, pendulum, or the path of an MJCF file."""
    runs: int = 6
    """Number of runs, 4 or more."""
    seconds: float = 3.0
    """Length of a run."""
    rate_hz: float = 500.0
    """Rows a second."""
    kp: float = 60.0
    """Proportional gain of the joint controllers in Nm/rad. Half of the runs have half of both gains."""
    kd: float = 2.0
    """Damping of the joint controllers in Nm s/rad."""
    torque_limit_nm: float = 60.0
    """Torque limit of the joint controllers."""
    control_hz: float = 1000.0
    """Rate of the joint controllers."""
    seed: int = 0
    """Seed of postures and steps."""


def main(args: Args) -> None:
    """Writes the targets, and a copy of the model where it is not a built-in one."""
    for name in ("seconds", "rate_hz", "kp", "torque_limit_nm", "control_hz"):
        if not 0 < getattr(args, name) < np.inf:
            raise ValueError(f"{name}: got {getattr(args, name)}, expected a positive, finite number")
    spec = models.spec(args.robot)
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    joints = tuple(joint.name for joint in spec.joints if joint.type in kinds)
    everywhere = np.ones(len(joints))
    gains = {"kp": args.kp, "kd": args.kd, "torque_limit_nm": args.torque_limit_nm}
    controller = Controller(
        kind="pd", rate_hz=args.control_hz, gains={name: value * everywhere for name, value in gains.items()}
    )
    runs = tuple(
        Run(
            name=one.name,
            condition=one.condition,
            split=one.split,
            controller=scaled(controller, one.gain),
            time=one.time,
            signals={"target": one.target, "enabled": one.enabled},
        )
        for one in excitation(spec, joints, args.runs, args.seconds, args.rate_hz, args.seed)
    )
    built_in = args.robot in models.BUILT_IN
    name = args.robot if built_in else Path(args.robot).name
    write(Log(robot=name, base="fixed", rate_hz=args.rate_hz, joints=joints, policy=None, runs=runs), args.out)
    if not built_in:
        shutil.copy(args.robot, args.out / name)
    console.print(
        f"{len(runs)} runs of {args.seconds:g} s for {', '.join(joints)} in {args.out}: play each run's targets, and "
        "write what was measured into the same files or copies of them (q.*, and dq.* where there is a sensor)"
    )


if __name__ == "__main__":
    run(main, Args)
