"""Effects from outside the robot: forces on its links and torques on its joints.

The signal is an `envs.chain.Wrench`, which starts at zero; every effect adds its force or torque. A spring is a
field of the model.
"""

import jax.numpy as jnp

from jaxtune.types import Effect, Form, Parameter

_REST = 1e-6  # m/s, where the root would have no derivative
_EXTERNAL = {"family": "external"}


def _drag(values, wrench, now, memory):
    """force = -(c + c2 |v|) v at every link's centre of mass, v its velocity."""
    speed = jnp.sqrt((now.body_velocity**2).sum(axis=1) + _REST**2)
    force = -(values["n_s_per_m"] + values["n_s2_per_m2"] * speed)[:, None] * now.body_velocity
    return wrench.replace(force=wrench.force + force), memory


def _constant_push(values, wrench, now, memory):
    """torque = a constant."""
    del now
    return wrench.replace(torque=wrench.torque + values["nm"]), memory


ROWS = (
    Effect(
        name="drag",
        on="body",
        parameters=(
            Parameter(name="n_s_per_m", scale="drag", bounds=(0.0, 5.0), prior=0.3),
            Parameter(name="n_s2_per_m2", scale="air", bounds=(-5.0, 5.0), prior=0.3),
        ),
        sizes=(0.03,),
        # As of viscous friction: free dampings of the joints take most of what grows with speed itself.
        forms=(Form("quadratic", "drag", ("n_s2_per_m2",), screened=True, alone=True),),
        enters="wrench",
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
        enters="wrench",
        act=_constant_push,
        sentence="A constant torque acts on the joint.",
        excited_by="postures on both sides of the vertical at two controller gains",
        **_EXTERNAL,
    ),
    Effect(
        name="joint_spring",
        on="joint",
        enters="model",
        # From where the model has the angle of its own springs, which is zero unless it says otherwise.
        parameters=(
            Parameter(name="nm_per_rad", scale="spring", bounds=(0.0, 10.0), prior=0.3, fields=("jnt_stiffness",)),
        ),
        sizes=(0.03, 0.3),
        forms=(Form("preloaded", "constant_push", ("nm",), screened=True),),
        sentence="A spring, such as a hose, a cable or a balancer, pulls on the joint in proportion to its angle.",
        excited_by="slow motion through the whole range, and a motor-off swing",
        **_EXTERNAL,
    ),
)
