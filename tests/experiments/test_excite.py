"""What `excite` writes: motions within limits, one model file that needs no other, and errors that name the option."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.csv
import pytest
import yaml

from envs import models
from envs.logs import Controller, read, write
from experiments import excite
from experiments.discovery.blind_cases import ARM
from experiments.discovery.excitation import deciding, excitation
from experiments.discovery.target_runs import MOTIONS, scaled

JOINTS = ("shoulder", "elbow")
LEG = """<mujoco model="leg">
  <compiler meshdir="shapes" {}/>
  <include file="assets.xml"/>
  <worldbody>
    <body name="thigh">
      <joint name="hip" axis="0 1 0" range="-1 1" limited="true" armature="0.01"/>
      <geom name="shell" type="mesh" mesh="shape" material="grey" density="500"/>
      <body name="shin" pos="0 0 -0.4">
        <joint name="knee" axis="0 1 0" range="-2 0" limited="true"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/>
        <geom type="mesh" mesh="shape" density="100"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
ASSETS = """<mujoco><asset>
  <mesh name="shape" file="shape.obj"/><material name="grey" rgba=".5 .5 .5 1"/>
</asset></mujoco>"""
WEDGE = """v 0 0 0\nv 0.1 0 0\nv 0 0.05 0\nv 0 0 -0.4\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"""


@pytest.fixture(scope="module")
def spec():
    return models.spec(str(ARM))


def leg(folder, compiler=""):
    (folder / "shapes").mkdir()
    (folder / "shapes" / "shape.obj").write_text(WEDGE)
    (folder / "assets.xml").write_text(ASSETS)
    (folder / "leg.xml").write_text(LEG.format(compiler))
    return folder / "leg.xml"


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_stays_within_limits_and_can_be_split(spec, motion):
    runs = excitation(spec, JOINTS, 4, 2.0, 200.0, seed=1, motion=motion)
    low, high = np.array([[-1.6, 1.6], [-2.0, 2.0]]).T
    assert [run.split for run in runs] == ["train", "select", "train", "sealed"]
    assert len({run.condition for run in runs}) == 4
    for run in runs:
        assert run.target.shape == (400, 2)
        assert ((run.target >= low) & (run.target <= high)).all()
        assert run.enabled.any()


def test_narrow_joints_stay_within_their_limits(spec):
    text = ARM.read_text().replace("-2.0 2.0", "0.1 0.16")
    for motion in MOTIONS:
        for run in excitation(mujoco.MjSpec.from_string(text), JOINTS, 4, 2.0, 200.0, motion=motion):
            assert 0.1 <= run.target[:, 1].min() <= run.target[:, 1].max() <= 0.16


def test_motions_do_what_they_are_named_after(spec):
    def of(name):
        return excitation(spec, JOINTS, 4, 3.0, 200.0, motion=name)[0]

    fast = {name: np.abs(np.diff(of(name).target, axis=0)).max() * 200.0 for name in ("slow_triangles", "holds")}
    assert max(fast.values()) < 5.0  # rad/s: no step, which would be 200 a second
    size = {name: np.ptp(of(name).target, axis=0).max() for name in ("small_steps", "large_steps")}
    assert size["large_steps"] == pytest.approx(4 * size["small_steps"])
    assert {of("chirp").gain, of("soft_chirp").gain} == {1.0, 0.5}
    assert of("swing").enabled.mean() == pytest.approx(0.3)
    # Two postures, each held for a third of the run.
    assert [len(np.unique(of("holds").target[rows], axis=0)) for rows in (slice(0, 195), slice(405, 600))] == [1, 1]


def test_the_motion_with_the_largest_score_is_chosen(spec):
    def speed(motion):
        return float(np.mean([np.abs(np.diff(run.target, axis=0)).mean() for run in motion]))

    slow = deciding(spec, JOINTS, lambda motion: -speed(motion), seconds=2.0, rate_hz=200.0)
    assert slow.name == "holds"
    assert set(slow.scores) == set(MOTIONS) - {"medley", "powered_medley"}
    quick = deciding(spec, JOINTS, speed, seconds=2.0, rate_hz=200.0)
    assert quick.scores[quick.name] == max(quick.scores.values())
    assert quick.name in ("chirp", "soft_chirp", "large_steps")


def test_scores_that_are_no_numbers_decide_nothing(spec):
    chosen = deciding(spec, JOINTS, lambda motion: 1.0 if motion[0].enabled.min() == 0 else np.nan, seconds=2.0)
    assert chosen.name == "swing"
    assert deciding(spec, JOINTS, lambda motion: np.inf, seconds=2.0) is None


def test_the_command_writes_the_motion_that_was_chosen(tmp_path, spec):
    chosen = deciding(spec, JOINTS, lambda motion: motion[0].gain == motion[1].gain == 0.5, seconds=2.0)
    excite.main(excite.Args(out=tmp_path / "log", robot=str(ARM), runs=4, seconds=2.0, motion=chosen.name))
    log = read(tmp_path / "log", measured=False)
    for run, wanted in zip(log.runs, chosen.motion, strict=True):
        np.testing.assert_allclose(run.signals["target"], wanted.target)
        assert run.controller.gains["kp"] == pytest.approx(30.0)
    assert (tmp_path / "log" / "arm.xml").read_text() == ARM.read_text()


def test_targets_for_the_robot_of_a_log_have_its_model_joints_and_controller(tmp_path):
    excite.main(excite.Args(out=tmp_path / "targets", robot=str(ARM), seconds=2.0, kp=(33.0,), control_hz=500.0))
    log = read(tmp_path / "targets", measured=False)
    order = JOINTS[::-1]
    runs = [replace(run, signals={"q": run.signals["target"], **run.signals}) for run in log.runs]
    write(replace(log, runs=tuple(runs), joints=order), tmp_path / "measured")
    assert (tmp_path / "measured" / "arm.xml").read_text() == ARM.read_text()
    excite.main(excite.Args(out=tmp_path / "next", like=tmp_path / "measured", motion="chirp", seconds=2.0))
    following = read(tmp_path / "next", measured=False)
    assert following.joints == order
    assert following.runs[0].controller.rate_hz == 500.0
    np.testing.assert_allclose(following.runs[0].controller.gains["kp"], 33.0)
    assert (tmp_path / "next" / "arm.xml").read_text() == ARM.read_text()


def test_targets_for_the_robot_of_a_log_have_its_units_and_signs(tmp_path):
    """A robot plays numbers: an elbow that its log counts backwards must not get mirrored ones."""
    options = {"motion": "chirp", "seconds": 2.0}
    excite.main(excite.Args(out=tmp_path / "plain", robot=str(ARM), **options))
    log = read(tmp_path / "plain", measured=False)
    runs = [replace(run, signals={"q": run.signals["target"], **run.signals}) for run in log.runs]
    write(replace(log, runs=tuple(runs)), tmp_path / "measured")
    said = {"units": {"angle": "deg"}, "sign": {"elbow": -1}}
    meta = yaml.safe_load((tmp_path / "measured" / "meta.yaml").read_text())
    (tmp_path / "measured" / "meta.yaml").write_text(yaml.safe_dump(meta | said))
    excite.main(excite.Args(out=tmp_path / "next", like=tmp_path / "measured", **options))
    written = yaml.safe_load((tmp_path / "next" / "meta.yaml").read_text())
    assert {key: written[key] for key in said} == said
    # Targets of the same motion, once in the model's convention and once in the log's.
    names = [f"target.{joint}" for joint in JOINTS]
    plain, own = (pyarrow.csv.read_csv(tmp_path / name / "run_000.csv") for name in ("plain", "next"))
    for name, factor in zip(names, (180 / np.pi, -180 / np.pi), strict=True):
        np.testing.assert_allclose(own[name], factor * plain[name].to_numpy(), atol=1e-9)
    again = read(tmp_path / "next", measured=False)
    np.testing.assert_allclose(again.runs[0].signals["target"], log.runs[0].signals["target"], atol=1e-9)


@pytest.mark.parametrize("compiler", ["", 'inertiafromgeom="true"'])
def test_a_model_of_several_files_becomes_one_with_the_same_masses(tmp_path, compiler):
    path = leg(tmp_path, compiler)
    excite.main(excite.Args(out=tmp_path / "log", robot=str(path), runs=4, seconds=1.0))
    before = mujoco.MjModel.from_xml_path(str(path))
    for needed in ("assets.xml", "leg.xml", "shapes/shape.obj"):
        (tmp_path / needed).unlink()
    after = mujoco.MjModel.from_xml_path(str(tmp_path / "log" / "leg.xml"))
    assert after.nmesh == 0
    assert [after.joint(i).name for i in range(after.njnt)] == ["hip", "knee"]
    for name in ("body_mass", "body_inertia", "body_ipos", "jnt_range", "dof_armature"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=1e-4, atol=1e-8)
    # Whatever the order of the axes of inertia, the same motion needs the same torques.
    torques = []
    for model in (before, after):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.qacc[:] = (0.3, -0.7), (1.0, 2.0), (5.0, -3.0)
        mujoco.mj_inverse(model, data)
        torques.append(data.qfrc_inverse.copy())
    np.testing.assert_allclose(*torques, rtol=1e-4)
    assert read(tmp_path / "log", measured=False).joints == ("hip", "knee")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kd": (2.0, -1.0)}, r"kd: got -1, expected 0 to 1e\+06"),
        ({"seconds": 1e9}, r"seconds: got 1e\+09, expected more than 0 and at most 3600"),
        ({"rate_hz": float("inf")}, "rate_hz: got inf, expected more than 0 and at most 100000"),
        ({"kd": (float("nan"),)}, "kd: got nan"),
        ({"kp": (0.0,)}, "kp: got 0, expected more than 0 and at most"),
        ({"kp": (60.0, 50.0, 40.0)}, "kp: got 3 values, expected one, or 2: shoulder, elbow"),
        (
            {"kp": (1e5,), "kd": (1e4,), "torque_limit_nm": (1e5,)},
            "kp, kd: got gains with which the simulated robot flies apart",
        ),
        ({"max_speed": 0.0}, "max_speed: got 0, expected more than 0"),
        ({"joints": ("elbow", "wrist")}, "joints: got elbow, wrist, expected some of elbow, shoulder, each once"),
        ({"joints": ("elbow", "elbow")}, "joints: got elbow, elbow, expected some of elbow, shoulder, each once"),
        ({"joints": ("elbow",)}, "joints: got none of shoulder, expected all that may move"),
        ({"seconds": float("inf")}, "seconds: got inf"),
        ({"rate_hz": -5.0}, "rate_hz: got -5,"),
        ({"control_hz": 0.0}, "control_hz: got 0,"),
        ({"torque_limit_nm": (-1.0,)}, "torque_limit_nm: got -1,"),
        ({"runs": 3}, "runs: got 3, expected 4 or more"),
        ({"seed": -1}, "seed: got -1, expected a number that is not negative"),
        ({"motion": "dance"}, "motion: got 'dance', expected one of medley, powered_medley, slow_triangles"),
        ({"seconds": 0.01}, "seconds: got 0.01 s at 500 rows a second, expected 10 rows"),
        ({"robot": "nobody.xml"}, "robot: got 'nobody.xml'"),
        ({"like": ARM.parent, "kp": (200.0,)}, r"kp: got \(200.0,\) and like, expected one of the two"),
    ],
)
def test_options_that_are_wrong_are_named(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        excite.main(replace(excite.Args(out=tmp_path / "log", robot=str(ARM)), **change))
    assert not (tmp_path / "log").exists()


def test_a_folder_that_is_not_empty_is_left_as_it_is(tmp_path):
    (tmp_path / "mine").write_text("")
    with pytest.raises(ValueError, match="out: got"):
        excite.main(excite.Args(out=tmp_path, robot=str(ARM)))
    assert [path.name for path in Path(tmp_path).iterdir()] == ["mine"]


def test_a_slide_joint_needs_a_range():
    text = """<mujoco><worldbody>
      <body><joint name="rail" type="slide" {}/><geom size="0.1"/></body>
    </worldbody></mujoco>"""
    with pytest.raises(ValueError, match="slide joint 'rail' has no range, expected one in the MJCF, in m"):
        excitation(mujoco.MjSpec.from_string(text.format("")), ("rail",), 4, 2.0, 100.0)
    spec = mujoco.MjSpec.from_string(text.format('range="-0.1 0.3" limited="true"'))
    for motion in excitation(spec, ("rail",), 4, 2.0, 100.0):
        assert -0.1 <= motion.target.min() < motion.target.max() <= 0.3


def test_half_the_gain_of_a_servo_is_half_of_its_gain():
    gains = {"gain": np.array([4.0]), "kt": np.array([0.5]), "resistance_ohm": np.array([2.0])}
    found = scaled(Controller(kind="servo", rate_hz=500.0, gains=gains), 0.5).gains
    assert (found["gain"], found["kt"], found["resistance_ohm"]) == (2.0, 0.5, 2.0)


TABLE = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="upper" pos="0 0 0.3">
      <joint name="shoulder" axis="0 1 0" range="-1.4 1.4" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" range="-1.4 1.4" limited="true"/>
        <geom type="capsule" fromto="0 0 0 {} 0 0" size="0.02"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize(("motion", "seconds"), [("medley", 2.0), ("large_steps", 30.0), ("holds", 2.0)])
def test_targets_do_not_go_through_a_table(motion, seconds):
    spec = mujoco.MjSpec.from_string(TABLE.format(0.25))
    model, runs = spec.compile(), excitation(spec, JOINTS, 4, seconds, 200.0, seed=0, motion=motion)
    data = mujoco.MjData(model)
    for run in runs:
        for row in run.target[::7]:
            data.qpos[:] = row
            mujoco.mj_fwdPosition(model, data)
            assert data.contact.dist.min(initial=0.0) > -0.02
    # It is the table that keeps the arm up.
    (without,) = [one for one in spec.geoms if one.type == mujoco.mjtGeom.mjGEOM_PLANE]
    without.contype = without.conaffinity = 0
    free = excitation(spec, JOINTS, 4, seconds, 200.0, seed=0, motion=motion)
    assert max(run.target[:, 0].max() for run in free) > max(run.target[:, 0].max() for run in runs)


def test_a_robot_that_touches_wherever_it_moves_is_named(tmp_path):
    # A forearm of 3 m that points down, 50 mm above a table.
    low = TABLE.format(3.0).replace('pos="0 0 0.3"', 'pos="0 0 0.05"').replace("-1.4 1.4", "0.2 1.4")
    (tmp_path / "low.xml").write_text(low)
    with pytest.raises(ValueError, match="at last lower and world in targets: narrow the joints' ranges"):
        excite.main(excite.Args(out=tmp_path / "log", robot=str(tmp_path / "low.xml"), seconds=2.0))
    assert not (tmp_path / "log").exists()
    assert deciding(models.spec(str(tmp_path / "low.xml")), JOINTS, lambda motion: 1.0, seconds=2.0) is None


def deepest_touch(model, joints, positions, ignored=()):
    """How far bodies go into each other at positions [rows, joints], in m; negative."""
    data, deepest = mujoco.MjData(model), 0.0
    columns = [int(model.joint(name).qposadr[0]) for name in joints]
    for row in positions:
        data.qpos[columns] = row
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact:
            if not {model.body(body).name for body in model.geom_bodyid[contact.geom]} & set(ignored):
                deepest = min(deepest, contact.dist)
    return deepest


def played(run, model, joints):
    """Positions to which targets lead a robot, by a simulation of the test's own in MuJoCo C."""
    gains, rows, data = run.controller.gains, (run.time * 1000).round().astype(int), mujoco.MjData(model)
    data.qpos[:], positions = run.signals["target"][0], []
    for step in range(rows[-1]):
        row = np.searchsorted(rows, step, side="right") - 1
        torque = gains["kp"] * (run.signals["target"][row] - data.qpos) - gains["kd"] * data.qvel
        limit = gains["torque_limit_nm"] * run.signals["enabled"][row]
        data.qfrc_applied[:] = np.clip(torque, -limit, limit)
        positions.append(data.qpos.copy())
        mujoco.mj_step(model, data)
    return np.array(positions)


def test_an_arm_whose_motors_are_off_does_not_fall_onto_a_table(tmp_path):
    (tmp_path / "arm.xml").write_text(TABLE.format(0.25).replace('pos="0 0 0.3"', 'pos="0 0 0.45"'))
    spec = models.spec(str(tmp_path / "arm.xml"))
    model, rig = spec.compile(), models.suspended(spec)
    rig.opt.timestep = 0.001
    gains = {"kp": (200.0,), "kd": (8.0,), "seconds": 2.0, "runs": 4}
    excite.main(excite.Args(out=tmp_path / "log", robot=str(tmp_path / "arm.xml"), **gains))
    log = read(tmp_path / "log", measured=False)
    for run in log.runs:
        assert deepest_touch(model, JOINTS, played(run, rig, JOINTS)[::10]) > -0.01
    # Targets alone do not tell.
    blind = excitation(spec, JOINTS, 4, 2.0, 500.0)
    falls = [
        replace(run, signals={"target": one.target, "enabled": one.enabled})
        for run, one in zip(log.runs, blind, strict=True)
    ]
    assert min(deepest_touch(model, JOINTS, played(run, rig, JOINTS)[::10]) for run in falls) < -0.03


def test_a_robot_on_a_free_base_does_not_strike_itself():
    text = """<mujoco>
      <compiler angle="radian"/>
      <worldbody>
        <geom type="plane" size="2 2 0.1"/>
        <body name="trunk" pos="0 0 0.1"><freejoint/><geom size="0.02"/>
          <body name="shield" pos="0 0 -0.25"><geom size="0.05" pos="0.16 0 0"/>
            <geom size="0.05" pos="-0.16 0 0"/></body>
          <body name="thigh"><joint name="hip" axis="0 1 0" range="-1 1" limited="true"/><geom size="0.01"/>
            <body name="shin"><joint name="knee" axis="0 1 0" range="-0.2 0.2" limited="true"/>
              <geom type="capsule" fromto="0 0 -0.05 0 0 -0.3" size="0.02"/></body></body>
        </body>
      </worldbody>
    </mujoco>"""
    spec, joints = mujoco.MjSpec.from_string(text), ("hip", "knee")
    ignored = ("world",)  # where a rig holds the base is not known
    reached = [np.concatenate([one.target for one in excitation(spec, joints, 4, 2.0, 200.0)])]
    shield = next(body for body in spec.bodies if body.name == "shield")
    spec.delete(shield)
    reached.append(np.concatenate([one.target for one in excitation(spec, joints, 4, 2.0, 200.0)]))
    whole = mujoco.MjSpec.from_string(text).compile()
    kept, free = (deepest_touch(whole, joints, positions[::5], ignored) for positions in reached)
    assert free < -0.02 < -0.005 < kept


def test_the_medley_with_motors_on_has_no_swing(spec):
    for run in excitation(spec, JOINTS, 4, 3.0, 200.0, motion="powered_medley"):
        assert run.enabled.all()


def test_targets_are_as_slow_as_a_robot_must_be(tmp_path):
    excite.main(excite.Args(out=tmp_path / "log", robot=str(ARM), seconds=2.0, max_speed=1.5))
    for run in read(tmp_path / "log", measured=False).runs:
        speed = np.abs(np.diff(run.signals["target"], axis=0)) * 500.0
        assert 1.4 < speed.max() <= 1.5 + 1e-6


def test_joints_are_chosen_and_have_gains_of_their_own(tmp_path):
    excite.main(
        excite.Args(out=tmp_path / "log", robot=str(ARM), seconds=2.0, joints=("elbow", "shoulder"), kp=(20.0, 70.0))
    )
    log = read(tmp_path / "log", measured=False)
    assert log.joints == ("elbow", "shoulder")
    np.testing.assert_allclose(log.runs[0].controller.gains["kp"], [20.0, 70.0])
    np.testing.assert_allclose(log.runs[0].controller.gains["kd"], [2.0, 2.0])


def like(tmp_path, kp, **options):
    """Targets for the robot of a log whose controller has these gains."""
    excite.main(excite.Args(out=tmp_path / "targets", robot=str(ARM), seconds=2.0))
    log = read(tmp_path / "targets", measured=False)
    gains = {"kp": np.array(kp), "kd": np.array([2.0, 0.5]), "torque_limit_nm": np.array([9.0, 9.0])}
    controller = Controller(kind="pd", rate_hz=500.0, gains=gains)
    runs = [
        replace(run, controller=controller, signals={"q": run.signals["target"], **run.signals}) for run in log.runs
    ]
    write(replace(log, runs=tuple(runs)), tmp_path / "measured")
    excite.main(excite.Args(out=tmp_path / "next", like=tmp_path / "measured", seconds=2.0, **options))
    return read(tmp_path / "next", measured=False)


def test_passive_joints_are_told_nothing(tmp_path):
    for run in like(tmp_path, [30.0, 0.0]).runs:
        assert np.ptp(run.signals["target"][:, 0]) > 0.1
        assert np.ptp(run.signals["target"][:, 1]) == 0.0


def test_a_robot_without_any_gain_follows_no_targets(tmp_path):
    with pytest.raises(ValueError, match="kp: got 0 for every joint"):
        like(tmp_path, [0.0, 0.0])


def test_targets_for_an_unknown_controller_are_refused(tmp_path):
    excite.main(excite.Args(out=tmp_path / "targets", robot=str(ARM), seconds=2.0))
    log = read(tmp_path / "targets", measured=False)
    controller = Controller(kind="unknown", rate_hz=500.0, gains={})
    silent = [
        replace(run, controller=controller, signals=dict.fromkeys(("q", "tau"), run.signals["target"]))
        for run in log.runs
    ]
    write(replace(log, runs=tuple(silent)), tmp_path / "measured")
    with pytest.raises(ValueError, match=r"controller\.type: got unknown, expected one that plays targets"):
        excite.main(excite.Args(out=tmp_path / "next", like=tmp_path / "measured", robot=str(ARM), seconds=2.0))


def test_a_built_in_robot_may_stand_for_the_one_of_a_log(tmp_path):
    excite.main(excite.Args(out=tmp_path / "targets", seconds=2.0))
    log = read(tmp_path / "targets", measured=False)
    runs = [replace(run, signals={"q": run.signals["target"], **run.signals}) for run in log.runs]
    write(replace(log, runs=tuple(runs)), tmp_path / "measured")
    excite.main(excite.Args(out=tmp_path / "next", like=tmp_path / "measured", robot="biteno", seconds=2.0))
    assert read(tmp_path / "next", measured=False).robot == "biteno"


def test_a_hinge_without_limits_turns_about_where_the_model_has_it():
    body = '<body><joint name="a" ref="143"/><geom size="0.1"/></body>'
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    runs = excitation(spec, ("a",), 16, 2.0, 100.0)
    # A quarter of its range away from there at most, and by 0.6 rad each way.
    assert all(np.abs(run.target - np.deg2rad(143)).max() < 0.25 * np.pi + 0.601 for run in runs)
