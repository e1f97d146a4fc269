"""Between the motor and the joint.

Encoders sit on the motor. Its rotor is part of the joint's armature, so play and springs let it run ahead of the joint
while the joint goes on without it: how far follows from the balance of torques on the rotor over one step, where the
controller answers with its stiffness and damping. The memory is that offset in rad and its rate in rad/s, [2, joints].
"""

import jax.numpy as jnp

from jaxtune.types import Effect, Parameter

_SLOPE_S = 0.006
_TRANSMISSION = {"family": "transmission", "on": "joint"}


def _resistance(now):
    """Torque that a motor loses for every rad that it runs ahead within a step."""
    return jnp.maximum(now.stiffness + (now.damping + now.rotor / now.dt) / now.dt, 1e-9)


def _pressing(torque, now, rate):
    """What would press on the gears if the motor kept up with the joint."""
    return torque - now.carried + now.rotor * rate / now.dt


def _passed(torque, now, memory, following):
    """What moves the joint, of whose inertia the rotor is a part."""
    offset, rate = memory
    return torque + now.rotor * rate / now.dt - _resistance(now) * (following - offset)


def _backlash(values, torque, now, memory):
    offset, rate = memory
    half = 0.5 * values["rad"]
    following = jnp.clip(offset + _pressing(torque, now, rate) / _resistance(now), -half, half)
    # Of a motor that was measured nobody knows when it let go.
    rate = jnp.where(now.measured, 0.0, (following - offset) / now.dt)
    return _passed(torque, now, memory, following), jnp.stack([following, rate])


def _compliance(values, torque, now, memory):
    offset, rate = memory
    softness = values["nm_per_rad"]
    resistance = _resistance(now)
    following = softness * (_pressing(torque, now, rate) + resistance * offset) / (1.0 + softness * resistance)
    fresh = (following - offset) / now.dt
    # Of a motor that was measured the torque is known row by row: its slope takes a few.
    rate = jnp.where(now.measured, rate + now.dt / _SLOPE_S * (fresh - rate), fresh)
    return _passed(torque, now, memory, following), jnp.stack([following, rate])


def _taken_up(values, torque, dt):
    """The motor leans on the side of the play to which its torque drives it."""
    del dt
    offset = 0.5 * values["rad"] * jnp.sign(torque)
    return jnp.stack([offset, jnp.zeros_like(offset)])


def _wound_up(values, torque, dt):
    del dt
    return jnp.stack([values["nm_per_rad"] * torque, jnp.zeros_like(torque)])


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
