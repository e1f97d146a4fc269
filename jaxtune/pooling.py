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

Each set's a is that of all others, so S is of sets that a does not know. S and C are shrunk towards their diagonals by
the number of coordinates over that of sets, or some combination of coordinates would seem exact by chance.

The errors of joined estimates are those of simulated sets. Each is joined with what earlier sets would have said of its
robot, if they err as `past` does: past + (1 - C) (truth - past) + a draw of C (1 - C). Where earlier sets said less
than the box does, that is its middle with its errors, and where they said all it is the truth.

A set may contradict the earlier ones: the robot was repaired, or an early set misled. Then they count no longer. The
conformal p-value of (unshrunk - past)' (C + R)^-1 (unshrunk - past) tells, at 1 % or, of fewer than 99 simulated sets,
by the smallest p-value, if it is also beyond the 0.99-quantile of chi-square.
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


def learnt(
    past: Past, pooled: jax.Array, dist: ParamDist, estimate: jax.Array, errors: jax.Array, sets: jax.Array
) -> Past:
    """Makes what is known after a set.

    Args:
      past: what was known before.
      pooled: whether that counts in the estimate.
      dist: whose radii are meant.
      estimate: [coords] in radii.
      errors: [coords, coords] mean products of its errors, in radii.
      sets: number of simulated sets that these are of.
    """
    centre, radius = dists.ravel(dist.centre), dists.ravel(dist.radius)
    errors = _steady(errors, sets)
    return Past(
        estimate=(centre + radius * estimate).astype(jnp.float32),
        errors=(errors * jnp.outer(radius, radius)).astype(jnp.float32),
        tunings=jnp.where(pooled, past.tunings + 1, 1).astype(jnp.int32),
    )


def joined_error(
    past: Past, pooled: jax.Array, dist: ParamDist, error: Float[Array, " coords"]
) -> Float[Array, " coords"]:
    """The size of errors of an estimate that errs by `error` and is joined with `past`, or not; both in radii."""
    box = dists.ignorance(dist) ** 2
    variance = jnp.maximum(jnp.diag(past.errors) / (_FADES * dists.ravel(dist.radius) ** 2), _LEAST * box)
    # What is known of the box is in the estimate already.
    more = jnp.maximum(1.0 / variance - 1.0 / box, 0.0)
    return jnp.where(pooled, 1.0 / jnp.sqrt(1.0 / error**2 + more), error)


def half_widths(errors: Float[Array, "coords coords"], sets: Array | int) -> Float[Array, " coords"]:
    """Half widths of a box whose draws vary along every direction at least as much as an estimate errs.

    Where parameters trade against each other, errors go along a direction on which the middles of boxes crowd: the mean
    of n draws varies by 1 / n of what each does. Sets of robots from such a box would teach that this direction is
    known, though nothing told it. With r the correlations of the errors E, and u^2 / 3 the variance of draws within u,

        u_i^2 / 3 = f E_ii sum_j |r_ij|,    f = 1 + 2 sqrt(2 / sets),

    with which diag(u^2 / 3) - f E is diagonally dominant, so no direction of it is below zero. Boxes never grow, so
    errors that are small by chance would narrow them reading after reading; f allows for two standard errors.

    Args:
      errors: mean products of errors.
      sets: number of simulated sets that they are of.
    """
    size = jnp.sqrt(jnp.maximum(jnp.diag(errors), 0.0))
    chance = 1.0 + 2.0 * jnp.sqrt(2.0 / jnp.maximum(sets, 1))
    return jnp.sqrt(3.0 * chance * size * (jnp.abs(errors) / jnp.maximum(size, 1e-9)).sum(axis=1))


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
    middle, unit = (low + high) / 2, dists.ignorance(dist)
    scale = dists.ravel(dist.radius) * unit
    # In standard deviations of the box from its middle, so that its variances are 1.
    read, true = (estimates - middle) / unit, jnp.where(valid[:, None], (truth - middle) / unit, 0.0)
    factors = _factors(jnp.where(valid[:, None], read[:-1], 0.0), true)
    unshrunk, noise = _unshrunk(factors * read, true, valid)

    before = (past.estimate - dists.ravel(dist.centre)) / scale - middle / unit
    values, axes = jnp.linalg.eigh(past.errors / (_FADES * jnp.outer(scale, scale)))
    # Where earlier sets know less than the box, it is the box that is known.
    before = (before @ axes / jnp.maximum(values, 1.0)) @ axes.T
    values = jnp.clip(values, _LEAST, 1.0)
    errors = (axes * values) @ axes.T
    drawn = jax.random.normal(key, true.shape) * jnp.sqrt(values * (1.0 - values))
    drawn = before + (((true - before) @ axes) * (1.0 - values) + drawn) @ axes.T
    before = jnp.concatenate([drawn, before[None]])

    weighed = jnp.linalg.solve(errors + noise, (unshrunk - before).T).T
    contradiction = ((unshrunk - before) * weighed).sum(axis=-1)
    known = (past.tunings > 0) & valid.any()
    p_value = conformal.p_value(jnp.where(jnp.append(valid, known), contradiction, jnp.nan))
    usual = p_value > jnp.maximum(_CONTRADICTS, 1.0 / (1 + valid.sum())) + conformal.ROUNDING
    # The smallest p-value of few sets is not small: then it must be far off for a Gaussian, too.
    pooled = known & (usual | (contradiction[-1] <= _far(len(unit))))
    return jnp.where(pooled, middle + unit * (before + weighed @ errors), estimates), pooled, p_value


def _far(size: int) -> float:
    """The 0.99-quantile of chi-square with so many degrees of freedom (Wilson and Hilferty, 1931)."""
    return size * (1.0 - 2.0 / (9.0 * size) + 2.326 * (2.0 / (9.0 * size)) ** 0.5) ** 3


def _steady(errors: Float[Array, "coords coords"], sets: jax.Array) -> Float[Array, "coords coords"]:
    """Shrinks mean products over so many sets towards their diagonal."""
    share = jnp.minimum(len(errors) / jnp.maximum(sets, 1), 1.0)
    return (1.0 - share) * errors + share * jnp.diag(jnp.diag(errors))


def _factors(read: Float[Array, "sets coords"], true: Float[Array, "sets coords"]) -> Float[Array, "sets+1 coords"]:
    """The factor a of every set, of all sets but itself, and of one more."""
    without = lambda each: each.sum(axis=0) - jnp.concatenate([each, jnp.zeros_like(each[:1])])  # noqa: E731
    products, squares = without(read * true), without(read**2)
    return jnp.where(squares > _LEAST, jnp.clip(products / jnp.maximum(squares, _LEAST), 0.0, 2.0), 1.0)


def _unshrunk(
    estimates: Float[Array, "sets+1 coords"], true: Float[Array, "sets coords"], valid: Bool[Array, " sets"]
) -> tuple[Float[Array, "sets+1 coords"], Float[Array, "coords coords"]]:
    """What sets say without the box, and the mean products of the errors of that."""
    off = jnp.where(valid[:, None], estimates[:-1] - true, 0.0)
    values, axes = jnp.linalg.eigh(_steady(off.T @ off / jnp.maximum(valid.sum(), 1), valid.sum()))
    share = jnp.clip(values, _LEAST, _MOST)
    return (estimates @ axes / (1.0 - share)) @ axes.T, (axes * (share / (1.0 - share))) @ axes.T
