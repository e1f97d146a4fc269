"""Rounds of walking and learning, kept in a folder so that a run may be stopped anywhere and goes on where it was.

    RUN/round_000/start/           policy and distribution that the round begins with
                  learner/         the policy alone, as experiments.train writes one
                  prediction.json  what simulation says of them
                  policy/          the policy, for the robot's computer
                  request.json     what the robot is asked for: how many walks, how long, and a seed
                  log/             the robot's answer. Or refused.txt, which says why there is none
                  measured.json    what came of it, and what the doctor says
                  tuned/           the distribution after the verdict
                  tuning.json      the verdict, what moved, and what the tuned simulator says of the same policy
                  report.html
    RUN/round_001/start/           the policy trained on in what the tuning left, and so on

Whatever a round makes is a file, and what is there is not made again.

Falls are what a robot pays with. It is asked for nothing where too many of its walks are expected to end in one.
Simulation alone is believed where the gate has accepted the last log, and where the tuned simulator has the policy that
walked fall about as often as it did; else what was measured is expected again. In the first round nothing was measured.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from envs import logs
from envs.biteno import constants
from envs.logs import Log
from envs.targets import recorded
from envs.targets.recorded import Recorded
from experiments import checkpoint, doctor, export, report
from experiments.checkpoint import write_json
from experiments.expected import expected_falls, measured
from experiments.loop import Loop, Policy
from experiments.robot_folder import request, wait
from experiments.train import console, policy_config
from jaxtune import baselines, tuner
from jaxtune.tuner import Tuner, TunerState


@dataclass(frozen=True)
class Method:
    """How a distribution is tuned, and how wide a policy trains in it."""

    tuner: Callable[[Tuner], Tuner | baselines.Untuned]
    policy: Callable[[Policy, float], Policy] = lambda policy, radius: policy


METHODS = {
    "ours": Method(lambda machine: machine),
    "spm": Method(baselines.spm),
    "dr": Method(
        lambda machine: baselines.Untuned(tuner=machine),
        lambda policy, radius: policy.replace(radius=jnp.full_like(policy.radius, radius)),
    ),
}

_STRANGE = 0.25  # share of the actions' size by which they may differ from the policy's
_KEYS = 7  # of the rounds, apart from what else begins with the seed


class Simulator:
    """The learner's side: a loop and its programs, each compiled once however many runs share them."""

    def __init__(self, loop: Loop):
        self.loop = loop
        self.machines = {name: method.tuner(loop.tuner()) for name, method in METHODS.items()}
        self.tune = {name: jax.jit(machine.tune) for name, machine in self.machines.items()}
        self.train = jax.jit(loop.tuner().train)
        self.foresee = jax.jit(loop.foresee, static_argnums=(3, 4))
        self.act = jax.jit(
            lambda policy, obs: jax.vmap(lambda one: loop.act(policy)(one, jax.random.PRNGKey(0))[0])(obs)
        )


@dataclass(frozen=True, kw_only=True)
class Terms:
    """What a robot is asked for, and on what conditions."""

    walk_s: float = 10.0
    """Length of a walk that the robot is asked for."""
    max_fall_rate: float = 0.2
    """The robot is asked for nothing where more of its walks are expected to end in a fall."""
    force: bool = False
    """Ask all the same."""
    trust_log: bool = False
    """Learn from a log even if the doctor thinks it means something else, or another policy has walked."""
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
      policy: what the first round begins with.
      start: middle of the first distribution, physical values by name.
      radius: of the first distribution, in log space.
    """

    def __init__(
        self,
        out: Path,
        terms: Terms,
        simulator: Simulator,
        method: str,
        policy: Policy,
        start: Mapping[str, float],
        radius: float,
    ):
        self._out, self._terms, self._simulator, self._loop = out, terms, simulator, simulator.loop
        self._tune = simulator.tune[method]
        policy = METHODS[method].policy(policy, radius)
        self._first = simulator.machines[method].init(policy, self._loop.dist(start, radius), tuner.knobs())
        self._steps = round(terms.walk_s / constants.POLICY_DT_S)

    def round(self, index: int, history: Sequence[Mapping]) -> dict:
        """Plays a round, or reads what an earlier call left of it.

        Args:
          index: of the round.
          history: what is known of the rounds before it.

        Returns:
          `predicted` and `measured` return, share of falls and power; `tuning`: the verdict, what moved, and the same
          numbers of the same policy in the tuned simulator, `explained`; `next`: what is predicted of the round that
          follows; `expected_falls` in it.

        Raises:
          ValueError: the robot is not asked to walk, has not answered, or its log cannot be learnt from.
        """
        place = self._place(index)
        state = self._start(index, lambda: self._first)
        predicted = self._foreseen(index, state)
        if not (place / "tuning.json").exists():
            if not (place / "log").exists():
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
        key = jax.random.fold_in(jax.random.PRNGKey(self._terms.seed), _KEYS)
        return jax.random.fold_in(jax.random.fold_in(key, index), use)

    def _start(self, index: int, make: Callable[[], TunerState]) -> TunerState:
        place = self._place(index)
        if not (place / "start" / "config.json").exists():
            state = make()
            checkpoint.save(place / "learner", state.policy.learner, policy_config(self._loop))
            checkpoint.save(place / "start", state, {})
        # Read back even if just made: a run that goes on has no other state than one that was never stopped.
        return checkpoint.load(place / "start", self._first, {})

    def _foresee(self, key: jax.Array, state: TunerState) -> dict:
        count = self._loop.preset.foreseen_episodes
        found = self._simulator.foresee(key, state.policy, state.dist, count, self._steps)
        # A fifth in single precision is more than a fifth.
        return found | {"fall_rate": round(count * float(found["fall_rate"])) / count, "episodes": count}

    def _foreseen(self, index: int, state: TunerState) -> dict:
        path = self._place(index) / "prediction.json"
        if not path.exists():
            write_json(path, self._foresee(self._key(index, 0), state))
        return json.loads(path.read_text())

    def _permit(self, index: int, predicted: Mapping, history: Sequence[Mapping]) -> None:
        rate, most = expected_falls(predicted, history), self._terms.max_fall_rate
        if not history:
            console.print(f"nothing was measured in this run yet; simulation alone expects {rate:.0%} of walks to fall")
        if rate > most and not self._terms.force:
            # An earlier call may have asked on other terms.
            (self._place(index) / "request.json").unlink(missing_ok=True)
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
        if len(log.runs) != preset.tuner.set_episodes:
            raise ValueError(
                f"{place / 'log'}: got {len(log.runs)} run(s), expected the {preset.tuner.set_episodes} walks that "
                f"{place / 'request.json'} asks for, in a run each"
            )
        walks = recorded.episodes(log, self._steps)
        said = doctor.summary(doctor.examine(log))
        if not self._terms.trust_log:
            self._check(place / "log", log, walks, state.policy, said)
        suspected = [{"sentence": finding.sentence, "runs": runs} for finding, runs in said]
        write_json(place / "measured.json", measured(walks, self._steps) | {"suspected": suspected})
        start = recorded.beginning(walks, preset.episode_steps)
        repeating = state.replace(policy=state.policy.replace(asked=start.asked))
        tuned, info = self._tune(self._key(index, 1), repeating, start.trajectory)
        tuned = tuned.replace(policy=state.policy)
        checkpoint.save(place / "tuned", tuned, {})
        told = report.tuning(info) | {"moved": report.moved(self._loop.entries, state.dist, tuned.dist, info)}
        told |= {"compared_s": preset.episode_steps * constants.POLICY_DT_S}
        # Last: what is there need not be learnt again.
        write_json(place / "tuning.json", told | {"explained": self._foresee(self._key(index, 3), tuned)})

    def _check(self, place: Path, log: Log, walks: Recorded, policy: Policy, said) -> None:
        """Nothing is learnt from numbers that mean something else, or from another policy's walks.

        Raises:
          ValueError: says what is wrong.
        """
        wrong = [finding.sentence for finding, runs in said if finding.wrong and 2 * len(runs) > len(log.runs)]
        task, given = self._loop.preset.task, log.policy or {}
        for name, value in {"action_scale": task.action_scale, "base": task.base}.items():
            if given.get(name, value) != value:
                wrong.append(f"policy.{name}: got {given[name]}, expected {value}")
        alive = np.asarray(walks.trajectory.alive)
        done = np.asarray(walks.trajectory.action)[alive]
        ours = np.asarray(self._simulator.act(policy, walks.trajectory.obs.reshape(-1, walks.trajectory.obs.shape[-1])))
        strange = np.sqrt(((done - ours[alive.ravel()]) ** 2).mean() / np.maximum((done**2).mean(), 1e-12))
        if strange > _STRANGE:
            wrong.append(f"actions differ from what this round's policy does by {strange:.0%} of their size")
        if wrong:
            raise ValueError(f"{place}: {'; '.join(wrong)} (trust_log learns from it all the same)")
