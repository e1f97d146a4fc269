"""Tells before a robot walks what a tuning would find: `python -m experiments.selftest --robot ... --out DIR`.

Simulated robots of known parameters are measured in the robot's place. The table says, for every parameter, how exact
its estimate is and how often the gate notices that it lies outside the simulated range; the same for effects that no
tuned parameter expresses.
"""

import fnmatch
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.progress import Progress
from rich.table import Table

from experiments.common import checkpoint, compiler, files, plots
from experiments.common.cli import bars, console, count, run
from experiments.common.config import preset, tell_limits
from experiments.common.rates import interval
from experiments.walking import memory
from experiments.walking.cases import check_positive
from experiments.walking.learner import Learner
from experiments.walking.policies import default_policy, starting_policy
from experiments.walking.robots import Kind, kind
from jaxtune import selftest, tuner
from jaxtune.mjx import Entry, parameters
from jaxtune.selftest import Rate, SelfTest

_NO_ROOM = "bounds leave no room"
_ENOUGH = 0.8  # power that a parameter should have
_NONE = "none"
_OTHER = 0.75  # of a multiplier that is not tuned, or of the way from nominal to an offset's bound


@dataclass(frozen=True, kw_only=True)
class Args:
    """Tests on simulated robots what the tuner would find: false alarms, power, errors and coverage."""

    out: Path = Path("runs/selftest")
    """Folder of the results: selftest.json and power.png. The same command with the same folder goes on where it was
    stopped."""
    robot: str = "biteno"
    """Robot: biteno, go2, playground:NAME, playground-warp:NAME, or path/to/file.py:function."""
    policy: str | None = None
    """Policy that walks: walk (biteno's, ships with the package), scratch (trained first), or a folder of
    experiments.train."""
    parameters: str | None = None
    """Parameters that are tuned, as for experiments.sim2sim."""
    radius: float = 0.2
    """Radius (half width) of the distribution that is tested, in log space."""
    episodes: tuple[int, ...] = ()
    """Measured episodes in a set; several numbers are tested in turn, which shows what more walks would bring. If none,
    as many as the preset has."""
    robots: int = 20
    """Simulated robots of every case and gate."""
    gates: int = 2
    """Gates, each with episodes and models of its own."""
    whole: int = 0
    """Robots of every case with which whole tunings are run as well."""
    tunings: int = 1
    """Whole tunings of each of these robots, one after another; the policy stays as it is."""
    lanes: int = 1
    """Robots whose whole tunings run side by side: 1 on a CPU, more on a GPU, where a larger batch costs little.
    A test that was stopped goes on with the same number."""
    states: bool = False
    """Whether whole tunings estimate last from measured states, and are `unexplained` where these fit no parameters."""
    others: tuple[str, ...] = ()
    """Differences that the gate should notice, as name=value in physical values: torque_scale=0.75, or '*_mass=2' for
    all tuned masses at once. Several names are joined by commas. By default every parameter of the robot that is not
    tuned, one at a time; with 'none', no difference."""
    level: float = 0.95
    """Share of sets that the gate should let pass."""
    preset: str = "cpu"
    """Size of the run: smoke (to see that it works), cpu (two cores) or gpu (one GPU)."""
    seed: int = 0
    """Of everything random."""


def _overlap(one: Entry, other: Entry) -> bool:
    """Whether two rows change the same field of the same target; without targets a row changes that of all."""
    everywhere = one.targets is None or other.targets is None
    return bool(set(one.fields) & set(other.fields)) and (everywhere or bool(set(one.targets) & set(other.targets)))


def other_cases(robot: Kind, tuned: Mapping[str, Entry], options: Sequence[str]) -> dict[str, dict[str, float]]:
    """Reads the differences that the gate should notice.

    Args:
      robot: its whole table names what can differ.
      tuned: the part of the table that is tuned.
      options: as `Args.others`.

    Returns:
      Physical values by parameter, by the name of the case.

    Raises:
      ValueError: an option is not of the form, or names no parameter, or a value is out of bounds.
    """
    if tuple(options) == (_NONE,):
        return {}
    if not options:
        return {
            f"{name}={_different(entry):g}": {name: _different(entry)}
            for name, entry in robot.entries.items()
            # One that changes what is tuned already is no other effect.
            if name not in tuned and not any(_overlap(entry, other) for other in tuned.values())
        }
    cases = {}
    for option in options:
        values = {}
        for item in option.split(","):
            pattern, _, number = item.partition("=")
            try:
                value = float(number)
            except ValueError:
                raise ValueError(f"others: got '{item}', expected name=value") from None
            # A pattern stands for tuned parameters: tied ones would be changed twice.
            names = [pattern] if pattern in robot.entries else fnmatch.filter(tuned, pattern)
            if not names:
                raise ValueError(f"others: got '{pattern}', expected some of {', '.join(robot.entries)}")
            values |= dict.fromkeys(names, value)
        parameters.check_values(robot.entries, values)
        cases[option] = values
    return cases


def _different(entry: Entry) -> float:
    low, high = entry.bounds
    if entry.log:
        # A multiplier that may only grow has to.
        return max(_OTHER, low) if low < 1.0 else min(1.0 / _OTHER, high)
    return _OTHER * (high if abs(high) >= abs(low) else low)


def check(args: Args) -> tuple[Kind, dict[str, Entry], dict[str, dict[str, float]], tuple[int, ...]]:
    """Checks the arguments before anything is compiled.

    Returns:
      The robot, the table that is tuned, the other cases, and the numbers of measured episodes.

    Raises:
      ValueError: names the field, the value and what is allowed.
    """
    sizes, robot = preset(args.preset), kind(args.robot)
    entries = robot.chosen(args.parameters)
    check_positive(radius=args.radius, robots=args.robots, gates=args.gates, tunings=args.tunings, lanes=args.lanes)
    if args.whole < 0:
        raise ValueError(f"whole: got {args.whole}, expected 0 or more")
    if args.states and not args.whole:
        raise ValueError("states: got true, expected whole robots as well (--whole): no gate reads states")
    numbers = args.episodes or (sizes.tuner.set_episodes,)
    for number in numbers:
        check_positive(episodes=number)
    tuner.knobs(level=args.level)
    sizes.tuner.check_level(args.level)
    return robot, entries, other_cases(robot, entries, args.others), numbers


@dataclass
class Parts:
    """Parts of a self-test in files, so that it goes on where it was stopped.

    Attributes:
      folder: of the files; made when the first part is kept.
      seconds: that the parts took, in this call or an earlier one.
      computed: how many were computed in this call.
    """

    folder: Path
    seconds: float = 0.0
    computed: int = 0

    def keep(self, name: str, compute: Callable[[], dict]) -> dict:
        """Computes a part, or reads it where it was computed before (`jaxtune.selftest.Keep`)."""
        path = self.folder / f"{name}.json"
        if not files.exists(path):
            begin = time.monotonic()
            part = compute()
            self.folder.mkdir(parents=True, exist_ok=True)
            files.write_json(path, {"seconds": time.monotonic() - begin, "part": part})
            self.computed += 1
        # Read again in any case, so that the numbers are those of a run that was interrupted.
        found = files.read_json(path)
        if not {"seconds", "part"} <= found.keys():
            raise ValueError(f"{path}: is damaged: got {', '.join(found) or 'nothing'}, expected seconds and part")
        self.seconds += found["seconds"]
        return found["part"]


def digest(robot: Kind, policy: Any, table: Mapping[str, Entry], others: Mapping[str, Mapping[str, float]]) -> str:
    """Names what the parts of a self-test depend on beside its options: they may change behind the same names.

    Args:
      robot: that is tested; of one's own, the content of its file counts.
      policy: arrays of the policy that walks.
      table: of all parameters.
      others: coordinates of the cases.
    """
    found = hashlib.sha256(json.dumps(files.as_json([table, others])).encode())
    found.update((robot.digest or "").encode())
    for leaf in jax.tree.leaves(policy):
        found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()[:16]


def tested(args: Args, robot: Kind, entries, others, episodes: int, progress: Progress) -> tuple[SelfTest, Parts]:
    """Runs the self-test with sets of so many episodes, or what is left of it."""
    sizes = preset(args.preset)
    sizes = replace(sizes, tuner=replace(sizes.tuner, set_episodes=episodes))
    hidden = {name: robot.entries[name] for values in others.values() for name in values if name not in entries}
    learner = Learner(sizes, entries, hidden, kind=robot, states=args.states)
    # The robots of every case: inside, outside in a parameter, and the others.
    memory.check(learner, sets=args.robots * (1 + len(entries) + len(others)))
    if (lanes := min(args.lanes, args.whole)) > 1:
        memory.check(learner, lanes)
    policy = starting_policy(args.policy or default_policy(robot), learner, args.out)
    dist = learner.dist(parameters.nominal(entries), args.radius)
    machine = learner.tuner()
    state = machine.init(policy, dist, tuner.knobs(level=args.level))
    table = {**entries, **hidden}
    coords = {
        name: {one: float(value) for one, value in parameters.to_coords(table, values).items()}
        for name, values in others.items()
    }
    task = progress.add_task(f"{episodes} episodes", total=None)
    parts = Parts(args.out / "parts" / digest(robot, policy.learner, table, coords) / str(episodes))

    def done(number: int, total: int) -> None:
        progress.update(task, total=total)
        count(progress, task, number, kept=not parts.computed)

    report = selftest.run(
        jax.random.PRNGKey(args.seed),
        machine,
        state,
        robots=args.robots,
        gates=args.gates,
        whole=args.whole,
        tunings=args.tunings,
        lanes=args.lanes,
        others=coords,
        keep=parts.keep,
        done=done,
    )
    return report, parts


def show(reports: Mapping[int, SelfTest]) -> None:
    """Prints a table for each number of episodes."""
    for episodes, report in reports.items():
        table = Table(title=f"{episodes} episodes in a set")
        table.add_column("", no_wrap=True)
        for column in ("identifiable", "median error", "half interval", "rejected (95 % interval)", "or then inside"):
            table.add_column(column)
        table.add_row("inside the distribution", "", "", "", _rate(report.alarms), "")
        for name, known in report.identified.items():
            room = name in report.outside
            outside = [_rate(report.outside[name]), f"{report.noticed[name].share:.2f}"] if room else [_NO_ROOM, ""]
            numbers = ("-" if isnan(value) else f"{value:.3f}" for value in (report.error[name], report.interval[name]))
            table.add_row(f"{name}, one radius outside", f"{known.share:.2f}", *numbers, *outside)
        for name, rate in report.others.items():
            table.add_row(name, "", "", "", _rate(rate), "")
        console.print(table)
        console.print(f"all true values in their intervals: {_rate(report.covered)}", markup=False)
        for name, sets in report.unusable.items():
            console.print(f"{name}: {sets} sets are not comparable or not finite, and are not counted", markup=False)
        for place, text in selftest.whole_tunings(report).items():
            console.print(f"{place}: {text}", markup=False)
    for line in lacking(reports):
        console.print(line, markup=False, highlight=False)


def lacking(reports: Mapping[int, SelfTest]) -> list[str]:
    """Says which parameters this walk does not show well enough, and whether more episodes are known to help."""
    lines = []
    for name in next(iter(reports.values())).outside:
        enough = [number for number, report in reports.items() if report.outside[name].share >= _ENOUGH]
        tested = ", ".join(map(str, reports))
        if all(report.unusable.get(name, 0) > report.outside[name].of for report in reports.values()):
            lines.append(
                f"{name}: most sets cannot be compared, since robots fall within a window, or hardly move; start from "
                "a policy that stands longer (--policy)"
            )
        elif not enough:
            lines.append(
                f"{name}: outside by one radius, it is noticed in less than {_ENOUGH:.0%} with {tested} episodes; "
                "more episodes (--episodes), or a policy that moves differently, may show it"
            )
        elif min(enough) > min(reports):
            lines.append(f"{name}: {min(enough)} episodes show it in {_ENOUGH:.0%} and more")
    return lines


def _rate(rate: Rate) -> str:
    low, high = interval(rate)
    return f"{rate.share:.2f} ({low:.2f} to {high:.2f})"


def main(args: Args) -> None:
    """Runs the self-test, prints tables, and writes `selftest.json` and a plot."""
    compiler.set_up(preset(args.preset).xla_flags)
    robot, entries, others, numbers = check(args)
    tell_limits(preset(args.preset))
    identity = {name: value for name, value in vars(args).items() if name != "out"}
    # A policy that is trained first is kept in the folder, and is another one for other sizes.
    checkpoint.open_run(args.out, identity | robot.identity | {"sizes": preset(args.preset)})
    path = args.out / "selftest.json"
    with checkpoint.lock(path), bars() as progress:
        found = {number: tested(args, robot, entries, others, number, progress) for number in numbers}
    reports = {number: report for number, (report, _) in found.items()}
    show(reports)
    if path.exists() and not any(parts.computed for _, parts in found.values()):
        return
    result = {
        "args": {name: value for name, value in vars(args).items() if name != "out"},
        "episodes": {str(number): report for number, report in reports.items()},
        "seconds": sum(parts.seconds for _, parts in found.values()),
        "versions": checkpoint.versions(),
    }
    files.write_json(path, result)
    plots.power(args.out / "power.png", reports, 1.0 - args.level)


if __name__ == "__main__":
    run(main, Args)
