"""Null logs: what a sensor of the measured log would have read of a robot that lacks nothing."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from envs import readings
from envs.logs import Controller, Log, Run
from envs.models import suspended
from envs.null_logs import Robot, as_recorded, play, simulate_null_logs
from envs.smoothing import smoothed
from tests.rigs import ARM, ARM_JOINTS

GAINS = {"kp": np.array([40.0, 20.0]), "kd": np.array([2.0, 0.8]), "torque_limit_nm": np.array([15.0, 15.0])}
SERVO = {name: np.array([value, value]) for name, value in {"gain": 5.0, "kt": 0.5, "resistance_ohm": 0.5}.items()}


@pytest.fixture(scope="module")
def spec():
    return mujoco.MjSpec.from_string(ARM)


def measured(rate_hz=100.0, between="hold", known=None, **signals):
    time = np.arange(round(2.0 * rate_hz)) / rate_hz
    target = 0.4 * np.sin(2 * np.pi * time)[:, None] * [1.0, -1.0]
    zero = np.zeros_like(target)
    return Run(
        name="run_000",
        condition="a",
        split=None,
        controller=Controller(kind="pd", rate_hz=500.0, gains=GAINS, between_rows=between),
        time=time,
        signals={"q": zero, "target": target, **signals},
        known=known or {},
    )


def log_of(run):
    rate = 1.0 / np.median(np.diff(run.time))
    return Log(robot="", base="fixed", rate_hz=rate, joints=ARM_JOINTS, policy=None, runs=(run,))


def played(run, spec, linear=False):
    model = suspended(spec)
    model.opt.timestep = 0.0005
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    between = "linear" if linear else "hold"
    run = replace(run, controller=replace(run.controller, between_rows=between))
    robot = Robot(model, linear, np.random.default_rng(0))
    return as_recorded(robot, run, play([(robot, run)], ARM_JOINTS)[0]).signals


def test_held_targets_come_half_a_row_later_than_lines(spec):
    run = measured(rate_hz=20.0)
    held, line = (played(run, spec, linear)["q"] for linear in (False, True))
    # A staircase is late by half a row in the mean.
    shifts = np.arange(0.0, 0.06, 0.005)
    apart = [np.abs(np.interp(run.time - late, run.time, line[:, 0]) - held[:, 0])[4:].mean() for late in shifts]
    assert shifts[np.argmin(apart)] == pytest.approx(0.025, abs=0.006)


def test_between_the_ticks_of_a_slow_controller_joints_move_in_curves(spec):
    # 40 ticks a second; between them the motor holds its torque.
    run = measured(400.0, dq=np.zeros((800, 2)), known={name: {"noise_sd": np.zeros(2)} for name in ("q", "dq")})
    run = replace(run, controller=replace(run.controller, rate_hz=40.0, gains={**GAINS, "kp": np.array([4.0, 2.0])}))
    model = suspended(spec)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    robot = Robot(model, False, np.random.default_rng(0))
    motion = play([(robot, run)], ARM_JOINTS)[0]
    read = as_recorded(robot, run, motion).signals
    # From tick to tick with the same torques.
    data = mujoco.MjData(model)
    tick = 12
    data.qpos[:], data.qvel[:] = motion.states[tick]
    data.qfrc_applied[:] = motion.torques[tick]
    rows = np.flatnonzero((run.time > motion.times[tick]) & (run.time < motion.times[tick + 1]))
    assert len(rows) >= 8
    states = []
    while motion.times[tick] + data.time < motion.times[tick + 1]:
        states.append([motion.times[tick] + data.time, *data.qpos, *data.qvel])
        mujoco.mj_step(model, data)
    states = np.array(states)
    for name, first in (("q", 1), ("dq", 3)):
        exact = [np.interp(run.time[rows], states[:, 0], states[:, first + joint]) for joint in range(2)]
        span = np.ptp(exact[0])
        np.testing.assert_allclose(read[name][rows].T, exact, atol=0.01 * span)


def test_null_robots_differ_in_mass_and_in_inertia(spec):
    nominal = spec.copy().compile()
    drawn = [Robot.drawn(spec, ARM_JOINTS, np.random.default_rng(seed)).model for seed in range(200)]
    mass, inertia = (
        np.log([getattr(model, name)[1:].reshape(nominal.nbody - 1, -1)[:, 0] for model in drawn])
        - np.log(getattr(nominal, name)[1:].reshape(nominal.nbody - 1, -1)[:, 0])
        for name in ("body_mass", "body_inertia")
    )
    # A tenth each, cut at two deviations, and a heavier link has more inertia.
    np.testing.assert_allclose([mass.std(), (inertia - mass).std()], 0.096, atol=0.012)
    assert abs(np.corrcoef((inertia - mass).ravel(), mass.ravel())[0, 1]) < 0.15


def test_unknown_targets_between_rows_are_drawn_for_every_null_log(spec):
    known = {"q": {"noise_sd": np.zeros(2)}}
    found = {}
    for between in ("hold", "linear", "unknown"):
        log = log_of(measured(20.0, between, known))
        found[between] = [one.runs[0].signals["q"] for one in simulate_null_logs(log, spec, 6, 0)]
    kinds = [
        "hold" if np.abs(unknown - held).max() < np.abs(unknown - line).max() else "linear"
        for held, line, unknown in zip(*found.values(), strict=True)
    ]
    assert set(kinds) == {"hold", "linear"}


def test_every_column_has_its_own_noise_rounding_and_time(spec):
    exact = played(measured(), spec)["q"]
    known = {
        "q": {
            "noise_sd": np.array([0.02, 0.0]),
            "quantum": np.array([0.0, 0.01]),
            "offset_s": np.array([0.0, 0.02]),
        }
    }
    run = measured(known=known)
    read = played(run, spec)["q"]
    assert (read[:, 0] - exact[:, 0]).std() == pytest.approx(0.02, rel=0.15)
    np.testing.assert_allclose(read[:, 1] / 0.01, np.round(read[:, 1] / 0.01), atol=1e-6)
    # Read two rows later than its time stamp says.
    np.testing.assert_allclose(read[:-2, 1], exact[2:, 1], atol=0.0051 + 1e-6)
    again = replace(run, signals={**run.signals, "q": read})
    np.testing.assert_allclose(smoothed(again)[4:-4, 0, 1], exact[4:-4, 1], atol=0.006)


def test_what_a_slow_bus_repeated_is_repeated(spec):
    time = measured().time
    repeated = 0.5 * np.sin(2 * np.pi * time)[:, None] * [1.0, 1.0]
    repeated = repeated[np.arange(len(time)) // 2 * 2]
    run = measured(q=repeated)
    wanted = readings.stale(run, "q")
    assert 0.4 < wanted.mean() < 0.5
    read = played(run, spec)["q"]
    assert (np.diff(read, axis=0)[wanted[1:]] == 0).all()
    assert (np.diff(read, axis=0)[~wanted[1:]] != 0).all()


def test_measured_torque_is_what_moves_the_joint(spec):
    blank = np.zeros_like(measured().signals["target"])
    exact = {name: {"noise_sd": np.zeros(2)} for name in ("q", "dq", "tau", "abs_tau")}
    run = measured(known=exact, dq=blank, tau=blank, abs_tau=blank, volts=np.full(200, 8.0))
    servo = Controller(kind="servo", rate_hz=500.0, gains=SERVO)
    for mine in (run, replace(run, controller=servo)):
        read = played(mine, spec, linear=True)
        law, speed = mine.impedance(), read["dq"]
        wanted = law.torque(read["target"], read["q"], speed) - law.back_emf * speed
        # But for what changes between two looks of the controller.
        assert np.median(np.abs(read["tau"] - wanted)) < 0.1 * np.abs(wanted).std()
        np.testing.assert_allclose(read["abs_tau"], np.abs(read["tau"]), atol=1e-4)
        assert (read["abs_tau"] >= 0).all()


def test_torques_that_were_sent_stay_what_they_are(spec):
    sent = 0.1 * np.ones((200, 2))
    run = measured(tau=sent)
    run = replace(run, signals={name: run.signals[name] for name in ("q", "tau")})
    read = played(run, spec)
    np.testing.assert_array_equal(read["tau"], sent)
    assert np.abs(read["q"]).max() > 0.01


def test_runs_with_targets_and_runs_with_torques_are_driven_each_by_its_own(spec):
    told = measured()
    sent = replace(told, name="run_001", signals={"q": told.signals["q"], "tau": 0.3 * told.signals["target"]})
    for runs in ((told, sent), (sent, told)):
        log = replace(log_of(told), runs=runs)
        (both,) = simulate_null_logs(log, spec, 1, 0)
        for run, mine in zip(runs, both.runs, strict=True):
            (alone,) = simulate_null_logs(replace(log, runs=(run,)), spec, 1, 0)
            # The controller's ticks are drawn for all runs together, and so is the noise.
            np.testing.assert_allclose(mine.signals["q"], alone.runs[0].signals["q"], atol=0.02)
        np.testing.assert_array_equal(both.runs[runs.index(sent)].signals["tau"], sent.signals["tau"])


def test_torques_of_which_nothing_is_said_are_held_in_all_null_logs(spec):
    exact = {"q": {"noise_sd": np.zeros(2)}}
    told = measured(20.0, "unknown", exact)
    run = replace(told, signals={"q": told.signals["q"], "tau": 0.5 * told.signals["target"]})
    robots = [Robot(suspended(spec), linear, np.random.default_rng(0)) for linear in (False, True)]
    for robot in robots:
        robot.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    held, too = (as_recorded(one, run, play([(one, run)], ARM_JOINTS)[0]).signals["q"] for one in robots)
    np.testing.assert_array_equal(held, too)


def test_controllers_that_read_noise_shake_their_joints(spec):
    # Encoders with steps of 20 mrad.
    known = {"q": {"quantum": np.full(2, 0.02), "noise_sd": np.full(2, 0.02) / np.sqrt(12.0)}}
    run = measured(known=known)
    exact, noisy = (
        play([(Robot(suspended(spec), False, np.random.default_rng(0), noisy), run)], ARM_JOINTS)[0]
        for noisy in (False, True)
    )
    # In steps of 20 mrad the controller sees the joint, so its torque, less that of its damping, moves in steps of kp.
    target = run.signals["target"][np.searchsorted(run.time, noisy.times + 1e-9, side="right") - 1]
    stiff = noisy.torques + GAINS["kd"] * noisy.states[:, 1]
    steps = (target - stiff / GAINS["kp"])[: len(noisy.times) - 1] / 0.02
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert 0 < np.abs(noisy.states[:, 0] - exact.states[:, 0]).max() < 0.05


def test_half_of_all_null_controllers_read_noise(spec):
    drawn = [Robot.drawn(spec, ARM_JOINTS, np.random.default_rng(seed)).noisy for seed in range(200)]
    assert 70 < sum(drawn) < 130
