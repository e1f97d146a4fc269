"""Effects of friction in the joints.

Dry friction is a bound on a torque (MuJoCo's `dof_frictionloss`). The signal is this bound, [joints] Nm; effects add
to it. The engine solves for the torque, within the bound, that brings the joint to rest or slows it most. So a joint
can stick, which a torque computed from its speed could not make it do.
"""

import jax.numpy as jnp

from jaxtune.types import Effect, Form, Parameter

_JOINT_FRICTION = {"family": "joint_friction", "on": "joint"}
# The engine's own friction creeps under load, where a robot's joint holds: a fit with it may gain nothing.
_PRESLIDING = Form("presliding", "presliding", ("travel_rad",), screened=True)
# While a joint slides, friction that differs between directions is symmetric friction and a constant torque.
_DIRECTION = Form("direction_dependent", "constant_push", ("nm",))
# A joint may stick harder and slide with the rest. The larger part gives the name.
_STICTION, _SLIDING = Form("stiction", "stribeck"), Form("sliding", "coulomb", ("torque_nm",))


def _coulomb(values, bound, now, memory):
    """bound' = bound + torque."""
    del now
    return bound + values["torque_nm"], memory


def _stribeck(values, bound, now, memory):
    """bound' = bound + torque exp(-(|speed| / Stribeck speed)^(1 + gaussian)).

    Both powers are in use: one (Tustin, 1947) and two (Armstrong-Helouvry, Dupont and Canudas de Wit, 1994).
    """
    share = jnp.abs(now.speed) / values["speed_rad_s"]
    return bound + values["torque_nm"] * jnp.exp(-(share ** (1.0 + values["gaussian"]))), memory


def _load_friction(values, bound, now, memory):
    """bound' = bound + ratio load, the load being the larger of motor torque and of gravity and Coriolis torque."""
    return bound + values["ratio"] * now.load, memory


ROWS = (
    Effect(
        name="coulomb",
        enters="friction",
        parameters=(Parameter(name="torque_nm", scale="torque", bounds=(-0.5, 5.0), prior=0.3),),
        sizes=(0.03, 0.3),
        act=_coulomb,
        forms=(_PRESLIDING, _DIRECTION, _STICTION),
        differs=True,
        sentence="The joint needs a fixed torque to start moving and loses the same torque while it moves.",
        excited_by="slow triangular reversals",
        **_JOINT_FRICTION,
    ),
    Effect(
        name="viscous",
        enters="model",
        parameters=(
            Parameter(name="nm_s_per_rad", scale="damping", bounds=(-0.5, 5.0), prior=0.3, fields=("dof_damping",)),
        ),
        sizes=(0.03,),
        # Where the model has damping, what is free under every hypothesis takes all that grows with speed itself.
        forms=(Form("quadratic", "learned_torque", ("square_nm_s2_per_rad2",), screened=True, alone=True),),
        differs=True,
        sentence="The joint loses a torque in proportion to its speed.",
        excited_by="a motor-off swing, or chirps at two amplitudes",
        **_JOINT_FRICTION,
    ),
    Effect(
        name="stribeck",
        enters="friction",
        parameters=(
            Parameter(name="torque_nm", scale="torque", bounds=(0.0, 5.0), prior=0.3),
            Parameter(name="speed_rad_s", form="ratio", scale="slow", bounds=(-2.0, 2.0), shape=True),
            Parameter(name="gaussian", bounds=(0.0, 1.0), prior=3.0, shape=True),
        ),
        sizes=(0.05, 0.3),
        act=_stribeck,
        forms=(_PRESLIDING, _DIRECTION, _SLIDING),
        sentence="The joint sticks harder than it slides: friction falls as it starts to move.",
        excited_by="slow triangular reversals at several speeds",
        **_JOINT_FRICTION,
    ),
    Effect(
        name="load_friction",
        enters="friction",
        parameters=(Parameter(name="ratio", bounds=(0.0, 0.9), prior=0.2),),
        sizes=(0.03, 0.2),
        act=_load_friction,
        forms=(_PRESLIDING,),
        differs=True,
        sentence="Friction in the gears grows with the torque that they transmit.",
        excited_by="the same reversals in postures of low and of high gravity torque",
        **_JOINT_FRICTION,
    ),
)
