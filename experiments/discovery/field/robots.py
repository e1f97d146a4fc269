"""Robots of the field benchmark: topologies that are fixed, and lengths, masses, motors and gains that are drawn.

All robots of a topology have the same names, tree, rates and lengths of runs, so that programs compiled for one serve
all of them. Everything else is data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

_GRAVITY = 9.81
_OFF_CENTRE_M = 0.03  # by which centres of mass are off at most, by the relative error of the other numbers


@dataclass(frozen=True, kw_only=True)
class Topology:
    """What robots of one kind have in common."""

    name: str
    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    """Body of each joint."""
    parents: tuple[int, ...]
    """Joint that carries each joint; -1 for the base."""
    axes: tuple[str, ...]
    """`x`, `y` or `z`: about which axis of its body each joint turns, before small misalignments are drawn."""
    ends: tuple[str, ...]
    """In which direction each link extends: `z` down, `y` sideways, `0` for a short link of a wrist or hip."""
    control_hz: float
    row_hz: float
    runs: int
    seconds: float
    limited: bool
    """Whether the MJCF gives ranges of the joints."""


def _legs(*sides: str) -> dict:
    parts = (("abad", "hip_link", "x", "y"), ("hip", "thigh", "y", "z"), ("knee", "shank", "y", "z"))
    return {
        "joints": tuple(f"{side}_{joint}" for side in sides for joint, _, _, _ in parts),
        "bodies": tuple(f"{side}_{body}" for side in sides for _, body, _, _ in parts),
        "axes": tuple(axis for _ in sides for _, _, axis, _ in parts),
        "ends": tuple(end for _ in sides for _, _, _, end in parts),
        "parents": tuple(parent for first in range(0, 3 * len(sides), 3) for parent in (-1, first, first + 1)),
    }


def _chain(joints: str, bodies: str, axes: str, ends: str) -> dict:
    count = len(joints.split())
    return {
        "joints": tuple(joints.split()),
        "bodies": tuple(bodies.split()),
        "axes": tuple(axes),
        "ends": tuple(ends),
        "parents": tuple(range(-1, count - 1)),
    }


_TIMES = ("control_hz", "row_hz", "runs", "seconds", "limited")
TOPOLOGIES = {
    name: Topology(name=name, **tree, **dict(zip(_TIMES, times, strict=True)))
    for name, tree, times in (
        ("arm2", _chain("shoulder elbow", "upper lower", "yy", "zz"), (1000.0, 200.0, 10, 4.0, False)),
        ("arm3", _chain("yaw shoulder elbow", "column upper lower", "zyy", "0zz"), (500.0, 250.0, 8, 4.0, False)),
        (
            "arm5",
            _chain("pan lift bend roll tip", "turret upper fore wrist hand", "zyyzy", "0zz0z"),
            (400.0, 100.0, 8, 4.0, True),
        ),
        (
            "arm7",
            _chain("j1 j2 j3 j4 j5 j6 j7", "l1 l2 l3 l4 l5 l6 l7", "zyzyzyx", "0z0z0zz"),
            (1000.0, 200.0, 6, 3.0, False),
        ),
        ("biped", _legs("left", "right"), (1000.0, 500.0, 6, 3.0, True)),
        (
            "leg4",
            _chain("twist roll pitch knee", "hip rocker thigh shank", "zxyy", "00zz"),
            (200.0, 100.0, 12, 5.0, True),
        ),
    )
}
"""By name: arms of 2, 3, 5 and 7 joints, a biped's two legs and a leg of 4 joints."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Numbers of one robot, from which each engine builds its bodies; arrays have an entry for every joint."""

    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    parents: tuple[int, ...]
    limited: bool
    pos: np.ndarray
    """[joints, 3] m, origin of each body in its parent."""
    axis: np.ndarray
    """[joints, 3] unit vectors."""
    mass: np.ndarray
    """[joints] kg"""
    com: np.ndarray
    """[joints, 3] m, centre of mass in the body."""
    inertia: np.ndarray
    """[joints, 3, 3] kg m^2 about the centre of mass, in the body's axes."""
    armature: np.ndarray
    """[joints] kg m^2"""
    damping: np.ndarray
    """[joints] Nm s/rad"""
    friction: np.ndarray
    """[joints] Nm"""
    kp: np.ndarray
    """[joints] Nm/rad"""
    kd: np.ndarray
    """[joints] Nm s/rad"""
    limit: np.ndarray
    """[joints] Nm, largest torque of the controller."""

    def with_at(self, field: str, at: Sequence[int] | int, values) -> "Robot":
        """Returns a robot that differs in some entries of one field."""
        changed = np.array(getattr(self, field))
        changed[at] = values
        return replace(self, **{field: changed})


def draw(topology: Topology, rng: np.random.Generator) -> Robot:
    """Draws a robot of a topology, with numbers as its maker would state them.

    Args:
      topology: of the robot.
      rng: random numbers.

    Returns:
      A robot whose kp gives each joint a natural frequency of 2 to 4 Hz.
    """
    count = len(topology.joints)
    scale = np.exp(rng.uniform(-0.35, 0.35))
    pos, com, inertia = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3, 3))
    mass, span = np.zeros(count), np.zeros((count, 3))
    symmetric = {name: number for number, name in enumerate(topology.joints)}
    axis = np.zeros((count, 3))
    for number, (letter, end) in enumerate(zip(topology.axes, topology.ends, strict=True)):
        twin = symmetric.get(topology.joints[number].replace("right", "left"), number)
        if twin != number:  # right legs mirror left ones
            mirror = np.array([1.0, -1.0, 1.0])
            mass[number], span[number], com[number] = mass[twin], span[twin] * mirror, com[twin] * mirror
            inertia[number], axis[number] = inertia[twin], axis[twin]
            continue
        length = scale * (rng.uniform(0.15, 0.4) if end == "z" else rng.uniform(0.04, 0.09))
        span[number] = {"z": [0, 0, -length], "y": [0, length, 0], "0": [0, 0, -length]}[end]
        mass[number] = scale**2 * rng.uniform(0.4, 2.0) * (0.85**number)
        com[number] = span[number] * rng.uniform(0.3, 0.65) + rng.uniform(-0.05, 0.05, 3) * length
        thick = rng.uniform(0.2, 0.4) * max(length, 0.1)
        long, across = mass[number] * (length**2 + thick**2) / 12, mass[number] * thick**2 / 6
        inertia[number] = np.diag([across, long, long] if end == "x" else [long, long, across])
        turn = np.eye(3)["xyz".index(letter)] * rng.choice([-1, 1]) + rng.uniform(-0.04, 0.04, 3) * rng.integers(2)
        axis[number] = turn / np.linalg.norm(turn)
    for number, parent in enumerate(topology.parents):
        side = -1.0 if topology.joints[number].startswith("right") else 1.0
        pos[number] = span[parent] if parent >= 0 else [0.0, side * 0.08 * scale, 1.2]
    none = np.zeros(count)
    body = Robot(
        joints=topology.joints,
        bodies=topology.bodies,
        parents=topology.parents,
        limited=topology.limited,
        pos=pos,
        axis=axis,
        mass=mass,
        com=com,
        inertia=inertia,
        armature=none,
        damping=none,
        friction=none,
        kp=none,
        kd=none,
        limit=none,
    )
    return _motors(body, topology, rng)


def _motors(body: Robot, topology: Topology, rng: np.random.Generator) -> Robot:
    """Gives every joint a motor, gains and friction that suit the mass that it moves."""
    count = len(body.joints)
    postures = rng.uniform(-0.9, 0.9, (6, count))
    # An arm is heavy to turn where it is stretched out, and its gains must do there too.
    moved = np.max([np.diag(_mass_matrix(body, posture)) for posture in postures], axis=0)
    weight = _weights(body)
    armature = rng.uniform(0.15, 0.8, count) * np.maximum(moved, 0.003)
    if topology.name == "biped":
        armature[3:] = armature[:3]
    moved = moved + armature
    frequency = rng.uniform(13.0, 26.0, count)
    kp = moved * frequency**2
    kd = 2 * rng.uniform(0.25, 0.7, count) * np.sqrt(kp * moved)
    # A sampled controller is unstable where it takes too much of a joint's speed within a period.
    with_motors = replace(body, armature=armature)
    alone = np.min([1 / np.diag(np.linalg.inv(_mass_matrix(with_motors, posture))) for posture in postures], axis=0)
    kd = np.minimum(kd, 0.35 * topology.control_hz * alone)
    limit = weight + kp * rng.uniform(0.7, 1.2, count)
    return replace(
        with_motors,
        damping=rng.uniform(0.02, 0.12, count) * kd,
        friction=rng.uniform(0.03, 0.12, count) * (0.3 * weight + 0.08 * kp),
        kp=kp,
        kd=kd,
        limit=limit,
    )


def _weights(robot: Robot) -> np.ndarray:
    """Returns a bound on the gravity torque of each joint in Nm."""
    weights = np.zeros(len(robot.joints))
    for number in range(len(weights)):
        at, reach = number, np.linalg.norm(robot.com[number])
        while at >= 0:
            weights[at] += _GRAVITY * robot.mass[number] * reach
            reach += np.linalg.norm(robot.pos[at])
            at = robot.parents[at]
    return weights * np.abs(robot.axis[:, :2]).max(axis=1).clip(0.2)


def _mass_matrix(robot: Robot, bent: np.ndarray) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(mjcf(robot))
    data = mujoco.MjData(model)
    data.qpos[:] = bent
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def mistaken(robot: Robot, error: float, rng: np.random.Generator) -> Robot:
    """Returns the real robot behind a nominal one: each number is off by itself, up or down.

    Args:
      robot: the nominal one.
      error: masses (with inertias), armatures, dampings and frictions are off by exp(0.5 to 1.5 times this), gains by
        exp(0.15 to 0.5 times this), and centres of mass by up to 30 mm times this in each direction (3 mm at 0.1).
      rng: random numbers.
    """

    def off(share: float = 1.0) -> np.ndarray:
        count = len(robot.joints)
        return np.exp(rng.choice([-1, 1], count) * rng.uniform(0.5, 1.5, count) * error * share)

    masses = off()
    return replace(
        robot,
        mass=robot.mass * masses,
        inertia=robot.inertia * masses[:, None, None],
        armature=robot.armature * off(),
        damping=robot.damping * off(),
        friction=robot.friction * off(),
        kp=robot.kp * off(1 / 3),
        kd=robot.kd * off(1 / 3),
        com=robot.com + _OFF_CENTRE_M * error * rng.uniform(-1.0, 1.0, robot.com.shape),
    )


def wandered(robot: Robot, spread: float, rng: np.random.Generator) -> Robot:
    """Returns a robot on another day: dry friction and damping of each joint are multiplied by a factor of their own.

    Args:
      robot: the real one.
      spread: standard deviation of the factors' logarithms.
      rng: random numbers.
    """
    factors = np.exp(spread * rng.normal(size=(2, len(robot.joints))))
    return replace(robot, friction=robot.friction * factors[0], damping=robot.damping * factors[1])


def rounded(robot: Robot) -> Robot:
    """Returns the robot with the digits that its MJCF has, so that file and numbers agree."""
    arrays = {name: value for name, value in vars(robot).items() if isinstance(value, np.ndarray)}
    fields = {
        name: np.array([float(f"{x:.6g}") for x in value.flat]).reshape(value.shape) for name, value in arrays.items()
    }
    fields["axis"] /= np.linalg.norm(fields["axis"], axis=1, keepdims=True)
    return replace(robot, **fields)


def mjcf(robot: Robot) -> str:
    """Writes the robot as an MJCF model with explicit inertias, as a CAD program would export it."""
    children: dict[int, list[int]] = {}
    for number, parent in enumerate(robot.parents):
        children.setdefault(parent, []).append(number)

    def text(values) -> str:
        return " ".join(f"{value:.6g}" for value in values)

    def body(number: int, indent: str) -> str:
        i = robot.inertia[number]
        full = (i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
        span = ' range="-2.8 2.8"' if robot.limited else ""
        inner = "".join(body(child, indent + "  ") for child in children.get(number, ()))
        return (
            f'{indent}<body name="{robot.bodies[number]}" pos="{text(robot.pos[number])}">\n'
            f'{indent}  <inertial pos="{text(robot.com[number])}" mass="{robot.mass[number]:.6g}" '
            f'fullinertia="{text(full)}"/>\n'
            f'{indent}  <joint name="{robot.joints[number]}" axis="{text(robot.axis[number])}"{span} '
            f'armature="{robot.armature[number]:.6g}" damping="{robot.damping[number]:.6g}" '
            f'frictionloss="{robot.friction[number]:.6g}"/>\n{inner}{indent}</body>\n'
        )

    tree = "".join(body(number, "    ") for number in children[-1])
    return (
        '<mujoco model="robot">\n  <compiler angle="radian" autolimits="true"/>\n'
        f'  <option timestep="0.001" gravity="0 0 -{_GRAVITY}"/>\n  <worldbody>\n{tree}  </worldbody>\n</mujoco>\n'
    )
