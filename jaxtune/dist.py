"""Makes, samples, moves and widens the parameter distribution (`ParamDist`).

All functions are pure and, but for `make`, can be traced and vmapped over stacked distributions. Named values become
vectors, sorted by name (`ravel`), only where a network reads or writes them. Two units occur: *coordinates* (log space
for multipliers) and *radii*, which are distances from the centre divided by the radius. Networks and steps use radii,
so that sizes mean the same for every parameter and after every widening.
"""

import math
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from jaxtune.types import Coords, ParamDist

_NARROWED, _LEAST = 0.9, 0.5  # of a radius, and of the least radius; less than that does not count


def make(centre: Coords, radius: float | Coords, lower: Coords, upper: Coords) -> ParamDist:
    """Makes the distribution that a search starts with, and checks it.

    Use it once, on the host, to describe where a search begins: the nominal model as `centre`, a `radius` that is small
    (the paper starts at 0.2) and bounds that no physical robot exceeds.

    Args:
      centre: scalars by name, in coordinates: 0.0 for a multiplier of one.
      radius: half width of the distribution, in coordinates, the same for every parameter or by name. A radius of 0.2
        spans multipliers of 0.82 to 1.22. Where it exceeds the width of a parameter's bounds, that width is its radius.
      lower: smallest coordinate by name.
      upper: largest coordinate by name.

    Raises:
      ValueError: there are no names or they differ, a radius is not a positive number, bounds leave no room, or a
        centre lies outside them.
    """
    if not centre:
        raise ValueError("centre: got no coordinates, expected one or more")
    radii = radius if isinstance(radius, Mapping) else dict.fromkeys(centre, radius)
    for name, value in radii.items():
        if isinstance(value, str) or not 0 < value < math.inf:
            field = f"radius['{name}']" if isinstance(radius, Mapping) else "radius"
            raise ValueError(f"{field}: got {value!r}, expected a positive number")
    for field, named in {"radius": radii, "lower": lower, "upper": upper}.items():
        if set(named) != set(centre):
            raise ValueError(f"{field}: got {sorted(named)}, expected {sorted(centre)}")
    for name, value in centre.items():
        if not lower[name] < upper[name]:
            raise ValueError(
                f"lower['{name}']: got {lower[name]}, expected less than {upper[name]}; leave out what is not searched"
            )
        if not lower[name] <= value <= upper[name]:
            raise ValueError(f"centre['{name}']: got {value}, expected {lower[name]} to {upper[name]}")

    # A weakly typed leaf would become strong in the first step, and the second would be compiled anew.
    def strong(named) -> dict:
        return {name: jnp.asarray(value, jnp.float32) for name, value in named.items()}

    # As `widen` does: a radius as wide as the bounds fills them from any centre.
    radii = {name: min(radii[name], upper[name] - lower[name]) for name in centre}
    return ParamDist(centre=strong(centre), radius=strong(radii), lower=strong(lower), upper=strong(upper))


def names(dist: ParamDist) -> tuple[str, ...]:
    """Lists the names of the coordinates in the order of `ravel`, which is alphabetical.

    Use it to label the columns of an `UpdateInfo` or of a search-parameter model's answers.
    """
    return tuple(sorted(dist.centre))


def ravel(coords: Coords) -> Shaped[Array, "... coords"]:
    """Stacks named values into a vector, sorted by name, along a new last axis.

    It works on any mapping from names to arrays of one shape: a centre ([] each) or the draws of many episodes
    ([episodes] each).
    """
    return jnp.stack([coords[name] for name in sorted(coords)], axis=-1)


def unravel(order: Sequence[str], vector: Float[Array, "... coords"]) -> dict:
    """Splits the last axis of a vector into named values; the inverse of `ravel`.

    `order` must be the sorted names that `names` gives.
    """
    return {name: vector[..., column] for column, name in enumerate(order)}


def box(dist: ParamDist) -> tuple[dict, dict]:
    """Computes the lower and the upper end of the distribution's support, by name, in coordinates.

    The ends are `max(centre - radius, lower)` and `min(centre + radius, upper)`: draws and guesses come from this box.
    """
    low = jax.tree.map(lambda c, r, bound: jnp.maximum(c - r, bound), dist.centre, dist.radius, dist.lower)
    high = jax.tree.map(lambda c, r, bound: jnp.minimum(c + r, bound), dist.centre, dist.radius, dist.upper)
    return low, high


def sample(key: jax.Array, dist: ParamDist, count: int) -> dict:
    """Draws `count` robots from the distribution, all coordinates independent and uniform over the box.

    Returns coordinates, [count] by name, as `simulate` takes them.
    """
    low, high = (ravel(side) for side in box(dist))
    draws = jax.random.uniform(key, (count, len(low)), minval=low, maxval=high)
    return unravel(names(dist), draws)


def normalise(dist: ParamDist, coords: Coords) -> Float[Array, "... coords"]:
    """Expresses named coordinates as a vector in radii: `(coords - centre) / radius`.

    The centre becomes 0 and the edge of the support 1 or -1 unless a bound cuts it. Networks read and answer in this
    unit.
    """
    return (ravel(coords) - ravel(dist.centre)) / ravel(dist.radius)


def normalised_box(dist: ParamDist) -> tuple[Float[Array, " coords"], Float[Array, " coords"]]:
    """Computes the lower and the upper end of the support in radii.

    They are -1 and 1, or closer to zero where a bound cuts the support. Guesses of the search-parameter model are drawn
    and swept between them.
    """
    low, high = box(dist)
    return normalise(dist, low), normalise(dist, high)


def ignorance(dist: ParamDist) -> Float[Array, " coords"]:
    """Computes the standard deviations of draws, in radii: by how much a guess at the middle of the support errs."""
    low, high = normalised_box(dist)
    return (high - low) / jnp.sqrt(12.0)


def at_bounds(dist: ParamDist) -> jax.Array:
    """Checks whether every coordinate's support fills its bounds; returns a boolean scalar.

    Widening such a distribution changes nothing, so the gate's loop must end there.
    """
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


def widen(dist: ParamDist, factor: jax.Array, towards: Float[Array, " coords"] | float = 0.0) -> ParamDist:
    """Multiplies every radius by a factor (Algorithm 1, `r <- r c`), up to the width of the bounds.

    The tuner widens only after a failed check, while Algorithm 1 as printed widens before every check.

    Args:
      dist: what is widened.
      factor: above 1.
      towards: where the robot seems to be, in radii. The centre moves there as far as the wider distribution still
        holds the narrower one. At 0 it stays, as in the paper.
    """
    wider = move(dist, jnp.clip(jnp.broadcast_to(towards, len(dist.centre)), 1.0 - factor, factor - 1.0))
    # A radius as wide as the bounds fills them from any centre.
    radius = jax.tree.map(
        lambda r, lower, upper: jnp.minimum(r * factor, upper - lower), dist.radius, dist.lower, dist.upper
    )
    return wider.replace(radius=radius)


def move(dist: ParamDist, step: Float[Array, " coords"]) -> ParamDist:
    """Shifts the centre by a step in radii, `centre + radius * step`, and clips it to the bounds.

    This is how every update changes the distribution; the radius stays.
    """
    centre = ravel(dist.centre) + ravel(dist.radius) * step
    centre = jnp.clip(centre, ravel(dist.lower), ravel(dist.upper))
    return dist.replace(centre=unravel(names(dist), centre.astype(jnp.float32)))


def narrow(dist: ParamDist, interval: Float[Array, " coords"], least: float) -> ParamDist:
    """Narrows every radius to an interval in radii, no further than to `least` in coordinates; none grows.

    A radius whose interval is nan stays.
    """
    radius = ravel(dist.radius)
    narrowed = jnp.clip(radius * interval, jnp.minimum(least, radius), radius)
    narrowed = jnp.where(jnp.isnan(interval), radius, narrowed)
    return dist.replace(radius=unravel(names(dist), narrowed.astype(jnp.float32)))


def narrowed(before: ParamDist, after: ParamDist, least: float) -> jax.Array:
    """Tells whether any radius has lost a tenth of it, and half of the least radius: is it worth simulating again?"""
    was, now = ravel(before.radius), ravel(after.radius)
    return ((now < _NARROWED * was) & (was - now > _LEAST * least)).any()
