"""Effects of the links' masses and centres of mass, which change fields of the model.

`jaxtune.mjx.apply` recomputes the fields that depend on them. Mass is easily
confused with torque scale and friction; what separates them is a swing with the motors off.
"""

from jaxtune.types import Effect, Form, Parameter

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
        parameters=(Parameter(name="kg", scale="mass", bounds=(0.0, 4.0), prior=0.3, fields=("body_mass",)),),
        sizes=(0.05,),
        sentence="A small heavy object is attached to the link, at its centre of mass or beside it.",
        excited_by="a motor-off swing, and postures of high gravity torque",
        forms=(Form("off_centre", "com_offset"),),
        **_INERTIA,
    ),
)
