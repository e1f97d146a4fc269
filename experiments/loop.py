"""BITeno's side of the tuner: how its policy is trained, its episodes simulated, its return measured."""

from collections.abc import Callable, Mapping

import chex
import jax
import jax.numpy as jnp
from brax.envs.base import State

from envs import domain
from envs.biteno import Biteno, BraxBiteno, constants
from envs.targets.mjx import MjxTarget, simulate
from envs.targets.protocol import Act, Target
from experiments.config import Preset
from jaxtune import dist as dists
from jaxtune.baselines import Untuned
from jaxtune.ppo import PPO, PPOState
from jaxtune.tuner import Tuner
from jaxtune.types import ParamDist, Trajectory


@chex.dataclass(frozen=True)
class Policy:
    """A learner and the robots it learns on."""

    learner: PPOState
    robots: State


class Loop:
    """Pure functions over one robot and one preset, to be handed to a `Tuner` or jitted alone."""

    def __init__(self, preset: Preset, entries: Mapping[str, domain.Entry]):
        self.preset = preset
        self.entries = entries
        self.robot = Biteno(preset.task, entries)
        self._env = BraxBiteno(self.robot)
        self._ppo = PPO(preset.ppo, self.robot.observation_size, self.robot.action_size)

    def jit(self, function: Callable) -> Callable:
        """Compiles with the preset's options."""
        return jax.jit(function, compiler_options=dict(self.preset.compiler_options))

    def dist(self, centre: Mapping[str, float], radius: float) -> ParamDist:
        """A distribution around physical values, in search coordinates, with the table's bounds."""
        ends = [{name: entry.bounds[end] for name, entry in self.entries.items()} for end in (0, 1)]
        middle, lower, upper = (
            {name: float(value) for name, value in domain.to_coordinates(self.entries, side).items()}
            for side in (centre, *ends)
        )
        return dists.make(middle, radius, lower, upper)

    def init(self, key: jax.Array, learner: PPOState | None = None) -> Policy:
        """A policy, new or with a given learner, and freshly reset robots."""
        key_learner, key_robots = jax.random.split(key)
        learner = self._ppo.init(key_learner) if learner is None else learner
        count = self.preset.ppo.num_envs
        params = {name: jnp.full(count, value) for name, value in domain.nominal(self.entries).items()}
        robots = self._env.start(params, jax.random.split(key_robots, count))
        return Policy(learner=learner, robots=jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), robots))

    def train(
        self, key: jax.Array, policy: Policy, dist: ParamDist, updates: int, radius: float = jnp.inf
    ) -> tuple[Policy, dict]:
        """PPO updates on robots drawn from the distribution, no wider than `radius` around its centre.

        Returns:
          The policy, and metrics [updates] by name.
        """
        key_params, key_updates = jax.random.split(key)
        dist = dist.replace(radius=jax.tree.map(lambda r: jnp.minimum(r, radius), dist.radius))
        params = dists.sample(key_params, dist, self.preset.ppo.num_envs)
        robots = self._env.with_params(policy.robots, domain.from_coordinates(self.entries, params))

        def update(carry, key):
            learner, robots, metrics = self._ppo.update(key, carry[0], self._env, carry[1])
            return (learner, robots), metrics

        (learner, robots), metrics = jax.lax.scan(
            update, (policy.learner, robots), jax.random.split(key_updates, updates)
        )
        return Policy(learner=learner, robots=robots), metrics

    def simulate(self, key: jax.Array, policy: Policy, params: Mapping[str, jax.Array]) -> Trajectory:
        """One episode for each draw, [episodes] by name in search coordinates."""
        return simulate(self.robot, key, self.act(policy), params, self.preset.episode_steps)

    def measure(self, key: jax.Array, policy: Policy, target: Target) -> Trajectory:
        """One measured set of the target."""
        count = self.preset.tuner.set_episodes
        return target.episodes(key, self.act(policy), count, self.preset.episode_steps)

    def evaluate(self, key: jax.Array, policy: Policy, target: Target) -> tuple[jax.Array, jax.Array]:
        """Mean return under the weights of Table I, and number of falls, over whole episodes in the target."""
        steps = round(self.preset.task.episode_s / constants.POLICY_DT_S)
        trajectory = target.episodes(key, self.act(policy), self.preset.evaluation_episodes, steps)
        return trajectory.score.sum(axis=-1).mean(), trajectory.fell.sum()

    def tuner(self, target: Target, policy_radius: float) -> Tuner:
        """Algorithm 1 against a target; the policy trains within `policy_radius` of the centre."""
        epochs = self.preset.epochs
        return Tuner(
            config=self.preset.tuner,
            train_policy=lambda key, policy, dist: self.train(key, policy, dist, epochs, policy_radius),
            simulate=self.simulate,
            measure=lambda key, policy: self.measure(key, policy, target),
        )

    def step(self, machine: Tuner | Untuned, target: Target) -> Callable:
        """The compiled step of a tuner; what asks a target that is not JAX stays outside."""
        if isinstance(machine, Untuned) or isinstance(target, MjxTarget):
            return self.jit(machine.step)
        tune, train = self.jit(machine.tune), self.jit(machine.train)

        def step(key, state):
            key_measure, key_tune, key_train = jax.random.split(key, 3)
            state, info = tune(key_tune, state, machine.measure(key_measure, state.policy))
            state, metrics = train(key_train, state)
            return state, info.replace(train=metrics)

        return step

    def act(self, policy: Policy) -> Act:
        """What the policy does, without noise."""
        return self._ppo.act(policy.learner)
