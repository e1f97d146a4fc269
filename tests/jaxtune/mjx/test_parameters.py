import copy
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import reference
from mujoco import mjx

from envs.biteno import constants
from envs.biteno.constants import ENTRIES
from jaxtune.mjx import derived_fields, parameters

# Single precision reaches 2e-6 in inverse weights and 2e-7 in masses (double precision 4e-15 in either).
RTOL = 1e-5

SETS = {**constants.PARAMETER_SETS, "everything": tuple(ENTRIES)}

# Compiled from the geometry and read by the viewer alone; the trunk's box travels with its mass where it is moved.
NOT_PHYSICS = (".stat.meanmass", ".stat.meansize", ".stat.extent", ".stat.center", ".geom_pos", ".light_poscom0")

# Every kind of joint, branches, a body welded to another and one welded to the world.
GENERAL = """
<mujoco>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="wall" pos="0 0 1"><geom size="0.1" mass="3"/></body>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3" pos="0.02 0.03 0.01" euler="20 10 5" mass="2"/>
      <body name="arm" pos="0 0.2 0.1" euler="30 0 40">
        <joint name="arm" type="ball" armature="0.02"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0.1 0.2 -0.3" mass="1"/>
        <body name="hand" pos="0.1 0.2 -0.3"><geom type="box" size="0.05 0.1 0.02" pos="0.05 0 0" mass="0.5"/></body>
      </body>
    </body>
    <body name="sled" pos="1 0 0">
      <joint name="sled" type="slide" axis="1 0 0" armature="0.1"/>
      <geom type="box" size="0.1 0.1 0.2" mass="0.7"/>
      <body name="wheel" pos="0 0 0.2">
        <joint name="wheel" axis="0 1 0"/>
        <geom type="cylinder" size="0.1 0.02" zaxis="0 1 0" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="sled" joint="sled" gear="2"/>
    <motor name="wheel" joint="wheel"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def set_const():
    return jax.jit(derived_fields.set_const)


def assert_fields(model, expected):
    for name in reference.FIELDS:
        np.testing.assert_allclose(getattr(model, name), getattr(expected, name), rtol=RTOL, err_msg=name)


def floats(model):
    """Every array of numbers in a model, by path."""
    return {
        jax.tree_util.keystr(path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(model)
        if np.issubdtype(np.asarray(leaf).dtype, np.floating)
    }


def assert_models(model, expected):
    got, expected = floats(model), floats(expected)
    assert got.keys() == expected.keys()
    for path in got:
        if path not in NOT_PHYSICS:
            np.testing.assert_allclose(got[path], expected[path], rtol=RTOL, atol=1e-7, err_msg=path)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("names", SETS.values(), ids=SETS)
def test_parameters_applied_are_the_model_recompiled(apply, names, seed):
    values = reference.draw(np.random.default_rng(seed), names)
    model, expected = apply(values), reference.recompiled(values)
    assert_fields(model, expected)
    np.testing.assert_allclose(model.stat.meaninertia, expected.stat.meaninertia, rtol=RTOL)
    # Nothing else may have moved, or been forgotten.
    assert_models(model, mjx.put_model(expected))


@pytest.mark.parametrize("name", [name for name, entry in ENTRIES.items() if entry.kind != "control"])
def test_each_parameter_alone_is_the_model_recompiled(apply, name):
    # Alone, so that no other hides it: every row of the table moves the model, and moves it where it should.
    values = reference.params(**{name: 1.7 if ENTRIES[name].log else 0.05})
    model = apply(values)
    assert_fields(model, reference.recompiled(values))
    nominal = floats(apply(reference.params()))
    assert any(np.any(leaf != nominal[path]) for path, leaf in floats(model).items())


@pytest.mark.parametrize("seed", range(3))
def test_derived_fields_are_those_of_mj_setconst(apply, robot, seed):
    values = reference.draw(np.random.default_rng(10 + seed), SETS["legs6"])
    model = copy.copy(robot.mj_model)
    for name, value in values.items():
        if name.endswith("_mass"):
            for body in ENTRIES[name].targets:
                model.body(body).mass *= value
                model.body(body).inertia *= value
    for foot in constants.FEET:
        model.geom(foot).friction[0] *= values["foot_friction"]
    # It leaves the mean inertia to the compiler.
    mujoco.mj_setConst(model, mujoco.MjData(model))
    assert_fields(apply(values), model)


def test_nominal_values_leave_the_model_as_it_is(apply, robot):
    model = mjx.put_model(robot.mj_model)
    assert_fields(apply(reference.params()), robot.mj_model)
    assert_models(apply(reference.params()), model)


def test_what_twice_the_trunk_weighs(apply):
    model = apply(reference.params(trunk_mass=2.0))
    # 15.5 + 8 kg, carried by the world and by the trunk, and felt by each axis of the free joint.
    np.testing.assert_allclose(model.body_subtreemass[:2], 23.5, rtol=1e-6)
    np.testing.assert_allclose(model.dof_M0[:3], 23.5, rtol=1e-6)
    # 8 (0.12^2 + 0.15^2) / 3 = 0.0984 kg m^2, twice.
    np.testing.assert_allclose(model.body_inertia[1, 0], 0.1968, rtol=1e-6)
    # A leg does not hear of it: 1.2 + 1.9 + 0.65 kg.
    np.testing.assert_allclose(model.body_subtreemass[2], 3.75, rtol=1e-6)


def test_derived_fields_of_every_kind_of_joint(set_const):
    spec = mujoco.MjSpec.from_string(GENERAL)
    stale = spec.compile()
    # As after a change of mass: what was derived for the old one must not survive.
    for name, factor in (("base", 0.4), ("arm", 3.0), ("hand", 2.0), ("sled", 1.5), ("wheel", 0.6)):
        for geom in spec.body(name).geoms:
            geom.mass *= factor
    expected = spec.compile()
    model = mjx.put_model(stale).replace(
        body_mass=jnp.asarray(expected.body_mass, jnp.float32),
        body_inertia=jnp.asarray(expected.body_inertia, jnp.float32),
    )
    assert np.any(np.abs(stale.dof_invweight0 / expected.dof_invweight0 - 1) > 0.1)
    got = set_const(model)
    for name in ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "actuator_acc0"):
        # What cannot turn has no weight in MuJoCo, and 1e-15 here.
        np.testing.assert_allclose(getattr(got, name), getattr(expected, name), rtol=RTOL, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(got.stat.meaninertia, expected.stat.meaninertia, rtol=RTOL)


def test_a_model_of_another_implementation_is_refused():
    # Warp needs a GPU, so only its name is here.
    with pytest.raises(ValueError, match=r"impl: got 'warp', expected 'jax'; .*config_overrides"):
        derived_fields.set_const(SimpleNamespace(impl=mjx.Impl.WARP))


def test_without_jit_and_without_the_rest_of_the_table_it_is_the_same(apply, robot, set_const, monkeypatch):
    # Op by op, this one function would take longer than all others; see the slow test of the environment.
    monkeypatch.setattr(parameters, "set_const", set_const)
    values = {"foot_friction": 0.5, "left_thigh_mass": 1.5, "trunk_com_x_m": 0.03, "torque_scale": 0.8}
    # Each of them a number, as a report would write it; what is left out stays nominal.
    assert_models(robot.model(values), apply(reference.params(**values)))


def test_models_of_a_batch_are_those_of_a_loop(apply, robot):
    rng = np.random.default_rng(20)
    draws = [reference.draw(rng, ENTRIES) for _ in range(3)]
    batch = {name: np.stack([values[name] for values in draws]) for name in ENTRIES}

    def changed(values):
        model = robot.model(values)
        return {name: getattr(model, name) for name in reference.FIELDS}

    models = jax.jit(jax.vmap(changed))(batch)
    for row, values in enumerate(draws):
        alone = apply(values)
        for name in reference.FIELDS:
            np.testing.assert_allclose(models[name][row], getattr(alone, name), rtol=RTOL, err_msg=name)


def test_rows_are_found_by_name(robot):
    model = robot.mj_model

    def rows(name):
        return ENTRIES[name].rows(model, ENTRIES[name].field_names[0])[0]

    # A joint's row is its degree of freedom, and the first six are the trunk's.
    assert rows("joint_damping").tolist() == [6, 7, 8, 9, 10, 11]
    assert [model.body(row).name for row in rows("shank_mass")] == ["left_shank", "right_shank"]
    assert [model.geom(row).name for row in rows("foot_friction")] == ["left_foot", "right_foot"]


def entry(**fields):
    return parameters.Entry(**{"kind": "joint", "targets": ("arm",), "bounds": (0.5, 2.0), **fields})


@pytest.fixture(scope="module")
def general():
    model = mujoco.MjModel.from_xml_string(GENERAL)
    # Joints are the base's, the arm's, the sled's and the wheel's, with 6, 3, 1 and 1 degrees of freedom.
    model.jnt_stiffness[:] = [0.0, 3.0, 5.0, 7.0]
    model.dof_damping[6:] = [0.3, 0.3, 0.3, 0.5, 0.7]
    # The sled's motor as a position servo: kp 40, kv 2.
    model.actuator_gainprm[0, :3] = [40.0, 0.0, 0.0]
    model.actuator_biasprm[0, :3] = [0.0, -40.0, -2.0]
    return model


def traced(model, table, **params):
    """The model changed in MJX."""
    return jax.jit(lambda params: parameters.apply(mjx.put_model(model), params, table))(params)


def both(model, table, **params):
    """The model changed in MJX, and in MuJoCo C."""
    return traced(model, table, **params), parameters.apply_mujoco(model, params, table)


def test_fields_of_a_joint_have_rows_by_joint_or_by_degree_of_freedom(general):
    table = {
        "spring": entry(targets=("sled",), fields=("jnt_stiffness",)),
        "damping": entry(targets=("wheel", "arm"), fields=("dof_damping",)),
    }
    for model in both(general, table, spring=2.0, damping=2.0):
        np.testing.assert_allclose(model.jnt_stiffness, [0.0, 3.0, 10.0, 7.0])
        np.testing.assert_allclose(model.dof_damping, [0.0] * 6 + [0.6] * 3 + [0.5, 1.4], rtol=1e-6)


def test_one_value_per_target_reaches_all_degrees_of_freedom_of_its_joint(general):
    table = {"damping": entry(targets=("wheel", "arm"), fields=("dof_damping",), bounds=(0.1, 9.0))}
    model = traced(general, table, damping=jnp.array([10.0, 3.0]))
    np.testing.assert_allclose(model.dof_damping, [0.0] * 6 + [0.9] * 3 + [0.5, 7.0], rtol=1e-6)


def test_without_targets_all_objects_of_the_kind_are_meant(general):
    table = {"mass": entry(kind="body", targets=None, fields=("body_mass",))}
    for model in both(general, table, mass=2.0):
        np.testing.assert_allclose(model.body_mass, 2.0 * general.body_mass, rtol=1e-6)


def test_an_actuator_may_be_named_by_its_joint():
    xml = GENERAL.replace("""<motor name="wheel" joint="wheel"/>""", """<motor joint="wheel"/><motor joint="wheel"/>""")
    model = mujoco.MjModel.from_xml_string(xml)
    table = {"strength": entry(kind="actuator", targets=("wheel", "sled"), fields=("actuator_gainprm",))}
    changed = traced(model, table, strength=jnp.array([0.5, 0.7]))
    np.testing.assert_allclose(changed.actuator_gainprm[:, 0], [0.7, 0.5, 0.5], rtol=1e-6)


def test_friction_of_contact_pairs_is_that_of_their_geoms():
    geoms = "".join(
        f'<body pos="0 0 {height}"><freejoint/><geom name="{name}" size="0.1"/></body>'
        for height, name in enumerate("abc")
    )
    pairs = '<pair geom1="a" geom2="b"/><pair geom1="b" geom2="c"/><pair geom1="a" geom2="c" friction="2 2 1 1 1"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody><contact>{pairs}</contact></mujoco>")
    fields = (("pair_friction", 0), ("pair_friction", 1))
    for changed in both(model, {"it": entry(kind="geom", targets=("c",), fields=fields)}, it=0.5):
        # MuJoCo sorts them: a-b, a-c, b-c.
        np.testing.assert_allclose(changed.pair_friction[:, :3], [[1, 1, 0.005], [1, 1, 1], [0.5, 0.5, 0.005]])


def test_the_stiffness_of_a_position_servo_is_in_two_columns(general):
    fields = (("actuator_gainprm", 0), ("actuator_biasprm", 1))
    table = {"kp": entry(kind="actuator", targets=("sled",), fields=fields)}
    for model in both(general, table, kp=1.5):
        # 1.5 * 40 on the target and on the position; the damping of 2 stays.
        np.testing.assert_allclose(model.actuator_gainprm[0, :3], [60.0, 0.0, 0.0])
        np.testing.assert_allclose(model.actuator_biasprm[0, :3], [0.0, -60.0, -2.0])
        np.testing.assert_allclose(model.actuator_gainprm[1, 0], 1.0)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"targets": ("arm", "")}, r"targets: got \('arm', ''\), expected distinct names"),
        ({"targets": ("arm", "arm")}, "expected distinct names"),
        ({"fields": ("geom_friction",)}, r"fields: got 'geom_friction', expected .* begin with jnt_ or dof_"),
        ({"kind": "body", "fields": (("dof_damping", 0),)}, "got 'dof_damping', expected fields of a body"),
        ({"kind": "control", "fields": ("body_mass",)}, "got 'body_mass', expected none"),
        ({"bounds": (2.0, 0.5)}, r"bounds: got \(2.0, 0.5\), expected ascending ones, above zero"),
        ({"bounds": (0.0, 2.0)}, "above zero for a multiplier"),
        ({"bounds": (1.0, -1.0), "log": False}, r"got \(1.0, -1.0\), expected ascending ones$"),
    ],
)
def test_a_row_that_cannot_be_right_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        entry(**{"fields": (), **fields})


def test_an_offset_may_be_negative():
    assert entry(fields=(), bounds=(-1.0, 0.0), log=False).bounds == (-1.0, 0.0)


def test_applying_an_unknown_parameter_names_it(robot):
    with pytest.raises(ValueError, match="parameters: got 'trunk_weight'"):
        robot.model({"trunk_weight": 1.0})


def test_select_takes_rows_in_the_order_of_the_names():
    names = ("trunk_mass", "foot_friction")
    assert tuple(parameters.select(ENTRIES, names)) == names


def test_an_unknown_parameter_is_named():
    with pytest.raises(ValueError, match="got 'trunk_weight', expected some of foot_friction, "):
        parameters.select(ENTRIES, ["trunk_mass", "trunk_weight"])


@pytest.mark.parametrize(("kind", "target"), [("body", "tail"), ("geom", "trunk_geom"), ("joint", "tail")])
def test_an_entry_for_an_object_that_is_not_there_is_named(robot, kind, target):
    missing = entry(kind=kind, targets=(target,), fields=())
    with pytest.raises(ValueError, match=f"targets: got {kind} '{target}', which the model does not have; expected"):
        missing.ids(robot.mj_model)


def test_applying_a_row_whose_target_is_missing_names_the_parameter(robot):
    table = {"tail_mass": entry(kind="body", targets=("tail",), fields=("body_mass",))}
    with pytest.raises(ValueError, match=r"parameter 'tail_mass', targets: got body 'tail', .* some of world, trunk, "):
        parameters.apply_mujoco(robot.mj_model, {"tail_mass": 1.0}, table)


def test_coordinates_are_logarithms_of_multipliers_and_offsets_in_half_widths_of_their_bounds():
    params = {"trunk_mass": jnp.float32(2.0), "trunk_com_x_m": jnp.float32(-0.03)}
    coords = parameters.to_coords(ENTRIES, params)
    # log 2 = 0.693147
    np.testing.assert_allclose(coords["trunk_mass"], 0.693147, rtol=1e-6)
    # Its bounds are -0.08 and 0.08 m.
    np.testing.assert_allclose(coords["trunk_com_x_m"], -0.375, rtol=1e-6)


def test_coordinates_and_back():
    params = reference.draw(np.random.default_rng(30), ENTRIES)
    back = parameters.from_coords(ENTRIES, parameters.to_coords(ENTRIES, params))
    assert back.keys() == params.keys()
    for name, value in params.items():
        np.testing.assert_allclose(back[name], value, rtol=1e-6, err_msg=name)


def test_the_nominal_robot_is_the_origin():
    coords = parameters.to_coords(ENTRIES, reference.params())
    assert len(coords) == len(ENTRIES)
    assert all(value == 0.0 for value in coords.values())
