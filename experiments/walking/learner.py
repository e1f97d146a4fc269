"""Connects a robot to the tuner: how its policy learns, and how episodes are simulated, measured and scored.

`Learner` binds one robot, one preset and one parameter table together. It offers the pure functions that
`jaxtune.tuner.Tuner` needs (`train`, `simulate`, a target's `measure`), and further ones for the commands (`evaluate`,
`predict`, `play`). It holds no state: what changes is in `Policy`, a pytree.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import chex
import jax
import jax.numpy as jnp
from brax.envs.base import State

from envs.corrected import Correction
from envs.targets.mjx import MjxTarget, rollout, simulate
from envs.targets.protocol import Act, Commands, Target
from experiments.common import compiler, hosts
from experiments.common.config import Preset
from experiments.walking.robots import BITENO, Kind
from jaxtune import devices, mjx
from jaxtune import dist as dists
from jaxtune.baselines import Untuned
from jaxtune.mjx import Entry, TrainingBatch, parameters
from jaxtune.ppo import PPO, PPOState
from jaxtune.tuner import Tuner
from jaxtune.types import Coords, ParamDist, Trajectory


@chex.dataclass(frozen=True)
class Policy:
    """A policy while it learns: PPO's state, the robots that it learns on, and what they are drawn from.

    This pytree is the `policy` of a `jaxtune.tuner.TunerState`, so it is also what a run's checkpoints hold.
    """

    learner: PPOState  # networks, optimiser and observation statistics
    robots: State  # [envs] states of the training environments, kept between two rollouts
    radius: jax.Array  # largest radius, in coordinates, of the distribution that the training robots are drawn from
    hidden: dict  # physical values by name of parameters that the training robots have and nobody tunes
    # Commands of measured episodes, which simulated ones repeat; drawn by the task where None. Named as in checkpoints.
    asked: Commands | None = None


class Learner:
    """Trains, simulates and evaluates policies of one robot, as pure functions.

    Use it wherever a command needs a robot: run the tuner that `learner.tuner(target)` makes, or jit single methods.
    All runs of the same preset and table can share one learner, and with it the programs that were compiled for it.

    Args:
      preset: sizes of everything.
      entries: the parameter table that is tuned.
      hidden: parameters that are not tuned, but may differ from nominal in training. `oracle` uses them.
      correction: a corrected model that discovery wrote; None means the nominal model.
      kind: the robot.
      states: True to measure and simulate the robot's states too, from which its tuner estimates last (`replay`).

    Raises:
      ValueError: the robot's episodes are shorter than a window of the tuner, or it cannot be made of the correction.
    """

    def __init__(
        self,
        preset: Preset,
        entries: Mapping[str, Entry],
        hidden: Mapping[str, Entry] = MappingProxyType({}),
        correction: Correction | None = None,
        kind: Kind = BITENO,
        states: bool = False,
    ):
        window = preset.tuner.longest_window
        if kind.episode_steps < window:
            raise ValueError(
                f"robot '{kind.name}': got episodes of {kind.episode_steps} steps, expected at least {window}, a window"
            )
        self.preset = preset = replace(preset, episode_steps=min(preset.episode_steps, kind.episode_steps))
        self.kind = kind
        self.correction = correction
        self.entries = entries
        self._hidden = hidden
        self.states = states
        self.robot = kind.make(preset, {**entries, **hidden}, correction)
        self.longest = min(round(preset.task.episode_s / kind.control_s), kind.episode_steps)
        """Control steps of a whole episode: the robot's own, up to the preset's time limit."""
        trained = kind.make(kind.trained(preset), self.robot.entries, correction)
        self._env = TrainingBatch(trained, self.robot.entries, self.longest)
        self._ppo = PPO(preset.ppo, self.robot.observation_size, self.robot.action_size)
        # Op by op, a reset would be hundreds of programs, compiled in every process anew.
        self._init = jax.jit(self._fresh)
        # One compiled program serves all methods, because they differ only in its arguments.
        self._program = jax.jit(lambda key, policy, dist: self.train(key, policy, dist, preset.epochs))
        self._train = devices.on_all(self._program)

    def dist(self, centre: Mapping[str, float], radius: float) -> ParamDist:
        """Makes a uniform distribution around physical values, with the table's bounds.

        Args:
          centre: physical values by name, multipliers of nominal for logarithmic entries.
          radius: half width in coordinates (log space for logarithmic entries), the same for every parameter.

        Returns:
          The distribution in coordinates, which is what the tuner searches.
        """
        return parameters.distribution(self.entries, radius, centre)

    def init(self, key: jax.Array) -> Policy:
        """Starts a policy with new networks on freshly reset training robots.

        Args:
          key: random key (`jax.random.PRNGKey`, as Brax's wrappers need it).
        """
        return self._init(key)

    def _fresh(self, key):
        key_learner, key_robots = jax.random.split(key)
        robots = self._env.reset(jax.random.split(key_robots, self.preset.ppo.num_envs))
        return Policy(
            learner=self._ppo.init(key_learner),
            # Strong types, as training returns them; with weak ones its second call would compile again.
            robots=jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), robots),
            radius=jnp.asarray(self.preset.policy_radius, jnp.float32),
            hidden={name: jnp.asarray(value, jnp.float32) for name, value in parameters.nominal(self._hidden).items()},
        )

    def train(self, key: jax.Array, policy: Policy, dist: ParamDist, updates: int) -> tuple[Policy, dict]:
        """Runs PPO updates on robots drawn from the distribution.

        The distribution's radius is limited to `policy.radius`. If the gate has widened the distribution, a policy that
        trained on all of it would become robust to physics that the robot does not have, at the price of its return.

        Args:
          key: random key.
          policy: where training starts.
          dist: distribution of the parameters, in coordinates.
          updates: number of PPO updates; static, as it is the length of a scan.

        Returns:
          The policy, and metrics [updates] by name.
        """
        key_params, key_updates = jax.random.split(key)
        count = self.preset.ppo.num_envs
        dist = dist.replace(radius=jax.tree.map(lambda r: jnp.minimum(r, policy.radius), dist.radius))
        params = parameters.from_coords(self.entries, dists.sample(key_params, dist, count))
        params |= {name: jnp.broadcast_to(value, count) for name, value in policy.hidden.items()}
        robots = self._env.with_params(policy.robots, params)

        def update(carry, key):
            ppo, robots, metrics = self._ppo.update(key, carry[0], self._env, carry[1])
            return (ppo, robots), metrics

        (ppo, robots), metrics = jax.lax.scan(update, (policy.learner, robots), jax.random.split(key_updates, updates))
        return policy.replace(learner=ppo, robots=robots), metrics

    def collect(self, keys: jax.Array, policy: Policy) -> tuple[State, Any, dict]:
        """Collects the rollout of one PPO update (`jaxtune.ppo.PPO.collect`), with keys [envs]."""
        return self._ppo.collect(keys, policy.learner, self._env, policy.robots)

    def simulate(self, key: jax.Array, policy: Policy, coords: Coords) -> Trajectory:
        """Simulates one episode for every row of coordinates; this is the tuner's `simulate`.

        If the policy carries commands (`asked`), episode i repeats the i-th of them (in turn), from the same phase of
        the gait clock. Only the last `episode_steps` steps are then returned. The log begins a few steps after the
        robot began to walk, so the simulated robot has to walk these steps too before the two can be compared.

        Args:
          key: random key.
          policy: acts without exploration noise.
          coords: [episodes] by name.

        Returns:
          Episodes, [episodes, time].
        """
        count, steps = len(next(iter(coords.values()))), self.preset.episode_steps
        commands = jax.tree.map(lambda leaf: leaf[jnp.arange(count) % len(leaf)], policy.asked)
        length = steps if commands is None else commands.command.shape[1]
        whole = simulate(self.robot, key, self.act(policy), coords, length, commands, self.states)
        return jax.tree.map(lambda leaf: leaf[:, -steps:] if leaf.ndim > 1 else leaf, whole)

    def play(self, target: Target) -> Callable[..., Trajectory]:
        """Makes the function that plays episodes in a target; it is compiled if the target is written in JAX.

        Args:
          target: the simulator that the policy walks in.

        Returns:
          `(key, policy, count, steps) -> Trajectory [count, steps]`.
        """
        if not isinstance(target, MjxTarget):
            # The rounding of other engines may differ between hosts, and all must go on with the same episodes.
            return hosts.on_first(
                lambda key, policy, *size: jax.device_get(target.episodes(key, self.act(policy), *size, self.states))
            )

        def whole(key, policy, until, count, steps):
            return target.episodes(key, self.act(policy), count, steps, self.states, until)

        compiled = devices.on_all(jax.jit(whole, static_argnums=(3, 4), compiler_options=compiler.for_seconds()))

        def play(key, policy, count, steps):
            # One program for measured episodes and evaluations: it takes longer to compile than to simulate the rest.
            rows, longest = max(count, self.preset.evaluation_episodes), max(steps, self.longest)
            found = compiled(key, policy, jnp.asarray(steps), rows, longest)
            return jax.tree.map(lambda leaf: leaf[:count, :steps] if leaf.ndim > 1 else leaf[:count], found)

        return play

    def evaluate(self, key: jax.Array, policy: Policy, play: Callable[..., Trajectory]) -> tuple[float, int]:
        """Measures a policy's return and falls in a target, over `evaluation_episodes` episodes of the full time limit.

        Args:
          key: random key; the same key gives the same commands and resets.
          policy: acts without exploration noise.
          play: what `play` made of the target.

        Returns:
          Mean return (BITeno's under the weights of Table I), and number of episodes that ended in a fall.
        """
        trajectory = play(key, policy, self.preset.evaluation_episodes, self.longest)
        return float(trajectory.score.sum(axis=-1).mean()), int(trajectory.fell.sum())

    def predict(self, key: jax.Array, policy: Policy, dist: ParamDist, count: int, steps: int) -> dict[str, jax.Array]:
        """Predicts by simulation how a policy will walk on robots drawn from the distribution.

        Use it before a real robot walks: `fall_rate` decides whether it may.

        Args:
          key: random key.
          policy: acts without exploration noise.
          dist: distribution of the robots' parameters, in coordinates.
          count: number of simulated walks.
          steps: policy steps of a walk.

        Returns:
          By name: mean `return`, `fall_rate`, and mean `power_w` while the robot walks.
        """
        key_params, key_episodes = jax.random.split(key)
        params = parameters.from_coords(self.entries, dists.sample(key_params, dist, count))
        trajectory, power = rollout(
            self.robot,
            key_episodes,
            self.act(policy),
            params,
            steps,
            watch=lambda before, after, motion: self.kind.power(motion),
        )
        return summarise_walks(trajectory, power)

    def tuner(self, target: Target | None = None) -> Tuner:
        """Makes the tuner (the paper's Algorithm 1) over this learner's functions.

        Args:
          target: the simulator that episodes are measured in. The tuner is pure if the target is written in JAX. None
            means that measured sets come from outside, such as a log, and are passed to `Tuner.tune`.
        """
        count, steps = self.preset.tuner.set_episodes, self.preset.episode_steps
        return Tuner(
            config=self.preset.tuner,
            train_policy=lambda key, policy, dist: self.train(key, policy, dist, self.preset.epochs),
            simulate=self.simulate,
            measure=target and (lambda key, policy: target.episodes(key, self.act(policy), count, steps, self.states)),
            replay=mjx.replay(self.robot, self.entries) if self.states else None,
            phase=self.kind.phase,
        )

    def channels(self) -> list[str]:
        """Names every observation and action, in the order of a window's channels."""
        meta = self.kind.meta(self.preset, self.robot)
        parts = [(part["name"], part["size"]) for part in meta["observation"]] + [("action", self.robot.action_size)]
        return [name if size == 1 else f"{name}[{column}]" for name, size in parts for column in range(size)]

    def step(self, machine: Tuner | Untuned, play: Callable[..., Trajectory]) -> Callable:
        """Makes a tuner's step out of parts that are compiled separately.

        Training is by far the largest program to compile, and it is the same for all methods. So they share one
        compiled `train`, and only the small rest is compiled for each tuner. A target that is not JAX fits in between.

        Args:
          machine: a tuner, or a baseline that is never tuned.
          play: what `play` made of the target.

        Returns:
          `(key, state) -> (state, info)`, with the random keys split as `Tuner.step` splits them.
        """
        if isinstance(machine, Untuned):
            return replace(machine, tuner=replace(machine.tuner, train_policy=self._train)).step
        tune = devices.on_all(jax.jit(machine.tune))
        count, steps = self.preset.tuner.set_episodes, self.preset.episode_steps

        def step(key, state):
            key_measure, key_tune, key_train = jax.random.split(key, 3)
            measured = play(key_measure, state.policy, count, steps)
            with compiler.beside(self._program, key_train, state.policy, state.dist):
                state, info = tune(key_tune, state, measured)
            policy, metrics = self._train(key_train, state.policy, state.dist)
            return state.replace(policy=policy), info.replace(train=metrics)

        return step

    def act(self, policy: Policy) -> Act:
        """Makes the policy's action function, `(observation [obs], key) -> action [act]`.

        It has no exploration noise. Targets and simulators take it to play episodes.
        """
        # A pytree, so that a program which takes it as an argument is not compiled again for the next policy.
        return jax.tree_util.Partial(self._act, policy.learner)

    def actions(self, policy: Policy, obs: jax.Array) -> jax.Array:
        """Computes what a policy does, without noise, for observations [steps, obs] of a log: actions [steps, act]."""
        return self._ppo.act(policy.learner)(obs, jax.random.PRNGKey(0))[0]

    def _act(self, ppo: PPOState, obs: Any, key: jax.Array) -> jax.Array:
        return self._ppo.act(ppo)(self.robot.observed(obs), key)[0]


def summarise_walks(trajectory: Trajectory, power: jax.Array) -> dict[str, jax.Array]:
    """Computes mean return, fall rate and mean power of walks.

    Simulated and recorded walks are summarised by the same code, so that predictions and measurements compare.

    Args:
      trajectory: walks, [episodes, time].
      power: [episodes, time] W, mechanical.

    Returns:
      Scalars by name: mean `return` of a walk, `fall_rate` (share of walks that end in a fall), and mean `power_w` over
      the steps on which the robot was alive; nan where score or power is not known.
    """
    alive = trajectory.alive
    return {
        "return": trajectory.score.sum(axis=1).mean(),
        "fall_rate": trajectory.fell.mean(),
        "power_w": jnp.where(alive, power, 0.0).sum() / jnp.maximum(alive.sum(), 1),
    }
