"""Repeats the paper's Fig. 6 on a stand-in robot: `python -m experiments.sim2real_bench --out DIR`.

The learner starts with all masses at half of the robot's, and with a policy that was trained there, in the nominal
model. The robot is a process of its own (`experiments.robot_stub`) with what a real one has: delay, lag, noise, drift,
another friction. Falls in the walks of the rounds are the price of tuning. At the end each policy is evaluated in
further walks, from which nothing is learnt.
"""

import json
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import numpy as np
from rich.table import Table

from envs import corrected, logs
from envs.biteno import constants
from envs.targets import recorded
from experiments.common import checkpoint, plots
from experiments.common.checkpoint import as_json, from_json, write_json
from experiments.common.cli import console, run
from experiments.common.config import preset
from experiments.robot import policy_files
from experiments.robot import transfer as transfers
from experiments.robot.exchange import request, wait
from experiments.robot.records import Round, WalkMeans
from experiments.robot.rounds import Programs, Terms
from experiments.robot.surrogate import Body
from experiments.robot.transfer import Transfer
from experiments.walking.learner import summarise_walks
from experiments.walking.policies import policy_config, starting_policy
from jaxtune.tuner import knobs

METHODS = ("ours", "spm", "dr", "oracle")
_DR_RADIUS = 0.4
_LEGS = ("abductor_mass", "thigh_mass", "shank_mass")
_ANSWER_S = 900.0
_DAY_S = 86400.0
_EVALUATION_SEED = 999_000


@dataclass(frozen=True, kw_only=True)
class Args:
    """Compares methods on a stand-in robot that answers through log files, from the same start policy."""

    out: Path = Path("runs/sim2real_bench")
    """Folder; the same command with the same folder goes on where it was. Other seeds may run beside it; a last call
    with all of them writes summary and picture."""
    methods: tuple[str, ...] = METHODS
    """Which of ours, spm, dr, oracle."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of everything random."""
    rounds: int = 5
    """Rounds of every method."""
    mass: float = 0.5
    """Where the learner's masses start, as a multiple of the robot's, or of what a corrected model says these are."""
    walk_s: float = 10.0
    """Length of a walk."""
    evaluation: int = 20
    """Walks in which a policy is evaluated before the first round and after the last."""
    model: Path | None = None
    """Folder of a corrected model that discovery wrote of the robot, for what every method learns in from the first
    round on; the nominal one where None."""
    preset: str = "cpu"
    """Sizes: smoke, cpu or gpu."""
    noise: float = 0.2
    """Noise of simulated sensors, in units of `sensing.NOISE`."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one method with one seed: its rounds, and evaluations of the policy before and after them."""

    seed: int
    rounds: list[Round]
    start: WalkMeans
    """Of the policy that every method begins with."""
    end: WalkMeans
    """Of the policy after the last round."""


def check(args: Args) -> None:
    """Checks the arguments, those of every run among them.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    for name in args.methods:
        if name not in METHODS:
            raise ValueError(f"methods: got '{name}', expected some of {', '.join(METHODS)}")
        transfers.check(transfer_of(args, name, 0))
    if not args.methods or not args.seeds:
        raise ValueError("methods, seeds: got none, expected one or more of each")
    for option in ("rounds", "evaluation"):
        if getattr(args, option) < 1:
            raise ValueError(f"{option}: got {getattr(args, option)}, expected 1 or more")


def transfer_of(args: Args, method: str, seed: int) -> Transfer:
    """Returns the run of one method with one seed, as `experiments.sim2real` would play it.

    Args:
      args: of the benchmark.
      method: one of `METHODS`; `oracle` is `dr` around what the stand-in has, as far as the simulator can have it.
      seed: of everything random.
    """
    body = Body()
    truth = {"trunk_mass": body.trunk_mass, **dict.fromkeys(_LEGS, body.leg_mass)}
    start = {name: args.mass * value for name, value in truth.items()}
    known = truth | {"foot_friction": body.foot_friction}
    how = {
        "ours": {"method": "ours", "start": start},
        "spm": {"method": "spm", "start": start},
        "dr": {"method": "dr", "start": start, "radius": _DR_RADIUS},
        "oracle": {"method": "dr", "start": known, "radius": preset(args.preset).policy_radius},
    }[method]
    return Transfer(
        out=args.out / f"{method}_{seed}",
        rounds=args.rounds,
        policy=str(args.out / f"start_{seed}" / "learner"),
        model=args.model,
        noise=args.noise,
        preset=args.preset,
        # Falls cost the stand-in nothing, and how many there are is what is measured.
        terms=Terms(walk_s=args.walk_s, force=True, timeout_s=_ANSWER_S, seed=seed),
        **how | {"start": tuple(f"{name}={value:g}" for name, value in how["start"].items())},
    )


def prepare(args: Args, programs: Programs, seed: int) -> None:
    """Trains the policy that every method of a seed starts with: the one that ships, trained on at wrong masses.

    Args:
      args: of the benchmark.
      programs: of the nominal model.
      seed: of the training.
    """
    place = args.out / f"start_{seed}" / "learner"
    if (place / "config.json").exists():
        return
    learner = programs.learner
    start = transfers.check(transfer_of(args, "ours", seed))[2]
    dist = learner.dist(start, learner.preset.policy_radius)
    state = programs.machines["ours"].init(starting_policy("walk", learner), dist, knobs())
    state, _ = programs.train(jax.random.PRNGKey(_EVALUATION_SEED + seed), state)
    checkpoint.save(place, state.policy.learner, policy_config(learner))


@contextmanager
def stand_in(folder: Path):
    """Runs the stand-in robot as a process of its own for the length of a `with` block.

    Args:
      folder: where it looks for requests; what it prints goes into `robot_NAME.log` beside the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    options = ["--folder", str(folder.resolve()), "--idle-s", str(_DAY_S)]
    command = [sys.executable, "-m", "experiments.robot_stub", *options]
    with (folder.parent / f"robot_{folder.name}.log").open("a") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, cwd=Path(__file__).parent.parent)
        try:
            yield process
        finally:
            process.terminate()
            process.wait()


def evaluate(args: Args, programs: Programs, policy: Path) -> WalkMeans:
    """Has the stand-in walk with a policy, in walks that nothing is learnt from, and summarises them.

    Args:
      args: of the benchmark; `evaluation` walks of `walk_s` are asked for.
      programs: whose learner loads the policy.
      policy: its folder; the walks are kept in `round_evaluation` beside it.
    """
    place = policy.parent / "round_evaluation"
    found = place / "evaluation.json"
    if not found.exists():
        ppo = starting_policy(str(policy), programs.learner).learner
        policy_files.export(place / "policy", ppo, programs.learner.preset)
        request(place, args.evaluation, args.walk_s, _EVALUATION_SEED)
        with stand_in(policy.parent):
            wait(place, _ANSWER_S)
        steps = round(args.walk_s / constants.POLICY_DT_S)
        write_json(found, summarise_walks(*recorded.whole(recorded.episodes(logs.read(place / "log"), steps), steps)))
    return from_json(WalkMeans, json.loads(found.read_text()))


def main(args: Args) -> None:
    """Plays what has not been played, evaluates, prints and draws."""
    check(args)
    checkpoint.set_up_compiler(preset(args.preset).xla_flags)
    identity = asdict(args) | {"model_sha256": args.model and corrected.read(args.model).digest}
    for option in ("out", "methods", "seeds"):
        del identity[option]
    checkpoint.open_run(args.out, identity)
    first = transfer_of(args, "ours", 0)
    programs = transfers.compile_programs(first)
    nominal = programs if args.model is None else transfers.compile_programs(replace(first, model=None))
    results: dict[str, list[Outcome]] = {name: [] for name in args.methods}
    for seed in args.seeds:
        prepare(args, nominal, seed)
        before = evaluate(args, programs, args.out / f"start_{seed}" / "learner")
        for name in args.methods:
            transfer = transfer_of(args, name, seed)
            with stand_in(transfer.out):
                rounds = transfers.play(transfer, programs)
            after = evaluate(args, programs, transfer.out / f"round_{args.rounds:03d}" / "learner")
            results[name].append(Outcome(seed=seed, rounds=rounds, start=before, end=after))
    write_json(args.out / "summary.json", {"methods": results, "versions": checkpoint.versions()})
    plots.transfer(args.out / "fig6.png", as_json(results))
    show(args, results)


def show(args: Args, results: dict[str, list[Outcome]]) -> None:
    """Prints a table with a row for every method.

    Args:
      args: of the benchmark.
      results: outcomes by method; numbers are means over their seeds.
    """
    model = f"in {args.model}, " if args.model else ""
    title = f"{model}masses at {args.mass:g}X, mean over {len(args.seeds)} seed(s), {args.evaluation} walks each"
    table = Table(title=title)
    for column in ("method", "return", "share that falls", "power, W", "masses at the end", "robot's walks", "falls"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for name, runs in results.items():
        change = [
            f"{np.mean([getattr(one.start, key) for one in runs]):.2f} -> "
            f"{np.mean([getattr(one.end, key) for one in runs]):.2f}"
            for key in ("mean_return", "fall_rate", "power_w")
        ]
        moved = [one.rounds[-1].tuning.moved for one in runs]
        masses = np.mean([[ends.after for key, ends in one.items() if key.endswith("_mass")] for one in moved])
        measured = [line.measured for one in runs for line in one.rounds]
        walks = sum(one.episodes for one in measured) / len(runs)
        falls = sum(one.episodes * one.fall_rate for one in measured) / len(runs)
        table.add_row(name, *change, f"{masses:.2f}", f"{walks:.0f}", f"{falls:.1f}")
    console.print(table)


if __name__ == "__main__":
    run(main, Args)
