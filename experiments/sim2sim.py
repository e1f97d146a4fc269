"""Tunes a robot's simulator to another simulator: `python -m experiments.sim2sim --out DIR`.

The simulator starts at its nominal model, in which the starting policy was trained. The target's parameters are the
nominal ones divided by `start`, so the simulator starts at `start` times the target. The tables' error is
|estimate / truth - 1| for multipliers, which is 0.5 at both of the paper's starts, 0.5X and 1.5X; for offsets it is
|estimate - truth| in half widths of their bounds.
"""

import dataclasses
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
from rich.progress import Progress, TaskID

from envs.targets.protocol import Target
from experiments.common import checkpoint, compiler, files, hosts, plots, report
from experiments.common.cli import bars, console, run
from experiments.common.config import Preset, named_values, preset, tell_limits
from experiments.common.files import as_json, read_json, write_json, write_text
from experiments.walking import comparison, memory
from experiments.walking.cases import Case, check_positive, check_seeds, checked_case, errors
from experiments.walking.comparison import METHODS, UPDATES, contenders
from experiments.walking.learner import Learner, Policy
from experiments.walking.policies import default_policy, policy_of_run
from experiments.walking.robots import Kind, kind
from jaxtune import tuner
from jaxtune.mjx import Entry, parameters
from jaxtune.types import ParamDist, Verdict


@dataclass(frozen=True, kw_only=True)
class Args(hosts.HostArgs):
    """Tunes a robot's simulator to a second simulator, the target, and compares tuning methods."""

    out: Path = Path("runs/sim2sim")
    """Folder of the run. The same command with the same folder continues after the last finished (method, seed)."""
    robot: str = "biteno"
    """Robot and task: biteno, go2, playground:NAME (an environment of MuJoCo Playground) or playground-warp:NAME (the
    same by MuJoCo Warp), or path/to/file.py:function, which returns a jaxtune.mjx.Simulator or an environment."""
    case: str = "mass"
    """How the target differs: friction, mass, bullet (the engine PyBullet), weak_motor or weaker_motor (PyBullet with
    0.75 or 0.6 of the torque)."""
    start: float = 0.5
    """Where the simulator starts, as a multiple of the target's values; only the cases friction and mass use it."""
    truth: tuple[str, ...] = ()
    """True values of the target, name=value, in place of what the case says; parameters that are left out are
    nominal."""
    target: str | None = None
    """Engine of the target: mjx, mujoco_c or bullet; the case's own if not given. Robots but biteno have mjx alone."""
    methods: tuple[str, ...] = ("ours", "dr")
    """Methods to compare: ours, spm (the paper's update without the gate), dr (wide domain randomisation without
    tuning), oracle (trained with the target's parameters)."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds; every method runs once with each. Other processes may play other seeds in the same folder; a last
    call with all of them then joins the results."""
    preset: str = "cpu"
    """Size of the run: smoke (a minute, to see that it works), cpu (two cores) or gpu (one GPU)."""
    policy: str | None = None
    """Starting policy: walk (biteno's, ships with the package), scratch (trained first), or a folder of
    experiments.train; if not given, the one that ships, or scratch where none does."""
    parameters: str | None = None
    """Parameters that are tuned: names joined by commas, or a set: for biteno legs6 (foot friction and the six link
    masses; its default) or whole_body (friction, trunk mass, link masses with left and right tied), for other robots
    all, their default."""
    radius: float = 0.2
    """First radius (half width of the distribution) of ours and spm, in log space: 0.2 spans 0.82 to 1.22 times the
    centre."""
    dr_radius: float = 0.4
    """Radius of dr, in log space: 0.4 spans 0.67 to 1.49 times the nominal value."""
    update: str = "posterior"
    """How ours moves the distribution: posterior (move to the estimate, narrow to its interval) or vote (the paper's
    steps)."""
    states: bool = False
    """Whether ours estimates last from measured states, which only a simulated target gives: more exact by far."""
    step_size: float = 0.5
    """Step of the paper's update, in radii per unit of vote; for spm, and for ours with --update vote."""
    widen_factor: float = 2.0
    """The radius is multiplied by this every time the gate rejects."""
    level: float = 0.95
    """Quantile of the novelty of held-out simulated sets that is the gate's threshold; 1 - level is the rate of false
    alarms."""
    threshold: float | None = None
    """Fixed threshold of the gate, a mean rank between 0 and 1, instead of the calibrated one."""


def check(args: Args) -> tuple[Preset, Kind, dict[str, Entry], Case, tuner.Knobs]:
    """Checks the arguments before anything is compiled.

    Returns:
      Sizes, the robot, the table of its parameters that are tuned, the case, and the tuner's knobs.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    sizes, robot = preset(args.preset), kind(args.robot)
    entries = robot.chosen(args.parameters)
    for option, values, allowed in (("update", (args.update,), UPDATES), ("methods", args.methods, METHODS)):
        for value in values:
            if value not in allowed:
                raise ValueError(f"{option}: got '{value}', expected one of {', '.join(allowed)}")
    if not args.methods:
        raise ValueError(f"methods: got none, expected some of {', '.join(METHODS)}")
    if args.states and not ("ours" in args.methods and args.update == "posterior"):
        raise ValueError("states: got true, expected method ours with the update posterior: no other one reads states")
    truth = named_values("truth", args.truth, robot.entries)
    case = checked_case(args.case, args.start, entries, engines=robot.engines, target=args.target, truth=truth)
    check_positive(radius=args.radius, dr_radius=args.dr_radius)
    check_seeds(args.seeds)
    knobs = tuner.knobs(
        step_size=args.step_size, widen_factor=args.widen_factor, level=args.level, threshold=args.threshold
    )
    if args.threshold is None:
        sizes.tuner.check_level(args.level)
    return sizes, robot, entries, case, knobs


class Runner:
    """Runs every (method, seed) pair, and keeps the result of each in a file of its own.

    A pair whose file exists is read instead of run again, so an interrupted run continues with its next pair.

    Args:
      args: options of the command.
      learner: gives the tuner its functions.
      target: what is tuned to.
      policy: what every pair starts with.
      knobs: scalars of the tuner, such as step size and level.
    """

    def __init__(self, args: Args, learner: Learner, target: Target, policy: Policy, knobs: tuner.Knobs):
        self._args, self._learner, self._target, self._knobs = args, learner, target, knobs
        self._play = learner.play(target)
        self._contenders = contenders(
            learner, target, policy, radius=args.radius, dr_radius=args.dr_radius, update=args.update
        )
        self._steps = {name: learner.step(one.tuner, self._play) for name, one in self._contenders.items()}

    def __call__(self, name: str, seed: int, progress: Progress) -> dict:
        """Runs one pair, or reads the result of an earlier call.

        Args:
          name: of the method.
          seed: of everything random.
          progress: display that gets a bar for the pair.

        Returns:
          `lines`, the metrics before the first tuning and after each, and `measured_episodes`, their total number.

        Raises:
          ValueError: another process runs this pair, or its result is damaged.
        """
        path = self._args.out / "results" / f"{name}_{seed}.json"
        tunings = self._learner.preset.tunings
        task = progress.add_task(f"{name} seed {seed}", total=tunings)
        if not files.exists(path):
            with checkpoint.lock(path):
                lines = self._play_tunings(name, seed, progress, task)
                sets = self._contenders[name].sets * tunings
                write_json(path, {"lines": lines, "measured_episodes": sets * self._learner.preset.tuner.set_episodes})
        progress.update(task, completed=tunings)
        return read_json(path)

    def _play_tunings(self, name: str, seed: int, progress: Progress, task: TaskID) -> list[dict]:
        lines = []
        for line in self._tunings(name, seed):
            lines.append(line)
            files.append_line(self._args.out / "metrics.jsonl", line)
            note = f" return {line['return']:.1f} {' '.join(line.get('verdicts', ()))}"
            progress.update(task, completed=line["tuning"], description=f"{name} seed {seed}{note}")
        return lines

    def _tunings(self, name: str, seed: int) -> Iterator[dict]:
        contender, step = self._contenders[name], self._steps[name]
        key = jax.random.PRNGKey(seed)
        key_evaluate, key_steps = jax.random.split(key)
        state = contender.tuner.init(contender.policy, contender.dist, self._knobs)
        begin = time.monotonic()
        info = None
        for index in range(self._learner.preset.tunings + 1):
            if index:
                state, info = step(jax.random.fold_in(key_steps, index), state)
                self._check_walked(info)
            # The same key for every evaluation: commands and resets are the same, so returns compare.
            value, falls = self._learner.evaluate(key_evaluate, state.policy, self._play)
            line = {"method": name, "seed": seed, "tuning": index, "return": value, "falls": falls}
            line |= self._describe(state.dist) | (report.tuning(info) if info is not None else {})
            yield as_json(line | {"seconds": time.monotonic() - begin})

    def _check_walked(self, info: tuner.Info) -> None:
        verdict = info.verdicts[int(info.calls) - 1] if info.calls else Verdict.ACCEPT
        # Further tunings would measure the same falls, since nothing was learnt from these.
        nothing = verdict in (Verdict.NOT_FINITE, Verdict.NOT_COMPARABLE)
        if nothing and info.measured_falls == self._learner.preset.tuner.set_episodes:
            raise ValueError(
                f"target: every measured episode fell or broke, and too few, here or in simulation, lasted for the "
                f"{self._learner.preset.tuner.dvm.window} steps of a window: start from a policy that can stand there"
            )

    def _describe(self, dist: ParamDist) -> dict:
        entries = self._learner.entries
        centre = parameters.from_coords(entries, dist.centre)
        return {
            "estimate": {name: float(value) for name, value in centre.items()},
            "radii": {name: float(value) for name, value in dist.radius.items()},
            "param_error": {name: float(error) for name, error in errors(entries, centre, self._target.params).items()},
        }


def main(args: Args) -> None:
    """Runs every pair that is not finished, writes metrics, summary and plots, and prints two tables.

    Raises:
      ValueError: an option is wrong, the run does not fit into memory, the folder holds another, or no measured episode
        lasts as long as a window.
    """
    compiler.set_up(preset(args.preset).xla_flags)
    hosts.join(args)
    sizes, robot, entries, case, knobs = check(args)
    args = dataclasses.replace(args, policy=args.policy or default_policy(robot))
    identity = {**dataclasses.asdict(args), **robot.identity, "sizes": sizes}
    # Other calls may play other methods and seeds in the same folder, on other machines.
    for option in ("out", "methods", "seeds", *hosts.OPTIONS):
        del identity[option]
    hidden = parameters.select(robot.entries, [name for name in case.hidden if name not in entries])
    learner = Learner(sizes, entries, hidden, kind=robot, states=args.states)
    memory.check(learner)
    if "ours" in args.methods:
        tell_limits(sizes)
    policy = policy_of_run(args.policy, learner)
    checkpoint.open_run(args.out, identity)
    target = robot.engines[case.target](learner.robot, case.true_params(entries, args.start))
    runner = Runner(args, learner, target, policy(args.out), knobs)
    with bars() as progress:
        results = {name: [runner(name, seed, progress) for seed in args.seeds] for name in args.methods}
    off = case.off(entries)
    settings = {name: getattr(args, name) for name in ("case", "start", "truth", "target", "preset", "seeds")}
    summary = comparison.summarise(settings, results, off)
    write_json(args.out / "summary.json", summary | {"versions": checkpoint.versions()})
    # The file that grew line by line may also hold lines of a run that was interrupted and started again.
    lines = [line for runs in results.values() for result in runs for line in result["lines"]]
    write_text(args.out / "metrics.jsonl", "".join(json.dumps(line) + "\n" for line in lines))
    plots.sim2sim(args.out, results, off, sizes.epochs)
    comparison.show(console, summary, results)


if __name__ == "__main__":
    run(main, Args)
