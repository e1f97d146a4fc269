import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from envs.biteno import constants
from jaxtune.mjx import Entry, action_delay, apply, apply_mujoco, check, field, friction, mass, parameters_of, strength
from jaxtune.mjx.parameters import distribution, from_coords

ARM = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" friction="0.6 0.005 0.0001"/>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1.2"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0"/>
        <geom name="tip" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.6"/>
      </body>
    </body>
  </worldbody>
  <contact><pair geom1="floor" geom2="tip" friction="0.9 0.9 0.005 0.0001 0.0001"/></contact>
  <actuator>
    <position joint="shoulder" kp="40" kv="2" forcerange="-10 10"/>
    <motor name="elbow_motor" joint="elbow" gear="3"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def arm():
    return mujoco.MjModel.from_xml_string(ARM)


def changed(arm, row, value):
    table = {"it": row}
    check(mjx.put_model(arm), table)
    return apply_mujoco(arm, {"it": value}, table)


def traced(model, row, value):
    """The same by MJX, compiled: one operation after the other takes longer."""
    table = {"it": row}
    return jax.jit(lambda model, value: apply(model, {"it": value}, table))(mjx.put_model(model), value)


def test_a_heavier_link_has_more_inertia(arm):
    model = changed(arm, mass("lower", bounds=(0.5, 2.0)), 1.5)
    np.testing.assert_allclose(model.body("lower").mass, 0.9)
    np.testing.assert_allclose(model.body("lower").inertia, 1.5 * arm.body("lower").inertia)
    np.testing.assert_allclose(model.body("upper").mass, 1.2)


def test_strength_scales_every_torque_of_motors_and_servos(arm):
    rng = np.random.default_rng(0)
    qpos, qvel, ctrl = rng.normal(0.0, 0.1, (3, 2))

    def torque(model):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_forward(model, data)
        return data.qfrc_actuator.copy()

    weak = changed(arm, strength(("shoulder", "elbow"), bounds=(0.4, 2.0)), 0.7)
    np.testing.assert_allclose(torque(weak), 0.7 * torque(arm))
    np.testing.assert_allclose(weak.actuator_forcerange[0], [-7.0, 7.0])
    np.testing.assert_allclose(
        torque(changed(arm, strength("elbow_motor", bounds=(0.4, 2.0)), 0.7)) / torque(arm), [1, 0.7]
    )


def test_strength_scales_the_limit_of_actuator_force_at_a_joint():
    xml = ARM.replace('name="elbow"', 'name="elbow" actuatorfrcrange="-5 5"').replace(
        'name="shoulder"', 'name="shoulder" actuatorfrcrange="-9 8"'
    )
    model = mujoco.MjModel.from_xml_string(xml)
    row = strength("elbow", bounds=(0.4, 2.0))
    for weak in (changed(model, row, 0.7), traced(model, row, 0.7)):
        np.testing.assert_allclose(weak.jnt_actfrcrange, [[-9.0, 8.0], [-3.5, 3.5]], rtol=1e-6)
    # A torque that the joint cuts: 3 * 4 Nm at the elbow, of 0.7 * 5 that it lets through.
    data = mujoco.MjData(changed(model, row, 0.7))
    data.ctrl[1] = 4.0
    mujoco.mj_forward(changed(model, row, 0.7), data)
    np.testing.assert_allclose(data.qfrc_actuator[1], 3.5)


def test_friction_reaches_geoms_and_contact_pairs(arm):
    model = changed(arm, friction(bounds=(0.3, 3.0)), 0.5)
    np.testing.assert_allclose(model.geom_friction[:, 0], 0.5 * arm.geom_friction[:, 0])
    np.testing.assert_allclose(model.geom_friction[:, 1:], arm.geom_friction[:, 1:])
    np.testing.assert_allclose(model.pair_friction[0], [0.45, 0.45, 0.005, 0.0001, 0.0001])


def test_a_field_may_be_multiplied_or_added_to_and_have_a_column(arm):
    model = changed(arm, field("dof_damping", joints="shoulder", bounds=(0.3, 3.0)), 2.0)
    np.testing.assert_allclose(model.dof_damping, [0.4, 0.0])
    model = changed(arm, field("dof_damping", joints=None, bounds=(0.0, 3.0), offset=True), 0.5)
    np.testing.assert_allclose(model.dof_damping, [0.7, 0.5])
    model = changed(arm, field("body_ipos", bodies=["lower"], column=2, bounds=(-0.1, 0.1), offset=True), 0.02)
    np.testing.assert_allclose(model.body("lower").ipos, [0.0, 0.0, -0.105])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: field("dof_damping", bounds=(0.3, 3.0)),
            "field 'dof_damping': got no targets, expected one of bodies",
        ),
        (lambda: field("dof_damping", links="upper", bounds=(0.3, 3.0)), "got links, expected one of bodies, geoms"),
        (
            lambda: field("dof_damping", joints="a", bodies="b", bounds=(0.3, 3.0)),
            "got joints, bodies, expected one of",
        ),
        (
            lambda: field("dof_damping", bodies="upper", bounds=(0.3, 3.0)),
            "got 'dof_damping', expected fields of a body",
        ),
        (lambda: mass("upper", bounds=(-1.0, 2.0)), r"bounds: got \(-1.0, 2.0\), expected ascending ones, above zero"),
        (lambda: mass("upper", bounds=(0.5, float("inf"))), r"bounds: got \(0.5, inf\), expected ascending ones"),
        (lambda: mass("upper", bounds=0.5), "bounds: got 0.5, expected two numbers"),
        (lambda: mass("upper", bounds=("a", "b")), r"bounds: got \('a', 'b'\), expected two numbers"),
        (lambda: action_delay(bounds_s=(0.0, 0.1, 0.2)), "expected two numbers"),
        (lambda: action_delay(bounds_s=("0", "2")), r"bounds: got \('0', '2'\), expected two numbers"),
        (
            lambda: Entry(kind="body", targets=None, fields=None, bounds=(0.5, 2.0)),
            "fields: got None, expected a tuple",
        ),
        (
            lambda: Entry(kind="body", targets=None, fields=(5,), bounds=(0.5, 2.0)),
            "fields: got 5, expected a name",
        ),
        (
            lambda: Entry(kind="geom", targets=None, fields=(("geom_friction", 0, 1),), bounds=(0.5, 2.0)),
            r"fields: got \('geom_friction', 0, 1\), expected a name",
        ),
        (lambda: mass({"upper", "lower"}, bounds=(0.5, 2.0)), "targets: got {.*}, expected a name, several, or None"),
        (lambda: mass(b"upper", bounds=(0.5, 2.0)), "targets: got b'upper', expected a name"),
        (lambda: mass((), bounds=(0.5, 2.0)), r"targets: got \(\), expected a tuple of names"),
        (
            lambda: Entry(kind="link", targets=None, fields=("body_mass",), bounds=(0.5, 2.0)),
            "kind: got 'link', expected one of body, geom, joint, actuator, control",
        ),
        (
            lambda: Entry(kind="body", targets="upper", fields=("body_mass",), bounds=(0.5, 2.0)),
            "targets: got 'upper', expected a tuple of names",
        ),
        (
            lambda: field("body_invweight0", bodies="upper", bounds=(0.5, 2.0)),
            "fields: got 'body_invweight0', which follows from masses",
        ),
        (lambda: field("geom_friction", geoms="tip", column=0.0, bounds=(0.5, 2.0)), "expected a name, or a name and"),
        (lambda: action_delay(bounds_s=(-0.01, 0.02)), r"bounds_s: got \(-0.01, 0.02\), expected no negative delay"),
    ],
)
def test_a_row_that_makes_no_sense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            mass("forearm", bounds=(0.5, 2.0)),
            "parameter 'it', targets: got body 'forearm', .* some of world, upper, lower$",
        ),
        (
            strength("wrist", bounds=(0.5, 2.0)),
            "targets: got actuator 'wrist', .* some of elbow_motor, shoulder, elbow$",
        ),
        (strength(("elbow", "elbow_motor"), bounds=(0.5, 2.0)), "got elbow, elbow_motor, two of which are the same"),
        (field("geom_condim", geoms="tip", bounds=(0.5, 2.0)), "got 'geom_condim', which holds int"),
        (
            field("body_mass", bodies="lower", bounds=(-5.0, 5.0), offset=True),
            r"bounds: got \(-5.0, 5.0\), which makes body_mass negative; expected at least -",
        ),
        (Entry(kind="body", targets=("lower",), fields=(), bounds=(0.5, 2.0)), "fields: got none, expected at least"),
        (
            field("dof_stiffness", joints=None, bounds=(0.5, 2.0)),
            "fields: got 'dof_stiffness', which mjx.Model does not",
        ),
        (
            field("geom_friction", geoms="tip", column=3, bounds=(0.5, 2.0)),
            "column: got 3 of 'geom_friction', which has 3",
        ),
        (
            field("dof_damping", joints="elbow", bounds=(0.5, 2.0)),
            "dof_damping: zero for elbow, so a multiplier changes",
        ),
        (
            field("dof_frictionloss", joints=None, bounds=(0.0, 2.0), offset=True),
            "MJX solves for dof_frictionloss only in joints that had some",
        ),
    ],
)
def test_a_row_that_cannot_change_the_model_is_refused(arm, row, message):
    with pytest.raises(ValueError, match=message):
        check(mjx.put_model(arm), {"it": row})


def test_a_distribution_spans_bounds_in_coordinates_of_order_one():
    table = {"mass": mass("lower", bounds=(0.5, 2.0)), "delay": action_delay(bounds_s=(0.0, 0.03))}
    dist = distribution(table, 0.4, {"mass": 1.5})
    assert dist.centre["mass"] == pytest.approx(np.log(1.5))
    # Half the width of the delay's bounds is a coordinate of one.
    assert (dist.lower["delay"], dist.centre["delay"], dist.upper["delay"]) == (0.0, 0.0, 2.0)
    assert from_coords(table, {"delay": dist.upper["delay"]})["delay"] == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("centre", "message"),
    [
        ({"mass": 3.0}, "parameter 'mass': got 3.0, expected 0.5 to 2"),
        ({"weight": 1.0}, "got 'weight', expected some of"),
    ],
)
def test_a_centre_that_cannot_be_is_refused(centre, message):
    with pytest.raises(ValueError, match=message):
        distribution({"mass": mass("lower", bounds=(0.5, 2.0))}, 0.4, centre)


def test_a_table_is_proposed_for_any_model(arm):
    table = parameters_of(arm)
    # The elbow has no damping, and no joint has armature or dry friction.
    assert list(table) == ["upper_mass", "lower_mass", "damping", "strength", "friction"]
    assert table["damping"].targets == ("shoulder",)
    check(mjx.put_model(arm), table)


def test_left_and_right_are_tied_in_a_proposed_table():
    model = mujoco.MjModel.from_xml_path(str(constants.MODEL_PATH))
    table = parameters_of(model, control_s=0.01)
    assert table["shank_mass"].targets == ("left_shank", "right_shank")
    assert {"trunk_mass", "abductor_mass", "thigh_mass", "damping", "armature", "strength", "friction"} < table.keys()
    assert table["delay"].bounds == (0.0, 0.02)
    check(mjx.put_model(model), table)


@pytest.mark.parametrize(
    ("names", "stems"),
    [
        (("FL_hip", "FR_hip", "RL_hip", "RR_hip"), ["f_hip", "r_hip"]),
        (("L_knee", "R_knee"), ["knee"]),
        (("knee-left", "knee-right", "torso"), ["knee", "torso"]),
        (("L", "R", "relay"), ["L", "R", "relay"]),
    ],
)
def test_names_of_links_tell_which_belong_together(names, stems):
    links = "".join(
        f'<body name="{name}"><joint axis="0 1 0"/><geom size="0.1" contype="0" conaffinity="0"/></body>'
        for name in names
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{links}</worldbody></mujoco>")
    assert list(parameters_of(model)) == [f"{stem}_mass" for stem in stems]


TENDONS = """
<mujoco>
  <worldbody>
    <site name="s0" pos="0.05 0 1.1"/>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1.2"/>
      <site name="s1" pos="0.05 0 -0.2"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.6"/>
        <site name="s2" pos="0.04 0 -0.1"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="string" limited="true" range="0.1 0.5"><site site="s0"/><site site="s1"/><site site="s2"/></spatial>
    <fixed name="belt" armature="0.02" actuatorfrclimited="true" actuatorfrcrange="-3 3">
      <joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-.5"/>
    </fixed>
  </tendon>
  <actuator>
    {muscle}
    <motor name="puller" tendon="belt" gear="2"/>
    <motor name="turner" joint="shoulder" gear="5"/>
  </actuator>
</mujoco>
"""
MUSCLE = '<muscle name="flexor" tendon="string" lengthrange="0.1 0.6"/>'


@pytest.mark.parametrize("muscle", ["", MUSCLE], ids=["motors", "muscle"])
def test_fields_of_tendons_follow_masses(muscle):
    model = mujoco.MjModel.from_xml_string(TENDONS.format(muscle=muscle))
    row = mass("lower", bounds=(0.2, 5.0))
    found, expected = traced(model, row, 3.0), apply_mujoco(model, {"it": 3.0}, {"it": row})
    for name in ("actuator_acc0", "tendon_invweight0", "dof_M0", "dof_invweight0"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-5, err_msg=name)
    assert (np.asarray(found.actuator_acc0) > 0).all()


def test_strength_scales_the_limit_of_actuator_force_at_a_tendon():
    model = mujoco.MjModel.from_xml_string(TENDONS.format(muscle=""))
    row = strength("puller", bounds=(0.4, 2.0))
    for weak in (changed(model, row, 0.5), traced(model, row, 0.5)):
        np.testing.assert_allclose(weak.tendon_actfrcrange, [[0, 0], [-1.5, 1.5]], rtol=1e-6)
    weak = changed(model, row, 0.5)
    data = mujoco.MjData(weak)
    data.ctrl[:] = 3.8
    mujoco.mj_forward(weak, data)
    np.testing.assert_allclose(data.actuator_force[0], 1.5)


def test_the_strength_of_a_muscle_is_refused():
    model = mujoco.MjModel.from_xml_string(TENDONS.format(muscle=MUSCLE))
    with pytest.raises(ValueError, match="actuator_gainprm of a muscle, whose numbers are not all forces"):
        check(mjx.put_model(model), {"it": strength(None, bounds=(0.4, 2.0))})
    check(mjx.put_model(model), {"it": strength(("puller", "turner"), bounds=(0.4, 2.0))})
    force = field("actuator_gainprm", actuators="flexor", column=2, bounds=(0.4, 2.0))
    check(mjx.put_model(model), {"it": force})
    assert "strength" not in parameters_of(model)


@pytest.mark.parametrize(
    ("name", "text"), [("body_ipos", 'set simple="false"'), ("body_gravcomp", "no body has gravity compensation")]
)
def test_what_the_compiler_left_out_cannot_be_changed(name, text):
    xml = """<mujoco><worldbody><body name="drone" {}><freejoint/><geom type="box" size=".2 .1 .05" mass="1"/></body>
      </worldbody></mujoco>"""
    column = {"column": 0} if name == "body_ipos" else {}
    table = {"it": field(name, bodies="drone", offset=True, bounds=(-0.1, 1.0), **column)}
    with pytest.raises(ValueError, match=text):
        check(mjx.put_model(mujoco.MjModel.from_xml_string(xml.format(""))), table)
    check(mjx.put_model(mujoco.MjModel.from_xml_string(xml.format('simple="false" gravcomp="1e-9"'))), table)
