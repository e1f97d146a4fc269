"""Effects from outside the robot: forces on its links and torques on its joints.

The signal is an `envs.chain.Wrench`, which starts at zero; every effect adds its force or torque.
"""

import jax.numpy as jnp

from jaxtune.types import Effect, Parameter

_EXTERNAL = {"family": "external", "enters": "wrench"}


def _drag(values, wrench, now, memory):
    """force = -c v at every link's centre of mass, v its velocity."""
    force = -values["n_s_per_m"][:, None] * now.body_velocity
    return wrench.replace(force=wrench.force + force), memory


def _constant_push(values, wrench, now, memory):
    """torque = a constant."""
    del now
    return wrench.replace(torque=wrench.torque + values["nm"]), memory


def _residual_torque(values, wrench, now, memory):
    """torque = a + b sin q + c cos q + d tanh(dq / 0.1 rad/s) + e dq: any smooth torque of position and velocity."""
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
    sentence="A torque acts on the joint that no effect of the library explains.",
    excited_by="a longer log of this joint in more postures",
    **_EXTERNAL,
)
"""A torque on every joint for what no effect of the library explains.

It is no hypothesis and names no cause. Discovery fits it last, within bounds, where a misfit is left, so that the user
gets a better simulator even without a name."""

ROWS = (
    Effect(
        name="drag",
        on="body",
        parameters=(Parameter(name="n_s_per_m", scale="drag", bounds=(0.0, 5.0), prior=0.3),),
        sizes=(0.05,),
        act=_drag,
        sentence="A cable or the air drags on the link in proportion to its speed.",
        excited_by="a motor-off swing and fast motion of several joints at once",
        **_EXTERNAL,
    ),
    Effect(
        name="constant_push",
        on="joint",
        parameters=(Parameter(name="nm", scale="torque", bounds=(-5.0, 5.0), prior=0.3),),
        sizes=(0.03,),
        act=_constant_push,
        sentence="A constant torque acts on the joint.",
        excited_by="postures on both sides of the vertical at two controller gains",
        **_EXTERNAL,
    ),
)
