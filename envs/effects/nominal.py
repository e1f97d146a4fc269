"""What every log leaves uncertain beside the model's own parameters; these rows are fitted, and never named as missing.

A controller's damping gain is rarely known to a percent, the constants of a servo's motor are those of a data sheet,
and the inertia of a link is known no better than its mass. Few logs say how their targets went on between two rows, and
a torque that was computed from a motor's current is as good as its constant. Discovery fits these under every
hypothesis, or it would call them a delay, friction, a load or a weak motor.
"""

from envs.effects.actuator import scaled
from jaxtune.types import Effect, Parameter


def _target_between_rows(values, target, now, memory):
    """target' = target + share (linear - held): targets that move on in a straight line to the next row."""
    return target + values["share"] * now.between, memory


ROWS = (
    Effect(
        name="damping_gain",
        family="actuator",
        on="joint",
        enters="speed",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.05),),
        sizes=(0.05,),
        act=scaled,
        sentence="The controller's damping gain is not the one that was set.",
        excited_by="chirps at two controller gains",
    ),
    Effect(
        name="back_emf",
        family="actuator",
        on="joint",
        enters="back_emf",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.1),),
        sizes=(0.05,),
        act=scaled,
        sentence="The motor's back electromotive force brakes more, or less, than its constants say.",
        excited_by="a swing with the motor's terminals closed",
    ),
    Effect(
        name="link_inertia",
        family="inertia",
        on="body",
        enters="model",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.1, fields=("body_inertia",)),),
        sizes=(0.05,),
        sentence="The link's mass is spread farther from its centre, or nearer to it, than the model says.",
        excited_by="fast motion of the link about its centre",
    ),
    Effect(
        name="target_between_rows",
        family="actuator",
        on="robot",
        enters="command",
        parameters=(Parameter(name="share", bounds=(0.0, 1.0), prior=0.5),),
        sizes=(0.2,),
        act=_target_between_rows,
        sentence="Targets move on between two rows of the log.",
        excited_by="a log at a higher rate",
    ),
    Effect(
        name="torque_reading",
        family="sensing",
        on="joint",
        enters="torque_reading",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.2),),
        sizes=(0.05,),
        act=scaled,
        sentence="The recorded torque is a multiple of the motor's.",
        excited_by="slow motion through postures of known gravity torque",
    ),
)
