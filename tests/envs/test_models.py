"""Models of robots: from several files into one, and nothing switched off unnoticed."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from mujoco import mjx
from PIL import Image

from envs import models, stepping
from envs.null_logs import Robot
from envs.rig import Rig

BOX = """v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
f 1 3 2
f 1 4 3
f 5 6 7
f 5 7 8
f 1 2 6
f 1 6 5
f 2 3 7
f 2 7 6
f 3 4 8
f 3 8 7
f 4 1 5
f 4 5 8
"""
LEG = """<mujocoinclude>
  <body name="leg" pos="0 0 -0.2">
    <joint name="knee" axis="0 1 0" damping="0.1" frictionloss="0.2"/>
    <geom type="mesh" mesh="box" pos="0 0 -0.1" mass="0.7" material="grey"/>
    <geom type="sphere" size="0.02" pos="0 0 -0.2" mass="0.1"/>
  </body>
</mujocoinclude>"""
ROBOT = """<mujoco>
  <compiler meshdir="assets" {compiler}/>
  <option>{option}</option>
  <asset>
    <mesh name="box" file="box.obj" scale="0.02 0.03 0.1"/>
    <texture name="skin" type="2d" file="skin.png"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0 0 0" rgb2="1 1 1" width="8" height="8"/>
    <material name="grey" rgba="0.5 0.5 0.5 1" texture="skin"/>
  </asset>
  <worldbody>
    <geom type="mesh" mesh="box"/>
    <body name="thigh">
      <inertial mass="1" pos="0 0 -0.1" diaginertia="0.01 0.02 0.03"/>
      <joint name="hip" axis="0 1 0"/>
      <geom type="mesh" mesh="box" contype="0" conaffinity="0"/>
      <body name="motor" pos="0.1 0 0">
        <inertial mass="9" pos="0 0 0" diaginertia="0.09 0.09 0.09"/>
        <geom size="0.03"/>
      </body>
      <include file="parts/leg.xml"/>
    </body>
  </worldbody>
  <actuator><position joint="hip" kp="3"/></actuator>
</mujoco>"""


@pytest.fixture
def robot(tmp_path):
    def put(option="", compiler=""):
        for folder in ("assets", "parts"):
            (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / "assets" / "box.obj").write_text(BOX)
        Image.new("RGB", (4, 4)).save(tmp_path / "skin.png")
        (tmp_path / "parts" / "leg.xml").write_text(LEG)
        path = tmp_path / "robot.xml"
        path.write_text(ROBOT.format(option=option, compiler=compiler))
        return path

    return put


@pytest.mark.parametrize("compiler", ["", 'inertiafromgeom="true"', 'discardvisual="true"', 'balanceinertia="true"'])
def test_one_file_moves_as_many_did(robot, tmp_path, compiler):
    path = robot(compiler=compiler)
    exact = mujoco.MjModel.from_xml_path(str(path))
    spec = models.spec(str(path))
    spec.compile()
    saved = tmp_path / "elsewhere" / "saved.xml"
    saved.parent.mkdir()
    saved.write_text(spec.to_xml())
    model = mujoco.MjModel.from_xml_path(str(saved))
    assert (model.nmesh, model.ntex) == (0, min(exact.ntex, 1))
    for field in ("body_mass", "body_inertia", "body_ipos", "dof_damping", "dof_frictionloss"):
        np.testing.assert_allclose(getattr(model, field), getattr(exact, field), rtol=1e-4, atol=1e-7, err_msg=field)
    found = []
    for one in (exact, model):
        one.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data = mujoco.MjData(one)
        data.qpos[:] = [0.5, -0.4]
        mujoco.mj_step(one, data, 300)
        found.append(data.qpos.copy())
    np.testing.assert_allclose(*found, atol=1e-4)


def test_contact_pairs_and_sensors_of_meshes_go_with_them(robot, tmp_path):
    path = robot()
    text = path.read_text().replace('<geom type="mesh" mesh="box"/>', '<geom name="shell" type="mesh" mesh="box"/>')
    text = text.replace('<geom size="0.03"/>', '<geom name="ball" size="0.03"/><geom name="second" size="0.02"/>')
    more = """
      <contact>
        <pair geom1="shell" geom2="ball"/>
        <pair geom1="second" geom2="ball"/>
        <exclude body1="thigh" body2="leg"/>
      </contact>
      <sensor>
        <framepos objtype="geom" objname="shell"/>
        <framepos objtype="geom" objname="ball" reftype="geom" refname="shell"/>
        <framepos objtype="geom" objname="ball"/>
        <distance geom1="ball" geom2="shell" cutoff="1"/>
        <jointpos joint="hip"/>
      </sensor>
    </mujoco>"""
    path.write_text(text.replace("</mujoco>", more))
    mujoco.MjModel.from_xml_path(str(path))
    spec = models.spec(str(path))
    model = spec.compile()
    assert (model.nmesh, model.npair, model.nexclude, model.nsensor) == (0, 1, 1, 2)
    (tmp_path / "saved.xml").write_text(spec.to_xml())
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "saved.xml")).npair == 1


ARM = """<mujoco>
  <compiler {compiler}/>
  <option {option}><flag {flag}/></option>
  <worldbody>
    <body name="upper" gravcomp="{gravcomp}">
      <joint name="shoulder" axis="0 1 0" armature="0.01" actuatorgravcomp="true"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1.2"/>
      <body {name} pos="0 0 -0.3" gravcomp="{gravcomp}">
        <joint name="elbow" axis="0 1 0" armature="0.01"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.6"/>
        <body name="tool" pos="0 0 -0.25"><geom size="0.03" mass="0.4"/><site name="tip"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
  <sensor><touch site="tip"/></sensor>
  <keyframe><key qpos="0.1 0.2"/></keyframe>
</mujoco>"""


@pytest.fixture
def arm(tmp_path):
    def put(**changed):
        plain = {"compiler": "", "option": "", "flag": 'contact="disable"', "gravcomp": 0, "name": 'name="lower"'}
        (tmp_path / "arm.xml").write_text(ARM.format(**{**plain, "actuator": "", **changed}))
        return models.spec(str(tmp_path / "arm.xml"))

    return put


@pytest.mark.filterwarnings("ignore:.*settotalmass:UserWarning")
@pytest.mark.parametrize("compiler", ['inertiafromgeom="true"', 'settotalmass="5"', 'fusestatic="true"'])
def test_inertias_that_a_compiler_would_compute_anew_are_written_out(arm, compiler):
    spec = arm(compiler=compiler)
    masses = np.array([0.0, 1.2, 0.6, 0.4])
    model = spec.compile()
    np.testing.assert_allclose(model.body_mass, masses * (5.0 / 2.2 if "total" in compiler else 1.0), rtol=1e-6)
    spec = arm(compiler=compiler)
    spec.body("lower").mass *= 1.5
    assert spec.copy().compile().body_mass[2] == pytest.approx(1.5 * model.body_mass[2])
    again = mujoco.MjModel.from_xml_string(spec.to_xml())
    assert again.body_mass[2] == pytest.approx(1.5 * model.body_mass[2], rel=1e-5)


@pytest.mark.parametrize(
    "changed",
    [
        {"flag": 'energy="enable"'},
        {"flag": 'fwdinv="enable"'},
        {"option": 'integrator="implicit"'},
        {"option": 'solver="PGS" noslip_iterations="3"'},
        {"actuator": '<adhesion body="tool" ctrlrange="0 1"/>'},
    ],
    ids=str,
)
def test_what_a_rig_does_not_need_is_no_obstacle(arm, changed):
    found, plain = (Rig(arm(**options), ("shoulder", "elbow"), 500.0) for options in (changed, {}))
    assert found.layout[:5] == plain.layout[:5]


def test_gravity_is_compensated_though_actuators_are_switched_off(arm):
    model = models.suspended(arm(gravcomp=1))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    data = mujoco.MjData(model)
    data.qpos[:] = 1.0, 0.5
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_passive, data.qfrc_gravcomp, atol=1e-9)
    assert np.abs(data.qfrc_gravcomp).min() > 0.1


def test_a_body_without_a_name_is_called_after_its_joint(arm):
    assert Rig(arm(name=""), ("shoulder", "elbow"), 500.0).bodies == ("upper", "elbow_link", "tool")


def test_a_mesh_that_is_missing_is_named(robot):
    path = robot()
    (path.parent / "assets" / "box.obj").unlink()
    with pytest.raises(ValueError, match=r"robot: .*robot\.xml: .*box\.obj"):
        models.spec(str(path))


@pytest.mark.parametrize("name", ["constraint", "frictionloss", "limit", "damper", "gravity"])
def test_flags_that_switch_physics_off_are_named_or_cleared(robot, name):
    spec = models.spec(str(robot(option=f'<flag {name}="disable" contact="disable"/>')))
    with pytest.raises(ValueError, match=rf"got {name} disabled, .*--clear-flags"):
        models.check_flags(spec)
    assert models.check_flags(spec, clear=True) == (name,)
    assert models.check_flags(spec) == ()
    # What does no harm stays.
    assert models.suspended(spec).opt.disableflags == mujoco.mjtDisableBit.mjDSBL_CONTACT


def test_built_in_robots_have_nothing_switched_off():
    for name in models.BUILT_IN:
        assert models.check_flags(models.spec(name)) == ()


def test_shapes_whose_contacts_mjx_lacks_hang_on_a_rig():
    """Published robots have cylinders beside boxes, and pairs of geoms of their own; nothing touches on a rig."""
    spec = mujoco.MjSpec.from_string("""<mujoco>
      <worldbody>
        <geom type="box" size="0.1 0.1 0.1" pos="0 0 0.5"/>
        <body name="hand" mocap="true"><geom size="0.01" mass="1"/></body>
        <body name="thigh">
          <joint name="hip" axis="0 1 0"/>
          <geom name="rod" type="cylinder" size="0.02 0.1" mass="1"/>
          <body name="foot" pos="0 0 -0.2"><geom name="ball" size="0.03" mass="0.06"/></body>
          <body name="tool" pos="0 0 -0.2"><geom size="0.03" mass="0.2" contype="0" conaffinity="0"/></body>
        </body>
        <body name="block" pos="1 0 0">
          <joint name="turn" axis="0 1 0"/>
          <geom name="cube" type="box" size="0.1 0.1 0.1" mass="2"/>
        </body>
      </worldbody>
      <contact><pair geom1="rod" geom2="cube"/></contact>
    </mujoco>""")
    rig = Rig(spec, ("hip", "turn"), 500.0)
    # Neither the foot, a sixteenth of the link that it is fixed to, nor what a simulation moves without a joint.
    assert rig.bodies == ("thigh", "tool", "block")


@pytest.mark.parametrize("moments", [[1 / 30, 1 / 30, 2 / 30 + 1e-8], [1e-7, 0.1, 0.1], [1e-6, 0.1, 0.1 + 1e-8]])
def test_a_disc_or_a_rod_may_be_rounded(tmp_path, moments):
    spec = mujoco.MjSpec.from_string('<mujoco><worldbody><body name="disc"><freejoint/></body></worldbody></mujoco>')
    # A third of one and a third of the other are two thirds, but not in single precision, nor in six digits.
    moments = np.float32(moments)
    model = SimpleNamespace(body_mass=[0.7], body_ipos=[np.zeros(3)], body_iquat=[[1, 0, 0, 0]], body_inertia=[moments])
    models.write_inertia(spec.body("disc"), model, 0)
    spec.compile()
    (tmp_path / "disc.xml").write_text(spec.to_xml())
    read = mujoco.MjModel.from_xml_path(str(tmp_path / "disc.xml"))
    np.testing.assert_allclose(np.sort(read.body_inertia[1]), moments, rtol=5e-5, atol=3e-6)


GEARED = """<mujoco><worldbody><body name="link"><joint name="hinge" axis="0 1 0" armature="0.01" damping="0.1"/>
  <geom size="0.05" pos="0.2 0 0" mass="1"/></body></worldbody>
  <actuator><motor joint="hinge" gear="50" armature="1e-4" damping="2e-4"/></actuator></mujoco>"""


def test_a_suspended_robot_keeps_the_rotors_of_its_actuators():
    spec = mujoco.MjSpec.from_string(GEARED)
    whole, hung = spec.compile(), models.suspended(spec)
    for model in (whole, hung):
        data = mujoco.MjData(model)
        data.qvel[:] = 1.0
        mujoco.mj_forward(model, data)
        assert data.M[0] == pytest.approx(0.01 + 2500 * 1e-4 + 0.04 + 0.4 * 0.05**2, rel=1e-6)
        assert data.qfrc_passive[0] == pytest.approx(-0.1 - 2500 * 2e-4, rel=1e-6)
    assert spec.actuators[0].armature == 1e-4


def test_a_rotor_that_is_no_joints_is_refused():
    tendon = '<tendon><fixed name="belt"><joint joint="hinge" coef="1"/></fixed></tendon>'
    xml = GEARED.replace('joint="hinge" gear', 'name="winch" tendon="belt" gear').replace(
        "</mujoco>", f"{tendon}</mujoco>"
    )
    with pytest.raises(
        ValueError, match="actuator 'winch': got an armature or damping, expected them on a joint alone"
    ):
        models.suspended(mujoco.MjSpec.from_string(xml))


def test_springs_that_mjx_lacks_are_refused():
    spec = mujoco.MjSpec.from_string(GEARED.replace('damping="0.1"', 'stiffness="2 0 30"'))
    with pytest.raises(ValueError, match=r"springs or dampers of several terms \(jnt_stiffnesspoly\)"):
        Rig(spec, ("hinge",), 200.0)


def test_a_turntable_may_have_its_weight_beside_its_axis():
    # The compiler would leave out what its inertia matrix does not have, and MuJoCo refuse another centre of mass.
    joints = '<joint name="x" type="slide" axis="1 0 0"/><joint name="turn"/>'
    disc = f'<body name="disc">{joints}<geom type="cylinder" size="0.2 0.02" mass="2"/></body>'
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{disc}</worldbody></mujoco>")
    drawn = Robot.drawn(spec, ("x", "turn"), np.random.default_rng(0)).model
    rig = Rig(spec, ("x", "turn"), 200.0)
    assert np.abs(drawn.body_ipos[1]).max() > 1e-4
    values = rig.tree(np.array([0.1 * (axis.effect == "com_offset" and axis.parameter == "y_m") for axis in rig.axes]))
    model = rig.model(rig.values(values))
    inertia = mjx.full_m(model, stepping.placed(model, mjx.make_data(model)))
    assert abs(inertia[0, 1]) == pytest.approx(2 * float(model.body_ipos[1, 1]), rel=1e-4)
