"""One pure PPO update, made of Brax's networks, loss, advantage estimate and rollout.

`brax.training.agents.ppo.train` owns its loop, its environments and its optimiser, and cannot be jitted. Here an
update is a function of the learner's state and the environments' state, so training scans, vmaps over seeds, goes on
where it stopped, and the physics it trains in may change between two updates without compiling anything anew.
"""

from collections.abc import Callable
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import optax
from brax.envs.base import Env, State
from brax.training.acme import running_statistics, specs
from brax.training.acting import generate_unroll
from brax.training.agents.ppo import losses, networks
from flax import linen

_LEARNING_RATE_RANGE = (1e-5, 1e-2)


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Sizes and weights of PPO; defaults are for two CPU cores."""

    num_envs: int = 256
    """Environments that run side by side."""
    unroll_steps: int = 32
    """Steps of each environment in one update."""
    epochs: int = 4
    """Passes over a rollout."""
    minibatches: int = 4
    """Parts of a pass; must divide num_envs."""
    learning_rate: float = 3e-4
    """First step size; it follows target_kl from there."""
    target_kl: float = 0.01
    """Divergence of the policy within an update that the step size is steered to."""
    clip: float = 0.2
    """Clipping range of the probability ratio."""
    entropy_cost: float = 0.003
    """Weight of the entropy bonus."""
    gae_lambda: float = 0.95
    """Mix of one-step and Monte Carlo advantages."""
    discount: float = 0.99
    """Discount of a policy step."""
    max_grad_norm: float = 1.0
    """Gradients are clipped to this norm."""
    init_std: float = 0.7
    """First standard deviation of every action."""
    hidden: tuple[int, ...] = (128, 128)
    """Hidden layers of policy and value, with ELU."""

    def __post_init__(self):
        if self.num_envs % self.minibatches:
            raise ValueError(f"minibatches: {self.minibatches} does not divide num_envs {self.num_envs}")

    @property
    def steps_per_update(self) -> int:
        return self.num_envs * self.unroll_steps


@chex.dataclass(frozen=True)
class PPOState:
    """What the next update needs of the learner."""

    params: losses.PPONetworkParams
    normalizer: running_statistics.RunningStatisticsState
    opt_state: optax.OptState


class PPO:
    """PPO with a Gaussian policy that is not squashed (Brax's `distribution_type="normal"`)."""

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
        self._optimizer = optax.inject_hyperparams(
            lambda learning_rate: optax.chain(
                optax.clip_by_global_norm(config.max_grad_norm), optax.adam(learning_rate)
            )
        )(learning_rate=config.learning_rate)

    def init(self, key: jax.Array) -> PPOState:
        """A fresh learner."""
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
        # Some of Brax's leaves are weakly typed or Python's own; the second update would then be traced anew.
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype), state)

    def act(self, state: PPOState, *, deterministic: bool = True) -> Callable:
        """The policy as Brax has it: `(observation [..., obs], key) -> (action [..., act], extras)`."""
        make = networks.make_inference_fn(self._networks)
        return make((state.normalizer, state.params.policy), deterministic=deterministic)

    @staticmethod
    def layers(state: PPOState) -> tuple[tuple[jax.Array, jax.Array], list[tuple[jax.Array, jax.Array]]]:
        """The deterministic policy as numbers, for who has no JAX.

        Returns:
          Mean and standard deviation [obs] that observations are normalised by; kernels [in, out] and biases [out] of
          the layers, with ELU behind all but the last.
        """
        params = state.params.policy["params"]
        hidden = params["MLP_0"]
        every = [*(hidden[f"hidden_{index}"] for index in range(len(hidden))), params["Dense_0"]]
        return (state.normalizer.mean, state.normalizer.std), [(layer["kernel"], layer["bias"]) for layer in every]

    def update(self, key: jax.Array, state: PPOState, env: Env, env_state: State) -> tuple[PPOState, State, dict]:
        """Collects one rollout and learns from it.

        Args:
          key: random key.
          state: the learner.
          env: a batch of environments that reset themselves, with `truncation` in `info`.
          env_state: where they are, [num_envs].

        Returns:
          Learner, environments, and metrics as scalars: the environment's own (means over the rollout), `reward`,
          `done` (share of steps that ended an episode), `kl`, `learning_rate`, `loss`, `std`.
        """
        key_unroll, key_learn = jax.random.split(key)

        def act(carry, key):
            following, transition = generate_unroll(
                env, carry, self.act(state, deterministic=False), key, 1, extra_fields=("truncation",)
            )
            return following, (jax.tree.map(lambda x: x[0], transition), following.metrics)

        env_state, (data, env_metrics) = jax.lax.scan(
            act, env_state, jax.random.split(key_unroll, self.config.unroll_steps)
        )
        normalizer = running_statistics.update(state.normalizer, data.observation)
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)
        (params, opt_state), learned = jax.lax.scan(
            lambda carry, key: self._pass(key, carry, normalizer, data),
            (state.params, state.opt_state),
            jax.random.split(key_learn, self.config.epochs),
        )
        metrics = {"reward": data.reward, "done": 1.0 - data.discount, **env_metrics, **learned}
        state = PPOState(params=params, normalizer=normalizer, opt_state=opt_state)
        return state, env_state, jax.tree.map(jnp.mean, metrics)

    def _pass(self, key, carry, normalizer, data):
        key_shuffle, key_loss = jax.random.split(key)
        order = jax.random.permutation(key_shuffle, self.config.num_envs)
        batches = jax.tree.map(lambda x: x[order].reshape(self.config.minibatches, -1, *x.shape[1:]), data)
        keys = jax.random.split(key_loss, self.config.minibatches)
        return jax.lax.scan(lambda carry, item: self._descend(*item, carry, normalizer), carry, (keys, batches))

    def _descend(self, key, batch, carry, normalizer):
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
        metrics = {
            "loss": loss,
            "kl": aux["kl_mean"],
            "std": aux["policy_dist_mean_std"],
            "learning_rate": learning_rate,
        }
        return (optax.apply_updates(params, updates), opt_state), metrics

    def _steer(self, learning_rate: jax.Array, kl: jax.Array) -> jax.Array:
        low, high = _LEARNING_RATE_RANGE
        slower = jnp.maximum(learning_rate / 1.5, low)
        faster = jnp.minimum(learning_rate * 1.5, high)
        target = self.config.target_kl
        return jnp.where(kl > 2 * target, slower, jnp.where((kl < target / 2) & (kl > 0), faster, learning_rate))
