"""Effects between the feet and the ground, which change fields of the model.

They show only on a free base. A robot on the test rig does not have them, and discovery lists them as not testable.
"""

from jaxtune.types import Effect, Parameter

_CONTACT = {"family": "contact", "enters": "model", "needs": "free"}

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
        **_CONTACT,
    ),
    Effect(
        name="ground_compliance",
        on="foot",
        parameters=(Parameter(name="seconds", bounds=(-0.005, 0.1), prior=0.01, fields=(("geom_solref", 0),)),),
        sizes=(0.005,),
        sentence="The ground is softer: it gives way and recovers more slowly.",
        excited_by="stepping in place, harder and softer",
        **_CONTACT,
    ),
    Effect(
        name="ground_slope",
        on="robot",
        parameters=tuple(
            Parameter(name=f"{axis}_rad", bounds=(-0.3, 0.3), prior=0.03, fields=(("gravity", column),))
            for column, axis in ((1, "roll"), (0, "pitch"))
        ),
        sizes=(0.01,),
        sentence="The ground is not level.",
        excited_by="standing and walking in two headings",
        **_CONTACT,
    ),
)
