"""Tunes a simulator to a robot that answers through log files: `python -m experiments.sim2real --out RUN`.

A round predicts how the policy will walk, exports it, requests walks and waits for their log. The log doctor checks the
log and the gate verifies it. The tuner moves the distribution, the policy trains in it, and a report is written.
`experiments.robot.rounds` lists the files in the folder.
"""

from dataclasses import dataclass

from experiments.common import compiler
from experiments.common.cli import run
from experiments.common.config import preset, tell_limits
from experiments.robot.transfer import Transfer, compile_programs, play


@dataclass(frozen=True, kw_only=True)
class Args(Transfer):
    """Tunes a simulator to a robot that answers through log files, round by round."""


def main(args: Args) -> None:
    """Plays all rounds that have not been played yet.

    Raises:
      ValueError: an option is wrong, too many falls are expected, or the robot's log is missing or unusable.
    """
    compiler.set_up(preset(args.preset).xla_flags)
    tell_limits(preset(args.preset))
    play(args, compile_programs(args))


if __name__ == "__main__":
    run(main, Args)
