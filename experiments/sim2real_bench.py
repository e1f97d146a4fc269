"""The paper's last experiment (Fig. 6) on a stand-in robot: `python -m experiments.sim2real_bench --out DIR`.

The learner starts with all masses at half of the robot's, and a policy that was trained there, in the nominal model.
The robot is a process of its own (`experiments.robot_stub`) that lacks nothing a robot has: delay, lag, noise, drift,
another friction. Nobody learns from the walks in which policies are evaluated at the end; those of the rounds are what
tuning is paid with.
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

from envs import correction, logs
from envs.biteno import constants
from envs.targets import recorded
from experiments import checkpoint, export, plots, sim2real
from experiments.checkpoint import write_json
from experiments.config import preset
from experiments.loop import walked
from experiments.robot_body import Body
from experiments.robot_folder import request, wait
from experiments.rounds import Simulator, Terms
from experiments.train import console, policy_config, run, starting_policy
from jaxtune.tuner import knobs

METHODS = ("ours", "spm", "dr", "oracle")
_DR_RADIUS = 0.4
_LEGS = ("abductor_mass", "thigh_mass", "shank_mass")
_ANSWER_S = 900.0
_DAY_S = 86400.0
_EVALUATION_SEED = 999_000


@dataclass(frozen=True, kw_only=True)
class Args:
    """Compares what methods make of a robot that answers through log files."""

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


def check(args: Args) -> None:
    """Reads the arguments.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    for name in args.methods:
        if name not in METHODS:
            raise ValueError(f"methods: got '{name}', expected some of {', '.join(METHODS)}")
        sim2real.check(asked(args, name, 0))
    if not args.methods or not args.seeds:
        raise ValueError("methods, seeds: got none, expected one or more of each")
    for option in ("rounds", "evaluation"):
        if getattr(args, option) < 1:
            raise ValueError(f"{option}: got {getattr(args, option)}, expected 1 or more")


def asked(args: Args, method: str, seed: int) -> sim2real.Args:
    """The command that plays a method's rounds."""
    body = Body()
    truth = {"trunk_mass": body.trunk_mass, **dict.fromkeys(_LEGS, body.leg_mass)}
    start = {name: args.mass * value for name, value in truth.items()}
    # Who knows the robot trains with what it has, as far as the simulator can have it.
    known = truth | {"foot_friction": body.foot_friction}
    how = {
        "ours": {"method": "ours", "start": start},
        "spm": {"method": "spm", "start": start},
        "dr": {"method": "dr", "start": start, "radius": _DR_RADIUS},
        "oracle": {"method": "dr", "start": known, "radius": preset(args.preset).policy_radius},
    }[method]
    return sim2real.Args(
        out=args.out / f"{method}_{seed}",
        rounds=args.rounds,
        policy=str(args.out / f"start_{seed}" / "learner"),
        model=args.model,
        noise=args.noise,
        preset=args.preset,
        # A stand-in may fall: what that costs is what is measured.
        terms=Terms(walk_s=args.walk_s, force=True, timeout_s=_ANSWER_S, seed=seed),
        **how | {"start": tuple(f"{name}={value:g}" for name, value in how["start"].items())},
    )


def prepare(args: Args, learner: Simulator, seed: int) -> None:
    """Trains the policy that every method of a seed starts with: the one that ships, at masses that are wrong."""
    place = args.out / f"start_{seed}" / "learner"
    if (place / "config.json").exists():
        return
    loop = learner.loop
    start = sim2real.check(asked(args, "ours", seed))[2]
    dist = loop.dist(start, loop.preset.policy_radius)
    state = learner.machines["ours"].init(starting_policy("walk", loop), dist, knobs())
    state, _ = learner.train(jax.random.PRNGKey(_EVALUATION_SEED + seed), state)
    checkpoint.save(place, state.policy.learner, policy_config(loop))


@contextmanager
def robot(folder: Path):
    """The stand-in, as a process of its own, while it is needed."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable,
        "-m",
        "experiments.robot_stub",
        "--folder",
        str(folder.resolve()),
        "--idle-s",
        str(_DAY_S),
    ]
    with (folder.parent / f"robot_{folder.name}.log").open("a") as said:
        process = subprocess.Popen(command, stdout=said, stderr=said, cwd=Path(__file__).parent.parent)
        try:
            yield process
        finally:
            process.terminate()
            process.wait()


def evaluate(args: Args, learner: Simulator, policy: Path) -> dict:
    """Return, falls and power of a policy over walks that nobody learns from."""
    place = policy.parent / "round_evaluation"
    found = place / "evaluation.json"
    if not found.exists():
        export.export(place / "policy", starting_policy(str(policy), learner.loop).learner, learner.loop.preset)
        request(place, args.evaluation, args.walk_s, _EVALUATION_SEED)
        with robot(policy.parent):
            wait(place, _ANSWER_S)
        steps = round(args.walk_s / constants.POLICY_DT_S)
        write_json(found, walked(*recorded.whole(recorded.episodes(logs.read(place / "log"), steps), steps)))
    return json.loads(found.read_text())


def main(args: Args) -> None:
    """Plays what has not been played, evaluates, prints and draws."""
    check(args)
    checkpoint.set_up_compiler(preset(args.preset).xla_flags)
    identity = asdict(args) | {"model_sha256": args.model and correction.read(args.model).digest}
    for option in ("out", "methods", "seeds"):
        del identity[option]
    checkpoint.open_run(args.out, identity)
    learner = sim2real.simulator(asked(args, "ours", 0))
    nominal = learner if args.model is None else sim2real.simulator(replace(asked(args, "ours", 0), model=None))
    results: dict[str, list[dict]] = {name: [] for name in args.methods}
    for seed in args.seeds:
        prepare(args, nominal, seed)
        before = evaluate(args, learner, args.out / f"start_{seed}" / "learner")
        for name in args.methods:
            command = asked(args, name, seed)
            with robot(command.out):
                rounds = sim2real.play(command, learner)
            after = evaluate(args, learner, command.out / f"round_{args.rounds:03d}" / "learner")
            results[name].append({"seed": seed, "rounds": rounds, "start": before, "end": after})
    write_json(args.out / "summary.json", {"methods": results, "versions": checkpoint.versions()})
    plots.transfer(args.out / "fig6.png", results)
    show(args, results)


def show(args: Args, results: dict[str, list[dict]]) -> None:
    """Prints a row for every method: means over seeds."""
    model = f"in {args.model}, " if args.model else ""
    title = f"{model}masses at {args.mass:g}X, mean over {len(args.seeds)} seed(s), {args.evaluation} walks each"
    table = Table(title=title)
    for column in ("method", "return", "share that falls", "power, W", "masses at the end", "robot's walks", "falls"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for name, runs in results.items():
        change = [
            f"{np.mean([one['start'][key] for one in runs]):.2f} -> {np.mean([one['end'][key] for one in runs]):.2f}"
            for key in ("return", "fall_rate", "power_w")
        ]
        moved = [one["rounds"][-1]["tuning"]["moved"] for one in runs]
        masses = np.mean([[ends["after"] for key, ends in one.items() if key.endswith("_mass")] for one in moved])
        measured = [line["measured"] for one in runs for line in one["rounds"]]
        walks = sum(one["episodes"] for one in measured) / len(runs)
        falls = sum(one["episodes"] * one["fall_rate"] for one in measured) / len(runs)
        table.add_row(name, *change, f"{masses:.2f}", f"{walks:.0f}", f"{falls:.1f}")
    console.print(table)


if __name__ == "__main__":
    run(main, Args)
