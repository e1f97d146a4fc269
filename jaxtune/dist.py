"""Operations on the parameter distribution."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from jaxtune.types import Coords, ParamDist


def make(centre: Coords, radius: float, lower: Coords, upper: Coords) -> ParamDist:
    """A distribution with one radius for all of its parameters.

    Args:
      centre, lower, upper: scalars by name, in search coordinates.
      radius: half width, in search coordinates.

    Raises:
      ValueError: names differ, the radius is not positive, or a centre lies outside its bounds.
    """
    if not radius > 0:
        raise ValueError(f"radius: got {radius}, expected a positive number")
    for field, named in {"lower": lower, "upper": upper}.items():
        if set(named) != set(centre):
            raise ValueError(f"{field}: got {sorted(named)}, expected {sorted(centre)}")
    for name, value in centre.items():
        if not lower[name] <= value <= upper[name]:
            raise ValueError(f"centre['{name}']: got {value}, allowed {lower[name]} to {upper[name]}")

    def strong(named) -> dict:
        return {name: jnp.asarray(value, jnp.float32) for name, value in named.items()}

    return ParamDist(
        centre=strong(centre), radius=strong(dict.fromkeys(centre, radius)), lower=strong(lower), upper=strong(upper)
    )


def names(dist: ParamDist) -> tuple[str, ...]:
    """Names of the parameters, in the order of `ravel`."""
    return tuple(sorted(dist.centre))


def ravel(coords: Coords) -> Shaped[Array, "... coords"]:
    """Coords values to a vector, at a network's door; sorted by name."""
    return jnp.stack([coords[name] for name in sorted(coords)], axis=-1)


def unravel(order: Sequence[str], vector: Float[Array, "... coords"]) -> dict:
    """The inverse of `ravel`."""
    return {name: vector[..., column] for column, name in enumerate(order)}


def box(dist: ParamDist) -> tuple[dict, dict]:
    """Lower and upper end of every parameter's support."""
    low = jax.tree.map(lambda c, r, bound: jnp.maximum(c - r, bound), dist.centre, dist.radius, dist.lower)
    high = jax.tree.map(lambda c, r, bound: jnp.minimum(c + r, bound), dist.centre, dist.radius, dist.upper)
    return low, high


def sample(key: jax.Array, dist: ParamDist, count: int) -> dict:
    """Independent draws, [count] by name."""
    low, high = (ravel(side) for side in box(dist))
    draws = jax.random.uniform(key, (count, len(low)), minval=low, maxval=high)
    return unravel(names(dist), draws)


def normalise(dist: ParamDist, coords: Coords) -> Float[Array, "... coords"]:
    """Coords values to a vector in units of the radius around the centre."""
    return (ravel(coords) - ravel(dist.centre)) / ravel(dist.radius)


def normalised_box(dist: ParamDist) -> tuple[Float[Array, " coords"], Float[Array, " coords"]]:
    """The support in units of the radius around the centre: -1 to 1, less where the bounds cut it."""
    low, high = box(dist)
    return normalise(dist, low), normalise(dist, high)


def at_bounds(dist: ParamDist) -> jax.Array:
    """True where every parameter's support fills its bounds, so that widening changes nothing."""
    low, high = box(dist)
    # A radius as wide as the bounds fills them from any centre, though the sum may round to less.
    full = jax.tree.map(
        lambda a, lower, b, upper, radius: ((a <= lower) & (b >= upper)) | (radius >= upper - lower),
        low,
        dist.lower,
        high,
        dist.upper,
        dist.radius,
    )
    return ravel(full).all()


def widen(dist: ParamDist, factor: jax.Array) -> ParamDist:
    """Multiplies every radius, up to the width of the bounds (Algorithm 1, `r <- r c`)."""
    radius = jax.tree.map(
        lambda r, lower, upper: jnp.minimum(r * factor, upper - lower), dist.radius, dist.lower, dist.upper
    )
    return dist.replace(radius=radius)


def move(dist: ParamDist, step: Float[Array, " coords"]) -> ParamDist:
    """Shifts the centre by a step in units of the radius, within the bounds."""
    centre = ravel(dist.centre) + ravel(dist.radius) * step
    centre = jnp.clip(centre, ravel(dist.lower), ravel(dist.upper))
    return dist.replace(centre=unravel(names(dist), centre))
