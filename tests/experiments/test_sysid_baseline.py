"""Logs played back in MuJoCo C, and what mujoco.sysid makes of a log whose truth is known."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from mujoco import sysid

from envs import models
from envs.logs import Controller, Log, Run, write
from experiments import sysid_baseline
from experiments.discovery import playback, sysid_fit, sysid_parameters
from tests.rigs import ARM, ARM_JOINTS

needs_sysid = pytest.mark.skipif(not hasattr(sysid, "optimize"), reason="needs the extra sysid")

PD = {"kp": np.array([3.0]), "kd": np.array([0.02]), "torque_limit_nm": np.array([0.4])}
SERVO = {"gain": np.array([4.0]), "kt": np.array([0.38]), "resistance_ohm": np.array([3.6])}
DAMPING, ARMATURE = 0.03, 0.004


def pendulum(seconds=1.0, kind="pd", damping=0.0, armature=0.0019, seeds=(0, 1, 2)):
    """Records a pendulum, stepped with the log's own law, that swings between random targets."""
    spec = models.spec("pendulum")
    spec.joint("hinge").armature = armature
    model = spec.compile()
    model.dof_damping[:] = damping
    controller = Controller(kind=kind, rate_hz=1000.0, gains=PD if kind == "pd" else SERVO)
    runs = [_run(model, controller, seconds, seed) for seed in seeds]
    splits = zip(runs, ("train", "select", "sealed"), strict=True)
    return Log(
        robot="pendulum",
        base="fixed",
        rate_hz=200.0,
        joints=("hinge",),
        policy=None,
        runs=tuple(replace(run, split=split) for run, split in splits),
    )


def _run(model, controller, seconds, seed):
    data, rows = mujoco.MjData(model), round(200 * seconds)
    target = np.repeat(np.random.default_rng(seed).uniform(-1.0, 1.0, -(-rows // 60)), 60)[:rows, None]
    on, volts = np.ones(rows), np.full(rows, 7.4)
    on[-rows // 5 :] = 0.0
    law = controller.impedance(on, volts)
    read = np.empty((rows, 2, 1))
    for row in range(rows):
        read[row] = data.qpos, data.qvel
        for _ in range(5):
            torque = law[row].torque(target[row], data.qpos, data.qvel)
            data.qfrc_applied[:] = torque - law.back_emf[row] * data.qvel
            mujoco.mj_step(model, data)
    signals = {"q": read[:, 0], "dq": read[:, 1], "target": target, "enabled": on}
    return Run(
        name=f"run_{seed:03d}",
        condition=f"targets {seed}",
        split=None,
        controller=controller,
        time=np.arange(rows) / 200.0,
        signals=signals | ({"volts": volts} if controller.kind == "servo" else {}),
    )


@pytest.mark.parametrize("kind", ["pd", "servo"])
def test_actuators_follow_the_law_of_the_logs_controller(kind):
    log = pendulum(1.0, kind)
    model = playback.playable(models.spec("pendulum"), log).compile()
    whole = playback.take(log.runs, playback.step_s(log))
    error = playback.mean_absolute_error(playback.play(model, log.joints, whole), whole)
    assert np.ptp(whole.measured) > 0.5
    assert error < 2e-3
    # Limits that the law does not have are seen.
    model.tendon_actfrcrange[:] *= 0.5
    assert playback.mean_absolute_error(playback.play(model, log.joints, whole), whole) > 10 * error


def test_a_delay_moves_commands_and_a_bias_moves_what_is_read():
    log = pendulum(0.6)
    model = playback.playable(models.spec("pendulum"), log).compile()
    whole = playback.take(log.runs, playback.step_s(log))
    plain = playback.play(model, log.joints, whole)
    late = playback.play(model, log.joints, whole, delay_s=0.02)
    earlier = replace(whole, target=np.roll(whole.target, 20, axis=1))
    np.testing.assert_allclose(late, playback.play(model, log.joints, earlier), atol=1e-9)
    assert np.abs(late - plain).max() > 0.01
    # Gravity alone tells where zero is: without it, controller and log agree on readings that are wrong together.
    assert np.abs(playback.play(model, log.joints, whole, bias=0.1) - plain).max() > 1e-3
    model.opt.gravity[:] = 0.0
    biased, plain = (playback.play(model, log.joints, whole, bias=bias) for bias in (0.1, 0.0))
    np.testing.assert_allclose(biased, plain, atol=1e-9)


@needs_sysid
def test_a_fit_finds_damping_and_armature():
    log = pendulum(1.0, damping=DAMPING, armature=ARMATURE)
    robot = sysid_parameters.robot_of(models.spec("pendulum"), log)
    pieces = playback.take(log.runs, playback.step_s(log), 0.45)
    fitted = sysid_fit.fit(robot, sysid_parameters.declare(robot, "joints").move_off_bounds(), pieces, 1e-6, 20)
    found = sysid_parameters.physical(robot, fitted)
    assert found["damping.hinge"] == pytest.approx(DAMPING, rel=0.1)
    assert found["armature.hinge"] == pytest.approx(ARMATURE, rel=0.1)


@needs_sysid
@pytest.mark.parametrize("subset", list(sysid_parameters.SUBSETS))
def test_nominal_parameters_change_nothing(subset):
    log = pendulum(0.6)
    robot = sysid_parameters.robot_of(models.spec("pendulum"), log)
    whole = playback.take(log.runs, playback.step_s(log))
    nominal = playback.play(robot.spec.compile(), log.joints, whole)
    np.testing.assert_allclose(robot.play(sysid_parameters.declare(robot, subset), whole), nominal, atol=1e-7)


@needs_sysid
def test_the_command_writes_errors_of_nominal_and_fit(tmp_path):
    write(pendulum(1.0, damping=DAMPING), tmp_path / "log")
    out = tmp_path / "found.json"
    args = sysid_baseline.Args(
        logs=(tmp_path / "log",), out=out, subsets=("joints",), horizons=(0.45,), iterations=4, halves=False
    )
    sysid_baseline.main(args)
    found = json.loads(out.read_text())
    fitted = found["chosen"]["free_run"]["errors"]["sealed"]["free_run_error_rad"]
    assert fitted < 0.3 * found["nominal"]["sealed"]["free_run_error_rad"]
    assert found["chosen"]["segments"]["as"] == "free_run"


@needs_sysid
@pytest.mark.parametrize(
    ("field", "value"), [("subsets", ("everything",)), ("horizons", ()), ("weights", (-1.0,)), ("iterations", 0)]
)
def test_options_that_make_no_sense_are_refused(tmp_path, field, value):
    with pytest.raises(ValueError, match=f"{field}: got .*, expected"):
        sysid_baseline.main(sysid_baseline.Args(logs=(tmp_path,), **{field: value}))


def test_without_the_package_the_command_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.delattr(sysid, "optimize", raising=False)
    with pytest.raises(ValueError, match=r"jaxtune\[sysid\]"):
        sysid_baseline.main(sysid_baseline.Args(logs=(tmp_path,)))


def test_logs_that_it_cannot_play_are_named():
    log = pendulum()
    signals = {name: values for name, values in log.runs[0].signals.items() if name != "target"}
    sent = replace(log, runs=(replace(log.runs[0], signals=signals | {"tau": signals["dq"]}), *log.runs[1:]))
    with pytest.raises(ValueError, match="run_000: got torques alone, expected the targets of a controller"):
        sysid_parameters.robot_of(models.spec("pendulum"), sent)
    still = Controller(kind="pd", rate_hz=1000.0, gains={**PD, "kp": np.array([0.0])})
    with pytest.raises(ValueError, match="got no row with motors on and a gain above 0"):
        off = replace(log, runs=tuple(replace(run, controller=still) for run in log.runs))
        sysid_parameters.robot_of(models.spec("pendulum"), off)


def test_parameters_of_a_passive_joint_have_a_unit():
    spec = mujoco.MjSpec.from_string(ARM)
    gains = {"kp": np.array([3.0, 0.0]), "kd": np.array([0.1, 0.0]), "torque_limit_nm": np.array([1.0, 1.0])}
    one = pendulum(0.5)
    runs = tuple(
        replace(
            run,
            controller=Controller(kind="pd", rate_hz=1000.0, gains=gains),
            signals={name: v if name == "enabled" else np.repeat(v, 2, axis=1) for name, v in run.signals.items()},
        )
        for run in one.runs
    )
    robot = sysid_parameters.robot_of(spec, replace(one, robot="arm.xml", joints=ARM_JOINTS, runs=runs))
    np.testing.assert_allclose(robot.stiffness, 3.0)
    for kind in ("armature", "damping", "friction"):
        assert sysid_parameters._unit(robot, robot.spec.compile(), 1, kind) > 0
