"""MuJoCo C, the engine that BITeno in MJX is compared with, and random parameters and states to compare at."""

import mujoco
import numpy as np

from envs.biteno import constants
from jaxtune.mjx import parameters

# Compared at a relative 1e-5: what `mj_setConst` derives, and what it derives it from.
FIELDS = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "dof_armature",
    "dof_damping",
    "dof_frictionloss",
    "actuator_acc0",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
    "geom_friction",
    "geom_solref",
)


def params(**values):
    """Every parameter of the table, nominal but for those named; one structure, so one trace."""
    return {name: np.float32(value) for name, value in {**parameters.nominal(constants.ENTRIES), **values}.items()}


def draw(rng, names, share=1.0):
    """Random values of the named parameters, the rest nominal; `share` of the way from nominal to the bounds."""
    values = {}
    for name in names:
        entry = constants.ENTRIES[name]
        low, high = np.log(entry.bounds) if entry.log else entry.bounds
        coordinate = share * rng.uniform(low, high)
        values[name] = np.exp(coordinate) if entry.log else coordinate
    return params(**values)


def recompiled(values):
    """The MJCF with these parameters written into it and compiled, by no means that `jaxtune.mjx` uses."""
    spec = mujoco.MjSpec.from_file(str(constants.MODEL_PATH))
    for side in constants.SIDES:
        for link in ("abductor", "thigh", "shank"):
            # Geometries give a body mass and inertia alike.
            for geom in spec.body(f"{side}_{link}").geoms:
                geom.mass *= float(values[f"{side}_{link}_mass"]) * float(values[f"{link}_mass"])
    (trunk,) = spec.body("trunk").geoms
    trunk.mass *= float(values["trunk_mass"])
    # The trunk's only geometry touches nothing, so where it stands is where the mass is.
    trunk.pos = trunk.pos + [float(values[f"trunk_com_{axis}_m"]) for axis in "xyz"]
    for name in constants.FEET:
        foot = spec.geom(name)
        foot.friction[0] *= float(values["foot_friction"])
        foot.solref[0] *= float(values["contact_time_constant"])
    for name in constants.JOINTS:
        joint = spec.joint(name)
        joint.armature *= float(values["joint_armature"])
        joint.damping[0] *= float(values["joint_damping"])
        # The robot of the whole table has a trace of friction in its joints, so that MJX solves for it.
        joint.frictionloss = 1e-6 + float(values["joint_friction_nm"])
        actuator, scale = spec.actuator(name), float(values["torque_scale"])
        actuator.gainprm = actuator.gainprm * scale
        actuator.biasprm = actuator.biasprm * scale
        actuator.forcerange = actuator.forcerange * scale
    return spec.compile()


def random_state(rng, model, clearance_m):
    """Positions and velocities of a tilted, moving robot whose lower foot is this far above the floor."""
    data = mujoco.MjData(model)
    qpos = model.keyframe("home").qpos.copy()
    lower, upper = model.jnt_range[1:].T
    qpos[7:] = np.clip(qpos[7:] + rng.uniform(-0.3, 0.3, 6), lower, upper)
    axis = rng.normal(size=3)
    mujoco.mju_axisAngle2Quat(qpos[3:7], axis / np.linalg.norm(axis), rng.uniform(0.0, 0.25))
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    lowest = min(data.geom(foot).xpos[2] - model.geom(foot).size[0] for foot in constants.FEET)
    qpos[2] += clearance_m - lowest
    qvel = rng.uniform(-1.0, 1.0, model.nv) * np.array([0.5] * 3 + [1.0] * 3 + [3.0] * 6)
    return qpos.astype(np.float32), qvel.astype(np.float32)
