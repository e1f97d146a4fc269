"""What is known of BITeno, what is chosen, and the parameters by which its simulation may be wrong.

Public: 15.5 kg, 0.95 m tall, legs of 0.65 m, three joints a leg, a policy at 100 Hz over a joint PD at 1000 Hz, 40
observations, 6 actions and Table I of the paper. Everything else (masses of single links, limits, gains, feet) is a
choice of this project, scaled from the nearest public robot, the point-footed LimX TRON1 (18.6 kg, the same six
joints).
"""

from pathlib import Path

import numpy as np

from jaxtune.mjx import Entry

MODEL_PATH = Path(__file__).parent / "model.xml"

SIDES = ("left", "right")
JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in ("abad", "hip", "knee"))
FEET = tuple(f"{side}_foot" for side in SIDES)

STAND_RAD = np.array([0.0, -0.35, 0.70] * 2)  # [6], each foot under its hip
HIP_HEIGHT_M = 0.612
HIP_Y_M = np.array([0.10, -0.10])  # left, right, from the trunk's middle
LINK_M = 0.31  # thigh and shank alike
STANCE_DEPTH_M = 0.582  # hip axis to the foot's centre: HIP_HEIGHT_M less the foot's radius
FOOT_RADIUS_M = 0.03
POLICY_DT_S = 0.01

CLOCK_HZ = 1.75  # strides a second
DUTY = 0.5  # share of a stride in which a foot is in stance
SWING_HEIGHT_M = 0.08

TABLE_ONE = {
    "linear_tracking": 2.0,
    "angular_tracking": 1.5,
    "linear_velocity_z": -1.25,
    "angular_velocity_xy": -0.1,
    "torque": -5.0e-6,
    "orientation": -10.0,
    "joint_acceleration": -2.0e-7,
    "action_rate": -0.1,
    "joint_default": -0.35,
    "raibert": -1.25,
}
"""Weights of the reward's terms in the paper's Table I (`rewards.terms`); what a policy is scored by."""

WALKING = {**TABLE_ONE, "raibert": -5.0, "action_rate": -0.01}
"""Weights that the policy is trained with. Under Table I alone this robot earns as much by buzzing, 13 touchdowns a
second and foot, as by walking."""

SHAPING = {"clock_contact": -1.0}
"""Weights of training terms beside Table I (`rewards.shaping`). Without them the robot walks, but its feet bounce: one
and a half touchdowns a step."""


def _mass(*bodies: str) -> Entry:
    # A heavier link of the same shape: its inertia grows in proportion to its mass.
    return Entry(kind="body", targets=bodies, fields=("body_mass", "body_inertia"), bounds=(0.2, 5.0))


def _joints(field: str, bounds: tuple[float, float], log: bool = True) -> Entry:
    return Entry(kind="joint", targets=JOINTS, fields=(field,), bounds=bounds, log=log)


ENTRIES = {
    "foot_friction": Entry(kind="geom", targets=FEET, fields=(("geom_friction", 0),), bounds=(0.15, 4.0)),
    **{f"{side}_{link}_mass": _mass(f"{side}_{link}") for side in SIDES for link in ("abductor", "thigh", "shank")},
    **{f"{link}_mass": _mass(f"left_{link}", f"right_{link}") for link in ("abductor", "thigh", "shank")},
    "trunk_mass": _mass("trunk"),
    **{
        f"trunk_com_{axis}_m": Entry(
            kind="body", targets=("trunk",), fields=(("body_ipos", column),), bounds=(-0.08, 0.08), log=False
        )
        for column, axis in enumerate("xyz")
    },
    # Gains and limits alike, so that the torque is a share of the nominal one.
    "torque_scale": Entry(
        kind="actuator",
        targets=JOINTS,
        fields=("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
        bounds=(0.3, 2.0),
    ),
    "joint_damping": _joints("dof_damping", (0.1, 10.0)),
    "joint_friction_nm": _joints("dof_frictionloss", (0.0, 5.0), log=False),
    "joint_armature": _joints("dof_armature", (0.2, 5.0)),
    "contact_time_constant": Entry(kind="geom", targets=FEET, fields=(("geom_solref", 0),), bounds=(0.5, 4.0)),
    # Time for which the joints still follow the previous target.
    "action_delay_s": Entry(kind="control", targets=(), fields=(), bounds=(0.0, POLICY_DT_S), log=False),
}
"""Every parameter that can be tuned, by name. Those whose name ends in a unit are added to the nominal value; the
others multiply it."""

PARAMETER_SETS = {
    # The seven parameters of the paper, in its order.
    "legs6": (
        "foot_friction",
        *(f"{side}_{link}_mass" for side in SIDES for link in ("abductor", "thigh", "shank")),
    ),
    # Left and right tied; it shows the robot's total mass.
    "whole_body": ("foot_friction", "trunk_mass", "abductor_mass", "thigh_mass", "shank_mass"),
}
"""Sets of parameters that are tuned together, by the name that `--parameters` takes."""
