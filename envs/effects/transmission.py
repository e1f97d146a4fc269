"""Between the motor and the joint.

The motor is massless here (its inertia is the joint's armature): what backlash or a spring lets it run ahead of the
joint follows from the balance of its torques over one step, where the controller answers with its stiffness and
damping. The memory is that offset [joints] in rad; encoders sit on the motor and read it.
"""

import jax.numpy as jnp

from jaxtune.types import Effect, Parameter

_TRANSMISSION = {"family": "transmission", "on": "joint"}


def _resistance(now):
    """Torque that the controller takes back for every rad that the motor runs ahead within a step."""
    return now.stiffness + now.damping / now.dt


def _backlash(values, torque, now, offset):
    half = 0.5 * values["rad"]
    resistance = jnp.maximum(_resistance(now), 1e-9)
    following = jnp.clip(offset + torque / resistance, -half, half)
    return torque - resistance * (following - offset), following


def _compliance(values, torque, now, offset):
    softness, resistance = values["nm_per_rad"], _resistance(now)
    passed = (torque + resistance * offset) / (1.0 + softness * resistance)
    return passed, softness * passed


def _taken_up(values, torque, dt):
    """The motor leans on the side of the play to which its torque drives it."""
    del dt
    return 0.5 * values["rad"] * jnp.sign(torque)


def _wound_up(values, torque, dt):
    del dt
    return values["nm_per_rad"] * torque


ROWS = (
    Effect(
        name="backlash",
        enters="transmission",
        parameters=(Parameter(name="rad", bounds=(0.0, 0.2), prior=0.02),),
        sizes=(0.003, 0.02),
        act=_backlash,
        start=_taken_up,
        sentence="The gears have play: the motor turns a little before the joint does.",
        excited_by="slow triangular reversals through the posture without gravity torque",
        **_TRANSMISSION,
    ),
    Effect(
        name="compliance",
        enters="transmission",
        parameters=(Parameter(name="nm_per_rad", form="reciprocal", scale="stiffness", bounds=(0.0, 20.0), prior=1.0),),
        sizes=(0.2, 2.0),
        act=_compliance,
        start=_wound_up,
        sentence="A spring sits between motor and joint.",
        excited_by="a chirp through its resonance, and postures of high gravity torque",
        **_TRANSMISSION,
    ),
    Effect(
        name="armature",
        enters="model",
        parameters=(Parameter(name="kg_m2", scale="inertia", bounds=(-0.5, 5.0), prior=0.3, fields=("dof_armature",)),),
        sizes=(0.03,),
        sentence="The motor's rotor weighs more, seen through the gears, than the model says.",
        excited_by="a chirp to 10 Hz at two controller gains",
        **_TRANSMISSION,
    ),
)
