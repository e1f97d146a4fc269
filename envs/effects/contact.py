"""Effects of the ground, which change the model.

Those of the feet show only on a free base. A robot on the test rig does not have them, and discovery lists them as
not testable.
"""

import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxtune.types import Effect, Parameter


def _sloped(values, model: mjx.Model, bodies: np.ndarray) -> mjx.Model:
    """Turns gravity as a robot sees it whose base is rolled about its x axis, and then pitched about its y axis."""
    del bodies
    roll, pitch = values["roll_rad"][0], values["pitch_rad"][0]
    x, y, z = model.opt.gravity
    y, z = jnp.cos(roll) * y + jnp.sin(roll) * z, jnp.cos(roll) * z - jnp.sin(roll) * y
    x, z = jnp.cos(pitch) * x - jnp.sin(pitch) * z, jnp.cos(pitch) * z + jnp.sin(pitch) * x
    return model.replace(opt=model.opt.replace(gravity=jnp.stack([x, y, z])))


_CONTACT = {"family": "contact", "enters": "model"}

ROWS = (
    Effect(
        name="ground_friction",
        on="foot",
        parameters=(
            Parameter(name="ratio", form="ratio", bounds=(-2.0, 1.5), prior=0.3, fields=(("geom_friction", 0),)),
        ),
        sizes=(0.1,),
        sentence="The feet slip earlier or later than the model says.",
        excited_by="walking fast, braking and turning",
        needs="free",
        **_CONTACT,
    ),
    Effect(
        name="ground_compliance",
        on="foot",
        parameters=(Parameter(name="seconds", bounds=(-0.005, 0.1), prior=0.01, fields=(("geom_solref", 0),)),),
        sizes=(0.005,),
        sentence="The ground is softer: it gives way and recovers more slowly.",
        excited_by="stepping in place, harder and softer",
        needs="free",
        **_CONTACT,
    ),
    Effect(
        name="ground_slope",
        on="robot",
        parameters=tuple(Parameter(name=f"{axis}_rad", bounds=(-0.3, 0.3), prior=0.03) for axis in ("roll", "pitch")),
        sizes=(0.01,),
        act=_sloped,
        sentence="The ground is not level, or what the robot is clamped to or hangs on.",
        excited_by="slow motion through many postures, or standing and walking in two headings",
        **_CONTACT,
    ),
)
