"""The response surface: which moments would a robot of given coordinates have shown?

The regression (`jaxtune.regression`) asks for the coordinates of measured episodes. This is the way back. Moments of an
episode are a polynomial of its coordinates, fitted to D_q by least squares (Box and Wilson 1951). What a measured set
shows beside the surface at its own estimate is its misfit: large where no coordinates explain the set. Let r be that
residual, and R the residuals of the episodes of D_q, each predicted without itself (one a row, n rows). Then

    misfit = r (R' R / n + lambda I)^-1 r',

the squared length of r in units of what single episodes scatter (Hotelling 1931), with lambda a tenth of the mean of
the n largest eigenvalues, since there are more moments than episodes.
"""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtune import devices
from jaxtune.regression import Regression

_EPISODES_EACH = 4  # for every coefficient; with fewer, the polynomial has a lower degree
_RIDGE = 1e-5  # of the number of episodes; it only keeps the solution finite
_SHRINKAGE = 0.1  # lambda, in mean eigenvalues
_LEAST_FREE = 0.1  # of an episode's residual, where the polynomial follows that episode closely
_LEAST = 1e-6  # lambda where all episodes are as predicted


@chex.dataclass(frozen=True)
class Surface:
    """A fitted response surface; coordinates are in radii, moments standardised as the regression does."""

    coefficients: jax.Array  # [terms, moments]
    residual: jax.Array  # R, [episodes, moments]
    inverse: jax.Array  # (n lambda I + R R')^-1, [episodes, episodes]
    penalty: jax.Array  # lambda
    count: jax.Array  # n


@devices.precisely
def train(model: Regression) -> Surface:
    """Fits a surface to the episodes that a regression was fitted to."""
    known = model.known[:, None]
    count = jnp.maximum(known.sum(), 1.0)
    terms = known * _terms(model.truth, len(model.truth))
    gram = jnp.linalg.inv(terms.T @ terms + _RIDGE * count * jnp.eye(terms.shape[1]))
    coefficients = gram @ (terms.T @ model.read)
    own = jnp.einsum("ei,ij,ej->e", terms, gram, terms)[:, None]
    residual = known * (model.read - terms @ coefficients) / jnp.maximum(1.0 - own, _LEAST_FREE)
    inner = residual @ residual.T
    penalty = jnp.maximum(_SHRINKAGE * jnp.trace(inner) / count**2, _LEAST)
    inverse = jnp.linalg.inv(inner + count * penalty * jnp.eye(len(inner)))
    return Surface(coefficients=coefficients, residual=residual, inverse=inverse, penalty=penalty, count=count)


@devices.precisely
def misfit(surface: Surface, moments: Float[Array, " moments"], coords: Float[Array, " coords"]) -> Float[Array, ""]:
    """Computes how far a set's moments lie from what robots of these coordinates show.

    Args:
      surface: fitted.
      moments: of the set, as `regression.answers` returns them.
      coords: in radii, such as the set's estimate.
    """
    rest = unexplained(surface, moments, coords)
    # By the matrix inversion lemma, since R has fewer rows than columns, and as the minimum over a of
    # |r - a R|^2 / lambda + n |a|^2: a sum of squares, in which rounding of the inverse hardly shows.
    a = surface.inverse @ (surface.residual @ rest)
    rest = rest - a @ surface.residual
    return rest @ rest / surface.penalty + surface.count * (a @ a)


@devices.precisely
def unexplained(
    surface: Surface, moments: Float[Array, " moments"], coords: Float[Array, " coords"]
) -> Float[Array, " moments"]:
    """Subtracts from a set's moments what robots of these coordinates show; arguments are those of `misfit`."""
    return moments - (_terms(coords[None], len(surface.residual)) @ surface.coefficients)[0]


def _terms(coords: Float[Array, "n coords"], episodes: int) -> Float[Array, "n terms"]:
    """The terms of the polynomial: of degree two, one or zero, as so many episodes can determine."""
    one = jnp.ones((len(coords), 1))
    size = coords.shape[1]
    first, second = jnp.triu_indices(size)
    if _EPISODES_EACH * (1 + size + len(first)) <= episodes:
        return jnp.concatenate([one, coords, coords[:, first] * coords[:, second]], axis=1)
    if _EPISODES_EACH * (1 + size) <= episodes:
        return jnp.concatenate([one, coords], axis=1)
    return one
