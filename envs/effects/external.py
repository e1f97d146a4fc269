"""From outside the robot."""

from jaxtune.types import Effect, Parameter

_EXTERNAL = {"family": "external", "enters": "wrench"}


def _drag(values, wrench, now, memory):
    """A force at every link's centre, against its velocity."""
    force = -values["n_s_per_m"][:, None] * now.body_velocity
    return wrench.replace(force=wrench.force + force), memory


def _constant_push(values, wrench, now, memory):
    del now
    return wrench.replace(torque=wrench.torque + values["nm"]), memory


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
