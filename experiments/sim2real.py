"""Tunes BITeno's simulator to a robot that answers through log files: `python -m experiments.sim2real --out RUN`.

A round says what the policy will do, exports it, waits for a log, looks it through, verifies and tunes, trains on and
reports (`experiments.rounds`, which tells what is in the folder).
"""

import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from envs import correction, domain
from envs.biteno import constants
from experiments import checkpoint, export, sim2real_report
from experiments.config import Preset, chosen, named_values, preset
from experiments.loop import Loop
from experiments.rounds import METHODS, Run, Simulator, Terms
from experiments.train import console, run, starting_policy


@dataclass(frozen=True, kw_only=True)
class Args:
    """Tunes a simulator to a robot that answers through log files, round by round."""

    out: Path = Path("runs/sim2real")
    """Folder of the run; the same command with the same folder goes on where it was."""
    rounds: int = 5
    """Rounds in all; more may be asked for later."""
    method: str = "ours"
    """ours, spm (the paper's rule without the gate) or dr (a wide distribution that stays)."""
    policy: str = "walk"
    """First policy: walk (ships with the package), scratch (trained first), or a folder of experiments.train."""
    parameters: str = "whole_body"
    """Parameters that are tuned: legs6, whole_body, or names joined by commas."""
    start: tuple[str, ...] = ()
    """Where the distribution starts, as name=value; nominal where not given."""
    radius: float = 0.2
    """First radius in log space; dr trains on all of it."""
    model: Path | None = None
    """Folder of a corrected model that discovery wrote (`OUT/model`), to tune instead of the nominal one."""
    noise: float = 0.2
    """Noise of simulated sensors, in units of `sensing.NOISE`."""
    preset: str = "cpu"
    """Sizes: smoke, cpu or gpu."""
    epochs: int | None = None
    """PPO updates in a round; twice the preset's where not given, after the paper's Fig. 6."""
    terms: Annotated[Terms, tyro.conf.arg(name="")] = field(default_factory=Terms)
    """What the robot is asked for."""


def check(args: Args) -> tuple[Preset, dict[str, domain.Entry], dict[str, float]]:
    """Reads the arguments: sizes, what is tuned, and where it starts.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    sizes, entries = preset(args.preset), chosen(args.parameters)
    if args.method not in METHODS:
        raise ValueError(f"method: got '{args.method}', expected one of {', '.join(METHODS)}")
    epochs = 2 * sizes.epochs if args.epochs is None else args.epochs
    # By option: the least and the largest that is allowed.
    least = {"rounds": 1, "epochs": 1, "radius": 1e-6, "noise": 0, "timeout_s": 0, "max_fall_rate": 0}
    # As long as simulated episodes.
    least["walk_s"] = sizes.episode_steps * constants.POLICY_DT_S
    for option, value in {**asdict(args), **asdict(args.terms), "epochs": epochs}.items():
        most = 1 if option == "max_fall_rate" else sys.float_info.max
        if option in least and not least[option] <= value <= most:
            raise ValueError(f"{option}: got {value}, expected {least[option]:g} to {most:g}")
    start = domain.nominal(entries) | named_values("start", args.start, entries)
    task = replace(sizes.task, noise=args.noise)
    return replace(sizes, task=task, epochs=epochs), entries, start


def simulator(args: Args) -> Simulator:
    """The learner's side of a run; runs that differ in nothing it depends on may share it."""
    sizes, entries, _ = check(args)
    return Simulator(Loop(sizes, entries, correction=args.model and correction.read(args.model)))


def play(args: Args, learner: Simulator) -> list[dict]:
    """Plays the rounds that have not been played, and reports on each; what is known of them all."""
    start = check(args)[2]
    export.needed()
    loop = learner.loop
    # What is wrong with a policy is said before there is a folder; one from scratch is kept in it.
    policy = None if args.policy == "scratch" else starting_policy(args.policy, loop)
    identity = {**asdict(args), "sizes": loop.preset, "terms": {"walk_s": args.terms.walk_s, "seed": args.terms.seed}}
    # A folder may hold another model by the time a run goes on.
    identity["model_sha256"] = args.model and correction.read(args.model).digest
    # Of a run that goes on, these may be others.
    for option in ("out", "rounds"):
        del identity[option]
    checkpoint.open_run(args.out, identity)
    policy = policy or starting_policy(args.policy, loop, args.out)
    rounds = Run(args.out, args.terms, learner, args.method, policy, start, args.radius)
    history: list[dict] = []
    for index in range(args.rounds):
        history.append(rounds.round(index, history))
        page = args.out / f"round_{index:03d}" / "report.html"
        sim2real_report.write(page, history, args.terms)
        sim2real_report.show(console, history)
        console.print(f"report in {page}")
    checkpoint.write_json(args.out / "summary.json", {"rounds": history, "versions": checkpoint.versions()})
    return history


def main(args: Args) -> None:
    """Plays the rounds."""
    checkpoint.set_up_compiler(preset(args.preset).xla_flags)
    play(args, simulator(args))


if __name__ == "__main__":
    run(main, Args)
