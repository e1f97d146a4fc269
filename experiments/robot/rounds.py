"""Rounds of walking and learning, kept in a folder so that a run may be stopped anywhere and goes on where it was.

    RUN/round_000/start/           policy and distribution that the round begins with
                  learner/         the policy alone, as experiments.train writes one
                  prediction.json  what simulation says of them
                  policy/          the policy, for the robot's computer
                  request.json     what the robot is asked for: how many walks, how long, and a seed
                  log/             the robot's answer; or refused.txt, which says why there is none
                  measured.json    how the robot walked, and what the log doctor suspects
                  tuned/           the distribution after the verdict
                  tuning.json      the verdict, what moved, and what the tuned simulator says of the same policy
                  report.html
    RUN/round_001/start/           the policy, trained on in what the tuning left; and so on

Every step of a round writes a file, and a step whose file exists is not made again. A robot is asked for nothing where
too many of its walks are expected to end in a fall (`experiments.robot.fall_risk`).
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp

from envs import logs
from envs.biteno import constants
from envs.diagnosis import diagnose_log, shared_findings
from envs.targets import recorded
from experiments.common import checkpoint, report
from experiments.common.checkpoint import from_json, write_json
from experiments.common.cli import console
from experiments.robot import policy_files
from experiments.robot.checks import check_meaning, check_runs
from experiments.robot.exchange import request, wait
from experiments.robot.fall_risk import fall_risk, summarise_log
from experiments.robot.records import Measured, Moved, Prediction, Round, Suspicion, Tuning
from experiments.walking.learner import Learner, Policy
from experiments.walking.policies import policy_config
from jaxtune import baselines, tuner
from jaxtune.tuner import Tuner, TunerState


@dataclass(frozen=True)
class Strategy:
    """How a method tunes a distribution, and how wide its policy trains in it."""

    tuner: Callable[[Tuner], Tuner | baselines.Untuned]
    policy: Callable[[Policy, float], Policy] = lambda policy, radius: policy


STRATEGIES = {
    "ours": Strategy(lambda machine: machine),
    "spm": Strategy(baselines.spm),
    "dr": Strategy(
        lambda machine: baselines.Untuned(tuner=machine),
        lambda policy, radius: policy.replace(radius=jnp.full_like(policy.radius, radius)),
    ),
}
"""By the name that the command line gives a method."""

_KEYS = 7  # keeps the rounds' random keys apart from others that begin with the same seed


class Programs:
    """A learner with the compiled programs of a round; runs that share it compile them once.

    Args:
      learner: BITeno's side of the tuner.
    """

    def __init__(self, learner: Learner):
        self.learner = learner
        self.machines = {name: strategy.tuner(learner.tuner()) for name, strategy in STRATEGIES.items()}
        self.tune = {name: jax.jit(machine.tune) for name, machine in self.machines.items()}
        self.train = jax.jit(learner.tuner().train)
        self.predict = jax.jit(learner.predict, static_argnums=(3, 4))
        self.act = jax.jit(
            lambda policy, obs: jax.vmap(lambda one: learner.act(policy)(one, jax.random.PRNGKey(0))[0])(obs)
        )


@dataclass(frozen=True, kw_only=True)
class Terms:
    """What a robot is asked for in a round, and the conditions under which it is asked and its log is believed."""

    walk_s: float = 10.0
    """Length of a walk that the robot is asked for."""
    max_fall_rate: float = 0.2
    """The robot is asked for nothing where a larger share of its walks is expected to end in a fall."""
    force: bool = False
    """Ask all the same."""
    trust_log: bool = False
    """Learn from a log even if the doctor thinks it means something else, or another policy has walked."""
    timeout_s: float = 3600.0
    """How long to wait for a log."""
    seed: int = 0
    """Seed of everything random."""


class Rounds:
    """Plays the rounds of one run, or reads what an earlier call left of them.

    Args:
      out: folder of the run.
      terms: what the robot is asked for.
      programs: the learner and its compiled programs.
      method: one of `STRATEGIES`.
      policy: what the first round begins with.
      start: middle of the first distribution, physical values by name.
      radius: of the first distribution, in coordinates.
    """

    def __init__(
        self,
        out: Path,
        terms: Terms,
        programs: Programs,
        method: str,
        policy: Policy,
        start: Mapping[str, float],
        radius: float,
    ):
        self._out, self._terms, self._programs, self._learner = out, terms, programs, programs.learner
        self._tune = programs.tune[method]
        policy = STRATEGIES[method].policy(policy, radius)
        self._first = programs.machines[method].init(policy, self._learner.dist(start, radius), tuner.knobs())
        self._steps = round(terms.walk_s / constants.POLICY_DT_S)

    def play(self, index: int, last: Round | None) -> Round:
        """Plays a round: predict, ask, wait, check, tune, and train the policy for the next one.

        Args:
          index: of the round, from 0.
          last: the round before it, if any; its measurements decide whether simulation is believed about falls.

        Raises:
          ValueError: too many falls are expected, the robot has not answered, or its log cannot be learnt from.
        """
        place = self._place(index)
        state = self._start(index, lambda: self._first)
        predicted = self._predicted(index, state)
        if not (place / "tuning.json").exists():
            if not (place / "log").exists():
                self._permit(index, predicted, last)
                self._request(index, state)
            wait(place, self._terms.timeout_s)
            self._learn(index, state)
        tuned = checkpoint.load(place / "tuned", self._first, {})
        following = self._start(index + 1, lambda: self._programs.train(self._key(index, 2), tuned)[0])
        measured, tuning = _read(Measured, place / "measured.json"), _read(Tuning, place / "tuning.json")
        next_predicted = self._predicted(index + 1, following)
        return Round(
            index=index,
            predicted=predicted,
            measured=measured,
            tuning=tuning,
            next_predicted=next_predicted,
            expected_falls=fall_risk(next_predicted, measured, tuning),
        )

    def _place(self, index: int) -> Path:
        return self._out / f"round_{index:03d}"

    def _key(self, index: int, use: int) -> jax.Array:
        key = jax.random.fold_in(jax.random.PRNGKey(self._terms.seed), _KEYS)
        return jax.random.fold_in(jax.random.fold_in(key, index), use)

    def _start(self, index: int, make: Callable[[], TunerState]) -> TunerState:
        place = self._place(index)
        if not (place / "start" / "config.json").exists():
            state = make()
            checkpoint.save(place / "learner", state.policy.learner, policy_config(self._learner))
            checkpoint.save(place / "start", state, {})
        # Read back even where it was just made, so that a run that goes on has the state of one that never stopped.
        return checkpoint.load(place / "start", self._first, {})

    def _predict(self, key: jax.Array, state: TunerState) -> Prediction:
        count = self._learner.preset.foreseen_episodes
        found = self._programs.predict(key, state.policy, state.dist, count, self._steps)
        # A fifth in single precision is more than a fifth, so the rate is rounded to whole episodes.
        fall_rate = round(count * float(found["fall_rate"])) / count
        return Prediction(
            mean_return=float(found["return"]), fall_rate=fall_rate, power_w=float(found["power_w"]), episodes=count
        )

    def _predicted(self, index: int, state: TunerState) -> Prediction:
        path = self._place(index) / "prediction.json"
        if not path.exists():
            write_json(path, self._predict(self._key(index, 0), state))
        return _read(Prediction, path)

    def _permit(self, index: int, predicted: Prediction, last: Round | None) -> None:
        rate = fall_risk(predicted, *((last.measured, last.tuning) if last else ()))
        most = self._terms.max_fall_rate
        if last is None:
            console.print(f"nothing is measured in this run yet; simulation alone expects {rate:.0%} of walks to fall")
        if rate > most and not self._terms.force:
            # An earlier call may have asked on other terms.
            (self._place(index) / "request.json").unlink(missing_ok=True)
            raise ValueError(
                f"round {index}: the robot is not asked to walk: {rate:.0%} of its walks are expected to end in a fall "
                f"({predicted.fall_rate:.0%} in simulation), and {most:.0%} may (max_fall_rate; force overrides)"
            )

    def _request(self, index: int, state: TunerState) -> None:
        place = self._place(index)
        if (place / "request.json").exists():
            return
        policy_files.export(place / "policy", state.policy.learner, self._learner.preset)
        episodes, seconds = self._learner.preset.tuner.set_episodes, self._terms.walk_s
        request(place, episodes, seconds, 1000 * self._terms.seed + index)
        console.print(f"round {index}: the robot is asked for {episodes} walks of {seconds:g} s in {place}")

    def _learn(self, index: int, state: TunerState) -> None:
        """Turns the robot's log into the next distribution, and writes what was measured and what moved."""
        place, preset = self._place(index), self._learner.preset
        log = logs.read(place / "log")
        check_runs(place, log, preset.tuner.set_episodes)
        walks = recorded.episodes(log, self._steps)
        suspicions = shared_findings(diagnose_log(log))
        if not self._terms.trust_log:
            act = lambda obs: self._programs.act(state.policy, obs)  # noqa: E731
            check_meaning(place / "log", log, walks.trajectory, preset.task, act, suspicions)
        suspected = tuple(Suspicion(sentence=one.sentence, runs=tuple(runs)) for one, runs in suspicions)
        write_json(place / "measured.json", summarise_log(walks, self._steps, suspected))
        start = recorded.beginning(walks, preset.episode_steps)
        repeating = state.replace(policy=state.policy.replace(asked=start.commands))
        tuned, info = self._tune(self._key(index, 1), repeating, start.trajectory)
        tuned = tuned.replace(policy=state.policy)
        checkpoint.save(place / "tuned", tuned, {})
        moved = report.moved(self._learner.entries, state.dist, tuned.dist, info)
        tuning = Tuning(
            **report.tuning(info),
            moved={name: Moved(**ends) for name, ends in moved.items()},
            compared_s=preset.episode_steps * constants.POLICY_DT_S,
            explained=self._predict(self._key(index, 3), tuned),
        )
        # Written last: a round that has it need not be learnt from again.
        write_json(place / "tuning.json", tuning)


def _read(kind: type, path: Path):
    """Reads a record that `write_json` wrote."""
    return from_json(kind, json.loads(path.read_text()))
