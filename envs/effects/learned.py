"""A learned torque at every joint, for what no effect of the library explains.

It depends on the joint, on the one that carries it and on the one that it carries: tendons and belts couple neighbours.

It is no hypothesis and names no cause. It bounds what effects of the joints could explain at all, and it is what a user
gets where something is missing that has no name.
"""

import jax.numpy as jnp

from envs.effects.memory import lagged
from jaxtune.types import Effect, Parameter

_HISTORY_S = 0.03  # over which torque and speed are remembered: longer than most lags of a motor
_SIGN_RAD_S = 0.1  # speed over which friction turns round

PARTS = {
    **dict.fromkeys(("constant_nm", "sine_nm", "cosine_nm"), "position"),
    **dict.fromkeys(("direction_nm", "speed_nm_s_per_rad", "square_nm_s2_per_rad2"), "speed"),
    "share": "torque",
    **dict.fromkeys(("late_share", "late_nm_s_per_rad"), "past"),
    **dict.fromkeys(("sine_before_nm", "share_before"), "joint before"),
    **dict.fromkeys(("sine_after_nm", "share_after"), "joint after"),
}
"""What each of its parameters depends on."""


def _learned_torque(values, torque, now, memory):
    """torque' = torque + sum of gains times features of the joint and of its short history.

    Features: 1, sin q, cos q, tanh(dq / 0.1), dq, dq |dq|, the torque itself, how torque and speed differ from their
    means over the last 30 ms, and torque and sin q of both neighbours.
    """
    past_torque, past_speed = memory
    seconds = jnp.full_like(torque, _HISTORY_S)
    _, past_torque = lagged(past_torque, torque, seconds, now.dt)
    _, past_speed = lagged(past_speed, now.speed, seconds, now.dt)
    features = {
        "constant_nm": 1.0,
        "sine_nm": jnp.sin(now.position),
        "cosine_nm": jnp.cos(now.position),
        "direction_nm": jnp.tanh(now.speed / _SIGN_RAD_S),
        "speed_nm_s_per_rad": now.speed,
        "square_nm_s2_per_rad2": now.speed * jnp.abs(now.speed),
        "share": torque,
        "late_share": torque - past_torque,
        "late_nm_s_per_rad": now.speed - past_speed,
    }
    for name, beside in (("before", now.before), ("after", now.after)):
        # Where there is none, index and signal are one longer.
        features[f"sine_{name}_nm"] = jnp.append(jnp.sin(now.position), 0.0)[beside]
        features[f"share_{name}"] = jnp.append(torque, 0.0)[beside]
    added = sum(values[name] * feature for name, feature in features.items())
    # A motor that is switched off cannot be the cause, but what acts on the joint may be; both are learned.
    return torque + added, jnp.stack([past_torque, past_speed])


def _from_rest(values, torque, dt):
    """Starts with the torque that there is, and at rest."""
    del values, dt
    return jnp.stack([torque, jnp.zeros_like(torque)])


LEARNED = Effect(
    name="learned_torque",
    family="external",
    on="joint",
    enters="torque",
    parameters=(
        *(
            Parameter(name=f"{name}_nm", scale="torque", bounds=(-1.0, 1.0), prior=0.3)
            for name in ("constant", "sine", "cosine", "direction", "sine_before", "sine_after")
        ),
        Parameter(name="speed_nm_s_per_rad", scale="damping", bounds=(-1.0, 1.0), prior=0.3),
        Parameter(name="square_nm_s2_per_rad2", scale="quadratic", bounds=(-1.0, 1.0), prior=0.3),
        Parameter(name="share", bounds=(-0.8, 0.8), prior=0.3),
        Parameter(name="late_share", bounds=(-0.8, 0.8), prior=0.3),
        Parameter(name="late_nm_s_per_rad", scale="damping", bounds=(-1.0, 1.0), prior=0.3),
        Parameter(name="share_before", scale="of_before", bounds=(-1.0, 1.0), prior=0.3),
        Parameter(name="share_after", scale="of_after", bounds=(-1.0, 1.0), prior=0.3),
    ),
    sizes=(0.05,),
    act=_learned_torque,
    start=_from_rest,
    sentence="A torque acts on the joint that no effect of the library explains.",
    excited_by="a longer log of this joint in more postures",
)
