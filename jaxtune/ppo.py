"""Proximal policy optimisation (PPO) as one pure update, made of Brax's networks, loss, advantages and rollout.

Use it for a user's `train_policy` where the policy is trained in a Brax environment. `brax.training.agents.ppo.train`
owns its loop, environments and optimiser, and cannot be jitted. Here an update is a function of the learner's state and
the environments' state. So training scans and vmaps over seeds, a run resumes where it stopped, and the physics may
change between two updates without compiling anew. The tuner itself does not need this module.

One update collects `num_envs x unroll_steps` steps and passes over them `epochs` times, in minibatches. For each it
takes an Adam step on PPO's clipped objective (Schulman et al., 2017), with rho = exp(log pi(a|o) - log pi_old(a|o)):

    loss = -mean(min(rho A, clip(rho, 1 - clip, 1 + clip) A)) + mean((G - V)^2) / 4 - entropy_cost * mean(entropy).

Returns G and advantages A come from generalised advantage estimation (Schulman et al., 2016), as Brax computes it:

    delta_t = reward_t + discount V_{t+1} - V_t
    G_t     = V_t + sum over k of (discount gae_lambda)^k delta_{t+k}
    A_t     = reward_t + discount G_{t+1} - V_t,    scaled to mean 0 and standard deviation 1 in the minibatch.

The value after a fall is zero. Where the time limit cut an episode off, delta and A are zero, since the environment is
reset before the value behind the cut could be known. The step size follows the divergence from the policy that
collected the rollout (`PPO._steer`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from brax.envs.base import Env, State
from brax.training.acme import running_statistics, specs
from brax.training.acting import actor_step
from brax.training.agents.ppo import losses, networks
from brax.training.types import Transition
from flax import linen

from jaxtune import devices

_LEARNING_RATE_RANGE = (1e-5, 1e-2)  # smallest and largest step size that the divergence may steer to
_CONSTANT = 2e-6  # standard deviation of an observation that never changed, as a multiple of its size, from one up


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Sizes and weights of PPO; the defaults are for a walking robot on two CPU cores.

    On a GPU, raise `num_envs` to several thousand first.

    Raises:
      ValueError: `minibatches` does not divide `num_envs`.
    """

    num_envs: int = 256
    """Environments that run side by side."""
    unroll_steps: int = 32
    """Steps of each environment in one update."""
    epochs: int = 4
    """Passes over a rollout."""
    minibatches: int = 4
    """Gradient steps in a pass; must divide num_envs."""
    learning_rate: float = 3e-4
    """First step size of Adam; it follows target_kl from there."""
    target_kl: float = 0.01
    """Divergence in nats between the policy and the one that collected the rollout; the step size is adapted to keep
    it near this value."""
    clip: float = 0.2
    """Largest deviation of the probability ratio from one that still counts in the objective."""
    entropy_cost: float = 0.003
    """Weight of the entropy bonus."""
    gae_lambda: float = 0.95
    """Mix of one-step (0) and Monte Carlo (1) advantages."""
    discount: float = 0.99
    """Discount factor per policy step."""
    max_grad_norm: float = 1.0
    """Gradients with a larger norm are scaled down to it."""
    init_std: float = 0.7
    """First standard deviation of every action, in the action's unit."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of policy and value network, with ELU."""

    def __post_init__(self):
        if self.num_envs % self.minibatches:
            raise ValueError(f"minibatches: got {self.minibatches}, expected a divisor of num_envs, {self.num_envs}")

    @property
    def steps_per_update(self) -> int:
        """Number of environment steps that one update collects, over all environments.

        Divide a training budget in steps by it to get the number of updates.
        """
        return self.num_envs * self.unroll_steps


@chex.dataclass(frozen=True)
class PPOState:
    """What the next update needs of the learner: save it to resume training, and stack it to vmap over seeds.

    `params` are network weights here, not physical parameters.
    """

    params: losses.PPONetworkParams  # of policy and value network
    normalizer: running_statistics.RunningStatisticsState  # running mean and standard deviation of observations
    opt_state: optax.OptState  # of Adam, with the current step size


class PPO:
    """PPO for one pair of observation and action sizes, with a Gaussian policy.

    `init` makes a learner, `update` improves it, and `act` and `layers` give its policy, in JAX or as plain weights.
    The object holds no state but the networks' definitions. Actions are not squashed (Brax's
    `distribution_type="normal"`), so the environment must limit them.

    Args:
      config: sizes and weights.
      observation_size: length of an observation.
      action_size: length of an action.
    """

    def __init__(self, config: PPOConfig, observation_size: int, action_size: int):
        self.config = config
        self._observation_size = observation_size
        self._networks = networks.make_ppo_networks(
            observation_size,
            action_size,
            preprocess_observations_fn=running_statistics.normalize,
            policy_hidden_layer_sizes=config.hidden,
            value_hidden_layer_sizes=config.hidden,
            activation=linen.elu,
            distribution_type="normal",
            noise_std_type="log",
            init_noise_std=config.init_std,
        )
        # The step size must be part of the optimiser's state, because every gradient step may change it (`_steer`).
        self._optimizer = optax.inject_hyperparams(
            lambda learning_rate: optax.chain(
                optax.clip_by_global_norm(config.max_grad_norm), optax.adam(learning_rate)
            )
        )(learning_rate=config.learning_rate)

    def init(self, key: jax.Array) -> PPOState:
        """Makes a learner with random weights, before any update.

        Its policy explores with a standard deviation of `init_std`. The observations' running mean and standard
        deviation begin at 0 and 1.
        """
        key_policy, key_value = jax.random.split(key)
        params = losses.PPONetworkParams(
            policy=self._networks.policy_network.init(key_policy),
            value=self._networks.value_network.init(key_value),
        )
        state = PPOState(
            params=params,
            normalizer=running_statistics.init_state(specs.Array((self._observation_size,), jnp.float32)),
            opt_state=self._optimizer.init(params),
        )
        # Some of Brax's leaves are weakly typed or Python's own. The second update would then be traced anew.
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype), state)

    def act(self, state: PPOState, *, deterministic: bool = True) -> Callable:
        """Gives the policy as Brax has it: `(observation [..., obs], key) -> (action [..., act], extras)`.

        It answers with the mean action, or with a random one where `deterministic` is False. Observations are
        normalised inside.
        """
        make = networks.make_inference_fn(self._networks)
        return make((state.normalizer, state.params.policy), deterministic=deterministic)

    @staticmethod
    def layers(state: PPOState) -> tuple[tuple[jax.Array, jax.Array], list[tuple[jax.Array, jax.Array]]]:
        """Gives the deterministic policy as plain weights, for export to a program without JAX.

        Start from x = (observation - mean) / std. Each layer computes x <- elu(x kernel + bias), the last one without
        elu, and its result is the action.

        Returns:
          Mean and standard deviation [obs] of observations; and, for every layer, its kernel [in, out] and bias [out].
        """
        # Names that Flax gives in Brax's policy network: the hidden layers, and a last layer for the mean.
        params = state.params.policy["params"]
        hidden = params["MLP_0"]
        every = [*(hidden[f"hidden_{index}"] for index in range(len(hidden))), params["Dense_0"]]
        return (state.normalizer.mean, state.normalizer.std), [(layer["kernel"], layer["bias"]) for layer in every]

    def update(self, key: jax.Array, state: PPOState, env: Env, env_state: State) -> tuple[PPOState, State, dict]:
        """Collects one rollout and learns from it; the module's docstring has the objective.

        It is pure, so `jax.lax.scan` over keys is a training run. Episodes go on where the last update left them.

        Args:
          key: random key.
          state: the learner.
          env: a batch of environments that reset themselves, with `truncation` in their state's `info`, as
            `brax.envs.wrappers.training.wrap` makes it.
          env_state: the environments' state, [num_envs] on every leaf. Devices in scope (`jaxtune.devices`) share the
            environments.

        Returns:
          The learner, the environments' state, and metrics as scalars: the environment's own (means over the rollout),
          `reward` per step, `done` (share of steps that ended an episode), `kl` (nats), `learning_rate`, `loss`, `std`
          of the actions, and `skipped`, the share of gradient steps that were not taken since a number was not finite.
        """
        key_unroll, key_learn = jax.random.split(key)
        keys = jax.random.split(key_unroll, self.config.num_envs)
        env_state, data, env_metrics = self.collect(keys, state, env, env_state)
        data = devices.gather(data)
        # As in Brax's own training, the loss already reads observations with the updated statistics.
        normalizer = _with_constants_unscaled(running_statistics.update(state.normalizer, data.observation))
        normalizer = optax.tree.where(_finite(normalizer), normalizer, state.normalizer)
        (params, opt_state), learned = jax.lax.scan(
            lambda carry, key: self._pass(key, carry, normalizer, data),
            (state.params, state.opt_state),
            jax.random.split(key_learn, self.config.epochs),
        )
        metrics = {"reward": data.reward, "done": 1.0 - data.discount, **env_metrics, **learned}
        state = PPOState(params=params, normalizer=normalizer, opt_state=opt_state)
        # Steps that were not taken have no loss; `skipped` counts them.
        return state, env_state, jax.tree.map(jnp.nanmean, metrics)

    def collect(
        self, keys: jax.Array, state: PPOState, env: Env, env_state: State
    ) -> tuple[State, Transition, dict[str, jax.Array]]:
        """Collects `unroll_steps` steps of every environment: the first half of an update.

        Args:
          keys: [num_envs] random keys; with one of its own an environment does not depend on the device that it is on.
          state: the learner; its policy explores.
          env: a batch of environments that reset themselves.
          env_state: the environments' state.

        Returns:
          The environments' state, transitions [num_envs, unroll_steps] and the environment's metrics of every step.
        """

        def of_some(state, keys, env_state):
            policy = jax.vmap(self.act(state, deterministic=False))

            def act(env_state, step):
                now = jax.vmap(jax.random.fold_in, (0, None))(keys, step)
                # Not Brax's `generate_unroll`, which gives all environments one key, and no metrics.
                following, transition = actor_step(env, env_state, policy, now, extra_fields=("truncation",))
                return following, (transition, following.metrics)

            env_state, found = jax.lax.scan(act, env_state, jnp.arange(self.config.unroll_steps))
            # Brax's loss takes environments first.
            return env_state, *jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), found)

        return devices.spread(of_some, (keys, env_state), shared=(state,))

    def _pass(self, key, carry, normalizer, data):
        """Goes once over the rollout, environments shuffled into minibatches."""
        key_shuffle, key_loss = jax.random.split(key)
        # Whole environments are shuffled, not single steps: the loss computes advantages along time.
        order = jax.random.permutation(key_shuffle, self.config.num_envs)
        batches = jax.tree.map(lambda x: x[order].reshape(self.config.minibatches, -1, *x.shape[1:]), data)
        batches = devices.share(batches, axis=1)
        keys = jax.random.split(key_loss, self.config.minibatches)
        return jax.lax.scan(lambda carry, item: self._descend(*item, carry, normalizer), carry, (keys, batches))

    def _descend(self, key, batch, carry, normalizer):
        """Adapts the step size to this minibatch's divergence and takes one gradient step with it."""
        params, opt_state = carry
        (loss, aux), grads = jax.value_and_grad(losses.compute_ppo_loss, has_aux=True)(
            params,
            normalizer,
            batch,
            key,
            self._networks,
            entropy_cost=self.config.entropy_cost,
            discounting=self.config.discount,
            gae_lambda=self.config.gae_lambda,
            clipping_epsilon=self.config.clip,
        )
        learning_rate = self._steer(opt_state.hyperparams["learning_rate"], aux["kl_mean"])
        opt_state = opt_state._replace(hyperparams={**opt_state.hyperparams, "learning_rate": learning_rate})
        updates, opt_state = self._optimizer.update(grads, opt_state, params)
        sane = _finite((loss, updates, opt_state))
        metrics = {
            "loss": loss,
            "kl": aux["kl_mean"],
            "std": aux["policy_dist_mean_std"],
            "learning_rate": learning_rate,
            "skipped": 1.0 - sane,
        }
        return optax.tree.where(sane, (optax.apply_updates(params, updates), opt_state), carry), metrics

    def _steer(self, learning_rate: jax.Array, kl: jax.Array) -> jax.Array:
        """Adapts the step size to the divergence, within its range (Rudin et al., CoRL 2021).

            step <- step / 1.5    where kl > 2 target_kl
            step <- step * 1.5    where 0 < kl < target_kl / 2

        A divergence of zero or nan was not measured and changes nothing.
        """
        low, high = _LEARNING_RATE_RANGE
        slower = jnp.maximum(learning_rate / 1.5, low)
        faster = jnp.minimum(learning_rate * 1.5, high)
        target = self.config.target_kl
        return jnp.where(kl > 2 * target, slower, jnp.where((kl < target / 2) & (kl > 0), faster, learning_rate))


def _with_constants_unscaled(
    normalizer: running_statistics.RunningStatisticsState,
) -> running_statistics.RunningStatisticsState:
    """Leaves observations unscaled that did not change in training.

    Brax divides them by 1e-6, so one that is a little different on the robot would drown all others.
    """
    varies = normalizer.std > _CONSTANT * jnp.maximum(jnp.abs(normalizer.mean), 1.0)
    return normalizer.replace(std=jnp.where(varies, normalizer.std, 1.0))


def _finite(values: Any) -> jax.Array:
    """Tells whether all numbers of a pytree are finite; whole numbers are."""
    return jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(values)]))
