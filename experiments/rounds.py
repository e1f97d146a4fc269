"""Rounds of walking and learning, kept in a folder so that a run may be stopped anywhere and goes on where it was.

    RUN/round_000/start/           policy and distribution that the round begins with
                  learner/         the policy alone, as experiments.train writes one
                  prediction.json  what simulation says of them
                  policy/          the policy, for the robot's computer
                  request.json     what the robot is asked for: how many walks, how long, and a seed
                  log/             the robot's answer; `meta.yaml` comes last. Or refused.txt, which says why not
                  measured.json    what came of it, and what the doctor says
                  tuned/           the distribution after the verdict
                  tuning.json      the verdict, and what moved
                  report.html
    RUN/round_001/start/           the policy trained on in what the tuning left, and so on

Whatever a round makes is a file, and what is there is not made again.

Falls are what a robot pays with. It is asked for nothing where too many of its walks are expected to end in one: by
simulation, and where the gate did not let the last log pass by that log too, because then simulation knows no better.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax

from envs import domain, logs
from envs.biteno import constants
from envs.targets import recorded
from experiments import checkpoint, doctor, export, report
from experiments.checkpoint import write_json
from experiments.loop import Loop, Policy, walked
from experiments.train import console, policy_config
from jaxtune import baselines, tuner
from jaxtune import dist as dists
from jaxtune.tuner import Info, Tuner, TunerState
from jaxtune.types import ParamDist

METHODS: dict[str, Callable[[Tuner], Tuner | baselines.Untuned]] = {
    "ours": lambda machine: machine,
    "spm": baselines.spm,
    "dr": lambda machine: baselines.Untuned(tuner=machine),
}
_LOOK_S = 1.0  # between two looks for a log
_SPARE_S = 0.05  # of a walk, for the ticks at its ends of which nobody knows what was before or after them


class Simulator:
    """The learner's side: a loop and its programs, each compiled once however many runs share them."""

    def __init__(self, loop: Loop):
        self.loop = loop
        self.machines = {name: method(loop.tuner()) for name, method in METHODS.items()}
        self.tune = {name: jax.jit(machine.tune) for name, machine in self.machines.items()}
        self.train = jax.jit(loop.tuner().train)
        self.foresee = jax.jit(loop.foresee, static_argnums=(3, 4))


@dataclass(frozen=True, kw_only=True)
class Terms:
    """What a robot is asked for, and on what conditions."""

    walk_s: float = 10.0
    """Length of a walk that the robot is asked for."""
    max_fall_rate: float = 0.2
    """The robot is asked for nothing where more of its walks are expected to end in a fall."""
    force: bool = False
    """Ask all the same, and learn from logs that the doctor thinks are wrong."""
    timeout_s: float = 3600.0
    """How long a log is waited for."""
    seed: int = 0
    """Seed of everything random."""


class Run:
    """The rounds of one run.

    Args:
      out: its folder.
      terms: what the robot is asked for.
      simulator: the learner's side.
      method: one of `METHODS`.
      policy, dist: what the first round begins with.
    """

    def __init__(self, out: Path, terms: Terms, simulator: Simulator, method: str, policy: Policy, dist: ParamDist):
        self._out, self._terms, self._simulator, self._loop = out, terms, simulator, simulator.loop
        self._tune = simulator.tune[method]
        self._first = simulator.machines[method].init(policy, dist, tuner.knobs())
        self._steps = round(terms.walk_s / constants.POLICY_DT_S)

    def round(self, index: int, history: Sequence[dict]) -> dict:
        """Plays a round, or reads what an earlier call left of it.

        Args:
          index: of the round.
          history: what is known of the rounds before it.

        Returns:
          `predicted` and `measured` return, share of falls and power; `tuning`: the verdict and what moved; `next`:
          what is predicted of the round that follows; `expected_falls` in it.

        Raises:
          ValueError: the robot is not asked to walk, has not answered, or its log cannot be learnt from.
        """
        place = self._place(index)
        state = self._start(index, lambda: self._first)
        predicted = self._foreseen(index, state)
        if not (place / "tuning.json").exists():
            self._permit(index, predicted, history)
            self._ask(index, state)
            wait(place, self._terms.timeout_s)
            self._learn(index, state)
        tuned = checkpoint.load(place / "tuned", self._first, {})
        following = self._start(index + 1, lambda: self._simulator.train(self._key(index, 2), tuned)[0])
        told = {name: json.loads((place / f"{name}.json").read_text()) for name in ("measured", "tuning")}
        line = {"round": index, "predicted": predicted, **told, "next": self._foreseen(index + 1, following)}
        return line | {"expected_falls": expected_falls(line["next"], [line])}

    def _place(self, index: int) -> Path:
        return self._out / f"round_{index:03d}"

    def _key(self, index: int, use: int) -> jax.Array:
        return jax.random.fold_in(jax.random.fold_in(jax.random.PRNGKey(self._terms.seed), index), use)

    def _start(self, index: int, make: Callable[[], TunerState]) -> TunerState:
        place = self._place(index)
        if not (place / "start" / "config.json").exists():
            state = make()
            checkpoint.save(place / "learner", state.policy.learner, policy_config(self._loop))
            checkpoint.save(place / "start", state, {})
        # Read back even if just made: a run that goes on has no other state than one that was never stopped.
        return checkpoint.load(place / "start", self._first, {})

    def _foreseen(self, index: int, state: TunerState) -> dict:
        path = self._place(index) / "prediction.json"
        if not path.exists():
            count = self._loop.preset.foreseen_episodes
            found = self._simulator.foresee(self._key(index, 0), state.policy, state.dist, count, self._steps)
            write_json(path, found | {"episodes": count})
        return json.loads(path.read_text())

    def _permit(self, index: int, predicted: Mapping, history: Sequence[dict]) -> None:
        rate, most = expected_falls(predicted, history), self._terms.max_fall_rate
        if rate > most and not self._terms.force:
            raise ValueError(
                f"round {index}: the robot is not asked to walk: {rate:.0%} of its walks are expected to end in a fall "
                f"({predicted['fall_rate']:.0%} in simulation), and {most:.0%} may (max_fall_rate; force overrides)"
            )

    def _ask(self, index: int, state: TunerState) -> None:
        place = self._place(index)
        if (place / "request.json").exists():
            return
        export.export(place / "policy", state.policy.learner, self._loop.preset)
        episodes, seconds = self._loop.preset.tuner.set_episodes, self._terms.walk_s
        request(place, episodes, seconds, 1000 * self._terms.seed + index)
        console.print(f"round {index}: {episodes} walks of {seconds:g} s are asked for in {place}")

    def _learn(self, index: int, state: TunerState) -> None:
        """From a log to the next distribution."""
        place, preset = self._place(index), self._loop.preset
        log = logs.read(place / "log")
        said = doctor.summary(doctor.examine(log))
        wrong = [finding.sentence for finding, runs in said if finding.wrong and 2 * len(runs) > len(log.runs)]
        if wrong and not self._terms.force:
            raise ValueError(f"{place / 'log'}: {'; '.join(wrong)} (force learns from it all the same)")
        walks = recorded.beginning(recorded.episodes(log, self._steps, most=1), preset.tuner.set_episodes, self._steps)
        seconds = float(walks.trajectory.alive.sum()) * constants.POLICY_DT_S
        suspected = [{"sentence": finding.sentence, "runs": runs} for finding, runs in said]
        numbers = {"episodes": preset.tuner.set_episodes, "seconds": seconds, "suspected": suspected}
        write_json(place / "measured.json", walked(walks.trajectory, walks.power) | numbers)
        start = recorded.beginning(walks, preset.tuner.set_episodes, preset.episode_steps)
        repeating = state.replace(policy=state.policy.replace(asked=start.asked))
        tuned, info = self._tune(self._key(index, 1), repeating, start.trajectory)
        checkpoint.save(place / "tuned", tuned.replace(policy=state.policy), {})
        # Last: what is there need not be learnt again.
        told = report.tuning(info) | {"moved": moved(self._loop, state.dist, tuned.dist, info)}
        write_json(place / "tuning.json", told)


def moved(loop: Loop, before: ParamDist, after: ParamDist, info: Info) -> dict[str, dict]:
    """What a tuning did to every parameter, in physical values by name."""
    interval = dists.unravel(dists.names(after), dists.ravel(info.dist.radius) * info.update.interval)
    ends = {
        "before": before.centre,
        "after": after.centre,
        "low": {name: centre - interval[name] for name, centre in after.centre.items()},
        "high": {name: centre + interval[name] for name, centre in after.centre.items()},
    }
    found = {end: domain.from_coordinates(loop.entries, values) for end, values in ends.items()}
    return {name: {end: float(values[name]) for end, values in found.items()} for name in after.centre}


def expected_falls(predicted: Mapping, history: Sequence[Mapping]) -> float:
    """Share of walks that are expected to end in a fall."""
    if not history:
        return predicted["fall_rate"]
    verdicts = history[-1]["tuning"]["verdicts"]
    covered = not verdicts or verdicts[-1] == "accept"
    return predicted["fall_rate"] if covered else max(predicted["fall_rate"], history[-1]["measured"]["fall_rate"])


def request(place: Path, episodes: int, seconds: float, seed: int) -> None:
    """Asks the robot for walks with the policy that is there: whoever finds the request may begin."""
    write_json(place / "request.json", {"episodes": episodes, "seconds": seconds + _SPARE_S, "seed": seed})


def wait(place: Path, timeout_s: float) -> None:
    """Waits for a log that is whole: it has its `meta.yaml`, and nothing of it changes between two looks.

    Raises:
      ValueError: the robot has refused, or has not answered in time.
    """
    begin, before = time.monotonic(), None
    while True:
        if (place / "refused.txt").exists():
            raise ValueError(f"{place / 'refused.txt'}: {(place / 'refused.txt').read_text().strip()}")
        files = {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in (place / "log").rglob("*")}
        if place / "log" / "meta.yaml" in files and files == before:
            return
        if time.monotonic() - begin > timeout_s:
            raise ValueError(
                f"{place / 'log'}: no log after {timeout_s:g} s, expected one as {place / 'request.json'} asks for; "
                "put it there and give the same command again"
            )
        before = files
        time.sleep(min(_LOOK_S, timeout_s))
