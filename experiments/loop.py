"""BITeno's side of the tuner: how its policy is trained, its episodes simulated, its return measured."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import chex
import jax
import jax.numpy as jnp
from brax.envs.base import State

from envs import biteno, domain
from envs.biteno import BraxBiteno, constants, gait
from envs.correction import Correction
from envs.targets.mjx import MjxTarget, rollout, simulate
from envs.targets.protocol import Act, Asked, Target
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
    radius: jax.Array  # its robots are drawn no wider than this around the centre, in search coordinates
    hidden: dict  # physical values by name of what its robots have and nobody tunes
    asked: Asked | None = None  # what simulated episodes are asked for in turn, where measured ones are repeated


class Loop:
    """Pure functions over one robot and one preset, to be handed to a `Tuner` or jitted alone.

    Args:
      preset: sizes.
      entries: what is tuned.
      hidden: what is not, but may be other than nominal where a policy trains.
      correction: the model as discovery left it; the nominal one where None.
    """

    def __init__(
        self,
        preset: Preset,
        entries: Mapping[str, domain.Entry],
        hidden: Mapping[str, domain.Entry] = MappingProxyType({}),
        correction: Correction | None = None,
    ):
        self.preset = preset
        self.entries = entries
        self._hidden = hidden
        self.robot = biteno.make(preset.task, {**entries, **hidden}, correction)
        pushed = replace(preset.task, push_mps=preset.push_mps)
        self._env = BraxBiteno(biteno.make(pushed, self.robot.entries, correction))
        self._ppo = PPO(preset.ppo, self.robot.observation_size, self.robot.action_size)
        # One program for all methods: what they differ in is an argument.
        self._train = jax.jit(lambda key, policy, dist: self.train(key, policy, dist, preset.epochs))

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
        robots = self._env.reset(jax.random.split(key_robots, count))
        return Policy(
            learner=learner,
            robots=jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), robots),
            radius=jnp.asarray(self.preset.policy_radius, jnp.float32),
            hidden={name: jnp.asarray(value, jnp.float32) for name, value in domain.nominal(self._hidden).items()},
        )

    def train(self, key: jax.Array, policy: Policy, dist: ParamDist, updates: int) -> tuple[Policy, dict]:
        """PPO updates on robots drawn from the distribution, no wider than the policy's radius.

        Returns:
          The policy, and metrics [updates] by name.
        """
        key_params, key_updates = jax.random.split(key)
        count = self.preset.ppo.num_envs
        dist = dist.replace(radius=jax.tree.map(lambda r: jnp.minimum(r, policy.radius), dist.radius))
        params = domain.from_coordinates(self.entries, dists.sample(key_params, dist, count))
        params |= {name: jnp.broadcast_to(value, count) for name, value in policy.hidden.items()}
        robots = self._env.with_params(policy.robots, params)

        def update(carry, key):
            learner, robots, metrics = self._ppo.update(key, carry[0], self._env, carry[1])
            return (learner, robots), metrics

        (learner, robots), metrics = jax.lax.scan(
            update, (policy.learner, robots), jax.random.split(key_updates, updates)
        )
        return policy.replace(learner=learner, robots=robots), metrics

    def simulate(self, key: jax.Array, policy: Policy, params: Mapping[str, jax.Array]) -> Trajectory:
        """One episode for each draw, [episodes] by name in search coordinates."""
        count, steps = len(next(iter(params.values()))), self.preset.episode_steps
        asked = jax.tree.map(lambda leaf: leaf[jnp.arange(count) % len(leaf)], policy.asked)
        whole = simulate(
            self.robot, key, self.act(policy), params, steps if asked is None else asked.command.shape[1], asked
        )
        # A log tells of a robot from a few steps after it has begun to walk.
        return jax.tree.map(lambda leaf: leaf[:, -steps:] if leaf.ndim > 1 else leaf, whole)

    def play(self, target: Target) -> Callable[..., Trajectory]:
        """Whole episodes in a target, `(key, policy, count, steps) -> Trajectory`, compiled where it is in JAX."""

        def play(key, policy, count, steps):
            return target.episodes(key, self.act(policy), count, steps)

        return jax.jit(play, static_argnums=(2, 3)) if isinstance(target, MjxTarget) else play

    def evaluate(self, key: jax.Array, policy: Policy, play: Callable[..., Trajectory]) -> tuple[float, int]:
        """Mean return under the weights of Table I, and number of falls, over episodes of the full time limit."""
        steps = round(self.preset.task.episode_s / constants.POLICY_DT_S)
        trajectory = play(key, policy, self.preset.evaluation_episodes, steps)
        return float(trajectory.score.sum(axis=-1).mean()), int(trajectory.fell.sum())

    def foresee(self, key: jax.Array, policy: Policy, dist: ParamDist, count: int, steps: int) -> dict[str, jax.Array]:
        """What the policy does in robots drawn from the distribution.

        Returns:
          By name, over `count` episodes of `steps` steps: mean `return` under the weights of Table I, `fall_rate`, and
          mean `power_w` while it walks.
        """
        key_params, key_episodes = jax.random.split(key)
        params = domain.from_coordinates(self.entries, dists.sample(key_params, dist, count))
        trajectory, power = rollout(
            self.robot,
            key_episodes,
            self.act(policy),
            params,
            steps,
            watch=lambda before, after, motion: gait.power(motion.torque, motion.qvel[6:]),
        )
        return walked(trajectory, power)

    def tuner(self, target: Target | None = None) -> Tuner:
        """Algorithm 1 against a target, pure where the target is in JAX; of none, measured sets come from outside."""
        count, steps = self.preset.tuner.set_episodes, self.preset.episode_steps
        return Tuner(
            config=self.preset.tuner,
            train_policy=lambda key, policy, dist: self.train(key, policy, dist, self.preset.epochs),
            simulate=self.simulate,
            measure=target and (lambda key, policy: target.episodes(key, self.act(policy), count, steps)),
        )

    def step(self, machine: Tuner | Untuned, play: Callable[..., Trajectory]) -> Callable:
        """The step of a tuner in parts that are compiled apart, so that several tuners share them."""
        if isinstance(machine, Untuned):
            return replace(machine, tuner=replace(machine.tuner, train_policy=self._train)).step
        tune = jax.jit(machine.tune)
        count, steps = self.preset.tuner.set_episodes, self.preset.episode_steps

        def step(key, state):
            key_measure, key_tune, key_train = jax.random.split(key, 3)
            state, info = tune(key_tune, state, play(key_measure, state.policy, count, steps))
            policy, metrics = self._train(key_train, state.policy, state.dist)
            return state.replace(policy=policy), info.replace(train=metrics)

        return step

    def act(self, policy: Policy) -> Act:
        """What the policy does, without noise."""
        # A pytree: who compiles a program that asks it need not do so again for the next learner.
        return jax.tree_util.Partial(self._act, policy.learner)

    def _act(self, learner: PPOState, obs: jax.Array, key: jax.Array):
        return self._ppo.act(learner)(obs, key)


def walked(trajectory: Trajectory, power: jax.Array) -> dict[str, jax.Array]:
    """What came of episodes, their power [episodes, time] in W beside them: mean return, share of falls, mean power."""
    alive = trajectory.alive
    return {
        "return": trajectory.score.sum(axis=1).mean(),
        "fall_rate": trajectory.fell.mean(),
        "power_w": jnp.where(alive, power, 0.0).sum() / jnp.maximum(alive.sum(), 1),
    }
