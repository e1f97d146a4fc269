"""What held-out sets say of one more: conformal quantiles and p-values (Vovk, Gammerman and Shafer, 2005)."""

import jax
import jax.numpy as jnp
from jax.scipy.stats import chi2

ROUNDING = 1e-5
"""Less than the distance of two p-values of as many sets as anybody simulates."""

IDENTIFIABLE = 0.9
"""Largest error of a coordinate that counts as identified, as a share of the error that ignores the data. It is below 1
because both are of a few dozen sets, and differ by chance."""

EACH = 0.1
"""Share of all misses that the box which a reading narrows to may have: what it excludes is excluded for good."""


def p_value(scores: jax.Array) -> jax.Array:
    """The conformal p-value of the last score among all [sets + 1]; nan where it is. Other nan are left out."""
    known = (~jnp.isnan(scores[:-1])).sum()
    p_value = (1 + jnp.sum(scores[:-1] >= scores[-1])) / (1 + known)
    return jnp.where(jnp.isnan(scores[-1]), jnp.nan, p_value)


def together(p_values: jax.Array) -> jax.Array:
    """One p-value of several independent ones [n] (Fisher, *Statistical Methods for Research Workers*, 1932).

        P(chi^2 with 2 n degrees of freedom >= -2 sum log p)

    What is missing in a model makes every set misfit a little. No single one may be rejected then, but all are:
    `together` of the `UpdateInfo.p_misfit` of several tunings. Each is compared with held-out sets of its own, but all
    are of one robot. So they are independent as far as that misfits like any other of its distribution, whose middle it
    is near after an update. Values that are nan are left out; it is nan where no other is there.
    """
    p_values = jnp.asarray(p_values, float)
    known = ~jnp.isnan(p_values)
    statistic = -2.0 * jnp.where(known, jnp.log(p_values), 0.0).sum()
    return jnp.where(known.any(), chi2.sf(statistic, 2.0 * jnp.maximum(known.sum(), 1)), jnp.nan)


def rejects(p_value: jax.Array, level: jax.Array | float) -> jax.Array:
    """Whether a p-value is at most `1 - level`. Both are rounded, which must not cost a rank; nan rejects nothing."""
    return p_value <= 1.0 - level + ROUNDING


def quantile(values: jax.Array, level: jax.Array | float) -> jax.Array:
    """Computes a bound that one more draw like `values` [n, ...] exceeds with probability at most `1 - level`.

    It is the ceil((n + 1) level)-th smallest value. The guarantee needs n of at least `level / (1 - level)`; with
    fewer, the largest value is returned. Values that are nan are left out, of `values` and of n: they are draws of
    another kind than the one more.
    """
    count = (~jnp.isnan(values)).sum(axis=0)
    # A product that is a whole number must not cost a rank by its rounding.
    rank = jnp.ceil((count + 1) * (level - ROUNDING)).astype(int) - 1
    place = jnp.maximum(jnp.minimum(rank, count - 1), 0)
    return jnp.take_along_axis(jnp.sort(values, axis=0), place[None], axis=0)[0]
