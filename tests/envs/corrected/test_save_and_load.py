"""A corrected model is what it was, once saved and loaded."""

import json

import jax
import mujoco
import numpy as np
import pytest
import rigs

from envs import corrected, models
from envs.biteno import constants
from envs.rig import Rig
from jaxtune.mjx import parameters

WRONG = {
    "link_mass": {"upper": {"ratio": 1.2}},
    "link_inertia": {"lower": {"ratio": 0.8}},
    "com_offset": {"lower": {"x_m": 0.02, "y_m": -0.01}},
    "payload": {"lower": {"kg": 0.2, "x_m": 0.03, "z_m": -0.05}},
    "armature": {"elbow": {"kg_m2": 0.013}},
    "viscous": {"shoulder": {"nm_s_per_rad": 0.11}},
    "coulomb": {"elbow": {"torque_nm": 0.07}},
    "stribeck": {"shoulder": {"torque_nm": 0.1, "speed_rad_s": 0.2, "gaussian": 0.5}},
    "command_delay": {"elbow": {"seconds": 0.0035}},
    "torque_limit": {"shoulder": {"torque_nm": 2.5}},
    "gain_error": {"elbow": {"ratio": 0.9}},
    "backlash": {"elbow": {"rad": 0.01}},
    "compliance": {"shoulder": {"nm_per_rad": 55.0}},
    "encoder_bias": {"elbow": {"rad": 0.01}},
    "drag": {"lower": {"n_s_per_m": 1.5}},
    "joint_spring": {"elbow": {"nm_per_rad": 0.6}},
    "imu_tilt": {"robot": {"pitch_rad": 0.02}},
    "ground_slope": {"robot": {"roll_rad": 0.03, "pitch_rad": -0.05}},
}
IN_THE_MODEL = {
    *("link_mass", "link_inertia", "com_offset", "payload", "armature", "viscous", "coulomb", "joint_spring"),
    "ground_slope",
}


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Op by op, derived fields would take longer than all the rest."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parameters, "set_const", jax.jit(parameters.set_const))
        yield


def save(folder, arm, vector):
    corrected.save(folder, mujoco.MjSpec.from_string(rigs.ARM), arm.rig, vector)
    return json.loads((folder / "effects.json").read_text())


@pytest.fixture(scope="module")
def folder(arm, quick, tmp_path_factory):
    folder = tmp_path_factory.mktemp("corrected")
    save(folder, arm, arm.vector(**WRONG))
    return folder


@pytest.mark.filterwarnings("ignore:.*settotalmass:UserWarning")
@pytest.mark.parametrize("compiler", ['inertiafromgeom="true"', 'settotalmass="5"'])
def test_a_compiler_that_computes_masses_anew_undoes_no_correction(tmp_path, compiler):
    spec = mujoco.MjSpec.from_string(rigs.ARM.replace("<compiler ", f"<compiler {compiler} "))
    arm = rigs.Player(Rig(spec, rigs.ARM_JOINTS, rigs.CONTROL_HZ))
    corrected.save(tmp_path, spec, arm.rig, arm.vector(link_mass={"lower": {"ratio": 1.5}}))
    rig, _ = corrected.load(tmp_path)
    np.testing.assert_allclose(rig.mj_model.body_mass, arm.rig.mj_model.body_mass * [1.0, 1.0, 1.5], rtol=1e-5)


def test_saved_and_loaded_it_moves_the_same(arm, folder):
    rig, vector = corrected.load(folder)
    loaded, start = rigs.Player(rig), np.array([0.5, -0.7])
    # It has rested against gravity: a link that falls within its play meets the motor in a way that rounding decides.
    data = mujoco.MjData(rig.mj_model)
    data.qpos[:] = start
    mujoco.mj_forward(rig.mj_model, data)
    target = np.tile(start + np.array([0.3, 0.5]), (rigs.STEPS, 1))
    target[0] = start + data.qfrc_bias / 12.0
    segment = rigs.segment(arm.rig, start, target, kp=12.0, kd=0.3, limit=3.0)
    got, expected = loaded.read(vector.astype(np.float32), segment), arm.play(segment, **WRONG)
    for name in ("q", "dq", "tau", "gravity"):
        # A file has six digits.
        np.testing.assert_allclose(got[name], expected[name], rtol=1e-4, atol=2e-4, err_msg=name)
    assert np.abs(expected["q"] - arm.play(segment)["q"]).max() > 0.05


def test_what_mujoco_has_a_form_for_is_in_the_mjcf(folder):
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    # 1.2 kg x 1.2, and 0.6 + 0.2, the latter at the end of an arm.
    np.testing.assert_allclose(model.body_mass[1:], [1.44, 0.8], rtol=1e-5)
    np.testing.assert_allclose(model.body("lower").ipos, [0.0275, -0.01, -0.1375], atol=1e-6)
    np.testing.assert_allclose(model.dof_armature, [0.01, 0.023], rtol=1e-5)
    np.testing.assert_allclose(model.dof_damping, [0.16, 0.05], rtol=1e-5)
    np.testing.assert_allclose(model.dof_frictionloss, [0.0, 0.07], rtol=1e-5)
    np.testing.assert_allclose(model.jnt_stiffness, [0.0, 0.6], rtol=1e-5)


def test_the_ground_of_a_robot_that_hung_is_not_in_its_model(tmp_path):
    """Where it walks, the ground is another one; simulated as it hung, it moves as before."""
    spec = models.spec("biteno")
    rig = Rig(spec, constants.JOINTS, 1000.0)
    slope = {"robot": {"roll_rad": 0.03, "pitch_rad": -0.05}}
    corrected.save(tmp_path, spec, rig, rigs.Player(rig).vector(ground_slope=slope))
    loaded, vector = corrected.load(tmp_path)
    np.testing.assert_array_equal(loaded.mj_model.opt.gravity, [0.0, 0.0, -9.81])
    found = {axis.parameter: value for axis, value in zip(loaded.axes, vector, strict=True) if value}
    assert found == pytest.approx(slope["robot"], rel=1e-5)


@pytest.mark.parametrize("turn", ['quat="0.9 0.1 0.3 -0.2"', 'euler="0.3 0.5 -0.7"'])
def test_a_loaded_link_has_the_moments_of_both_whatever_its_axes(tmp_path, turn):
    """A disc, whose moments rounding must not make impossible, in any form of its orientation."""
    disc = f'<inertial pos="0.01 0 -0.1" mass="0.6" diaginertia="0.001 0.001 0.002" {turn}/>'
    text = rigs.ARM.replace('<joint name="elbow"', f'{disc}<joint name="elbow"')
    spec = mujoco.MjSpec.from_string(text)
    rig = Rig(spec, rigs.ARM_JOINTS, rigs.CONTROL_HZ)
    arm, at = np.array([0.1, -0.05, 0.02]), np.array([0.01, 0.0, -0.1])
    for load, reach in ((0.3, arm), (0.3, 0.0 * arm), (0.0, arm)):
        values = {"kg": load} | dict(zip(("x_m", "y_m", "z_m"), reach.tolist(), strict=True))
        corrected.save(tmp_path, spec, rig, rigs.Player(rig).vector(payload={"lower": values}))
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
        about = lambda point: point @ point * np.eye(3) - np.outer(point, point)  # noqa: E731
        whole, centre = 0.6 + load, at + load / (0.6 + load) * reach
        second = tensor(spec.compile(), "lower") + 0.6 * about(at) + load * about(at + reach)
        np.testing.assert_allclose(model.body("lower").ipos, centre, atol=1e-6)
        np.testing.assert_allclose(tensor(model, "lower"), second - whole * about(centre), atol=1e-4 * 0.002)


def tensor(model, name):
    """Inertia of a body about its centre, along the axes of its frame, [3, 3]."""
    turn, body = np.zeros(9), model.body(name)
    mujoco.mju_quat2Mat(turn, body.iquat)
    return turn.reshape(3, 3) * body.inertia @ turn.reshape(3, 3).T


def test_the_rest_is_said_in_its_units(folder):
    said = json.loads((folder / "effects.json").read_text())
    assert (said["joints"], said["control_hz"]) == (["shoulder", "elbow"], 200.0)
    expected = {name: places for name, places in WRONG.items() if name not in IN_THE_MODEL}
    assert said["effects"].keys() == expected.keys()
    for name, places in expected.items():
        assert said["effects"][name].keys() == places.keys()
        for place, values in places.items():
            assert said["effects"][name][place] == pytest.approx(values, rel=1e-5)


def test_a_shape_that_is_its_scale_is_kept(arm, tmp_path):
    # Nothing was fitted to the speed: its coordinate is zero, and it means 0.31 rad/s here.
    stribeck = {"shoulder": {"torque_nm": 0.1, "speed_rad_s": float(rigs.ARM_SCALES["slow"][0])}}
    vector = arm.vector(stribeck=stribeck)
    save(tmp_path, arm, np.where(np.abs(vector) < 1e-6, 0.0, vector))
    rig, loaded = corrected.load(tmp_path)
    values = rig.values(rig.tree(loaded))["stribeck"]
    np.testing.assert_allclose(values["torque_nm"], [0.1, 0.0], rtol=1e-5)
    np.testing.assert_allclose(values["speed_rad_s"][0], 0.31, rtol=1e-5)


def test_a_controller_carries_no_more_of_a_robot_that_is_heavier(tmp_path):
    xml = rigs.ARM.replace('<body name="lower"', '<body name="lower" gravcomp="0.8"')
    spec = mujoco.MjSpec.from_string(xml)
    carried = rigs.Player(Rig(spec, rigs.ARM_JOINTS, rigs.CONTROL_HZ))
    corrected.save(tmp_path, spec, carried.rig, carried.vector(link_mass={"lower": {"ratio": 1.5}}))
    rig, _ = corrected.load(tmp_path)
    np.testing.assert_allclose(rig.mj_model.body_mass[-1], 1.5 * carried.rig.mj_model.body_mass[-1], rtol=1e-5)
    np.testing.assert_allclose(rig.chain.lift.forces, carried.rig.chain.lift.forces, rtol=1e-5)
    assert len(rig.chain.lift.forces) == 1


def test_a_model_without_effects_is_the_nominal_one(arm, tmp_path):
    assert save(tmp_path, arm, arm.vector())["effects"] == {}
    model, nominal = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")), arm.rig.mj_model
    for field in ("body_mass", "body_inertia", "body_ipos", "dof_armature", "dof_damping", "dof_frictionloss"):
        np.testing.assert_allclose(getattr(model, field), getattr(nominal, field), rtol=1e-5, atol=1e-9, err_msg=field)


def test_a_walking_robot_keeps_its_base_and_its_trunk(tmp_path):
    spec = models.spec("biteno")
    rig = Rig(spec, constants.JOINTS, 200.0)
    vector = np.array([float(axis == ("link_mass", "left_thigh")) for axis in names(rig)])
    corrected.save(tmp_path, spec, rig, np.log(1.5) * vector)
    model, nominal = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")), spec.compile()
    assert (model.nq, model.nu) == (nominal.nq, nominal.nu)
    expected = nominal.body_mass.copy()
    expected[nominal.body("left_thigh").id] *= 1.5
    np.testing.assert_allclose(model.body_mass, expected, rtol=1e-5)
    assert corrected.load(tmp_path)[0].bodies == rig.bodies


def names(rig):
    return [(axis.effect, axis.place) for axis in rig.axes]


@pytest.mark.parametrize(
    "effects",
    [
        {"warp": {"elbow": {"rad": 1.0}}},
        {"backlash": {"knee": {"rad": 1.0}}},
        {"backlash": {"elbow": {"seconds": 1.0}}},
    ],
)
def test_what_the_rig_does_not_have_is_named(arm, effects):
    ((effect, places),) = effects.items()
    ((place, values),) = places.items()
    with pytest.raises(ValueError, match=f"got '{next(iter(values))}' of '{effect}' at '{place}'"):
        corrected.coordinates(arm.rig, effects)


def test_coordinates_are_those_that_were_saved(arm):
    np.testing.assert_allclose(corrected.coordinates(arm.rig, WRONG), arm.vector(**WRONG), rtol=1e-6, atol=1e-7)
