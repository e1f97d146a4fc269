"""Effects between the motor and the joint: backlash, compliance, and the rotor's inertia.

Backlash and compliance let the motor run ahead of its joint by an offset o. Encoders sit on the motor, or on the joint
(`JOINT_ENCODER`), where they and the controller see nothing of o: then kp and kd below are zero. A robot with both may
control by the one and log the other (`JOINT_LOG`). Only the joint is a body of the model; the rotor's inertia J is part
of its armature. The offset follows from the balance of torques on the rotor over one step of length dt. If o changes by
d within the step, then

- a controller that acts within the step gives kp d + kd d / dt less torque (stiffness kp, damping kd);
- the rotor takes J (d / dt - rate) / dt to change the rate of its offset.

Together the joint receives

    torque + J rate / dt - R d    with    R = kp + (kd + J / dt) / dt

(`_resistance`). What presses on the gears is less, since the rotor accelerates along with its link. If the
link has the inertia M and would accelerate by a without them, that is

    M / (M + J) (torque - J a + J rate / dt - R d)

(`Now.link`), and decides how far o moves. The memory is the offset in rad and its rate in rad/s,
[2, joints].

Without its gears and without dry friction the link would accelerate by `Now.alone`. If dry friction can stop it, its
acceleration is `Now.stopped`, whatever presses on the gears. Else a is `Now.alone` less the bound over M, which is one
over `Now.mobility`. Bristles follow the joint's speed from step to step, so their torque is in `Now.alone`.

Friction and damping are at the joint or before the gears, at the motor (`at_motor` is that share). There they act on
the motor's speed v + d / dt, where v is the joint's. So damping D is added to kd above and takes D v of the torque, and
dry friction of the bound F takes the torque f with |f| <= F that would stop the motor, or F. The signal of this stage
is [5, joints]: torque in Nm, bound in Nm and damping in Nm s/rad of the joint, and those of the motor. What no row has
used of the motor's is the joint's again, because the two move as one.
"""

import jax.numpy as jnp

from jaxtune.types import Effect, Form, Parameter

_TRANSMISSION = {"family": "transmission", "on": "joint"}
_AT_MOTOR = Parameter(name="at_motor", bounds=(0.0, 1.0), prior=0.5)


def _shared(values, there, signal):
    """Takes the motor's share out of the joint's friction and damping, where gears are `there`.

    Returns:
      Torque of the motor [joints] Nm, and bound in Nm and damping in Nm s/rad of joint and of motor, [2, joints] each.
    """
    joint, motor = signal[1:3], signal[3:5]
    # A hypothesis may ask for less friction than none.
    taken = jnp.where(there, values["at_motor"], 0.0) * jnp.maximum(joint, 0.0)
    return signal[0], joint - taken, motor + taken


def _resistance(now, slows=0.0):
    """R: torque that a motor loses for every rad that it runs ahead within a step, [joints] Nm/rad."""
    return jnp.maximum(now.stiffness + (now.damping + slows + now.rotor / now.dt) / now.dt, 1e-9)


def _stopping(torque, bound):
    """Torque of dry friction, [joints] Nm: what would stop the motor, or its bound."""
    return jnp.where(bound > 0, jnp.clip(torque, -bound, bound), 0.0)


def _most(now, bound):
    """Largest acceleration that dry friction of this bound [joints] Nm gives a link, [joints] rad/s^2."""
    return now.mobility * now.rigid * jnp.maximum(bound, 0.0)


def _backlash(values, signal, now, memory):
    """o' = clip(o + (pressing - f) / R, -rad / 2, rad / 2): inside the play the motor runs free, at its ends it pushes.

    There motor and joint rub as one.
    """
    offset, rate = memory
    half = 0.5 * values["rad"]
    torque, joint, motor = _shared(values, half > 0, signal)
    torque, (bound, slows), resistance = torque + now.rotor * rate / now.dt, motor, _resistance(now, motor[1])
    alone = now.alone - _stopping(now.alone - now.stopped, _most(now, joint[0]))
    pressing = torque - now.rotor * alone - slows * now.speed
    friction = _stopping(pressing + resistance * now.dt * now.speed, bound)
    following = jnp.clip(offset + (pressing - friction) / resistance, -half, half)
    inside = jnp.abs(following) < half
    rubs = jnp.where(inside, slows * (now.speed + (following - offset) / now.dt) + friction, 0.0)
    passed = torque - _resistance(now) * (following - offset) - rubs
    signal = jnp.stack([passed, *joint, *jnp.where(inside, 0.0, motor)])
    return signal, jnp.stack([following, (following - offset) / now.dt])


def _compliance(values, signal, now, memory):
    """A spring that may harden, and a damper beside it:

        k o' (1 + h o'^2) + c (o' - o) / dt = M / (M + J) (pressing - f + R (o - o'))

    without the factor M / (M + J) where friction stops the link.
    """
    offset, rate = memory
    softness, hardening = values["nm_per_rad"], values["hardening_per_rad2"]
    loss = softness * values["nm_s_per_rad"] / now.dt
    torque, joint, motor = _shared(values, softness > 0, signal)
    bound, slows = jnp.where(softness > 0, motor, 0.0)
    torque, resistance = torque + now.rotor * rate / now.dt - slows * now.speed, _resistance(now, slows)
    still = offset - now.dt * now.speed  # the offset if the motor stood still

    def beside(link, acceleration):
        """Offset and friction of the motor, [2, joints], if its link accelerates by this without the spring.

        The spring moves the link by `link` of what it would move a light one.
        """
        soft = softness * link
        pressing = torque - now.rotor * acceleration + resistance * offset
        wound = (still * (1.0 + hardening * still**2) + loss * (still - offset)) / jnp.maximum(soft, 1e-9)
        friction = _stopping(pressing - resistance * still - wound, bound)
        pushed = soft * (pressing - friction) + loss * offset
        return jnp.stack([_root(1.0 + loss + soft * resistance, hardening, pushed), friction])

    following, friction = beside(1.0, now.stopped)
    pressing = torque - now.rotor * now.stopped - resistance * (following - offset) - friction
    # What the link's friction would have to do, and can.
    needed, most = now.alone + now.mobility * pressing - now.stopped, _most(now, joint[0])
    sliding = beside(now.link, now.alone - jnp.clip(needed, -most, most))
    following, friction = jnp.where(jnp.abs(needed) < most, jnp.stack([following, friction]), sliding)
    passed = torque - resistance * (following - offset) - friction
    signal = jnp.stack([passed, *joint, *jnp.where(softness > 0, 0.0, motor)])
    return signal, jnp.stack([following, (following - offset) / now.dt])


def _taken_up(values, torque, dt):
    """Starts with the motor on the side of the play to which torque [steps, joints] drives it."""
    del dt
    offset = 0.5 * values["rad"] * jnp.sign(torque.mean(axis=0))
    return jnp.stack([offset, jnp.zeros_like(offset)])


def _wound_up(values, torque, dt):
    """Starts with the spring wound up by torque [steps, joints], at its first step: o (1 + h o^2) = softness torque."""
    wound = _root(1.0, values["hardening_per_rad2"], values["nm_per_rad"] * torque)
    half = (len(wound) + 1) // 2
    early, late = wound[:half].mean(axis=0), wound[-half:].mean(axis=0)
    rate = (late - early) / (max(len(wound) - half, 1) * dt)
    return jnp.stack([early - 0.5 * (half - 1) * dt * rate, rate])


def _root(linear, cubic, value):
    """The real x with linear x + cubic x^3 = value, for linear > 0 and cubic >= 0."""
    share = jnp.sqrt(3.0 * jnp.maximum(cubic, 1e-6) / linear)
    root = 2.0 / share * jnp.sinh(jnp.arcsinh(1.5 * share * value / linear) / 3.0)
    return jnp.where(cubic > 0, root, value / linear)


def _joint_encoder(values, ahead, now, memory):
    """seen = (1 - share) ahead: what encoders see of how far motors run ahead, [..., joints] rad."""
    del now
    return (1.0 - values["at_joint"]) * ahead, memory


JOINT_ENCODER = Effect(
    name="joint_encoder",
    enters="encoder",
    parameters=(Parameter(name="at_joint", bounds=(0.0, 1.0), prior=0.5),),
    sizes=(0.9,),
    act=_joint_encoder,
    sentence="The encoder sits on the joint, behind the gears.",
    excited_by="slow triangular reversals",
    **_TRANSMISSION,
)
"""A form of backlash and of compliance, and no effect of its own."""

JOINT_LOG = Effect(
    name="joint_log",
    enters="log",
    parameters=(Parameter(name="at_joint", bounds=(0.0, 1.0), prior=0.5),),
    sizes=(0.9,),
    act=_joint_encoder,
    sentence="The log has an encoder behind the gears, and the controller one on the motor.",
    excited_by="slow triangular reversals, and postures of high gravity torque",
    **_TRANSMISSION,
)
"""A form of backlash and of compliance, and no effect of its own."""

ROWS = (
    Effect(
        name="backlash",
        enters="transmission",
        parameters=(Parameter(name="rad", scale="angle", bounds=(0.0, 0.2), prior=0.02), _AT_MOTOR),
        sizes=(0.003, 0.02),
        act=_backlash,
        start=_taken_up,
        forms=(
            Form("compliant", "compliance", ("nm_per_rad",)),
            Form("motor_friction", "backlash", ("at_motor",)),
            # All that shows then is that the joint is not driven for a moment. Friction at the motor makes that longer:
            # it holds the motor within the play, of which the controller sees nothing.
            Form("joint_encoder", "joint_encoder", ("at_joint",), screened=True, beside="motor_friction"),
            Form("joint_log", "joint_log", ("at_joint",), screened=True),
        ),
        sentence="The gears have backlash: the motor turns a little before the joint does.",
        excited_by="slow triangular reversals through the posture without gravity torque",
        **_TRANSMISSION,
    ),
    Effect(
        name="compliance",
        enters="transmission",
        parameters=(
            Parameter(name="nm_per_rad", form="reciprocal", scale="stiffness", bounds=(0.0, 20.0), prior=1.0),
            Parameter(name="hardening_per_rad2", scale="hardening", bounds=(0.0, 100.0), prior=1.0),
            Parameter(name="nm_s_per_rad", scale="damping", bounds=(0.0, 5.0), prior=0.3),
            _AT_MOTOR,
        ),
        sizes=(0.05, 2.0),
        act=_compliance,
        start=_wound_up,
        forms=(
            Form("hardening", "compliance", ("hardening_per_rad2",)),
            Form("damped", "compliance", ("nm_s_per_rad",)),
            Form("motor_friction", "compliance", ("at_motor",)),
            # Without a damper the motor swings on and on, since its controller does not see it.
            Form("joint_encoder", "joint_encoder", ("at_joint",), beside="damped"),
            Form("joint_log", "joint_log", ("at_joint",), screened=True),
        ),
        sentence="A spring sits between motor and joint.",
        excited_by="a chirp through its resonance, and postures of high gravity torque",
        **_TRANSMISSION,
    ),
    Effect(
        name="armature",
        enters="model",
        parameters=(Parameter(name="kg_m2", scale="inertia", bounds=(-0.5, 5.0), prior=0.3, fields=("dof_armature",)),),
        sizes=(0.03,),
        differs=True,
        sentence="The rotor's inertia, seen through the gears, differs from the model's.",
        excited_by="a chirp to 10 Hz at two controller gains",
        **_TRANSMISSION,
    ),
)
