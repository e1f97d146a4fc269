"""From outside the robot."""

import jax.numpy as jnp

from jaxtune.types import Effect, Parameter

_EXTERNAL = {"family": "external", "enters": "wrench"}


def _drag(values, wrench, now, memory):
    """A force at every link's centre, against its velocity."""
    force = -values["n_s_per_m"][:, None] * now.body_velocity
    return wrench.replace(force=wrench.force + force), memory


def _constant_push(values, wrench, now, memory):
    del now
    return wrench.replace(torque=wrench.torque + values["nm"]), memory


def _residual_torque(values, wrench, now, memory):
    """What nobody has a name for: a torque that depends on where the joint is and how it moves."""
    torque = (
        values["constant_nm"]
        + values["sine_nm"] * jnp.sin(now.position)
        + values["cosine_nm"] * jnp.cos(now.position)
        + values["direction_nm"] * jnp.tanh(now.speed / 0.1)
        + values["speed_nm_s_per_rad"] * now.speed
    )
    return wrench.replace(torque=wrench.torque + torque), memory


RESIDUAL = Effect(
    name="residual_torque",
    on="joint",
    parameters=(
        *(
            Parameter(name=f"{name}_nm", scale="torque", bounds=(-1.0, 1.0), prior=0.3)
            for name in ("constant", "sine", "cosine", "direction")
        ),
        Parameter(name="speed_nm_s_per_rad", scale="damping", bounds=(-1.0, 1.0), prior=0.3),
    ),
    sizes=(0.05,),
    act=_residual_torque,
    sentence="Something that the library has no name for acts on the joint.",
    excited_by="a longer log of this joint in more postures",
    **_EXTERNAL,
)
"""No hypothesis, but what is left where none fits: it names nothing, and is bounded."""

ROWS = (
    Effect(
        name="drag",
        on="body",
        parameters=(Parameter(name="n_s_per_m", scale="drag", bounds=(0.0, 5.0), prior=0.3),),
        sizes=(0.05,),
        act=_drag,
        sentence="Something drags on the link in proportion to its speed, a cable or the air.",
        excited_by="a motor-off swing and fast motion of several joints at once",
        **_EXTERNAL,
    ),
    Effect(
        name="constant_push",
        on="joint",
        parameters=(Parameter(name="nm", scale="torque", bounds=(-5.0, 5.0), prior=0.3),),
        sizes=(0.03,),
        act=_constant_push,
        sentence="A constant torque pulls at the joint.",
        excited_by="postures on both sides of the vertical at two controller gains",
        **_EXTERNAL,
    ),
)
