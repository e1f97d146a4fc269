"""The log doctor, on logs of the arm that are damaged here: every kind of damage, alone and two at a time."""

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest

from envs import models
from envs.diagnosis import Finding, diagnose, shared_findings
from envs.diagnosis.repeats import repeated
from envs.logs import Controller
from envs.models import suspended
from experiments.discovery.blind_cases import ARM
from experiments.discovery.blind_drive import Truth
from experiments.discovery.blind_robots import record
from experiments.discovery.excitation import excitation

JOINTS = ("shoulder", "elbow")
SPEC = models.spec(str(ARM))
MODEL = suspended(SPEC)
NAMING = ("swapped joints", "flipped sign", "clipped", "offset")
GAINS = {"kp": np.array([40.0, 20.0]), "kd": np.array([2.0, 0.8]), "torque_limit_nm": np.array([15.0, 15.0])}


@cache
def undamaged(seed):
    """A run of 3 s of an arm in another engine, its masses and gains off, its sensors noisy and rounded."""
    motion = excitation(SPEC, JOINTS, 4, 3.0, 500.0, seed)[:1]
    controller = Controller(kind="pd", rate_hz=1000.0, gains=GAINS)
    return record(SPEC, JOINTS, motion, controller, Truth(None), 0.1, seed).runs[0]


def measured(run, change):
    return replace(run, signals=run.signals | {name: change(run.signals[name]) for name in ("q", "dq")})


def rows(run, keep):
    return replace(run, time=run.time[keep], signals={name: values[keep] for name, values in run.signals.items()})


def swapped(run, rng):
    return measured(run, lambda values: values[:, ::-1]), ("swapped joints", JOINTS)


def flipped(run, rng):
    joint = rng.integers(2)
    sign = np.where(np.arange(2) == joint, -1.0, 1.0)
    return measured(run, lambda values: values * sign), ("flipped sign", (JOINTS[joint],))


def degrees(run, rng):
    return measured(run, np.degrees), ("degrees", ())


def target_degrees(run, rng):
    return replace(run, signals=run.signals | {"target": np.degrees(run.signals["target"])}), ("degrees", ())


def offset(run, rng):
    joint = rng.integers(2)
    shift = np.where(np.arange(2) == joint, rng.choice([-1, 1]) * rng.uniform(0.06, 0.2), 0.0)
    return replace(run, signals=run.signals | {"q": run.signals["q"] + shift}), ("offset", (JOINTS[joint],))


def late(run, rng):
    count = rng.integers(5, 20)
    delayed = measured(run, lambda values: np.concatenate([values[:count], values[:-count]]))
    return rows(delayed, np.arange(count, len(run.time))), ("late", ())


def quantised(run, rng):
    step = rng.uniform(0.01, 0.03)
    return replace(run, signals=run.signals | {"q": np.round(run.signals["q"] / step) * step}), ("quantised", ())


def clipped(run, rng):
    joint = rng.integers(2)
    values = run.signals["dq"].copy()
    most = np.quantile(np.abs(values[:, joint]), 0.85)
    values[:, joint] = np.clip(values[:, joint], -most, most)
    return replace(run, signals=run.signals | {"dq": values}), ("clipped", (JOINTS[joint],))


def low_rate(run, rng):
    return rows(run, np.arange(0, len(run.time), 8)), ("low rate", ())


def duplicated(run, rng):
    at, count = rng.integers(50, len(run.time) - 50), rng.integers(3, 20)
    again = rows(run, np.r_[0:at, np.repeat(at, count), at : len(run.time)])
    period = np.median(np.diff(run.time))
    return replace(again, time=run.time[0] + period * np.arange(len(again.time))), ("duplicated rows", ())


def missing(run, rng):
    at, count = rng.integers(100, len(run.time) - 200), rng.integers(10, 60)
    return rows(run, np.r_[0:at, at + count : len(run.time)]), ("missing rows", ())


def jump(run, rng):
    time = run.time.copy()
    time[rng.integers(len(time) // 5, 4 * len(time) // 5) :] += rng.uniform(0.05, 0.5)
    return replace(run, time=time), ("clock jump", ())


def drift(run, rng):
    return replace(run, time=run.time * np.exp(rng.choice([-1, 1]) * rng.uniform(0.04, 0.2))), ("clock drift", ())


# In the order in which they can happen to a log: units come late, the clock last.
DAMAGE = (swapped, flipped, offset, late, quantised, clipped, degrees, target_degrees, duplicated, missing, jump, drift)
# Behind coarse encoders nobody sees a small offset or delay; and two kinds of degrees are one word.
TOGETHER = ({offset, quantised}, {late, quantised}, {degrees, target_degrees})
ALONE = (*DAMAGE, low_rate)


def said(run):
    return {(one.kind, one.joints if one.kind in NAMING else ()) for one in diagnose(run, JOINTS, MODEL)}


def share_right(cases):
    """Share of (run, what is wrong with it) of which exactly that is said; the others, to be read."""
    wrong = [(truth, found) for run, truth in cases if named(found := said(run)) != named(truth)]
    return 1.0 - len(wrong) / len(cases), wrong


def named(findings):
    """What counts: of exchanged joints, what else is wrong with one may as well be said of the other."""
    if ("swapped joints", JOINTS) not in findings:
        return findings
    return {kind for kind, _ in findings}


def alone(count):
    rng = np.random.default_rng(0)
    done = [ALONE[i % len(ALONE)](undamaged(i // len(ALONE)), rng) for i in range(count)]
    return [(run, {truth}) for run, truth in done]


def paired(count):
    rng, cases = np.random.default_rng(1), []
    while len(cases) < count:
        one, two = np.sort(rng.choice(len(DAMAGE), 2, replace=False))
        if {DAMAGE[one], DAMAGE[two]} in TOGETHER:
            continue
        run, first = DAMAGE[one](undamaged(len(cases) % 20), rng)
        run, second = DAMAGE[two](run, rng)
        cases.append((run, {first, second}))
    return cases


def test_one_damage_is_found():
    share, wrong = share_right(alone(len(ALONE)))
    assert share == 1.0, wrong


def test_two_at_a_time_are_found():
    share, wrong = share_right(paired(8))
    assert share >= 0.87, wrong


def test_nothing_is_said_of_undamaged_logs():
    share, wrong = share_right([(undamaged(seed), set()) for seed in range(6)])
    assert share == 1.0, wrong


@pytest.mark.parametrize("seed", range(4))
def test_noise_at_a_high_rate_swaps_no_joints(seed):
    # Over seven rows, of a thousand a second whose stamps jitter, accelerations would be noise.
    rng = np.random.default_rng(seed)
    time = 0.001 * np.arange(2500)
    position = 0.5 * np.sin(time[:, None] * [3.0, 4.0] + [0.0, 1.0]) * [1.0, 0.7]
    speed = np.gradient(position, time, axis=0)
    data, torque = mujoco.MjData(MODEL), np.empty_like(position)
    for row, state in enumerate(zip(position, speed, np.gradient(speed, time, axis=0), strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mujoco.mj_inverse(MODEL, data)
        torque[row] = data.qfrc_inverse
    stamps = np.sort(time + rng.uniform(-5e-4, 5e-4, len(time)))
    signals = {"q": position + 3e-4 * rng.normal(size=position.shape), "tau": torque}
    controller = Controller(kind="pd", rate_hz=1000.0, gains=GAINS)
    run = replace(undamaged(0), controller=controller, time=stamps, signals=signals, known={})
    assert diagnose(run, JOINTS, MODEL) == []


@pytest.mark.slow
@pytest.mark.parametrize("cases", [alone, paired])
def test_two_hundred_are_found(cases):
    share, wrong = share_right(cases(200))
    assert share >= 0.95, wrong


@pytest.mark.slow
def test_nothing_is_said_of_two_hundred_undamaged_logs():
    share, wrong = share_right([(undamaged(seed), set()) for seed in range(200)])
    assert share >= 0.95, wrong


def test_a_log_in_pieces_is_named():
    run = undamaged(0)
    again = rows(run, np.repeat(np.arange(len(run.time)), 2))
    again = replace(again, time=0.002 * np.arange(len(again.time)))
    assert {"duplicated rows", "in pieces"} == {kind for kind, _ in said(again)}


@pytest.mark.parametrize("names", [("q", "dq", "target"), ("q", "dq"), ("target",)])
@pytest.mark.parametrize("joint", [0, 1])
def test_one_joint_in_degrees_is_named(names, joint):
    run = undamaged(0)
    factor = np.where(np.arange(2) == joint, 180.0 / np.pi, 1.0)
    damaged = replace(run, signals=run.signals | {name: run.signals[name] * factor for name in names})
    (one,) = diagnose(damaged, JOINTS, MODEL)
    assert (one.kind, one.joints, one.wrong) == ("degrees", (JOINTS[joint],), True)
    assert f"{JOINTS[joint]} alone is in degrees; multiply its columns by pi / 180" in one.sentence


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("share", [0.05, 0.3])
def test_a_joint_that_is_pressed_against_its_stop_is_no_defect(joint, share):
    # Half a centirad of difference in where the stop is makes hundreds of Nm in the model.
    motion = excitation(SPEC, JOINTS, 4, 3.0, 500.0, 0)[:1]
    position = undamaged(0).signals["q"][:, joint]
    stopped, stop = mujoco.MjSpec.from_file(str(ARM)), float(np.quantile(position, 1.0 - share))
    stopped.joint(JOINTS[joint]).limited = True
    stopped.joint(JOINTS[joint]).range = [position.min() - 0.5, stop]
    controller = Controller(kind="pd", rate_hz=1000.0, gains=GAINS)
    (run,) = record(stopped, JOINTS, motion, controller, Truth(None), 0.1, 0).runs
    stopped.joint(JOINTS[joint]).range = [position.min() - 0.5, stop - 0.005]
    model = suspended(stopped)
    assert diagnose(run, JOINTS, model) == []
    # What is wrong elsewhere still shows.
    factor = np.where(np.arange(2) == joint, 1.0, -1.0)
    (one,) = diagnose(measured(run, lambda values: values * factor), JOINTS, model)
    assert (one.kind, one.joints) == ("flipped sign", (JOINTS[1 - joint],))


def test_a_repair_does_not_seem_good_because_it_moves_a_joint_into_its_stop():
    # The dynamics do not fit, and in degrees the elbow would rest at its stop, where nothing is known of them.
    run = undamaged(0)
    shift = np.array([0.0, 0.1 - run.signals["q"][:, 1].min()])
    shifted = replace(run, signals=run.signals | {name: run.signals[name] + shift for name in ("q", "target")})
    spec = mujoco.MjSpec.from_file(str(ARM))
    spec.joint("elbow").limited = True
    spec.joint("elbow").range = [0.0, float(shifted.signals["q"][:, 1].max() + 0.5)]
    (one,) = diagnose(shifted, JOINTS, suspended(spec))
    assert (one.kind, one.joints) == ("offset", ("elbow",))


CRANE = """<mujoco>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" range="-1.6 1.6" limited="true" armature="0.02" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="1"/>
      <body pos="0 0 -0.3">
        <joint name="elbow" type="slide" axis="0 0 -1" range="-0.1 0.2" limited="true" damping="4"/>
        <geom size="0.04" mass="0.8"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize(
    ("factors", "kind", "named"), [((1.0, 1e3), "millimetres", ("elbow",)), ((180.0 / np.pi, 1.0), "degrees", ())]
)
def test_a_slide_has_units_of_its_own(factors, kind, named):
    spec = mujoco.MjSpec.from_string(CRANE)
    gains = {"kp": np.array([40.0, 400.0]), "kd": np.array([2.0, 20.0]), "torque_limit_nm": np.array([15.0, 60.0])}
    controller = Controller(kind="pd", rate_hz=1000.0, gains=gains)
    motion = excitation(spec, JOINTS, 4, 3.0, 500.0, 0)[:1]
    run = record(spec, JOINTS, motion, controller, Truth(None), 0.1, 0).runs[0]
    wrong = lambda run: [one for one in diagnose(run, JOINTS, suspended(spec)) if one.wrong]  # noqa: E731
    assert wrong(run) == []
    run = replace(run, signals=run.signals | {name: run.signals[name] * factors for name in ("q", "dq", "target")})
    (one,) = wrong(run)
    assert (one.kind, one.signal, one.joints) == (kind, "all", named)


def late_row(run, at, periods):
    """The run with one row that was read late, at the time of its stamp."""
    time = run.time.copy()
    time[at] += (periods - 1.0) * np.median(np.diff(time))
    read = {name: values.copy() for name, values in run.signals.items()}
    for name in ("q", "dq"):
        for joint in range(2):
            read[name][at, joint] = np.interp(time[at], run.time, run.signals[name][:, joint])
    return replace(run, time=time, signals=read)


@pytest.mark.parametrize("periods", [1.3, 1.65, 1.9])
@pytest.mark.parametrize("at", [10, 700, 1490])
def test_a_row_that_is_read_late_is_no_clock_jump(periods, at):
    assert said(late_row(undamaged(0), at, periods)) == set()


def test_short_gaps_are_said_and_do_not_mislead():
    run = undamaged(0)
    keep = np.setdiff1d(np.arange(len(run.time)), [300, 700, 701])
    (one,) = diagnose(rows(run, keep), JOINTS, MODEL)
    assert (one.kind, one.size, one.misleading) == ("short gaps", 2.0, False)
    assert "2 of up to 0.006 s, where 0.002 s from row to row are usual, the first after row 300" in one.sentence
    # Every fortieth row is more than chance.
    many = np.setdiff1d(np.arange(len(run.time)), np.arange(30, 1400, 40))
    assert "missing rows" in {kind for kind, _ in said(rows(run, many))}


def test_many_lost_rows_are_no_pace_of_the_clock():
    run = undamaged(0)
    for keep in (np.arange(1500) % 10 != 5, np.arange(1500) % 60 > 6):
        assert "missing rows" in {kind for kind, _ in said(rows(run, np.flatnonzero(keep)))}


def test_a_short_piece_at_a_high_rate_is_tried_for_short_delays_alone():
    """100 rows at 4 kHz last for 25 ms, less than the longest delay that is tried."""
    run = undamaged(0)
    time = np.arange(120) / 4000.0
    fine = {
        name: np.stack([np.interp(time, run.time - 0.5, v) for v in values.T], axis=1)
        for name, values in run.signals.items()
        if values.ndim == 2
    }
    diagnose(replace(run, time=time, signals=fine), JOINTS, MODEL)


def test_sizes_are_what_was_done():
    rng = np.random.default_rng(3)
    for damage, kind in ((late, "late"), (offset, "offset"), (drift, "clock drift")):
        run, _ = damage(undamaged(1), rng)
        (one,) = diagnose(run, JOINTS, MODEL)
        assert one.kind == kind
        if damage is late:
            # The first rows are those that are not there any more.
            assert one.size == pytest.approx(2.0 * (len(undamaged(1).time) - len(run.time)), abs=8.0)
        if damage is offset:
            moved = np.median(run.signals["q"] - undamaged(1).signals["q"], axis=0)
            assert one.size == pytest.approx(moved[np.abs(moved).argmax()], abs=0.03)
        if damage is drift:
            assert 1 + one.size == pytest.approx(run.time[-1] / undamaged(1).time[-1], rel=0.01)


def test_a_suspicion_is_reported_once_for_all_runs_that_share_it():
    hole = lambda row: Finding("missing rows", "t", (), 0.02, f"rows are missing behind row {row}")  # noqa: E731
    found = {"run_000": [hole(3), hole(9), hole(12)], "run_001": [], "run_002": [hole(5)]}
    assert shared_findings(found) == [(hole(3), ["run_000 (3 times)", "run_002"])]


LEVEL = """<mujoco>
  <default><joint axis="0 1 0" damping="0.1" armature="0.02"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body>
      <joint name="shoulder"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1.2"/>
      <body pos="0.3 0 0">
        <joint name="elbow"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.6"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize(("kp", "mean"), [(40.0, -0.05), (20.0, -0.05), (20.0, -0.15)])
@pytest.mark.parametrize("base", ["free", "fixed"])
def test_joints_that_sag_to_the_other_side_have_no_flipped_sign(kp, mean, base):
    # Where inverse dynamics are not compared, targets alone say something of signs.
    spec = mujoco.MjSpec.from_string(LEVEL)
    (motion,) = excitation(spec, JOINTS, 4, 3.0, 500.0, 0)[:1]
    target = 0.15 * (motion.target - motion.target.mean(axis=0)) + mean
    motion = replace(motion, target=target, enabled=np.ones(len(target)))
    gains = {"kp": np.array([kp, kp / 3.0]), "kd": np.array([2.0, 0.6]), "torque_limit_nm": np.full(2, 15.0)}
    controller = Controller(kind="pd", rate_hz=1000.0, gains=gains)
    (run,) = record(spec, JOINTS, [motion], controller, Truth(None), 0.1, 0).runs
    assert (run.signals["q"].mean(axis=0) > target.mean(axis=0) + 0.04).all()
    if base == "fixed":
        run = measured(run, lambda values: np.round(values / 0.0015) * 0.0015)
    assert not [one for one in diagnose(run, JOINTS, suspended(spec), base) if one.misleading]


def test_joints_that_friction_rules_are_not_in_degrees():
    # 2 Nm hold them within 40 mrad, while targets move by 120; the nominal model has a fraction of that.
    spec = mujoco.MjSpec.from_file(str(ARM))
    for name in JOINTS:
        spec.joint(name).frictionloss = 2.0
    model = suspended(spec)
    model.opt.timestep = 0.0005
    data, read = mujoco.MjData(model), []
    target = 0.06 * np.sin(2 * np.pi * 0.002 * np.arange(1500)[:, None] * [0.4, 0.7])
    for row in target:
        read.append([*data.qpos, *data.qvel])
        for _ in range(4):
            torque = GAINS["kp"] * (row - data.qpos) - GAINS["kd"] * data.qvel
            data.qfrc_applied[:] = np.clip(torque, -15.0, 15.0)
            mujoco.mj_step(model, data)
    read = np.array(read) + [1e-5, 1e-5, 1e-3, 1e-3] * np.random.default_rng(0).standard_normal((1500, 4))
    run = undamaged(0)
    signals = run.signals | {"q": read[:, :2], "dq": read[:, 2:], "target": target, "enabled": np.ones(1500)}
    rubbed = replace(run, time=0.002 * np.arange(1500), signals=signals)
    assert np.ptp(rubbed.signals["q"], axis=0).max() < 0.05
    assert diagnose(rubbed, JOINTS, MODEL) == []


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_robot_at_rest_has_no_signs_units_offsets_or_drift(noise):
    run = undamaged(0)
    scatter = np.random.default_rng(0).standard_normal((1500, 4)) * noise
    still = {"q": 0.2 + scatter[:, :2], "dq": 100.0 * scatter[:, 2:], "target": np.full((1500, 2), 0.25)}
    assert diagnose(replace(run, signals=run.signals | still), JOINTS, MODEL) == []


def test_stamps_in_milliseconds_are_no_clock_jumps():
    run = undamaged(0)
    time = np.round(np.arange(1500) / 700.0, 3)
    assert {1.0, 2.0} == set(np.unique(np.round(1e3 * np.diff(time))))
    kinds = {one.kind for one in diagnose(replace(run, time=time), JOINTS, MODEL)}
    assert not kinds & {"clock jump", "missing rows", "short gaps"}


@pytest.mark.parametrize(("quantum", "twice"), [(8e-4, False), (1e-6, True)])
def test_noise_in_coarse_steps_repeats_no_rows(quantum, twice):
    # Two coarse steps a row, and noise of 0.6 of one: now and then a row is the one before.
    rng, time = np.random.default_rng(2), 0.005 * np.arange(4000)
    q = (0.3 * time + 5e-4 * rng.standard_normal(len(time)))[:, None]
    q = quantum * np.round(q / quantum)
    written = slice(1000, 3000, 50)
    if twice:
        q[1001:3001:50] = q[written]
    run = replace(undamaged(0), time=time, signals={"q": q, "target": q}, known={})
    assert (np.diff(q, axis=0) == 0).sum() >= 40
    found = repeated(run)
    # Finer than noise, equal readings are no chance.
    assert found[written].mean() > 0.5 if twice else not found.any()


def test_rounded_speeds_of_a_robot_at_rest_repeat_no_rows():
    run = undamaged(0)
    rest = {"q": np.full((1500, 2), 0.2), "dq": np.full((1500, 2), 0.01)}
    rest["dq"][750:] = 0.0
    rest["q"][750:] += 1e-3
    assert "duplicated rows" not in {kind for kind, _ in said(replace(run, signals=run.signals | rest))}


def test_motion_of_a_few_steps_of_the_encoder_is_quantised():
    run = undamaged(0)
    turn = 0.02 * np.sin(2 * np.pi * 0.5 * run.time)[:, None] * [1.0, -1.0]
    coarse = replace(run, signals={**run.signals, "q": np.round(turn / 0.01) * 0.01, "target": turn})
    assert "quantised" in {one.kind for one in diagnose(coarse, JOINTS, MODEL)}
