"""Between which sizes an effect is searched, on a robot that is known: from harmless to extreme."""

from dataclasses import dataclass

from experiments.discovery.field.robots import Robot

FAMILIES = {
    "joint_friction": ("coulomb", "viscous", "stribeck", "load_friction"),
    "actuator": (
        *("torque_scale", "torque_limit", "torque_speed", "command_delay"),
        *("target_slew", "deadband", "gain_error", "torque_lag"),
    ),
    "transmission": ("backlash", "compliance", "armature"),
    "inertia": ("link_mass", "com_offset", "payload"),
    "sensing": ("encoder_bias", "sensor_delay", "sensor_lag", "velocity_lag"),
    "external": ("drag", "constant_push", "joint_spring"),
}
"""Names of the library that a suspended robot can show, by family."""

FAMILY = {name: family for family, names in FAMILIES.items() for name in names}
"""Family by name."""

ON_BODY = ("link_mass", "com_offset", "payload", "drag")
"""Effects that sit on a body, not on a joint."""


@dataclass(frozen=True, kw_only=True)
class Scales:
    """What a joint does in the runs of a case without any effect."""

    torque_nm: float
    """Root of the mean square."""
    peak_nm: float
    speed_rad_s: float
    """Root of the mean square."""
    peak_rad_s: float


def bounds(effect: str, robot: Robot, place: int, scales: Scales) -> tuple[float, float]:
    """Returns the harmless and the extreme size of an effect at a place, in the unit of its first parameter.

    Args:
      effect: its name, of the library or of `outside`.
      robot: that has it.
      place: index of joint or body.
      scales: of the joint.
    """
    torque, speed, kp, limit = scales.torque_nm, scales.speed_rad_s, robot.kp[place], robot.limit[place]
    length = 0.1 + abs(robot.com[place]).max()
    found = {
        "coulomb": (0.02 * torque, 2.0 * torque),
        "viscous": (0.02 * torque / speed, 2.0 * torque / speed),
        "stribeck": (0.03 * torque, 4.0 * torque),
        "load_friction": (0.01, 0.7),
        "torque_limit": (scales.peak_nm, 0.3 * torque),
        "torque_speed": (0.1 * limit / scales.peak_rad_s, 2.0 * limit / speed),
        "target_slew": (300.0 * speed, 0.4 * speed),
        "compliance": (200.0 * kp, 1.5 * kp),
        "armature": (0.05 * robot.armature[place], 4.0 * robot.armature[place]),
        "payload": (0.02 * robot.mass[place], 2.5 * robot.mass[place]),
        "link_mass": (1.03, 3.0),
        "com_offset": (0.002, min(0.09, length)),
        "constant_push": (0.02 * torque, 1.5 * torque),
        "joint_spring": (0.02 * torque, 3.0 * torque),
        "drag": (0.02 * torque / speed / length**2, 3.0 * torque / speed / length**2),
        "torque_scale": (0.98, 0.35),
        "gain_error": (0.98, 0.35),
        "deadband": (0.002, 0.18),
        "backlash": (0.0004, 0.15),
        "encoder_bias": (0.001, 0.25),
        # Outside the library.
        "cogging": (0.03 * torque, 2.0 * torque),
        "temperature_fade": (0.05, 0.85),
        "detent": (0.03 * torque, 3.0 * torque),
        "loose_foot": (0.02 * robot.mass[place], 1.5 * robot.mass[place]),
        "gear_error": (0.001, 0.06),
        "joint_coupling": (0.03, 0.8),
        "dropout": (0.02, 0.4),
        "worn_gear": (0.03, 0.8),
    }
    return found.get(effect, (0.001, 0.04))  # delays and lags
