"""What several measured sets of a robot say together.

Physics does not depend on which policy walked. So an estimate from one set is joined with what all sets before it said,
as the mean of a product of two Gaussians,

    joined = past + C (C + R)^-1 (unshrunk - past),

where C holds the mean products of the errors of `past`, and R those of `unshrunk`. All these are matrices over
coordinates, since parameters trade against each other.

`unshrunk` is what a set says by itself. Its estimate is drawn towards the middle of the box that simulated sets came
from, since they teach no more; and that middle is what earlier sets said, which must not count twice. Held-out sets
undo it. In standard deviations of the box from its middle, with a factor a for every coordinate,

    a = <truth estimate> / <estimate^2>,    S = <(truth - a estimate) (truth - a estimate)'>,
    unshrunk = (1 - S)^-1 a estimate,       R = S (1 - S)^-1.

Each set's a is that of all others, so S is of sets that a does not know. S is shrunk towards its diagonal by the number
of coordinates over that of sets, or some combination of coordinates would seem exact by chance.

The errors of joined estimates are those of simulated sets. Each is joined with what earlier sets would have said of its
robot, if they err as `past` does: past + (1 - C) (truth - past) + a draw of C (1 - C). Where earlier sets said nothing
that is the middle of the box, and where they said all it is the truth.

A set may contradict the earlier ones: the robot was repaired, or an early set misled. Then they count no longer. The
conformal p-value of (unshrunk - past)' (C + R)^-1 (unshrunk - past) tells, at 1 % where there are 99 simulated sets.
"""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtune import conformal, devices
from jaxtune import dist as dists
from jaxtune.types import ParamDist

_LEAST = 1e-6  # of the box's variance: least one of an estimate's errors
_MOST = 0.95  # of it: largest one, which says little and not nothing
_FADES = 0.9  # factor on what is known, from tuning to tuning: robots wear, and all sets share errors of the simulator
_CONTRADICTS = 0.01  # largest p-value; fewer than 99 sets give none so small, and the smallest one counts


@chex.dataclass(frozen=True)
class Past:
    """What the sets of earlier tunings said."""

    estimate: jax.Array  # [coords] in coordinates
    errors: jax.Array  # [coords, coords] mean products of its errors, in coordinates
    tunings: jax.Array  # how many; with none of them the estimate is the middle of the first box


def nothing(dist: ParamDist) -> Past:
    """Makes what is known before the first set: that the robot lies in the box."""
    low, high = (dists.ravel(end) for end in dists.box(dist))
    return Past(
        estimate=((low + high) / 2).astype(jnp.float32),
        errors=jnp.diag((high - low) ** 2 / 12.0).astype(jnp.float32),
        tunings=jnp.zeros((), jnp.int32),
    )


def learnt(past: Past, pooled: jax.Array, dist: ParamDist, estimate: jax.Array, errors: jax.Array) -> Past:
    """Makes what is known after a set.

    Args:
      past: what was known before.
      pooled: whether that counts in the estimate.
      dist: whose radii are meant.
      estimate: [coords] in radii.
      errors: [coords, coords] mean products of its errors, in radii.
    """
    centre, radius = dists.ravel(dist.centre), dists.ravel(dist.radius)
    return Past(
        estimate=(centre + radius * estimate).astype(jnp.float32),
        errors=(errors * jnp.outer(radius, radius)).astype(jnp.float32),
        tunings=jnp.where(pooled, past.tunings + 1, 1).astype(jnp.int32),
    )


def joined_error(
    past: Past, pooled: jax.Array, dist: ParamDist, error: Float[Array, " coords"]
) -> Float[Array, " coords"]:
    """The size of errors of an estimate that errs by `error` and is joined with `past`, or not; both in radii."""
    low, high = dists.normalised_box(dist)
    variance = jnp.diag(past.errors) / (_FADES * dists.ravel(dist.radius) ** 2)
    # What is known of the box is in the estimate already.
    more = jnp.maximum(1.0 / variance - 12.0 / (high - low) ** 2, 0.0)
    return jnp.where(pooled, 1.0 / jnp.sqrt(1.0 / error**2 + more), error)


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
    # In standard deviations of the box from its middle, so that its variances are 1.
    read, true = (estimates - middle) / unit, jnp.where(valid[:, None], (truth - middle) / unit, 0.0)
    factors = _factors(jnp.where(valid[:, None], read[:-1], 0.0), true)
    unshrunk, noise = _unshrunk(factors * read, true, valid)

    before = (past.estimate - dists.ravel(dist.centre)) / scale - middle / unit
    errors = past.errors / (_FADES * jnp.outer(scale, scale))
    errors = errors + _LEAST * jnp.maximum(jnp.diag(errors).max(), 1.0) * jnp.eye(len(unit))
    values, axes = jnp.linalg.eigh(errors)
    knows = jnp.clip(1.0 - values, 0.0, 1.0)
    drawn = jax.random.normal(key, true.shape) * jnp.sqrt(knows * jnp.maximum(values, 0.0))
    drawn = before + (((true - before) @ axes) * knows + drawn) @ axes.T
    before = jnp.concatenate([drawn, before[None]])

    weighed = jnp.linalg.solve(errors + noise, (unshrunk - before).T).T
    contradiction = ((unshrunk - before) * weighed).sum(axis=-1)
    known = (past.tunings > 0) & valid.any()
    p_value = conformal.p_value(jnp.where(jnp.append(valid, known), contradiction, jnp.nan))
    # A p-value that is nan contradicts nothing, but says that there is nothing to join.
    pooled = p_value > jnp.maximum(_CONTRADICTS, 1.0 / (1 + valid.sum())) + conformal.ROUNDING
    return jnp.where(pooled, middle + unit * (before + weighed @ errors), estimates), pooled, p_value


def _factors(read: Float[Array, "sets coords"], true: Float[Array, "sets coords"]) -> Float[Array, "sets+1 coords"]:
    """The factor a of every set, of all sets but itself, and of one more."""
    without = lambda each: each.sum(axis=0) - jnp.concatenate([each, jnp.zeros_like(each[:1])])  # noqa: E731
    products, squares = without(read * true), without(read**2)
    return jnp.where(squares > _LEAST, jnp.clip(products / jnp.maximum(squares, _LEAST), 0.0, 2.0), 1.0)


def _unshrunk(
    estimates: Float[Array, "sets+1 coords"], true: Float[Array, "sets coords"], valid: Bool[Array, " sets"]
) -> tuple[Float[Array, "sets+1 coords"], Float[Array, "coords coords"]]:
    """What sets say without the box, and the mean products of the errors of that."""
    count, size = jnp.maximum(valid.sum(), 1), true.shape[1]
    off = jnp.where(valid[:, None], estimates[:-1] - true, 0.0)
    errors = off.T @ off / count
    alone = jnp.minimum(size / count, 1.0)
    values, axes = jnp.linalg.eigh((1.0 - alone) * errors + alone * jnp.diag(jnp.diag(errors)))
    share = jnp.clip(values, _LEAST, _MOST)
    return (estimates @ axes / (1.0 - share)) @ axes.T, (axes * (share / (1.0 - share))) @ axes.T
