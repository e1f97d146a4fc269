import mujoco
import numpy as np
import pytest
import reference

from envs.biteno import constants
from jaxtune.mjx import parameters

# kg, and kg m^2 about the centre of mass along the trunk's axes, to the four digits the design gives.
LINKS = {
    "trunk": (8.00, [0.0984, 0.0867, 0.0651]),
    "abductor": (1.20, [0.0014, 0.0015, 0.0014]),
    "thigh": (1.90, [0.0185, 0.0191, 0.0011]),  # the larger about y, along which its motor lies
    "shank": (0.65, [0.0075, 0.0075, 0.0001]),
}
BODIES = ["trunk", *(f"{side}_{link}" for side in constants.SIDES for link in ("abductor", "thigh", "shank"))]


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_path(str(constants.MODEL_PATH))


@pytest.fixture
def home(model):
    """The robot in its home pose, with its contacts."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.keyframe("home").id)
    mujoco.mj_forward(model, data)
    return data


def test_a_free_trunk_and_six_driven_joints(model):
    assert (model.nv, model.nq, model.nu) == (12, 13, 6)
    assert [model.joint(joint).name for joint in range(1, 7)] == list(constants.JOINTS)
    driven = [model.joint(model.actuator(name).trnid[0]).name for name in constants.JOINTS]
    assert driven == list(constants.JOINTS)


def test_it_weighs_what_was_published(model):
    np.testing.assert_allclose(model.body_mass.sum(), 15.5, atol=1e-9)
    # Table I, the task and the robot agree on the standing pose.
    np.testing.assert_array_equal(model.keyframe("home").qpos[7:], constants.STAND_RAD)
    np.testing.assert_array_equal(model.keyframe("home").ctrl, constants.STAND_RAD)


@pytest.mark.parametrize("name", BODIES)
def test_links_have_the_mass_and_inertia_of_the_design(model, name):
    mass, inertia = LINKS[name.split("_")[-1]]
    body = model.body(name)
    np.testing.assert_allclose(body.mass[0], mass, atol=1e-9)
    # MuJoCo stores the principal moments; `iquat` turns them back to the axes of the body.
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, body.iquat)
    turn = turn.reshape(3, 3)
    # Half a unit of the last digit.
    np.testing.assert_allclose(turn @ np.diag(body.inertia) @ turn.T, np.diag(inertia), atol=5e-5)


def test_the_home_pose_stands_on_its_feet(model, home):
    assert home.body("trunk").xpos[2] == constants.HIP_HEIGHT_M == 0.612
    for side, foot in zip(constants.SIDES, constants.FEET, strict=True):
        hip, centre = home.body(f"{side}_abductor").xpos, home.geom(foot).xpos
        np.testing.assert_allclose(centre[:2], hip[:2], atol=1e-9)
        # Two links of 0.31 m, each 0.35 rad off the vertical: 0.62 cos(0.35) = 0.5824 m, less than 1 mm from the
        # 0.582 m that the gait takes for it, and the foot of 0.03 m touches the floor.
        np.testing.assert_allclose(hip[2] - centre[2], 0.5824, atol=5e-5)
        np.testing.assert_allclose(hip[2] - centre[2], constants.STANCE_DEPTH_M, atol=1e-3)
        np.testing.assert_allclose(centre[2] - model.geom(foot).size[0], 0.0, atol=1e-3)
    touching = {frozenset(model.geom(geom).name for geom in contact.geom) for contact in home.contact}
    assert touching == {frozenset(("floor", foot)) for foot in constants.FEET}


def test_nothing_but_the_feet_touches_the_floor(model):
    data = mujoco.MjData(model)
    # On its back, knees folded against each other: every link is in the floor, and the feet are above it.
    data.qpos[:] = [0, 0, 0.05, np.sqrt(0.5), 0, -np.sqrt(0.5), 0, 0.4, -1.4, 2.2, -0.4, -1.4, 2.2]
    mujoco.mj_forward(model, data)
    assert min(data.geom(foot).xpos[2] for foot in constants.FEET) > 0.03
    assert data.ncon == 0


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_foots_friction_rules_the_contact(factor, home, model):
    # The floor's own friction is 1: by the larger of the two, neither 0.3 nor 0.6 would ever act.
    assert model.geom("floor").friction[0] == 1.0
    assert model.geom("left_foot").friction[0] == 0.6
    for foot in constants.FEET:
        model.geom(foot).friction[0] *= factor
    try:
        mujoco.mj_forward(model, home)
        np.testing.assert_allclose([contact.friction[0] for contact in home.contact], [0.6 * factor] * 2)
    finally:
        for foot in constants.FEET:
            model.geom(foot).friction[0] = 0.6


def test_joint_ranges(model):
    ranges = {
        "left_abad": [-0.4, 0.8],
        "right_abad": [-0.8, 0.4],  # mirrored: outwards is negative here
        **{f"{side}_hip": [-1.4, 1.0] for side in constants.SIDES},
        **{f"{side}_knee": [0.1, 2.2] for side in constants.SIDES},
    }
    for name, expected in ranges.items():
        assert model.joint(name).range.tolist() == expected
        assert model.jnt_limited[model.joint(name).id]


def test_positive_abduction_moves_the_left_foot_outwards_and_the_right_foot_inwards(model, home):
    sideways = [home.geom(foot).xpos[1] for foot in constants.FEET]
    home.qpos[[7, 10]] = 0.2
    mujoco.mj_kinematics(model, home)
    # 0.5824 sin(0.2) = 0.1157 m to the left, either of them.
    moved = [home.geom(foot).xpos[1] for foot in constants.FEET]
    np.testing.assert_allclose(np.subtract(moved, sideways), 0.1157, atol=5e-5)


def test_the_controller_is_a_pd_law_with_a_limit(model, home):
    home.qpos[8] += 0.1
    home.qvel[7] = 0.5
    home.ctrl[2] += 10.0
    mujoco.mj_forward(model, home)
    # Left hip: -60 * 0.1 - 2 * 0.5 = -7 Nm. Left knee: 60 * 10 Nm, cut to 60.
    np.testing.assert_allclose(home.actuator_force[:3], [0.0, -7.0, 60.0], atol=1e-9)


def test_parameter_sets_are_rows_of_the_table():
    sets = {name: parameters.select(constants.ENTRIES, names) for name, names in constants.PARAMETER_SETS.items()}
    assert {name: len(entries) for name, entries in sets.items()} == {"legs6": 7, "whole_body": 5}
    # Where every mass of a set doubles, friction and all that the set leaves out stay: 2 x the moving links, and
    # the trunk too in `whole_body`.
    for name, kilograms in (("legs6", 8.0 + 2 * 7.5), ("whole_body", 31.0)):
        doubled = reference.params(**{entry: 2.0 for entry in sets[name] if entry.endswith("_mass")})
        np.testing.assert_allclose(reference.recompiled(doubled).body_mass.sum(), kilograms, atol=1e-6)


def test_the_nominal_robot_lies_within_every_bound():
    for name, value in parameters.nominal(constants.ENTRIES).items():
        low, high = constants.ENTRIES[name].bounds
        assert low <= value < high, name
