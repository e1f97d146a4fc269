"""Logs of unknown controllers: what is read, who follows the motion, and which torques a model then needs."""

from dataclasses import replace

import jax
import mujoco
import numpy as np
import pytest

from envs import segments
from envs.clock import clock_of
from envs.following import followed, follower
from envs.logs import Controller, Log, Run, read, write
from envs.rig import Rig
from envs.smoothing import smoothed
from experiments.discovery.question import build_question
from experiments.discovery.whole_runs import simulate_runs
from tests.rigs import ARM, ARM_JOINTS, Player

UNKNOWN = Controller(kind="unknown", rate_hz=1000.0, gains={})
FRICTION_NM = 0.25


def recorded(friction_nm=0.0, names=("run_000",)):
    """A log of the arm under computed torques and a PD law, which it does not tell; the elbow may have dry friction."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.opt.timestep = 0.0005
    real, ideal = mujoco.MjData(model), mujoco.MjData(model)
    rate = 2 * np.pi * np.array([0.7, 1.1])
    rows = []
    for step in range(3000):
        phase = rate * real.time
        target = np.array([0.6, 0.9]) * np.stack([np.sin(phase), rate * np.cos(phase), -(rate**2) * np.sin(phase)])
        if step == 0:
            real.qpos[:], real.qvel[:] = target[:2]
        ideal.qpos[:], ideal.qvel[:] = real.qpos, real.qvel
        ideal.qacc[:] = target[2] + 400 * (target[0] - real.qpos) + 40 * (target[1] - real.qvel)
        mujoco.mj_inverse(model, ideal)
        torque = ideal.qfrc_inverse.copy()
        if step % 4 == 0:
            rows.append(np.concatenate([[real.time], real.qpos, real.qvel, torque]))
        real.qfrc_applied[:] = torque - [0.0, friction_nm * np.tanh(real.qvel[1] / 0.01)]
        mujoco.mj_step(model, real)
    time, *columns = np.array(rows).T
    q, dq, tau = np.reshape(columns, (3, 2, -1)).transpose(0, 2, 1)
    runs = [
        Run(
            name=name,
            condition=name,
            split=None,
            controller=UNKNOWN,
            time=time,
            signals={"q": q, "dq": dq, "tau": tau},
        )
        for name in names
    ]
    return Log(robot="arm.xml", base="fixed", rate_hz=500.0, joints=ARM_JOINTS, policy=None, runs=tuple(runs))


def follow(log, spec):
    return followed(log, follower(log, spec))


@pytest.fixture(scope="module")
def spec():
    return mujoco.MjSpec.from_string(ARM)


@pytest.fixture(scope="module")
def needed(spec):
    """Torques that the nominal arm needs, less the measured ones, and measured speeds: [rows, joints] by friction."""
    rig = Rig(spec, ARM_JOINTS, UNKNOWN.rate_hz)
    player, found = Player(rig), {}
    for friction in (0.0, FRICTION_NM):
        log = follow(recorded(friction), spec)
        cut = segments.cut(log.runs, 0.1, rig.dt)
        pieces = [jax.tree.map(lambda leaf, n=n: leaf[n], cut.segments) for n in range(len(cut.run))]
        read = [player.play(piece) for piece in pieces]
        settled = slice(15, None)
        less = np.concatenate([one["command"][settled] for one in read]) - np.concatenate(
            cut.signals["tau"][:, settled]
        )
        far = np.concatenate([one["q"][settled] for one in read]) - np.concatenate(cut.signals["q"][:, settled])
        found[friction] = less, far, np.concatenate(cut.signals["dq"][:, settled])
    return found


def test_a_model_that_is_right_needs_the_measured_torques(needed):
    less, far, _ = needed[0.0]
    assert np.sqrt((less**2).mean(axis=0)) == pytest.approx([0.0, 0.0], abs=0.02)
    assert np.abs(far).max() < 2e-4


def test_what_a_model_lacks_shows_in_the_torque_of_its_joint(needed):
    less, far, speed = needed[FRICTION_NM]
    fast = np.abs(speed[:, 1]) > 0.5
    # The model moves as the robot did, without the friction that the robot had to overcome.
    np.testing.assert_allclose(less[fast, 1], -FRICTION_NM * np.sign(speed[fast, 1]), atol=0.3 * FRICTION_NM)
    assert np.abs(less[fast, 1]).mean() == pytest.approx(FRICTION_NM, rel=0.1)
    assert np.abs(less[:, 0]).mean() < 0.15 * FRICTION_NM
    assert np.abs(far).max() < 2e-3


def test_following_twice_follows_the_readings_that_are_there(spec):
    log = follow(recorded(), spec)
    again = follow(log, spec)
    np.testing.assert_array_equal(again.runs[0].signals["target"], log.runs[0].signals["target"])
    moved = replace(log.runs[0], signals=log.runs[0].signals | {"q": log.runs[0].signals["q"] + 0.1})
    moved = follow(replace(log, runs=(moved,)), spec).runs[0]
    np.testing.assert_allclose(moved.signals["target"] - log.runs[0].signals["target"], 0.1, atol=1e-6)


def test_rows_of_a_followed_run_keep_their_jittering_stamps(spec):
    log = recorded()
    run, rng = log.runs[0], np.random.default_rng(0)
    time = run.time + 3e-4 * rng.uniform(-1, 1, len(run.time))
    at = lambda values: np.stack([np.interp(time, run.time, column) for column in values.T], 1)  # noqa: E731
    shaken = replace(run, time=time, signals={name: at(values) for name, values in run.signals.items()})
    run = follow(replace(log, runs=(shaken,)), spec).runs[0]
    # Its targets are readings, which were taken when they were stamped.
    np.testing.assert_array_equal(clock_of(run, 0.001).rows, time)


def test_sealed_runs_have_no_say_in_the_gains(spec):
    log = recorded(names=tuple(f"run_{number:03d}" for number in range(4)))
    splits = ("train", "train", "select", "sealed")
    runs = [replace(run, split=split) for run, split in zip(log.runs, splits, strict=True)]
    bent = replace(runs[3], signals=runs[3].signals | {"q": runs[3].signals["q"] + [0.0, 1.2]})
    ours, other = (
        build_question(replace(log, runs=(*runs[:3], last)), spec, (0.05, 0.1, 0.2), null_logs=0).log.runs[0].controller
        for last in (runs[3], bent)
    )
    np.testing.assert_array_equal(ours.gains["kp"], other.gains["kp"])


def test_noise_asks_for_little_torque(spec):
    log = recorded()
    (run,) = log.runs
    sensors = lambda sd: {"q": {"noise_sd": np.full(2, sd)}, "dq": {"noise_sd": np.full(2, 30.0 * sd)}}  # noqa: E731
    follow_at = lambda sd: follower(replace(log, runs=(replace(run, known=sensors(sd)),)), spec).gains  # noqa: E731
    fine, coarse, coarsest = (follow_at(sd) for sd in (1e-7, 3e-4, 1.0))
    # What noise of the sensors asks for, at rest.
    rng = np.random.default_rng(7)
    shaken = {name: sd * rng.standard_normal(run.signals[name].shape) for name, sd in (("q", 3e-4), ("dq", 9e-3))}
    far, fast = smoothed(replace(run, signals=shaken, known=sensors(3e-4))).std(axis=0)
    rms = np.sqrt((run.signals["tau"] ** 2).mean(axis=0))
    np.testing.assert_allclose(coarse["kp"] * far + coarse["kd"] * fast, 0.05 * rms, rtol=0.15)
    # As fast as its steps allow, or as slow as makes sense; critically damped in any case.
    np.testing.assert_allclose(fine["kp"] / coarsest["kp"], (150.0 / 15.0) ** 2, rtol=1e-6)
    assert (coarse["kp"] < 0.9 * fine["kp"]).all() and (coarse["kp"] > 1.1 * coarsest["kp"]).all()
    for gains in (fine, coarse):
        np.testing.assert_allclose(coarsest["kd"] ** 2 / coarsest["kp"], gains["kd"] ** 2 / gains["kp"], rtol=1e-6)


def test_a_known_controller_stays_and_a_mixture_is_refused(spec):
    log = recorded(names=("run_000", "run_001"))
    gains = {name: np.ones(2) for name in ("kp", "kd", "torque_limit_nm")}
    known = replace(log.runs[1], controller=Controller(kind="pd", rate_hz=1000.0, gains=gains))
    driven = replace(log, runs=(known,))
    assert follow(driven, spec) is driven
    with pytest.raises(ValueError, match=r"run_001: controller\.type: got a known one, expected 'unknown'"):
        follower(replace(log, runs=(log.runs[0], known)), spec)


def written(folder, log):
    write(log, folder)
    (folder / "arm.xml").write_text(ARM)
    return folder


@pytest.mark.parametrize("said", ["{type: unknown}", "{type: unknown, rate_hz: 100}"])
def test_only_the_type_of_an_unknown_controller_counts(tmp_path, said):
    meta = written(tmp_path, recorded()) / "meta.yaml"
    assert read(tmp_path).runs[0].controller.kind == "unknown"
    text = meta.read_text()
    start, end = text.index("controller:"), text.index("runs:")
    meta.write_text(f"{text[:start]}controller: {said}\n{text[end:].split('    controller')[0]}")
    # The one that follows is too hard for slow ticks.
    assert read(tmp_path).runs[0].controller.rate_hz == 1000.0


def test_currents_of_an_unknown_controller_are_torques(tmp_path):
    log = recorded()
    run = log.runs[0]
    signals = {name: run.signals[name] for name in ("q", "dq")} | {"current": run.signals["tau"] / 0.5}
    controller = replace(UNKNOWN, gains={"kt": np.full(2, 0.5)})
    run = replace(run, signals=signals, controller=controller)
    found = read(written(tmp_path, replace(log, runs=(run,)))).runs[0]
    np.testing.assert_allclose(found.signals["tau"], log.runs[0].signals["tau"], rtol=1e-6)


def test_targets_of_an_unknown_controller_are_not_used_and_said_so(tmp_path):
    log = recorded()
    run = log.runs[0]
    run = replace(run, signals=run.signals | {"target": run.signals["q"], "enabled": np.ones(len(run.time))})
    log = read(written(tmp_path, replace(log, runs=(run,))))
    assert not {"target", "enabled"} & set(log.runs[0].signals)
    assert "run_000: not used, since the controller is unknown: target, enabled" in log.notes


def test_an_unknown_controller_without_measured_torques_is_refused(tmp_path):
    log = recorded()
    run = log.runs[0]
    signals = {"q": run.signals["q"], "target": run.signals["q"], "abs_tau": np.abs(run.signals["tau"])}
    with pytest.raises(ValueError, match=r"run_000.csv.*tau.shoulder'.*unknown controller"):
        read(written(tmp_path, replace(log, runs=(replace(run, signals=signals),))))


def test_what_a_controller_does_is_no_question_where_ours_follows(spec):
    log = recorded(names=tuple(f"run_{number:03d}" for number in range(4)))
    question = build_question(log, spec, (0.05, 0.1, 0.2), null_logs=2)
    problem = question.problem
    names = {hypothesis.name for hypothesis in problem.hypotheses}
    assert {"coulomb", "payload", "encoder_bias", "sensor_delay"} <= names
    assert not {"command_delay", "gain_error", "deadband", "torque_scale", "torque_limit", "constant_push"} & names
    # Scales and offsets of the torque sensors are free, and gains of our own controller are known.
    free = {axis: np.abs(problem.unknowns).sum(axis=0)[axis] for axis in range(problem.axes)}
    rig = Rig(spec, ARM_JOINTS, UNKNOWN.rate_hz)
    of = {(axis.effect, axis.place): number for number, axis in enumerate(rig.axes)}
    for name in ("torque_scale", "constant_push"):
        assert all(free[of[name, joint]] > 0 for joint in ARM_JOINTS)
    assert not {form.key for form in problem.forms if form.form == "direction_dependent"}
    assert problem.prior[of["gain_error", "elbow"]] == 0 < problem.prior[of["armature", "elbow"]]
    # A corrected model is no weaker for a sensor that reads too little.
    sensed = {question.rig.axes[number].effect for number in np.flatnonzero(question.sensed)}
    assert sensed == {"torque_scale", "constant_push"}
    for null in problem.null_logs:
        for own, measured in zip(null["train"].values(), problem.data["train"].values(), strict=True):
            # Null logs are followed by their own readings, and share the rest.
            assert np.abs(own.inputs.target - measured.inputs.target).max() > 0
            assert own.inputs.feed is measured.inputs.feed
    # Positions would say nothing of whole runs.
    assert question.of_whole_runs == "tau"
    rubbing = np.array([0.5 * (axis.effect == "coulomb" and axis.place == "elbow") for axis in question.rig.axes])
    rows, found = simulate_runs(question, question.log.runs[:1], np.stack([0.0 * rubbing, rubbing]))
    measured = log.runs[0].signals["tau"][rows[0]]
    nominal, rubbed = (np.abs(torque - measured).mean(axis=0) for torque in found[0])
    assert (nominal < 0.1 * np.abs(measured).mean(axis=0)).all()
    assert rubbed[1] > 3.0 * nominal[1]
