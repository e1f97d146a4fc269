"""Effects between the motor and the joint: backlash, compliance, and the rotor's inertia.

Encoders sit on the motor. Backlash and compliance let the motor run ahead of its joint by an offset o. Only the
joint is a body of the model; the rotor's inertia J is part of its armature. The offset follows from the balance of
torques on the rotor over one step of length dt. If o changes by d within the step, then

- the controller, which reads the motor, gives kp d + kd d / dt less torque (stiffness kp, damping kd);
- the rotor takes J (d / dt - rate) / dt to change the rate of its offset.

Together the joint receives

    torque + J rate / dt - R d    with    R = kp + (kd + J / dt) / dt

(`_passed`, `_resistance`). The torque that accelerates the rotor along with the joint does not press on the gears
(`Now.carried`), so it is subtracted where the pressing torque decides how far o moves (`_pressing`). The memory is the
offset in rad and its rate in rad/s, [2, joints].
"""

import jax.numpy as jnp

from jaxtune.types import Effect, Form, Parameter

_SLOPE_S = 0.006  # over which the rate of a measured motor's offset is averaged
_TRANSMISSION = {"family": "transmission", "on": "joint"}


def _resistance(now):
    """R: torque that a motor loses for every rad that it runs ahead within a step, [joints] Nm/rad."""
    # All terms are zero for a measured motor. Its offset then follows the pressing torque at once.
    return jnp.maximum(now.stiffness + (now.damping + now.rotor / now.dt) / now.dt, 1e-9)


def _pressing(torque, now, rate):
    """Torque that would press on the gears if the motor kept up with the joint, [joints] Nm."""
    return torque - now.carried + now.rotor * rate / now.dt


def _passed(torque, now, memory, following):
    """Torque that moves the joint, [joints] Nm: the motor's less what its offset took within the step."""
    offset, rate = memory
    return torque + now.rotor * rate / now.dt - _resistance(now) * (following - offset)


def _backlash(values, torque, now, memory):
    """o' = clip(o + pressing / R, -rad / 2, rad / 2): inside the play the motor runs free, at its ends it pushes."""
    offset, rate = memory
    half = 0.5 * values["rad"]
    following = jnp.clip(offset + _pressing(torque, now, rate) / _resistance(now), -half, half)
    # The moment within a step at which a measured motor crossed the play is unknown, so its rate counts as zero.
    rate = jnp.where(now.measured, 0.0, (following - offset) / now.dt)
    return _passed(torque, now, memory, following), jnp.stack([following, rate])


def _compliance(values, torque, now, memory):
    """A spring of stiffness k = 1 / softness that may harden: o' (1 + h o'^2) = softness (pressing + R (o - o'))."""
    offset, rate = memory
    softness = values["nm_per_rad"]
    resistance = _resistance(now)
    wound = softness * (_pressing(torque, now, rate) + resistance * offset)
    following = _root(1.0 + softness * resistance, values["hardening_per_rad2"], wound)
    fresh = (following - offset) / now.dt
    # The torque of a measured motor is known only row by row, so its slope is averaged over a few.
    rate = jnp.where(now.measured, rate + now.dt / _SLOPE_S * (fresh - rate), fresh)
    return _passed(torque, now, memory, following), jnp.stack([following, rate])


def _taken_up(values, torque, dt):
    """Starts with the motor on the side of the play to which its torque drives it."""
    del dt
    offset = 0.5 * values["rad"] * jnp.sign(torque)
    return jnp.stack([offset, jnp.zeros_like(offset)])


def _wound_up(values, torque, dt):
    """Starts with the spring wound up by the motor's torque: o (1 + h o^2) = softness torque."""
    del dt
    offset = _root(1.0, values["hardening_per_rad2"], values["nm_per_rad"] * torque)
    return jnp.stack([offset, jnp.zeros_like(torque)])


def _root(linear, cubic, value):
    """The real x with linear x + cubic x^3 = value, for linear > 0 and cubic >= 0."""
    share = jnp.sqrt(3.0 * jnp.maximum(cubic, 1e-6) / linear)
    root = 2.0 / share * jnp.sinh(jnp.arcsinh(1.5 * share * value / linear) / 3.0)
    return jnp.where(cubic > 0, root, value / linear)


ROWS = (
    Effect(
        name="backlash",
        enters="transmission",
        parameters=(Parameter(name="rad", scale="angle", bounds=(0.0, 0.2), prior=0.02),),
        sizes=(0.003, 0.02),
        act=_backlash,
        start=_taken_up,
        forms=(Form("compliant", "compliance", "nm_per_rad"),),
        sentence="The gears have backlash: the motor turns a little before the joint does.",
        excited_by="slow triangular reversals through the posture without gravity torque",
        **_TRANSMISSION,
    ),
    Effect(
        name="compliance",
        enters="transmission",
        parameters=(
            Parameter(name="nm_per_rad", form="reciprocal", scale="stiffness", bounds=(0.0, 20.0), prior=1.0),
            Parameter(name="hardening_per_rad2", bounds=(0.0, 200.0), prior=30.0),
        ),
        sizes=(0.2, 2.0),
        act=_compliance,
        start=_wound_up,
        forms=(Form("hardening", "compliance", "hardening_per_rad2"),),
        sentence="A spring sits between motor and joint.",
        excited_by="a chirp through its resonance, and postures of high gravity torque",
        **_TRANSMISSION,
    ),
    Effect(
        name="armature",
        enters="model",
        parameters=(Parameter(name="kg_m2", scale="inertia", bounds=(-0.5, 5.0), prior=0.3, fields=("dof_armature",)),),
        sizes=(0.03,),
        sentence="The rotor's inertia, seen through the gears, differs from the model's.",
        excited_by="a chirp to 10 Hz at two controller gains",
        **_TRANSMISSION,
    ),
)
