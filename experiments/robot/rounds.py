"""Plays rounds of walking and learning in a folder, so that a run may be stopped anywhere and continues where it was.

    RUN/round_000/start/           policy and distribution that the round begins with
                  learner/         the policy alone, in the form that experiments.train writes
                  prediction.json  how it should walk: return, falls and power in simulation
                  policy/          the policy, exported for the robot's computer
                  request.json     number and length of the requested walks, and a seed
                  log/             the robot's answer; or refused.txt, which says why there is none
                  measured.json    how the robot walked, and what the log doctor suspects
                  tuned/           the distribution after the tuning
                  tuning.json      verdicts, what moved, and how the same policy walks in the tuned simulator
                  report.html      all of it for a person
    RUN/round_001/start/           the policy, trained further in the tuned distribution; and so on

Every step of a round writes a file, and a step whose file exists is skipped. No walks are requested if too many of
them are expected to end in a fall (`experiments.robot.fall_risk`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp

from envs.targets import recorded
from experiments.common import checkpoint, report
from experiments.common.cli import console
from experiments.common.files import from_json, read_json, write_json
from experiments.robot import policy_files
from experiments.robot.checks import check_meaning, check_runs
from experiments.robot.exchange import request, wait
from experiments.robot.fall_risk import fall_risk, summarise_log
from experiments.robot.records import Measured, Misfit, Moved, Prediction, Round, Suspicion, Tuning
from experiments.walking.learner import Learner, Policy
from experiments.walking.policies import policy_config
from jaxtune import baselines, devices, tuner
from jaxtune.explain import doubtful
from jaxtune.tuner import Tuner, TunerState
from jaxtune.types import Trajectory, Verdict


@dataclass(frozen=True)
class Strategy:
    """One tuning method: how it changes the default tuner and the policy that training starts from."""

    tuner: Callable[[Tuner], Tuner | baselines.Untuned]
    """Makes the method's tuner from the default one."""
    policy: Callable[[Policy, float], Policy] = lambda policy, radius: policy
    """Adapts the first policy to the first radius; `dr` lets it train on all of the distribution."""


STRATEGIES = {
    "ours": Strategy(lambda machine: machine),
    "spm": Strategy(baselines.spm),
    "dr": Strategy(
        lambda machine: baselines.Untuned(tuner=machine),
        lambda policy, radius: policy.replace(radius=jnp.full_like(policy.radius, radius)),
    ),
}
"""Strategies by the name that `--method` takes."""

_WORST = 5  # signals that are listed where no parameters explain a log
_KEYS = 7  # keeps the random keys of rounds different from others that begin with the same seed


class Programs:
    """A learner with the compiled programs of a round: tune, train, predict, actions.

    Compiling takes minutes. A benchmark that plays many runs shares one `Programs`, so that each is compiled once.

    Args:
      learner: gives the tuner its functions.
    """

    def __init__(self, learner: Learner):
        self.learner = learner
        self.machines = {name: strategy.tuner(learner.tuner()) for name, strategy in STRATEGIES.items()}
        self.tune = {name: devices.on_all(jax.jit(machine.tune)) for name, machine in self.machines.items()}
        self.train = devices.on_all(jax.jit(learner.tuner().train))
        self.predict = devices.on_all(jax.jit(learner.predict, static_argnums=(3, 4)))
        self.actions = jax.jit(learner.actions)
        self.misfits = devices.on_all(jax.jit(learner.tuner().misfits))


@dataclass(frozen=True, kw_only=True)
class Terms:
    """Conditions under which a robot walks, and under which its log is used."""

    walk_s: float = 10.0
    """Length of a walk in s."""
    max_fall_rate: float = 0.2
    """Largest share of the next walks that may be expected to end in a fall; above it no walks are requested."""
    force: bool = False
    """Request walks even if more falls are expected than max_fall_rate allows."""
    trust_log: bool = False
    """Learn from a log even if the log doctor finds its numbers wrong, or another policy seems to have walked."""
    timeout_s: float = 3600.0
    """How long to wait for the robot's log, in s."""
    seed: int = 0
    """Random seed of simulation and training; it is also part of the request."""


class Rounds:
    """Plays the rounds of one run, or reads those that an earlier call has played.

    Args:
      out: folder of the run.
      terms: conditions of the walks.
      programs: the learner and its compiled programs.
      method: one of `STRATEGIES`.
      policy: policy of the first round.
      start: centre of the first distribution, physical values by name.
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
        self._kind = self._learner.kind
        self._steps = round(terms.walk_s / self._kind.control_s)

    def play(self, index: int, last: Round | None, tell: Callable[[str], None] = lambda what: None) -> Round:
        """Plays a round: predict, request, wait, check, tune, and train the policy for the next one.

        Args:
          index: of the round, from 0.
          last: the round before it, if any; its measurements decide whether the simulated fall rate is trusted.
          tell: is called with what is done next.

        Returns:
          The record of the round.

        Raises:
          ValueError: too many falls are expected, the robot has not answered, or its log cannot be used.
        """
        place = self._place(index)
        tell("predicts how the robot walks")
        state = self._start(index, lambda: self._first)
        predicted = self._predicted(index, state)
        if not (place / "tuning.json").exists():
            if not (place / "log").exists():
                self._permit(index, predicted, last)
                self._request(index, state)
            tell("waits for the robot")
            wait(place, self._terms.timeout_s)
            tell("tunes the simulator")
            self._learn(index, state)
        tell("trains the policy")
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
        # `use` is 0 for the prediction, 1 for tuning, 2 for training, 3 for the prediction in the tuned simulator,
        # 4 for what misfits there.
        key = jax.random.fold_in(jax.random.PRNGKey(self._terms.seed), _KEYS)
        return jax.random.fold_in(jax.random.fold_in(key, index), use)

    def _start(self, index: int, make: Callable[[], TunerState]) -> TunerState:
        place = self._place(index)
        if not (place / "start" / "config.json").exists():
            state = make()
            checkpoint.check_finite("policy", state.policy.learner)
            checkpoint.save(place / "learner", state.policy.learner, policy_config(self._learner))
            checkpoint.save(place / "start", state, {})
        # Read back even if it was just made, so that an interrupted run has the same state as one that never stopped.
        return checkpoint.load(place / "start", self._first, {})

    def _predict(self, key: jax.Array, state: TunerState) -> Prediction:
        count = self._learner.preset.foreseen_episodes
        found = self._programs.predict(key, state.policy, state.dist, count, self._steps)
        # 0.2 in single precision is more than 0.2 in double, and would exceed max_fall_rate by rounding alone.
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
            console.print(
                f"nothing has been measured in this run yet; in simulation, {rate:.0%} of the walks end in a fall"
            )
        if rate > most and not self._terms.force:
            # An earlier call, with a larger max_fall_rate or with force, may have left a request that holds no more.
            (self._place(index) / "request.json").unlink(missing_ok=True)
            raise ValueError(
                f"round {index}: no walks are requested: {rate:.0%} of them are expected to end in a fall "
                f"({predicted.fall_rate:.0%} in simulation), expected at most {most:.0%} (--max-fall-rate; --force "
                "overrides)"
            )

    def _request(self, index: int, state: TunerState) -> None:
        place = self._place(index)
        if (place / "request.json").exists():
            return
        policy_files.export(place / "policy", state.policy.learner, self._learner)
        episodes, seconds = self._learner.preset.tuner.set_episodes, self._terms.walk_s
        request(place, episodes, seconds, 1000 * self._terms.seed + index)
        text = f"round {index}: requested {episodes} walks of {seconds:g} s in {place}, waiting for the log"
        console.print(text, markup=False)

    def _learn(self, index: int, state: TunerState) -> None:
        """Turns the robot's log into the next distribution, and writes what was measured and what moved."""
        place, preset = self._place(index), self._learner.preset
        log = self._kind.read(place / "log")
        check_runs(place, log, preset.tuner.set_episodes)
        walks = self._kind.episodes(log, self._steps)
        suspicions = self._kind.findings(log)
        if not self._terms.trust_log:
            act = partial(self._programs.actions, state.policy)
            check_meaning(place / "log", log, walks.trajectory, self._kind.config(preset), act, suspicions)
        suspected = tuple(Suspicion(sentence=one.sentence, runs=tuple(runs)) for one, runs in suspicions)
        write_json(place / "measured.json", summarise_log(walks, self._steps, self._kind.control_s, suspected))
        start = recorded.beginning(walks, preset.episode_steps)
        # Simulated episodes must have the robot's commands; otherwise the gate would measure these and not the physics.
        repeating = state.replace(policy=state.policy.replace(asked=start.commands))
        tuned, info = self._tune(self._key(index, 1), repeating, start.trajectory)
        tuned = tuned.replace(policy=state.policy)
        checkpoint.check_finite("distribution", tuned.dist)
        checkpoint.save(place / "tuned", tuned, {})
        moved = report.moved(self._learner.entries, state.dist, tuned.dist, info)
        tuning = Tuning(
            **report.tuning(info),
            moved={name: Moved(**ends) for name, ends in moved.items()},
            compared_s=preset.episode_steps * self._kind.control_s,
            explained=self._predict(self._key(index, 3), tuned),
            misfits=self._misfits(index, repeating.replace(dist=tuned.dist), start.trajectory, info),
        )
        # Written last, because a round with this file counts as learnt.
        write_json(place / "tuning.json", tuning)

    def _misfits(self, index: int, state: TunerState, measured: Trajectory, info: tuner.Info) -> dict[str, Misfit]:
        """The signals that no parameters explain, the worst first; none unless the set was rejected or fits badly."""
        rejected = (Verdict.UNEXPLAINED, Verdict.RADIUS_EXHAUSTED)
        if info.calls == 0 or not (info.verdicts[int(info.calls) - 1] in rejected or doubtful(info)):
            return {}
        found = self._programs.misfits(self._key(index, 4), state, measured)
        names = self._learner.channels()
        times, phases = found.channels.tolist(), found.phases.T.tolist()
        order = sorted(range(len(names)), key=lambda channel: -times[channel])
        return {names[i]: Misfit(times=times[i], phases=tuple(phases[i])) for i in order[:_WORST]}


def _read(kind: type, path: Path):
    """Reads a record that `write_json` wrote."""
    return from_json(kind, read_json(path))
