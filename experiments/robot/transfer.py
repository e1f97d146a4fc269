"""A whole run of rounds with a robot: its options, their checks, and the loop over the rounds.

`experiments.sim2real` is this module as a command. `experiments.sim2real_bench` plays many runs with it.
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from envs import corrected
from experiments.common import checkpoint, files
from experiments.common.cli import bars, console
from experiments.common.config import Preset, named_values, preset
from experiments.robot import policy_files, report
from experiments.robot.records import Round
from experiments.robot.rounds import STRATEGIES, Programs, Rounds, Terms
from experiments.walking.learner import Learner
from experiments.walking.policies import default_policy, policy_of_run
from experiments.walking.robots import Kind, kind
from jaxtune.mjx import Entry, nominal


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """Options of a run that tunes a simulator to a robot that answers through log files, round by round."""

    out: Path = Path("runs/sim2real")
    """Folder of the run. The same command with the same folder continues where it was."""
    robot: str = "biteno"
    """Robot and task: biteno, go2, playground:NAME (an environment of MuJoCo Playground) or playground-warp:NAME (the
    same by MuJoCo Warp), or path/to/file.py:function, which returns a jaxtune.mjx.Simulator or an environment."""
    rounds: int = 5
    """Number of rounds; a later call may raise it."""
    method: str = "ours"
    """Tuning method: ours, spm (the paper's update without the gate) or dr (wide domain randomisation without
    tuning)."""
    policy: str | None = None
    """First policy: walk (biteno's, ships with the package), scratch (trained first), or a folder of experiments.train;
    if not given, the one that ships, or scratch where none does."""
    parameters: str | None = None
    """Parameters that are tuned: names joined by commas, or a set: for biteno legs6 (foot friction and the six link
    masses) or whole_body (friction, trunk mass, link masses with left and right tied; its default), for other robots
    all, their default."""
    start: tuple[str, ...] = ()
    """Centre of the first distribution, as name=value, such as trunk_mass=0.5 (a multiple of nominal); nominal if not
    given."""
    radius: float = 0.2
    """First radius (half width of the distribution), in log space: 0.2 spans 0.82 to 1.22 times the centre. dr trains
    its policy on all of it."""
    model: Path | None = None
    """Folder of a corrected model that discovery wrote (`OUT/model`), to tune instead of the nominal model; for biteno
    alone."""
    noise: float = 0.2
    """Factor of the uniform noise of biteno's simulated sensors. At 1 its half widths are 0.1 m/s, 0.2 rad/s, 0.05
    (gravity), 0.01 rad and 1.5 rad/s (joints)."""
    preset: str = "cpu"
    """Size of the run: smoke (minutes, to see that it works), cpu (two cores) or gpu (one GPU)."""
    epochs: int | None = None
    """PPO updates in a round; twice the preset's epochs if not given, as in the paper's Fig. 6."""
    terms: Annotated[Terms, tyro.conf.arg(name="")] = field(default_factory=Terms)
    """Conditions of the walks."""


def check(transfer: Transfer) -> tuple[Preset, Kind, dict[str, Entry], dict[str, float]]:
    """Checks the options before anything is compiled, and looks up what they name.

    Args:
      transfer: options of the run.

    Returns:
      Sizes of the run, the robot, the table of its parameters that are tuned, and where they start (physical values by
      name).

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    sizes, robot = preset(transfer.preset), kind(transfer.robot)
    # A robot that walks free shows its whole body, where it has such a set.
    entries = robot.chosen(transfer.parameters or ("whole_body" if "whole_body" in robot.sets else None))
    if transfer.method not in STRATEGIES:
        raise ValueError(f"method: got '{transfer.method}', expected one of {', '.join(STRATEGIES)}")
    epochs = 2 * sizes.epochs if transfer.epochs is None else transfer.epochs
    least = {"rounds": 1, "epochs": 1, "radius": 1e-6, "noise": 0, "timeout_s": 0, "max_fall_rate": 0}
    # A walk is compared with simulated episodes, so it lasts at least as long as one.
    least["walk_s"] = min(sizes.episode_steps, robot.episode_steps) * robot.control_s
    for option, value in {**asdict(transfer), **asdict(transfer.terms), "epochs": epochs}.items():
        most = 1 if option == "max_fall_rate" else np.inf
        if option in least and not (np.isfinite(value) and least[option] <= value <= most):
            allowed = f"{least[option]:g} " + (f"to {most:g}" if np.isfinite(most) else "or more")
            raise ValueError(f"{option}: got {value}, expected {allowed}")
    start = nominal(entries) | named_values("start", transfer.start, entries)
    task = replace(sizes.task, noise=transfer.noise)
    return replace(sizes, task=task, epochs=epochs), robot, entries, start


def compile_programs(transfer: Transfer) -> Programs:
    """Makes the learner of a run and its programs; runs with the same sizes, parameters and model may share them.

    Args:
      transfer: options of the run.

    Raises:
      ValueError: an option is wrong, or the corrected model cannot be read.
    """
    sizes, robot, entries, _ = check(transfer)
    return Programs(Learner(sizes, entries, correction=transfer.model and corrected.read(transfer.model), kind=robot))


def play(transfer: Transfer, programs: Programs) -> list[Round]:
    """Plays all rounds that have not been played, and reports on each.

    Args:
      transfer: options of the run.
      programs: of `compile_programs`.

    Returns:
      All rounds of the run; `summary.json` holds them too.

    Raises:
      ValueError: an option is wrong, the folder holds another run or belongs to a process that still works there, or
        a round cannot be played.
    """
    start = check(transfer)[3]
    policy_files.require_onnx()
    learner = programs.learner
    transfer = replace(transfer, policy=transfer.policy or default_policy(learner.kind))
    policy = policy_of_run(transfer.policy, learner)
    checkpoint.open_run(transfer.out, learner.kind.identity | _identity(transfer, learner.preset))
    with checkpoint.lock(transfer.out / "summary.json"):
        rounds = Rounds(
            transfer.out, transfer.terms, programs, transfer.method, policy(transfer.out), start, transfer.radius
        )
        history: list[Round] = []
        with bars() as progress:
            task = progress.add_task("", total=transfer.rounds)
            for index in range(transfer.rounds):
                tell = lambda what, index=index: progress.update(task, description=f"round {index} {what}")  # noqa: E731
                history.append(rounds.play(index, history[-1] if history else None, tell))
                page = transfer.out / f"round_{index:03d}" / "report.html"
                report.write(page, history, transfer.terms, programs.learner.kind.name)
                report.show(console, history)
                console.print(f"report in {page}")
                progress.advance(task)
        files.write_json(transfer.out / "summary.json", {"rounds": history, "versions": checkpoint.versions()})
    return history


def _identity(transfer: Transfer, sizes: Preset) -> dict:
    """Lists the options that must be unchanged when a run continues; a later call may change all others."""
    terms = {"walk_s": transfer.terms.walk_s, "seed": transfer.terms.seed}
    identity = {**asdict(transfer), "sizes": sizes, "terms": terms}
    # The folder may hold another model by the time that a run continues, so the model's hash is compared.
    identity["model_sha256"] = transfer.model and corrected.read(transfer.model).digest
    # A later call may find the folder moved, and may play more rounds.
    for option in ("out", "rounds"):
        del identity[option]
    return identity
