"""Dry friction of bristles, which give way a little before they slide: a form of friction, and no effect of its own.

The signal is [2, joints]: the bound of dry friction in Nm, for which the engine solves, and a torque on the joint in
Nm. Where bristles are, they take the bound over.
"""

import jax
import jax.numpy as jnp

from jaxtune.types import Effect, Parameter

# Of the unit of angle: bristles that are stiffer would need shorter steps. Those have a share of the friction, and the
# engine's own, which is as sharp, the rest: a travel that shrinks to nothing changes nothing at once.
_LEAST_TRAVEL = 1e-4


def _presliding(values, friction, now, memory):
    """torque' = torque - bound z with d z / dt = speed / travel, |z| <= 1 (Dahl friction with a sharp knee)."""
    bound, torque = friction
    travel, least = values["travel_rad"], _LEAST_TRAVEL * now.unit
    # The memory is z, the deflection of the bristles in shares of that at which they slide.
    wound = jnp.clip(memory + now.dt * now.speed / jnp.maximum(travel, least), -1.0, 1.0)
    theirs = jnp.clip(travel / least, 0.0, 1.0) * bound
    return jnp.stack([bound - theirs, torque - theirs * wound]), wound


def _wound(values, past, dt):
    """Starts with bristles as past positions have wound them.

    `past` is a pair: bristles at the first of these positions, [joints] as the memory, and positions [past, joints].
    """
    del dt
    before, positions = past

    def wind(wound, moved):
        return jnp.clip(wound + moved / jnp.maximum(values["travel_rad"], 1e-9), -1.0, 1.0), None

    return jax.lax.scan(wind, before, jnp.diff(positions, axis=0))[0]


PRESLIDING = Effect(
    name="presliding",
    family="joint_friction",
    on="joint",
    enters="bristle",
    parameters=(Parameter(name="travel_rad", scale="angle", bounds=(0.0, 0.05), prior=0.005),),
    sizes=(0.0005, 0.005),
    act=_presliding,
    start=_wound,
    sentence="Friction sets in over a small travel instead of at once.",
    excited_by="slow triangular reversals of a few milliradians",
)
