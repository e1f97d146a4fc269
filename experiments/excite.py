"""Writes joint targets that make missing effects visible in a log: `python -m experiments.excite --robot MJCF --out D`.

The result is a log without measurements. Play its targets on the robot, suspended or clamped, and add the measured
columns; `experiments.discover` then reads the log. The motion is described in `experiments.discovery.target_runs`.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from envs import models
from envs.held import held_joints, independent_joints, unread_joints
from envs.logs import Controller, Convention, Log, read_any, write
from experiments.common.cli import console, run
from experiments.discovery.excitation import controller_of, excitation, passive
from experiments.discovery.rehearsal import rehearsal, run_of
from experiments.discovery.target_runs import MOTIONS

_MOST = {"seconds": 3600.0, "rate_hz": 1e5, "kp": 1e6, "torque_limit_nm": 1e5, "control_hz": 1e5}
"""Largest values of options: what a robot can be, and what fits into memory."""
_MOST_ROWS = 2e7  # of all runs together: five hours at 1 kHz


@dataclass(frozen=True, kw_only=True)
class Args:
    """Writes joint targets for a robot to play, so that discovery can distinguish missing effects in its log."""

    out: Path
    """Folder of the log: meta.yaml, and for every run a run_*.csv with times, joint targets, and whether the motors are
    on."""
    robot: str | None = None
    """Robot: biteno (the default), pendulum, or the path of an MJCF file."""
    like: Path | None = None
    """Folder of a log of the robot. Its joints and controller are taken, in the place of joints, kp, kd,
    torque_limit_nm and control_hz, and its model unless robot is given. Targets are written in its units and signs."""
    runs: int = 6
    """Number of runs; 4 or more, so that they can be split into train, select and sealed."""
    seconds: float = 3.0
    """Length of a run in s."""
    rate_hz: float = 500.0
    """Rows per second of the log."""
    joints: tuple[str, ...] = ()
    """Joints that move, in the order of the log's columns; all others must be held. If not given, all hinges and slides
    that no equality or tendon couples to others, as it does the fingers of a gripper."""
    kp: tuple[float, ...] = (60.0,)
    """Proportional gain of the joint controllers in Nm/rad: one, or one for each joint. Half of the runs use half of kp
    and kd."""
    kd: tuple[float, ...] = (2.0,)
    """Derivative gain of the joint controllers in Nm s/rad: one, or one for each joint."""
    torque_limit_nm: tuple[float, ...] = (60.0,)
    """Torque limit of the joint controllers in Nm: one, or one for each joint."""
    control_hz: float = 1000.0
    """Rate of the joint controllers in Hz."""
    seed: int = 0
    """Random seed of postures, paces and steps."""
    motion: str = "medley"
    """What the robot does: medley, powered_medley (the same with the motors always on), or one that distinguishes
    certain effects best: slow_triangles, small_steps, large_steps, chirp, soft_chirp, swing or holds."""
    max_speed: float = math.inf
    """Largest speed of the targets in rad/s (m/s for slides). Without it targets jump, as torque limits need it."""


def main(args: Args) -> None:
    """Writes the targets, and the model as one file if it is not a built-in one.

    Raises:
      ValueError: an option is wrong, or the model cannot be read.
    """
    _check(args)
    robot, joints, controller, convention = _described(args) if args.like is None else _alike(args.like, args.robot)
    still = passive(controller)
    if still.all():
        raise ValueError("kp: got 0 for every joint, expected a joint that follows its target")
    spec = models.spec(robot)
    _check_held(spec, joints)
    sizes = (args.runs, args.seconds, args.rate_hz, args.seed, args.motion, still, args.max_speed)
    follow = rehearsal(spec, joints, controller, args.seconds)
    if follow is None:
        console.print("note: what the motions would strike is looked for in the targets alone", highlight=False)
    runs = tuple(run_of(one, controller) for one in excitation(spec, joints, *sizes, follow))
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
        f"wrote {len(runs)} runs of {args.seconds:g} s for {', '.join(joints)} to {args.out}. For each run, move the "
        "robot to the first targets slowly, wait until it is still, and play the rest. Add the measured columns to the "
        "run's file or a copy of it: q.*, and dq.* if there is a sensor.",
        markup=False,
    )


def _check_held(spec: mujoco.MjSpec, joints: tuple[str, ...]) -> None:
    """Says which joints must be held, and refuses a model of which others would not be read but may swing."""
    if others := unread_joints(models.suspended(spec, joints), joints):
        raise ValueError(f"joints: got none of {', '.join(others)}, expected all that may move and that no motor holds")
    if found := held_joints(spec, joints):
        console.print(f"note: to be held where the model draws them: {', '.join(found)}", highlight=False, markup=False)


def _described(args: Args) -> tuple[str, tuple[str, ...], Controller, Convention]:
    """Robot, joints and controller as the options say, in the model's units and signs."""
    robot = args.robot or "biteno"
    spec = models.spec(robot)
    joints = args.joints or independent_joints(spec)
    if not joints or not all(joints):
        raise ValueError(f"robot: got '{robot}' with joints {joints}, expected hinges or slides that have names")
    # A free joint is the base, which is held, and a ball joint has no scalar target.
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    known = {joint.name for joint in spec.joints if joint.type in kinds} - {""}
    if len(set(joints) & known) < len(joints):
        raise ValueError(f"joints: got {', '.join(joints)}, expected some of {', '.join(sorted(known))}, each once")
    every = {}
    for name in ("kp", "kd", "torque_limit_nm"):
        values = getattr(args, name)
        if len(values) not in (1, len(joints)):
            raise ValueError(f"{name}: got {len(values)} values, expected one, or {len(joints)}: {', '.join(joints)}")
        every[name] = np.resize(np.array(values, float), len(joints))
    return robot, joints, Controller(kind="pd", rate_hz=args.control_hz, gains=every), Convention()


def _alike(folder: Path, robot: str | None) -> tuple[str, tuple[str, ...], Controller, Convention]:
    """Robot, joints, controller, units and signs of a log, which may be read with another model."""
    log = read_any(folder, robot and Path(robot))
    controller = controller_of(log)
    if controller.kind == "unknown":
        raise ValueError(
            f"{folder}: controller.type: got unknown, expected one that plays targets: give --robot, --kp, ..."
        )
    return log.robot, log.joints, controller, log.convention


def _check(args: Args) -> None:
    """Checks every number, before the model is read."""
    for name in ("joints", "kp", "kd", "torque_limit_nm", "control_hz") if args.like else ():
        if getattr(args, name) != Args.__dataclass_fields__[name].default:
            raise ValueError(f"{name}: got {getattr(args, name)} and like, expected one of the two: a log has its own")
    for name, most in _MOST.items():
        for value in np.atleast_1d(getattr(args, name)):
            if not 0 < value <= most:
                raise ValueError(f"{name}: got {value:g}, expected more than 0 and at most {most:g}")
    for value in args.kd:
        if not 0 <= value <= _MOST["kp"]:
            raise ValueError(f"kd: got {value:g}, expected 0 to {_MOST['kp']:g}")
    if not args.max_speed > 0:
        raise ValueError(f"max_speed: got {args.max_speed:g}, expected more than 0")
    if args.seed < 0:
        raise ValueError(f"seed: got {args.seed}, expected a number that is not negative")
    if args.runs < 4:
        raise ValueError(f"runs: got {args.runs}, expected 4 or more")
    if args.runs * args.seconds * args.rate_hz > _MOST_ROWS:
        raise ValueError(
            f"runs, seconds, rate_hz: got {args.runs}, {args.seconds:g} and {args.rate_hz:g}, expected {_MOST_ROWS:g} "
            "rows together at most"
        )
    if args.motion not in MOTIONS:
        raise ValueError(f"motion: got '{args.motion}', expected one of {', '.join(MOTIONS)}")
    if args.out.exists() and any(args.out.iterdir()):
        raise ValueError(f"out: got {args.out}, expected a new or empty folder")


if __name__ == "__main__":
    run(main, Args)
