"""Motions, hidden robots and scores of the blind benchmark; what the command refuses."""

import json
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from envs.axes import loose
from envs.logs import Controller, read, splits, write
from envs.scales import measure_scales
from envs.segments import noise
from experiments import discover
from experiments.discovery import report
from experiments.discovery.blind_bench import Bench
from experiments.discovery.blind_cases import ARM, SIZE_BOUNDS, SIZES
from experiments.discovery.blind_drive import Truth
from experiments.discovery.blind_robots import OUTSIDE, record
from experiments.discovery.excitation import excitation
from experiments.discovery.hypotheses import forms, hypotheses, place_sets, unknown_directions
from experiments.discovery.measured import drop_useless, read_logs
from experiments.discovery.question import build_question
from jaxtune.discovery.problem import Problem, are_distinct

JOINTS = ("shoulder", "elbow")
GAINS = {"kp": np.array([40.0, 20.0]), "kd": np.array([2.0, 0.8]), "torque_limit_nm": np.array([15.0, 15.0])}
CONTROLLER = Controller(kind="pd", rate_hz=1000.0, gains=GAINS)


@pytest.fixture(scope="module")
def spec():
    return mujoco.MjSpec.from_file(str(ARM))


@pytest.fixture(scope="module")
def motions(spec):
    return excitation(spec, JOINTS, 4, 1.0, 500.0)


def hidden(spec, motions, effect, size, places=("elbow",), **kwargs):
    settings = {"nominal_error": 0.0, "seed": 3, "noise": False} | kwargs
    return record(spec, JOINTS, motions, CONTROLLER, Truth(effect, places, size), **settings)


@pytest.fixture(scope="module")
def plain(spec, motions):
    return hidden(spec, motions, None, 0.0, ())


def test_every_split_has_every_kind_of_motion(motions, plain):
    assert [motion.split for motion in motions] == ["train", "select", "train", "sealed"]
    assert {split: len(runs) for split, runs in splits(plain).items()} == {"train": 2, "select": 1, "sealed": 1}
    for motion in motions:
        assert len(motion.target) == len(motion.time) == len(motion.enabled) == 500
        # 15 % at the end with the motors off.
        assert motion.enabled.sum() == 425
        assert not motion.enabled[-75:].any()
    assert {motion.gain for motion in motions} == {1.0, 0.5}


def test_targets_stay_within_the_joints_ranges(spec):
    for motion in excitation(spec, JOINTS, 8, 3.0, 500.0, seed=4):
        low, high = np.array([[-1.6, 1.6], [-2.0, 2.0]]).T
        assert (motion.target >= low).all()
        assert (motion.target <= high).all()


def test_too_few_runs_to_split_are_refused(spec):
    with pytest.raises(ValueError, match="runs: got 3, expected 4 or more"):
        excitation(spec, JOINTS, 3, 1.0, 500.0)


@pytest.mark.parametrize(
    ("effect", "size"),
    [
        ("coulomb", 0.4),
        ("command_delay", 0.01),
        ("torque_scale", 0.7),
        ("encoder_bias", 0.05),
        ("backlash", 0.05),
        ("com_offset", 0.02),
        ("compliance", 60.0),
        ("cogging", 0.5),
        ("temperature_fade", 0.5),
        ("joint_spring", 2.0),
        ("detent", 3.0),
        ("loose_foot", 0.2),
    ],
)
def test_what_is_hidden_moves_the_robot_and_more_of_it_further(spec, motions, plain, effect, size):
    far = {"torque_scale": 0.4, "compliance": 20.0}.get(effect, 2.0 * size)
    places = ("lower",) if effect == "com_offset" else ("elbow",)
    moved = [
        np.abs(hidden(spec, motions[:1], effect, value, places).runs[0].signals["q"] - plain.runs[0].signals["q"]).max()
        for value in (size, far)
    ]
    assert 1e-3 < moved[0] < moved[1] < 3.0


def test_a_bias_is_in_what_is_read_of_its_joint_alone(spec, motions):
    # With the motors off nothing answers to what is read.
    off = [type(motion)(**{**motion.__dict__, "enabled": np.zeros_like(motion.enabled)}) for motion in motions[:1]]
    difference = (
        hidden(spec, off, "encoder_bias", 0.05).runs[0].signals["q"] - hidden(spec, off, None, 0.0).runs[0].signals["q"]
    )
    np.testing.assert_allclose(difference, np.tile([0.0, 0.05], (500, 1)), atol=1e-9)


def test_readings_are_rounded_and_noisy(spec, motions):
    run = hidden(spec, motions[:1], None, 0.0, (), noise=True).runs[0]
    quantum = 2 * np.pi / 2**14
    np.testing.assert_allclose(run.signals["q"] / quantum, np.round(run.signals["q"] / quantum), atol=1e-6)
    assert noise(run.signals["dq"]) == pytest.approx(0.01, rel=0.3)


@pytest.mark.parametrize(
    ("signal", "said"), [("dq", "dq lags q by 20 ms at elbow"), ("q", "dq is ahead of q by 10 ms at elbow")]
)
def test_a_velocity_that_lags_or_leads_is_left_out_and_said_so(plain, signal, said):
    assert drop_useless(plain)[1] == ()
    # At one joint alone.
    runs, seconds = [], np.array([0.0, 0.02 if signal == "dq" else 0.01])
    for run in plain.runs:
        columns = zip(seconds, run.signals[signal].T, strict=True)
        late = np.stack([np.interp(run.time - behind, run.time, column) for behind, column in columns], axis=1)
        runs.append(replace(run, signals={**run.signals, signal: late}))
    kept, notes = drop_useless(replace(plain, runs=tuple(runs)))
    assert notes == (f"{said}, so one of them was filtered or read late, and dq is not used",)
    assert all("dq" not in run.signals for run in kept.runs)


def test_places_are_each_alone_pairs_and_all():
    assert place_sets(("left_hip", "left_knee", "right_hip", "right_knee")) == [
        ("left_hip",),
        ("left_knee",),
        ("right_hip",),
        ("right_knee",),
        ("left_hip", "right_hip"),
        ("left_knee", "right_knee"),
        ("left_hip", "left_knee", "right_hip", "right_knee"),
    ]
    assert place_sets(JOINTS) == [("shoulder",), ("elbow",), JOINTS]
    assert place_sets(("hinge",)) == [("hinge",)]


def test_a_page_names_all_places_at_once():
    rig = SimpleNamespace(places={"joint": ("hip", "knee"), "body": ("thigh", "shank"), "robot": ("robot",)})
    question = SimpleNamespace(rig=rig)
    assert report.brief_keys(question, "coulomb@hip+knee + link_mass@thigh+shank") == (
        "coulomb@all joints + link_mass@all bodies"
    )
    assert report.place_in_words(question, {"name": "coulomb", "places": ["knee"]}) == "knee"
    assert report.place_in_words(question, {"name": "coulomb", "places": ["hip", "knee"]}) == "all joints"
    assert report.place_in_words(question, {"name": "link_mass", "places": ["shank", "thigh"]}) == "shank, thigh"
    own = {"name": "coulomb", "each": True}
    assert report.place_in_words(question, own | {"places": ["hip", "knee"]}) == "each joint"
    assert report.place_in_words(question, own | {"places": ["hip", "ankle"]}) == "each of hip, ankle"


@pytest.mark.parametrize(
    ("names", "pairs"),
    [
        (("L_hip", "L_knee", "R_hip", "R_knee"), [("L_hip", "R_hip"), ("L_knee", "R_knee")]),
        (("wrist_r", "wrist_l", "neck"), [("wrist_l", "wrist_r")]),
        (("leftKnee", "rightKnee", "neck"), [("leftKnee", "rightKnee")]),
        (("Left_Knee", "Right_Knee", "neck"), [("Left_Knee", "Right_Knee")]),
        (("front_hip", "rear_hip", "neck"), [("front_hip", "rear_hip")]),
        (("roll", "pull", "elbow_flex"), []),
    ],
)
def test_sides_are_words_of_a_name(names, pairs):
    assert place_sets(names) == [*((name,) for name in names), *pairs, names]


@pytest.mark.parametrize(
    "legs",
    [("FL", "FR", "RL", "RR"), ("LF", "RF", "LH", "RH"), ("front_left", "front_right", "rear_left", "rear_right")],
)
def test_legs_are_paired_and_their_joints_grouped_by_kind(legs):
    names = tuple(f"{leg}_{kind}_joint" for leg in legs for kind in ("hip", "calf"))
    hips, calves = names[::2], names[1::2]
    pairs = [one[start : start + 2] for start in (0, 2) for one in (hips, calves)]
    assert place_sets(names) == [*((name,) for name in names), *pairs, hips, calves, names]


def test_a_size_at_two_places_is_the_same_physical_size(spec, plain):
    from envs.rig import Rig

    rig = Rig(spec, JOINTS, 1000.0)
    rig = rig.scaled(measure_scales(rig, plain.runs))
    rows = {name: rig.effects[name] for name in ("coulomb", "torque_limit", "torque_scale")}
    for hypothesis in (one for one in hypotheses(rig.axes, rig.places, rows) if not one.each):
        row = rig.effects[hypothesis.name]
        # A form's parameter is not among its directions.
        parameter, (direction,) = row.parameters[0], hypothesis.directions
        values = [
            float(parameter.value(0.5 * direction[number], rig.scale(row, parameter)[axis.index]))
            for number, axis in enumerate(rig.axes)
            if direction[number]
        ]
        assert len(values) == len(hypothesis.places)
        np.testing.assert_allclose(values, values[0], rtol=1e-5)


def renamed_joints(spec):
    text = spec.to_xml().replace('name="shoulder"', 'name="right_wheel"').replace('name="elbow"', 'name="left_wheel"')
    return mujoco.MjSpec.from_string(text)


def test_what_joints_have_in_sizes_of_their_own_is_tried_so(spec, plain):
    from envs.rig import Rig

    rig = Rig(spec, JOINTS, 1000.0)
    rig = rig.scaled(measure_scales(rig, plain.runs))
    rows = {name: rig.effects[name] for name in ("coulomb", "command_delay")}
    (each,) = [one for one in hypotheses(rig.axes, rig.places, rows) if one.each]
    assert (each.key, each.joints) == ("coulomb@shoulder&elbow", (0, 1))
    alone = {one.key: one for one in hypotheses(rig.axes, rig.places, rows) if len(one.places) == 1}
    for row, place in enumerate(JOINTS):
        one = alone[f"coulomb@{place}"]
        np.testing.assert_array_equal(each.directions[row], one.directions[0])
        np.testing.assert_array_equal(each.bounds[row], one.bounds[0])
        assert np.abs(one.probes).min() == each.probes[row, row]
    # Places are in the order of those with one size, whose forms it has.
    wheels = Rig(renamed_joints(spec), ("right_wheel", "left_wheel"), 1000.0)
    every = [
        one for one in hypotheses(wheels.axes, wheels.places, rows) if len(one.places) == 2 and one.name == "coulomb"
    ]
    assert len({one.places for one in every}) == 1
    assert {one.each for one in every} == {False, True}


def test_a_size_of_slides_is_none_of_hinges(spec):
    from envs.rig import Rig

    gantry = spec.copy()
    gantry.joint(JOINTS[0]).type = mujoco.mjtJoint.mjJNT_SLIDE
    rig = Rig(gantry, JOINTS, 1000.0)
    assert rig.slides == JOINTS[:1]
    rows = {name: rig.effects[name] for name in ("viscous", "command_delay")}
    found = {(one.name, one.places) for one in hypotheses(rig.axes, rig.places, rows, rig.slides) if not one.each}
    alone = {(name, (joint,)) for name in rows for joint in JOINTS}
    # A delay is in seconds at both.
    assert found == alone | {("command_delay", JOINTS)}
    every = hypotheses(rig.axes, rig.places, rows)
    assert {(one.name, one.places) for one in every if not one.each} == alone | {(name, JOINTS) for name in rows}


def test_no_place_loses_more_than_it_has(spec):
    """Armatures of 0.1 and 0.01 at once: coordinates are in the unit of the first."""
    from envs.rig import Rig

    spec = spec.copy()
    for name, armature in zip(JOINTS, (0.1, 0.01), strict=True):
        spec.joint(name).armature = armature
    rig = Rig(spec, JOINTS, 1000.0).scaled({"inertia": np.array([0.25, 0.08])})
    rows = {"armature": rig.effects["armature"]}
    (both,) = [one for one in hypotheses(rig.axes, rig.places, rows) if len(one.places) == 2 and not one.each]
    vector = (both.bounds[:, 0] @ both.directions).astype(np.float32)
    left = np.asarray(rig.model(rig.values(rig.tree(vector))).dof_armature)
    assert (left > 0).all()
    # The elbow may lose all but a hundredth, and the shoulder loses as much.
    np.testing.assert_allclose(left[rig.dof], [0.0901, 0.0001], rtol=1e-3)
    assert (both.probes >= both.bounds[0, 0]).all()


def test_sets_are_tried_at_what_is_of_interest_where_it_acts_most(spec):
    from envs.rig import Rig

    # The elbow's torques are a hundredth of the shoulder's.
    rig = Rig(spec, JOINTS, 1000.0).scaled({"torque": np.array([20.0, 0.2])})
    rows = {name: rig.effects[name] for name in ("coulomb", "torque_limit", "torque_scale")}
    for one in hypotheses(rig.axes, rig.places, rows):
        if not one.each:
            most = np.abs(one.directions[0]).max()
            assert most == pytest.approx(100.0 if (one.name, one.places) == ("coulomb", JOINTS) else 1.0)
            assert np.abs(one.probes[:, 0]).min() * most == pytest.approx(rows[one.name].sizes[0])
            # Sizes do not lie farther apart than those of one place.
            positive = one.probes[one.probes[:, 0] > 0, 0]
            assert (np.diff(np.log(positive)) < np.log(20.0)).all()


def test_a_centre_of_mass_is_tried_near_and_far_in_each_direction(spec):
    # About an upright axis only a far one is felt, since inertia grows with its square.
    from envs.rig import Rig

    rig = Rig(spec, JOINTS, 1000.0)
    for hypothesis in hypotheses(rig.axes, rig.places, {"com_offset": rig.effects["com_offset"]}):
        near, far = hypothesis.probes[:3], hypothesis.probes[3:]
        np.testing.assert_array_equal(near, 0.005 * np.eye(3))
        np.testing.assert_array_equal(far, 0.05 * np.eye(3))


def test_the_travel_of_friction_is_unknown_where_the_model_has_friction(spec):
    from envs.rig import Rig

    spec = spec.copy()
    spec.joint("elbow").frictionloss = 0.1
    rig = Rig(spec, JOINTS, 1000.0)
    directions, bounds = unknown_directions(rig.axes, 1000.0)
    assert directions.shape == (6, len(rig.axes)) and bounds.shape == (6, 2)
    (number,) = np.flatnonzero(directions[5])
    assert (rig.axes[number].effect, rig.axes[number].place) == ("presliding", "elbow")
    assert (bounds[:, 0] == 0).all()
    # When velocities were read is, by one period for all joints, and what lags more is an effect.
    lag, most = unknown_directions(rig.axes, 500.0, ("dq", "q"))
    moved = [rig.axes[number] for number in np.flatnonzero(lag[4])]
    assert [(axis.effect, axis.place) for axis in moved] == [("velocity_lag", joint) for joint in JOINTS]
    np.testing.assert_allclose(lag[4][lag[4] != 0] * most[4, 1], 1.0 / 500.0)
    # A controller may act on velocities that were filtered before they were recorded, unless it is one of ours.
    for follows, longest in ((False, 0.004 + 1.0 / 500.0), (True, 1.0 / 500.0)):
        lag, most = unknown_directions(rig.axes, 500.0, ("dq", "q"), follows, filter_s=0.004)
        (found,) = [row for row in lag if rig.axes[np.flatnonzero(row)[0]].effect == "velocity_lag"]
        np.testing.assert_allclose(found[found != 0] * most[0, 1], longest)
    # The scale of torques is unknown where they are compared.
    more, _ = unknown_directions(rig.axes, 1000.0, ("abs_tau", "q"))
    np.testing.assert_array_equal(more[:6], directions)
    places = [rig.axes[number] for row in more[6:] for number in np.flatnonzero(row)]
    assert [(axis.effect, axis.place) for axis in places] == [("torque_reading", joint) for joint in JOINTS]


@pytest.mark.parametrize(("control_hz", "most"), [(1000.0, 0.5e-3), (500.0, 1e-3), (100.0, 2.5e-3)])
def test_positions_may_lead_by_half_a_step_of_a_simulator(spec, control_hz, most):
    from envs.rig import Rig

    axes = Rig(spec, JOINTS, control_hz).axes
    for signals, names in ((("dq", "q"), ["seconds"]), (("q",), ["seconds", "velocity_seconds"])):
        directions, bounds = unknown_directions(axes, control_hz, signals)
        mine = [row for row in np.arange(len(axes)) if axes[row].effect == "position_lead"]
        (row,) = np.flatnonzero(directions[:, mine].any(axis=1))
        # Velocities that were taken from positions lead as these do.
        assert [axes[number].parameter for number in np.flatnonzero(directions[row])] == names
        np.testing.assert_allclose(directions[row][directions[row] != 0] * bounds[row, 1], most)


def test_centres_of_mass_are_loose_across_their_hinges(spec):
    from envs.rig import Rig

    rig = Rig(spec, JOINTS, 1000.0)
    centres, plain = rig.loose_centres(), unknown_directions(rig.axes, 1000.0)[0]
    directions, bounds = unknown_directions(rig.axes, 1000.0, centres=centres)
    np.testing.assert_array_equal(directions[: len(plain)], plain)
    assert (bounds[len(plain) :] == [-3.0, 3.0]).all()
    shifts = np.concatenate(list(centres.values()))
    axes = [np.cross(*rows) for rows in centres.values()]
    for direction, shift in zip(directions[len(plain) :], shifts, strict=True):
        moved = [rig.axes[number] for number in np.flatnonzero(direction)]
        assert {axis.effect for axis in moved} == {"com_offset"} and len({axis.place for axis in moved}) == 1
        before, after = (rig.model(rig.values(rig.tree(at))).body_ipos for at in (0.0 * direction, direction))
        np.testing.assert_allclose(np.abs(after - before).sum(axis=0), np.abs(shift), atol=1e-7)
    for axis, name in zip(axes, JOINTS, strict=True):
        hinge = rig.mj_model.joint(name).axis
        assert abs(axis @ hinge) == pytest.approx(np.linalg.norm(axis))
    # Of short links a millimetre, of long ones a percent of the radius of gyration.
    assert all(0.000999 < np.linalg.norm(shift) < 0.003 for shift in shifts)
    assert loose(np.ones(1), np.full((1, 3), 2.0 / 3.0))[0] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("kinds", "axes", "count"),
    [
        (("hinge", "hinge"), ("1 0 0", "0 1 0"), 3),
        (("hinge", "hinge"), ("0 0 1", "0 0 -1"), 2),
        (("slide", "hinge"), ("1 0 0", "0 1 0"), 2),
        (("slide", "slide"), ("1 0 0", "0 1 0"), 0),
    ],
)
def test_a_centre_is_loose_in_those_directions_that_its_joints_feel(kinds, axes, count):
    from envs.rig import Rig

    first, last = (
        f'<joint name="{name}" type="{kind}" axis="{axis}"/>'
        f'<inertial pos="0.01 0.02 0.1" mass="1" diaginertia="0.003 0.002 0.001"/>'
        for name, kind, axis in zip("ab", kinds, axes, strict=True)
    )
    bodies = f'<body name="first">{first}<body name="last" pos="0 0.1 0.3" euler="0 0 30">{last}</body></body>'
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    shifts = Rig(spec, ("a", "b"), 1000.0).loose_centres()["last"]
    assert len(shifts) == count

    def torques(shift):
        spec.body("last").ipos = np.array([0.01, 0.02, 0.1]) + shift
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.qacc = [0.4, -0.7], [3.0, 2.0], [20.0, -30.0]
        mujoco.mj_inverse(model, data)
        return data.qfrc_inverse.copy()

    rest = np.linalg.svd(np.vstack([shifts, np.zeros((1, 3))]))[2][count:]
    assert all(np.abs(torques(shift) - torques(0.0)).max() > 1e-3 for shift in shifts)
    assert all(np.abs(torques(0.002 * unfelt) - torques(0.0)).max() < 1e-9 for unfelt in rest)


def test_more_friction_is_a_change_of_the_model_and_stiction_is_missing_in_it(spec):
    from envs.effects import LIBRARY
    from envs.rig import Rig

    spec = spec.copy()
    spec.joint("elbow").frictionloss = 0.1
    rig = Rig(spec, JOINTS, 1000.0)
    every = hypotheses(rig.axes, rig.places, {name: LIBRARY[name] for name in ("coulomb", "stribeck")})
    shapes = {one.key: one for one in forms(rig.axes, rig.effects, every)}
    unknowns, _ = unknown_directions(rig.axes, 1000.0)
    ask = lambda effect, *names: Problem.is_change(  # noqa: E731
        asked, next(one for one in every if one.key == effect), [shapes[name] for name in names]
    )
    asked = SimpleNamespace(prior=np.array([axis.prior_sd for axis in rig.axes]), unknowns=unknowns)
    asked.is_nominal = lambda hypothesis: Problem.is_nominal(asked, hypothesis)
    assert ask("coulomb@elbow")
    assert ask("coulomb@elbow", "coulomb(presliding)@elbow")
    assert not ask("coulomb@elbow", "coulomb(stiction)@elbow")
    assert not ask("coulomb@shoulder")
    assert not ask("stribeck@elbow", "stribeck(sliding)@elbow")


def test_every_form_moves_the_axes_of_its_parameter_at_the_places_of_its_effect(spec):
    from envs.effects import LIBRARY
    from envs.rig import Rig

    rig = Rig(spec, JOINTS, 1000.0)
    every = hypotheses(rig.axes, rig.places, {name: LIBRARY[name] for name in rig.effects if name in LIBRARY})
    found = forms(rig.axes, rig.effects, every)
    assert {(one.name, one.form) for one in found} >= {("coulomb", "presliding"), ("torque_limit", "soft")}
    for one in found:
        parent, *others = [other for other in every if one.shapes(other)]
        assert all(other.each for other in others)
        (mine,) = [form for form in LIBRARY[one.name].forms if form.name == one.form]
        parameters = mine.parameters or [p.name for p in rig.effects[mine.effect].parameters]
        for parameter, direction in zip(parameters, one.directions, strict=True):
            moved = [axis for axis, move in zip(rig.axes, direction, strict=True) if move]
            assert [(axis.effect, axis.parameter) for axis in moved] == [(mine.effect, parameter)] * len(parent.places)
            assert [axis.place for axis in moved] == list(parent.places)
        assert are_distinct(one, parent) and one.key != parent.key
    # Sticking friction that slides is what dry friction is on its own.
    (part,) = [one for one in found if one.key == "stribeck(sliding)@elbow"]
    (whole,) = [one for one in every if one.key == "coulomb@elbow"]
    np.testing.assert_array_equal(part.directions, whole.directions)


@pytest.mark.parametrize(
    ("one", "other"),
    [("sensor_delay", "sensor_lag"), ("command_delay", "torque_lag"), ("coulomb", "stribeck")],
)
def test_two_effects_that_are_forms_of_each_other_may_change_names(spec, one, other):
    from envs.effects import LIBRARY
    from envs.rig import Rig
    from jaxtune.discovery.candidate import Candidate
    from jaxtune.discovery.naming import renamed

    rig = Rig(spec, JOINTS, 1000.0)
    every = hypotheses(rig.axes, rig.places, {name: LIBRARY[name] for name in (one, other)})
    asked = SimpleNamespace(hypotheses=every, forms=forms(rig.axes, rig.effects, every))

    def model(name, size, of_form):
        """A model of an effect at the elbow with the other one as its form."""
        (effect,) = (h for h in every if h.key == f"{name}@elbow")
        twin = next(h for h in every if h.key == f"{other if name == one else one}@elbow")
        (form,) = (f for f in asked.forms if f.shapes(effect) and np.array_equal(f.directions, twin.directions))
        sizes = np.concatenate([np.full(len(effect.directions), size), np.full(len(form.directions), of_form)])
        along = {effect.key: np.arange(len(effect.directions)), form.key: np.arange(len(effect.directions), len(sizes))}
        fit = SimpleNamespace(coordinates=sizes, along=lambda part: along[part.key])
        return Candidate((effect, form), fit, np.zeros(0))

    for name, twin in ((one, other), (other, one)):
        assert [h.key for h in renamed(asked, model(name, 0.02, 0.01)).effects] == [f"{name}@elbow"]
        swapped = renamed(asked, model(name, 0.01, 0.02))
        assert [h.key for h in swapped.effects] == [f"{twin}@elbow"]
        assert sorted(bool(h.form) for h in swapped.hypotheses) == [False, True]


def test_sizes_hide_what_the_library_has_and_what_it_has_not():
    standard = SIZES["standard"]
    assert (len(standard.hidden), standard.empty, len(standard.outside)) == (48, 40, 10)
    assert {name for name, _ in standard.outside} == set(OUTSIDE)
    for severity in (2.0, 5.0, 15.0):
        assert sum(asked == severity for _, asked in standard.hidden) == 16
    assert all(name in SIZE_BOUNDS for name, _ in (*standard.hidden, *standard.outside))
    # An effect is not always as large.
    severities = {name: {asked for other, asked in standard.hidden if other == name} for name, _ in standard.hidden}
    assert min(map(len, severities.values())) > 1


def test_the_learner_reads_a_log_that_says_nothing_of_the_truth(tmp_path, spec, motions):
    bench = Bench(tmp_path, "smoke", seed=0, nominal_error=0.1)
    case = next(case for case in bench.cases if case.effect is None)
    folder = bench.write(case)
    assert json.loads((tmp_path / "sealed" / f"case_{case.number:03d}.json").read_text())["effects"] == []
    log = read(folder)
    assert log.joints == JOINTS
    assert {run.split for run in log.runs} == {"train", "select", "sealed"}
    written = "".join(path.read_text(errors="ignore") for path in folder.iterdir() if path.suffix in (".yaml", ".xml"))
    assert "effect" not in written
    # The robot in the log is the nominal one, not the one that moved.
    assert (folder / "arm.xml").read_text() == ARM.read_text()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": "free"}, "base: got 'free', expected 'fixed'"),
        ({"joints": JOINTS[::-1]}, r"joints: got \('elbow', 'shoulder'\), expected \('shoulder', 'elbow'\)"),
    ],
)
def test_logs_that_do_not_go_together_are_refused(tmp_path, plain, change, message):
    folders = []
    for name, changed in {"one": {}, "two": change}.items():
        folder = tmp_path / name
        write(type(plain)(**{**plain.__dict__, "robot": "arm.xml", **changed}), folder)
        (folder / "arm.xml").write_text(ARM.read_text())
        folders.append(folder)
    with pytest.raises(ValueError, match=message):
        read_logs(tuple(folders))


def test_horizons_that_do_not_rise_are_refused_before_anything_is_computed(tmp_path, plain):
    folder = tmp_path / "log"
    write(type(plain)(**{**plain.__dict__, "robot": "arm.xml"}), folder)
    (folder / "arm.xml").write_text(ARM.read_text())
    for horizons in ((0.1, 0.2), (0.2, 0.1, 0.4), (0.0, 0.1, 0.2)):
        with pytest.raises(ValueError, match="horizons: got"):
            discover.main(discover.Args(logs=(folder,), out=tmp_path / "out", horizons=horizons))
    assert not (tmp_path / "out").exists()


def changed(log, **changes):
    """A log whose last run is otherwise."""
    return replace(log, runs=(*log.runs[:-1], replace(log.runs[-1], **changes)))


def test_logs_that_cannot_be_simulated_are_refused_with_the_run_named(spec, plain):
    last = plain.runs[-1]
    servo = Controller(kind="servo", rate_hz=1000.0, gains=dict.fromkeys(("gain", "kt", "resistance_ohm"), np.ones(2)))
    short = {"time": last.time[:40], "signals": {name: values[:40] for name, values in last.signals.items()}}
    slow = replace(last.controller, rate_hz=500.0)
    for log, message in [
        (changed(plain, controller=slow), "run_003: controller.rate_hz: got 500, expected 1000"),
        (changed(plain, controller=servo), "run_003: column 'volts' is missing"),
        (changed(plain, **short), "run_003: got 0.078 s, expected 0.17 s or more"),
        (replace(plain, joints=("elbow",)), "joints: got a log without shoulder, expected all joints that may move"),
    ]:
        with pytest.raises(ValueError, match=message):
            build_question(log, spec, null_logs=0)
    # A run of a second has one segment of 0.45 s, beside what comes before it.
    with pytest.raises(ValueError, match=r"'train' has 2 segment\(s\) of 0.45 s, expected 3 or more"):
        build_question(plain, spec, null_logs=0)


def test_an_imu_on_a_link_that_moves_is_not_compared(spec):
    log = record(spec, JOINTS, excitation(spec, JOINTS, 4, 1.2, 200.0), CONTROLLER, Truth(None, (), 0.0), 0.0, seed=3)
    level = {run.name: np.tile([0.0, 0.0, -1.0], (len(run.time), 1)) for run in log.runs}
    runs = tuple(replace(run, signals={**run.signals, "gravity": level[run.name]}) for run in log.runs)
    question = build_question(replace(log, runs=runs), spec, (0.05, 0.1, 0.2), null_logs=0)
    assert "gravity is of a link that moves, and is not used" in question.notes
    assert "gravity" not in {signal for signal, _ in question.problem.cells}
