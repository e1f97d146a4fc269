"""Compares tuning methods on a stand-in robot (the paper's Fig. 6): `python -m experiments.sim2real_bench --out DIR`.

The learner's simulator starts with all masses at half of the robot's, and the first policy was trained there. The robot
is a process of its own (`experiments.robot_stub`) that has what real robots have and the nominal model lacks: delay,
motor lag, noise, drift, another friction. Falls in the walks of the rounds are the price of tuning. At the end each
policy is evaluated in further walks, from which nothing is learnt.
"""

import os
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import numpy as np
from rich.table import Table

from envs import corrected, logs
from envs.biteno import constants, walks
from envs.targets import recorded
from experiments.common import checkpoint, compiler, plots
from experiments.common.cli import bars, console, count, run
from experiments.common.config import preset
from experiments.common.files import as_json, from_json, read_json, write_json
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
"""`ours` (gate and posterior update), `spm` (the paper's update without the gate), `dr` (wide domain randomisation,
never tuned) and `oracle` (trained with the robot's masses and friction)."""

_DR_RADIUS = 0.4
_LEGS = ("abductor_mass", "thigh_mass", "shank_mass")
_ANSWER_S = 900.0  # how long the stand-in may take for the walks of a request
_DAY_S = 86400.0  # longer than any round: the stand-in ends with its `with` block, not by itself
_EVALUATION_SEED = 999_000  # far from the seeds of the rounds, so evaluation walks are new ones


@dataclass(frozen=True, kw_only=True)
class Args:
    """Compares tuning methods on a simulated robot that answers through log files, as a real one would."""

    out: Path = Path("runs/sim2real_bench")
    """Folder of the results. The same command with the same folder continues where it was. Several processes may share
    the folder with a seed each; a last call with all seeds then writes summary.json and fig6.png."""
    methods: tuple[str, ...] = METHODS
    """Methods to compare: ours, spm (the paper's update without the gate), dr (wide domain randomisation without
    tuning), oracle (trained with the robot's masses and friction)."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Random seeds; every method runs once with each."""
    rounds: int = 5
    """Rounds of every method; in each the robot walks and the policy trains."""
    mass: float = 0.5
    """Where the simulator's masses start, as a multiple of the robot's masses. With --model, as a multiple of the
    corrected model's masses."""
    walk_s: float = 10.0
    """Length of a walk in s."""
    evaluation: int = 20
    """Number of walks in which a policy is evaluated before the first round and after the last."""
    model: Path | None = None
    """Folder of a corrected model of the robot, written by discovery (`OUT/model`), in which all methods learn; the
    nominal model if not given."""
    preset: str = "cpu"
    """Size of the run: smoke (minutes, to see that it works), cpu (two cores) or gpu (one GPU)."""
    noise: float = 0.2
    """Noise of simulated sensors, as a multiple of envs.sensing.NOISE."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one method with one seed: its rounds, and how the policy walks before and after them."""

    seed: int
    rounds: list[Round]
    start: WalkMeans
    """Evaluation of the policy that all methods of the seed begin with."""
    end: WalkMeans
    """Evaluation of the policy after the last round."""


def check(args: Args) -> None:
    """Checks the arguments, and the options of every run that they lead to, before anything is compiled.

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
    """Returns the options of one method with one seed, with which `experiments.sim2real` would play the same run.

    Args:
      args: of the benchmark.
      method: one of `METHODS`. `oracle` is `dr` with a small radius around the stand-in's own masses and friction; its
        delay and lag cannot be set in the simulator.
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
        # The stand-in cannot break, and the number of falls is a result, so walks are never withheld.
        terms=Terms(walk_s=args.walk_s, force=True, timeout_s=_ANSWER_S, seed=seed),
        **how | {"start": tuple(f"{name}={value:g}" for name, value in how["start"].items())},
    )


def prepare(args: Args, programs: Programs, seed: int) -> None:
    """Trains the policy that all methods of a seed start with, unless an earlier call did.

    It is the policy that ships, trained further in the nominal model with the wrong masses. So it fits a simulator
    that does not fit the robot, as in the paper.

    Args:
      args: of the benchmark.
      programs: of the nominal model.
      seed: of the training.
    """
    place = args.out / f"start_{seed}" / "learner"
    if (place / "config.json").exists():
        return
    learner = programs.learner
    start = transfers.check(transfer_of(args, "ours", seed))[3]
    dist = learner.dist(start, learner.preset.policy_radius)
    state = programs.machines["ours"].init(starting_policy("walk", learner), dist, knobs())
    state, _ = programs.train(jax.random.PRNGKey(_EVALUATION_SEED + seed), state)
    checkpoint.save(place, state.policy.learner, policy_config(learner))


@contextmanager
def stand_in(folder: Path):
    """Runs the stand-in robot as a process of its own for the duration of a `with` block.

    A separate process shares nothing with the learner but files, as a real robot would.

    Args:
      folder: where it looks for requests; its output goes into `robot_NAME.log` beside the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    options = ["--folder", str(folder.resolve()), "--idle-s", str(_DAY_S), "--parent", str(os.getpid())]
    command = [sys.executable, "-m", "experiments.robot_stub", *options]
    with (folder.parent / f"robot_{folder.name}.log").open("a") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, cwd=Path(__file__).parent.parent)
        try:
            yield process
        finally:
            process.terminate()
            process.wait()


def evaluate(args: Args, programs: Programs, policy: Path) -> WalkMeans:
    """Lets the stand-in walk with a policy, in walks from which nothing is learnt, and summarises them.

    Args:
      args: of the benchmark; `evaluation` walks of `walk_s` seconds are requested.
      programs: their learner loads the policy.
      policy: folder of the policy. The walks are kept in `round_evaluation` beside it, where a second call finds them.
    """
    place = policy.parent / "round_evaluation"
    found = place / "evaluation.json"
    if not found.exists():
        ppo = starting_policy(str(policy), programs.learner).learner
        policy_files.export(place / "policy", ppo, programs.learner)
        request(place, args.evaluation, args.walk_s, _EVALUATION_SEED)
        with stand_in(policy.parent):
            wait(place, _ANSWER_S)
        steps = round(args.walk_s / constants.POLICY_DT_S)
        write_json(found, summarise_walks(*recorded.whole(walks.episodes(logs.read(place / "log"), steps), steps)))
    return from_json(WalkMeans, read_json(found))


def main(args: Args) -> None:
    """Plays and evaluates all runs that are not finished, prints a table, and writes summary.json and fig6.png.

    Raises:
      ValueError: an option is wrong, the folder holds another benchmark, or the stand-in does not answer.
    """
    check(args)
    compiler.set_up(preset(args.preset).xla_flags)
    identity = asdict(args) | {"model_sha256": args.model and corrected.read(args.model).digest}
    # Other processes may play other methods and seeds in the same folder.
    for option in ("out", "methods", "seeds"):
        del identity[option]
    checkpoint.open_run(args.out, identity)
    first = transfer_of(args, "ours", 0)
    programs = transfers.compile_programs(first)
    # The first policy is trained in the nominal model, also where the methods then learn in a corrected one.
    nominal = programs if args.model is None else transfers.compile_programs(replace(first, model=None))
    results: dict[str, list[Outcome]] = {name: [] for name in args.methods}
    with bars() as progress:
        task = progress.add_task("runs", total=len(args.seeds) * len(args.methods))
        for seed in args.seeds:
            # Another process may play other methods of this seed.
            with checkpoint.lock(args.out / f"start_{seed}"):
                prepare(args, nominal, seed)
                before = evaluate(args, programs, args.out / f"start_{seed}" / "learner")
            for name in args.methods:
                transfer = transfer_of(args, name, seed)
                last = transfer.out / f"round_{args.rounds:03d}"
                kept = (last / "round_evaluation").exists()
                with stand_in(transfer.out):
                    rounds = transfers.play(transfer, programs)
                after = evaluate(args, programs, last / "learner")
                results[name].append(Outcome(seed=seed, rounds=rounds, start=before, end=after))
                count(progress, task, sum(map(len, results.values())), kept)
    write_json(args.out / "summary.json", {"methods": results, "versions": checkpoint.versions()})
    plots.transfer(args.out / "fig6.png", as_json(results))
    show(args, results)


def show(args: Args, results: dict[str, list[Outcome]]) -> None:
    """Prints a table with a row for every method: means over seeds, before the first round and after the last."""
    model = f"in {args.model}, " if args.model else ""
    title = f"{model}masses start at {args.mass:g}X, mean over {len(args.seeds)} seed(s), {args.evaluation} walks each"
    table = Table(title=title)
    columns = "method", "return", "share that falls", "power, W", "masses at the end", "walks to tune", "falls in them"
    for column in columns:
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
