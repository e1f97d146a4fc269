"""Tunes BITeno's simulator to a robot that answers through log files: `python -m experiments.sim2real --out RUN`.

A round predicts how the policy will walk, exports it, waits for a log, has the doctor look it through, verifies and
tunes, trains on, and reports. `experiments.robot.rounds` says what is in the folder.
"""

from dataclasses import dataclass

from experiments.common import checkpoint
from experiments.common.cli import run
from experiments.common.config import preset
from experiments.robot.transfer import Transfer, compile_programs, play


@dataclass(frozen=True, kw_only=True)
class Args(Transfer):
    """Tunes a simulator to a robot that answers through log files, round by round."""


def main(args: Args) -> None:
    """Plays the rounds that are not played yet, and reports on each one."""
    checkpoint.set_up_compiler(preset(args.preset).xla_flags)
    play(args, compile_programs(args))


if __name__ == "__main__":
    run(main, Args)
