"""Tunes the simulator of a walking BITeno to another simulator: `python -m experiments.sim2sim --out DIR`.

The simulator starts at its nominal model, where the starting policy was trained; the target's parameters are the
nominal ones divided by `start`, so that the simulator starts at `start` times the target. What the table calls error
is |estimate / truth - 1|, which is 0.5 at both of the paper's starts, 0.5X and 1.5X.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.progress import Progress

from envs import domain
from envs.biteno import constants
from envs.targets.protocol import Target
from experiments import checkpoint, plots, report
from experiments.checkpoint import as_json, write_json
from experiments.config import Preset, chosen, preset
from experiments.loop import Loop, Policy
from experiments.targets import TARGETS
from experiments.train import bars, console, run, starting_policy
from jaxtune import baselines, tuner
from jaxtune.types import ParamDist, Verdict


@dataclass(frozen=True, kw_only=True)
class Case:
    """How the target differs from the simulator."""

    scaled: Callable[[str], bool] = lambda name: False
    """Which of the tuned parameters the target has otherwise: the nominal ones divided by `start`."""
    hidden: Mapping[str, float] = field(default_factory=dict)
    """What else it has otherwise; nobody tunes it but who asks for it."""
    target: str = "mjx"
    """Its engine."""


CASES = {
    "friction": Case(scaled=lambda name: name == "foot_friction"),
    "mass": Case(scaled=lambda name: name.endswith("_mass")),
    "bullet": Case(target="bullet"),
    "weak_motor": Case(hidden={"torque_scale": 0.75}, target="bullet"),
    "weaker_motor": Case(hidden={"torque_scale": 0.6}, target="bullet"),
}
"""The paper's four gaps, Figs. 3.1 to 3.4, and a harder one."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Tunes a simulator to a target in another simulator, and compares with the baselines."""

    out: Path = Path("runs/sim2sim")
    """Folder of the run; the same command with the same folder goes on after the last finished (method, seed)."""
    case: str = "mass"
    """What is off: friction, mass, bullet (another engine), weak_motor or weaker_motor (0.75 and 0.6 of the torque, in
    bullet)."""
    start: float = 0.5
    """Where the simulator starts, as a multiple of the target; friction and mass alone."""
    target: str | None = None
    """Engine of the target, where not the case's own: mjx, mujoco_c or bullet."""
    methods: tuple[str, ...] = ("ours", "dr")
    """Which of ours, spm, dr, oracle."""
    seeds: int = 1
    """Number of seeds, from 0."""
    preset: str = "cpu"
    """Sizes: smoke, cpu or gpu."""
    policy: str = "walk"
    """Starting policy: walk (ships with the package), scratch (trained first), or a folder of experiments.train."""
    parameters: str = "legs6"
    """Parameters that are tuned: legs6, whole_body, or names joined by commas."""
    radius: float = 0.2
    """First radius of ours and spm, in log space."""
    dr_radius: float = 0.4
    """Radius of domain randomisation."""
    update: str = "posterior"
    """How ours moves the distribution: posterior (sweep, move, narrow) or vote (the paper's rule)."""
    step_size: float = 0.5
    """Radii per unit vote in the paper's rule."""
    widen_factor: float = 1.5
    """What a failed check multiplies the radius by."""
    level: float = 0.95
    """The threshold is this quantile of the novelty of held-out simulated sets."""
    threshold: float | None = None
    """A fixed threshold in its stead, a mean rank between 0 and 1."""


@dataclass(frozen=True)
class Method:
    """One row of the comparison."""

    tuner: Any
    policy: Policy
    dist: ParamDist
    sets: int
    """Measured sets in a tuning."""


UPDATES = {"posterior": tuner.posterior_update, "vote": tuner.vote_update}


def methods(args: Args, loop: Loop, target: Target, policy: Policy) -> dict[str, Method]:
    """The four methods, each the same tuner with other functions or another distribution."""
    nominal = domain.nominal(loop.entries)
    machine = loop.tuner(target)
    untuned = baselines.Untuned(tuner=machine)
    ours = dataclasses.replace(machine, update=UPDATES[args.update])
    start = loop.dist(nominal, args.radius)
    truth = {name: target.params[name] for name in nominal}
    wide = policy.replace(radius=jnp.full_like(policy.radius, args.dr_radius))
    knowing = policy.replace(
        hidden={name: jnp.full_like(value, target.params[name]) for name, value in policy.hidden.items()}
    )
    return {
        "ours": Method(ours, policy, start, 1),
        "spm": Method(baselines.spm(machine), policy, start, 1),
        "dr": Method(untuned, wide, loop.dist(nominal, args.dr_radius), 0),
        "oracle": Method(untuned, knowing, loop.dist(truth, loop.preset.policy_radius), 0),
    }


def check(args: Args) -> tuple[Preset, dict[str, domain.Entry], tuner.Knobs]:
    """Reads the arguments; whatever is wrong with them is said before anything is compiled.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    sizes, entries = preset(args.preset), chosen(args.parameters)
    allowed = {"case": CASES, "update": UPDATES, "methods": ("ours", "spm", "dr", "oracle"), "target": TARGETS}
    for option, values in allowed.items():
        asked = getattr(args, option)
        for value in asked if isinstance(asked, tuple) else (asked,):
            if value is not None and value not in values:
                raise ValueError(f"{option}: got '{value}', expected one of {', '.join(values)}")
    if not args.methods:
        raise ValueError(f"methods: got none, expected some of {', '.join(allowed['methods'])}")
    case = CASES[args.case]
    about_parameters = case.target == "mjx" or (engine(args) == "mjx" and not case.hidden)
    if about_parameters and not off(args, entries):
        raise ValueError(f"parameters: got '{args.parameters}', but case '{args.case}' needs one that it is about")
    for option in ("start", "radius", "dr_radius", "seeds"):
        value = getattr(args, option)
        if not 0 < value < float("inf"):
            raise ValueError(f"{option}: got {value}, expected a positive, finite number")
    for name in filter(case.scaled, entries):
        low, high = entries[name].bounds
        if not low <= 1.0 / args.start <= high:
            raise ValueError(f"start: got {args.start}, expected {1 / high:g} to {1 / low:g} ({name}'s bounds)")
    knobs = tuner.knobs(
        step_size=args.step_size, widen_factor=args.widen_factor, level=args.level, threshold=args.threshold
    )
    return sizes, entries, knobs


def true_params(args, entries: Mapping[str, domain.Entry]) -> dict[str, float]:
    """What the target has."""
    case, nominal = CASES[args.case], domain.nominal(entries)
    return {name: value / args.start if case.scaled(name) else value for name, value in nominal.items()} | case.hidden


def off(args, entries: Mapping[str, domain.Entry]) -> tuple[str, ...]:
    """Which of the tuned parameters the target has otherwise."""
    case = CASES[args.case]
    return tuple(name for name in entries if case.scaled(name) or name in case.hidden)


def engine(args) -> str:
    """The target's engine."""
    return args.target or CASES[args.case].target


def make_target(args, loop: Loop) -> Target:
    """The target of a case."""
    return TARGETS[engine(args)](loop.robot, true_params(args, loop.entries))


class Runner:
    """Runs (method, seed) pairs, each into a file of its own."""

    def __init__(self, args: Args, loop: Loop, target: Target, policy: Policy, knobs: tuner.Knobs):
        self._args, self._loop, self._target, self._knobs = args, loop, target, knobs
        self._play = loop.play(target)
        self._methods = methods(args, loop, target, policy)
        self._steps = {name: loop.step(method.tuner, self._play) for name, method in self._methods.items()}

    def __call__(self, name: str, seed: int, progress: Progress) -> dict:
        """Runs one pair, or reads what an earlier call left."""
        path = self._args.out / "results" / f"{name}_{seed}.json"
        tunings = self._loop.preset.tunings
        task = progress.add_task(f"{name} seed {seed}", total=tunings)
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            lines = []
            for line in self._tunings(name, seed):
                lines.append(line)
                with (self._args.out / "metrics.jsonl").open("a") as log:
                    log.write(json.dumps(line) + "\n")
                note = f" return {line['return']:.1f} {' '.join(line.get('verdicts', ()))}"
                progress.update(task, completed=line["tuning"], description=f"{name} seed {seed}{note}")
            sets = self._methods[name].sets * tunings
            write_json(path, {"lines": lines, "measured_episodes": sets * self._loop.preset.tuner.set_episodes})
        progress.update(task, completed=tunings)
        return json.loads(path.read_text())

    def _tunings(self, name: str, seed: int):
        method, step = self._methods[name], self._steps[name]
        key = jax.random.PRNGKey(seed)
        key_evaluate, key_steps = jax.random.split(key)
        state = method.tuner.init(method.policy, method.dist, self._knobs)
        begin = time.monotonic()
        info = None
        for index in range(self._loop.preset.tunings + 1):
            if index:
                state, info = step(jax.random.fold_in(key_steps, index), state)
                self._must_have_walked(info)
            value, falls = self._loop.evaluate(key_evaluate, state.policy, self._play)
            line = {"method": name, "seed": seed, "tuning": index, "return": value, "falls": falls}
            line |= self._describe(state.dist) | (report.tuning(info) if info is not None else {})
            yield as_json(line | {"seconds": time.monotonic() - begin})

    def _must_have_walked(self, info: tuner.Info) -> None:
        verdict = info.verdicts[int(info.calls) - 1] if info.calls else Verdict.ACCEPT
        if verdict == Verdict.NOT_FINITE and info.measured_falls == self._loop.preset.tuner.set_episodes:
            raise ValueError(
                f"target: every measured episode fell or broke within {self._loop.preset.tuner.dvm.window} steps"
            )

    def _describe(self, dist: ParamDist) -> dict:
        centre = domain.from_coordinates(self._loop.entries, dist.centre)
        truth = self._target.params
        return {
            "estimate": {name: float(value) for name, value in centre.items()},
            "radii": {name: float(value) for name, value in dist.radius.items()},
            "param_error": {
                name: abs(float(value) / truth[name] - 1)
                if self._loop.entries[name].log
                else abs(float(value) - truth[name])
                for name, value in centre.items()
            },
        }


def main(args: Args) -> None:
    """Runs what is not there yet, and writes metrics, summary and plots."""
    checkpoint.set_up_compiler(preset(args.preset).xla_flags)
    sizes, entries, knobs = check(args)
    identity = {**dataclasses.asdict(args), "sizes": sizes}
    for option in ("out", "methods", "seeds"):
        del identity[option]
    hidden = domain.select(constants.ENTRIES, [name for name in CASES[args.case].hidden if name not in entries])
    loop = Loop(sizes, entries, hidden)
    checkpoint.open_run(args.out, identity)
    target = make_target(args, loop)
    runner = Runner(args, loop, target, starting_policy(args.policy, loop, args.out), knobs)
    with bars() as progress:
        results = {name: [runner(name, seed, progress) for seed in range(args.seeds)] for name in args.methods}
    summary = report.sim2sim(args, results, off(args, entries))
    write_json(args.out / "summary.json", summary | {"versions": checkpoint.versions()})
    # What was logged as it came may hold lines of a run that was cut and started again.
    lines = [line for runs in results.values() for result in runs for line in result["lines"]]
    (args.out / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    plots.sim2sim(args.out, results, off(args, entries), sizes.epochs)
    report.print_sim2sim(console, summary, results)


if __name__ == "__main__":
    run(main, Args)
