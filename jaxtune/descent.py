"""Gradient descent on a random loss, as one scan: how both models of a tuning learn."""

from collections.abc import Callable
from typing import Any

import jax
import optax


def descend(
    key: jax.Array,
    loss: Callable[[Any, jax.Array], jax.Array],
    variables: Any,
    optimizer: optax.GradientTransformation,
    steps: int,
) -> tuple[Any, jax.Array]:
    """Takes gradient steps on a loss that draws its own batch.

    Args:
      key: random key.
      loss: `(variables, key) -> scalar`.
      variables: where to begin, a pytree.
      optimizer: of optax.
      steps: number of steps; static, as it is the length of the scan.

    Returns:
      The variables, and the loss as the mean over the last tenth of the steps.
    """

    # As one vector: a third of the verification model's compilation went into updates of many small arrays.
    optimizer = optax.flatten(optimizer)

    def step(carry, key):
        variables, opt_state = carry
        value, grads = jax.value_and_grad(loss)(variables, key)
        updates, opt_state = optimizer.update(grads, opt_state, variables)
        return (optax.apply_updates(variables, updates), opt_state), value

    start = (variables, optimizer.init(variables))
    (variables, _), losses = jax.lax.scan(step, start, jax.random.split(key, steps))
    return variables, losses[-max(steps // 10, 1) :].mean()
