"""Effects of the links' masses and centres of mass, which change fields of the model.

`envs.rig` recomputes the fields that depend on them. Mass is easily confused with torque scale and friction; what
separates them is a swing with the motors off.
"""

import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation
from mujoco import mjx

from jaxtune.types import Effect, Form, Parameter


def _with_load(values, model: mjx.Model, bodies: np.ndarray) -> mjx.Model:
    """Attaches an object to each body: two rigid bodies become one (the parallel axis theorem)."""
    added, arm = values["kg"], jnp.stack([values[f"{axis}_m"] for axis in "xyz"], axis=-1)
    share = added / (model.body_mass[bodies] + added)
    # About the common centre of mass, two bodies turn like their reduced mass at the end of the arm.
    squares = (arm**2).sum(axis=-1)[:, None, None] * jnp.eye(3) - arm[:, :, None] * arm[:, None, :]
    turning = (model.body_mass[bodies] * share)[:, None, None] * squares
    turning += (added * values["gyration_m"] ** 2)[:, None, None] * jnp.eye(3)
    frame = Rotation.from_quat(jnp.roll(model.body_iquat[bodies], -1, axis=-1)).as_matrix()
    own = (frame * model.body_inertia[bodies][:, None, :]) @ frame.mT
    moments, axes = jnp.linalg.eigh(own + turning)
    # Rounding of a large load could make a small link's moments negative.
    moments = jnp.maximum(moments, model.body_inertia[bodies].min(axis=-1, keepdims=True))
    # Eigenvectors may be a mirror image.
    axes *= jnp.linalg.det(axes)[:, None, None]
    changed = {
        "body_mass": model.body_mass[bodies] + added,
        "body_ipos": model.body_ipos[bodies] + share[:, None] * arm,
        "body_inertia": moments,
        "body_iquat": jnp.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=-1),
    }
    # Principal axes may change places, so what carries nothing stays as it is to the last bit.
    for name, value in changed.items():
        field = getattr(model, name)
        loaded = (added > 0).reshape(-1, *(1,) * (field.ndim - 1))
        changed[name] = field.at[bodies].set(jnp.where(loaded, value, field[bodies]))
    return model.replace(**changed)


_INERTIA = {"family": "inertia", "on": "body", "enters": "model"}

ROWS = (
    Effect(
        name="link_mass",
        parameters=(
            Parameter(name="ratio", form="ratio", bounds=(-1.6, 1.6), prior=0.5, fields=("body_mass", "body_inertia")),
        ),
        sizes=(0.05,),
        sentence="The link is heavier or lighter than the model says, its shape the same.",
        excited_by="a motor-off swing, and postures of high gravity torque",
        **_INERTIA,
    ),
    Effect(
        name="com_offset",
        parameters=tuple(
            Parameter(name=f"{axis}_m", bounds=(-0.1, 0.1), prior=0.01, fields=(("body_ipos", column),))
            for column, axis in enumerate("xyz")
        ),
        # About an upright axis gravity does not feel it, and inertia grows with its square.
        sizes=(0.005, 0.05),
        sentence="The link's centre of mass is not where the model has it.",
        excited_by="slow motion through postures on both sides of the vertical",
        **_INERTIA,
    ),
    Effect(
        name="payload",
        parameters=(
            Parameter(name="kg", scale="mass", bounds=(0.0, 6.0), prior=0.3),
            *(Parameter(name=f"{axis}_m", bounds=(-0.4, 0.4), prior=0.1) for axis in "xyz"),
            Parameter(name="gyration_m", bounds=(0.0, 0.4), prior=0.1),
        ),
        sizes=(0.05,),
        act=_with_load,
        sentence="An object is attached to the link, at its centre of mass or beside it.",
        excited_by="a motor-off swing, and postures of high gravity torque",
        # How far the object's centre is from the link's, and its radius of gyration.
        forms=(
            Form("off_centre", "payload", ("x_m", "y_m", "z_m"), like="com_offset"),
            Form("bulky", "payload", ("gyration_m",)),
        ),
        **_INERTIA,
    ),
)
