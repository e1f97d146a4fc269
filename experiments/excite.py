"""Writes joint targets that make missing effects visible in a log: `python -m experiments.excite --robot MJCF --out D`.

The result is a log without measurements. Play its targets on the robot, suspended or clamped, and add the measured
columns; `experiments.discover` then reads the log. The motion is described in `experiments.discovery.excitation`.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from envs import models
from envs.logs import Controller, Convention, Log, Run, read_any, write
from experiments.common.cli import console, run
from experiments.discovery.excitation import MOTIONS, controller_of, excitation, passive, scaled

_MOST = {"seconds": 3600.0, "rate_hz": 1e5, "kp": 1e6, "torque_limit_nm": 1e5, "control_hz": 1e5}
"""Largest values of options: what a robot can be, and what fits into memory."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Writes joint targets for a robot to play, so that discovery can distinguish missing effects in its log."""

    out: Path
    """Folder of the log: meta.yaml, and for every run a run_*.csv with times, joint targets, and whether the motors are
    on."""
    robot: str | None = None
    """Robot: biteno (the default), pendulum, or the path of an MJCF file."""
    like: Path | None = None
    """Folder of a log of the robot. Its joints and controller are taken, in the place of kp, kd,
    torque_limit_nm and control_hz, and its model unless robot is given. Targets are written in its units and signs."""
    runs: int = 6
    """Number of runs; 4 or more, so that they can be split into train, select and sealed."""
    seconds: float = 3.0
    """Length of a run in s."""
    rate_hz: float = 500.0
    """Rows per second of the log."""
    kp: float = 60.0
    """Proportional gain of the joint controllers in Nm/rad. Half of the runs use half of kp and kd."""
    kd: float = 2.0
    """Derivative gain of the joint controllers in Nm s/rad."""
    torque_limit_nm: float = 60.0
    """Torque limit of the joint controllers in Nm."""
    control_hz: float = 1000.0
    """Rate of the joint controllers in Hz."""
    seed: int = 0
    """Random seed of postures, paces and steps."""
    motion: str = "medley"
    """What the robot does: medley, or one that distinguishes certain effects best: slow_triangles, small_steps,
    large_steps, chirp, soft_chirp, swing or holds."""


def main(args: Args) -> None:
    """Writes the targets, and the model as one file if it is not a built-in one.

    Raises:
      ValueError: an option is wrong, or the model cannot be read.
    """
    _check(args)
    robot, joints, controller, convention = _described(args) if args.like is None else _alike(args.like, args.robot)
    held = passive(controller)
    if held.all():
        raise ValueError("kp: got 0 for every joint, expected a joint that follows its target")
    spec = models.spec(robot)
    runs = tuple(
        Run(
            name=one.name,
            condition=one.condition,
            split=one.split,
            controller=scaled(controller, one.gain),
            time=one.time,
            signals={"target": one.target, "enabled": one.enabled},
        )
        for one in excitation(spec, joints, args.runs, args.seconds, args.rate_hz, args.seed, args.motion, held)
    )
    log = Log(
        robot=robot,
        base="fixed",
        rate_hz=args.rate_hz,
        joints=joints,
        policy=None,
        runs=runs,
        convention=convention,
    )
    write(log, args.out)
    console.print(
        f"wrote {len(runs)} runs of {args.seconds:g} s for {', '.join(joints)} to {args.out}. Play each run's targets "
        "on the robot, and add the measured columns to its file or a copy of it: q.*, and dq.* if there is a sensor.",
        markup=False,
    )


def _described(args: Args) -> tuple[str, tuple[str, ...], Controller, Convention]:
    """Robot, joints and controller as the options say, in the model's units and signs."""
    # A free joint is the base, which is held, and a ball joint has no scalar target.
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    robot = args.robot or "biteno"
    joints = tuple(joint.name for joint in models.spec(robot).joints if joint.type in kinds)
    if not joints or not all(joints):
        raise ValueError(f"robot: got '{robot}' with joints {joints}, expected hinges or slides that have names")
    gains = {"kp": args.kp, "kd": args.kd, "torque_limit_nm": args.torque_limit_nm}
    every = {name: np.full(len(joints), value) for name, value in gains.items()}
    return robot, joints, Controller(kind="pd", rate_hz=args.control_hz, gains=every), Convention()


def _alike(folder: Path, robot: str | None) -> tuple[str, tuple[str, ...], Controller, Convention]:
    """Robot, joints, controller, units and signs of a log, which may be read with another model."""
    log = read_any(folder, robot and Path(robot))
    return log.robot, log.joints, controller_of(log), log.convention


def _check(args: Args) -> None:
    """Checks every number, before the model is read."""
    for name, most in _MOST.items():
        if not 0 < getattr(args, name) <= most:
            raise ValueError(f"{name}: got {getattr(args, name)}, expected more than 0 and at most {most:g}")
    if not 0 <= args.kd <= _MOST["kp"]:
        raise ValueError(f"kd: got {args.kd}, expected 0 to {_MOST['kp']:g}")
    if args.seed < 0:
        raise ValueError(f"seed: got {args.seed}, expected a number that is not negative")
    if args.runs < 4:
        raise ValueError(f"runs: got {args.runs}, expected 4 or more")
    if args.motion not in MOTIONS:
        raise ValueError(f"motion: got '{args.motion}', expected one of {', '.join(MOTIONS)}")
    if args.out.exists() and any(args.out.iterdir()):
        raise ValueError(f"out: got {args.out}, expected a new or empty folder")


if __name__ == "__main__":
    run(main, Args)
