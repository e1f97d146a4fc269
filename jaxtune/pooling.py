"""What several measured sets of a robot say together.

Physics does not depend on which policy walked. So an estimate from one set is joined with what all sets before it said,

    joined = past + C (C + R)^-1 (alone - past),

the mean of a product of two Gaussians: C holds the mean products of the errors of `past`, R those of `alone`. All these
are matrices over coordinates, since parameters trade against each other.

What a set says alone is not its estimate e. That is drawn towards the middle of the box which the simulated sets came
from, since they teach no more; and the middle of the box is what earlier sets said, which must not count twice. With S
the mean products of the errors of e on simulated sets, and B the variances of the box,

    alone = middle + (1 - S B^-1)^-1 (e - middle),    R = S (1 - B^-1 S)^-1.

The errors of joined estimates are those of simulated sets. Each is joined with an estimate that errs as `past` does:
its true coordinates and a draw of C. Of a coordinate that no set has identified the box is all that is known before.

A set may contradict the earlier ones: the robot was repaired, or an early set misled. Then they count no longer. The
conformal p-value of (alone - past)' (C + R)^-1 (alone - past) tells, at 1 % where there are 99 simulated sets.
"""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtune import conformal, devices
from jaxtune import dist as dists
from jaxtune.types import ParamDist

_LEAST = 1e-3  # standard deviations of the box; least error of an estimate
_CONTRADICTS = 0.01  # largest p-value; fewer than 99 sets give none so small, and the smallest one counts
_MOST = 0.95  # share of the box's variance that an estimate's errors have at most: it says little then, and not nothing


@chex.dataclass(frozen=True)
class Past:
    """What the sets of earlier tunings said."""

    estimate: jax.Array  # [coords] in coordinates
    # [coords, coords] mean products of its errors, in coordinates; nan in row and column of one that no set identified
    errors: jax.Array


def nothing(dist: ParamDist) -> Past:
    """Makes what is known before the first set."""
    size = len(dist.centre)
    return Past(estimate=jnp.full(size, jnp.nan, jnp.float32), errors=jnp.full((size, size), jnp.nan, jnp.float32))


def alone(
    estimates: Float[Array, "sets+1 coords"], truth: Float[Array, "sets coords"], valid: Bool[Array, " sets"]
) -> tuple[Float[Array, "sets+1 coords"], Bool[Array, ""], Float[Array, ""]]:
    """Joins estimates with nothing; stands where `joined` does."""
    return estimates, jnp.asarray(False), jnp.asarray(jnp.nan)


@devices.precisely
def joined(
    key: jax.Array,
    past: Past,
    dist: ParamDist,
    estimates: Float[Array, "sets+1 coords"],
    truth: Float[Array, "sets coords"],
    valid: Bool[Array, " sets"],
) -> tuple[Float[Array, "sets+1 coords"], Bool[Array, ""], Float[Array, ""]]:
    """Joins the estimates of all sets with what earlier sets said.

    Args:
      key: random key, for what earlier sets would have said of simulated robots.
      past: what they said of the measured one.
      dist: the distribution that simulated sets were drawn from.
      estimates: of simulated sets and, last, of the measured one, in radii.
      truth: true coordinates of the simulated sets, in radii.
      valid: simulated sets whose estimates count.

    Returns:
      The estimates, in radii; whether they are joined, or as they came, since nothing was known or the measured set
      contradicts it; and the p-value of that contradiction, nan where nothing was known.
    """
    low, high = dists.normalised_box(dist)
    middle, unit = (low + high) / 2, (high - low) / jnp.sqrt(12.0)
    scale = dists.ravel(dist.radius) * unit
    # In standard deviations of the box, so that B is 1.
    own, true = (estimates - middle) / unit, (truth - middle) / unit
    off = jnp.where(valid[:, None], own[:-1] - true, 0.0)
    values, axes = jnp.linalg.eigh(off.T @ off / jnp.maximum(valid.sum(), 1))
    share = jnp.clip(values, _LEAST**2, _MOST)
    said = (own @ axes / (1.0 - share)) @ axes.T
    noise = (axes * (share / (1.0 - share))) @ axes.T
    # Of the others all that is known is the box: it has errors of 1 around its middle.
    told = jnp.isfinite(jnp.diag(past.errors))
    errors = jnp.where(jnp.outer(told, told), past.errors / jnp.outer(scale, scale), jnp.eye(len(unit)))
    errors = errors + _LEAST**2 * jnp.eye(len(unit))
    drawn = true + jax.random.normal(key, true.shape) @ jnp.linalg.cholesky(errors).T
    earlier = (past.estimate - dists.ravel(dist.centre)) / scale - middle / unit
    before = jnp.where(told, jnp.concatenate([drawn, earlier[None]]), 0.0)
    weighed = jnp.linalg.solve(errors + noise, (said - before).T).T
    contradiction = ((said - before) * weighed).sum(axis=-1)
    p_value = conformal.p_value(jnp.where(jnp.append(valid, told.any()), contradiction, jnp.nan))
    agrees = told.any() & (p_value > jnp.maximum(_CONTRADICTS, 1.0 / (1 + valid.sum())) + 1e-5)
    return jnp.where(agrees, middle + unit * (before + weighed @ errors), estimates), agrees, p_value
