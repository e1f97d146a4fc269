"""Signals that do not move with the rest of a log, or have a size that it contradicts: what the log doctor says."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from envs import models
from envs.diagnosis import diagnose
from envs.logs import Controller
from envs.models import suspended
from experiments.discovery.blind_cases import ARM
from experiments.discovery.blind_drive import Truth
from experiments.discovery.blind_robots import record
from experiments.discovery.excitation import excitation
from experiments.discovery.measured import drop_useless

JOINTS = ("shoulder", "elbow")
SPEC = models.spec(str(ARM))
GAINS = {"kp": np.array([40.0, 20.0]), "kd": np.array([2.0, 0.8]), "torque_limit_nm": np.array([15.0, 15.0])}


@cache
def recorded():
    """A log of an arm in another engine, with measured torques; its motors are switched off at the end."""
    motions = excitation(SPEC, JOINTS, 4, 3.0, 500.0, 1)
    controller = Controller(kind="pd", rate_hz=1000.0, gains=GAINS)
    log = record(SPEC, JOINTS, motions, controller, Truth(None), 0.1, 1)
    runs = []
    for run in log.runs:
        torque = run.impedance().torque(run.signals["target"], run.signals["q"], run.signals["dq"])
        runs.append(replace(run, signals=run.signals | {"tau": torque}))
    return replace(log, runs=tuple(runs))


def with_signal(name, change, run=None):
    run = recorded().runs[0] if run is None else run
    return replace(run, signals=run.signals | {name: change(run.signals[name].copy())})


def said(run, joints=JOINTS):
    return {(one.kind, one.signal, one.joints) for one in diagnose(run, joints, suspended(SPEC))}


def column(joint, change):
    def changed(values):
        values[:, joint] = change(values[:, joint])
        return values

    return changed


def frozen(values):
    half = len(values) // 2
    return np.append(values[:half], np.full(len(values) - half, values[half]))


DAMAGE = {
    "a column that was never written": ("tau", lambda v: 0.0 * v, {("constant", "tau", (j,)) for j in JOINTS}),
    "torques before a gear": ("tau", lambda v: v / 50.0, {("scale", "tau", JOINTS)}),
    "one joint's torque before a gear": ("tau", column(1, lambda v: v / 50), {("scale", "tau", ("elbow",))}),
    "torques in mNm": ("tau", lambda v: 1e3 * v, {("millinewtonmetres", "tau", ())}),
    "velocities in rpm": ("dq", lambda v: v * 30.0 / np.pi, {("scale", "dq", JOINTS)}),
    "no velocities": ("dq", lambda v: 0.0 * v, {("constant", "dq", (j,)) for j in JOINTS}),
    "a velocity that freezes": ("dq", column(0, frozen), {("constant", "dq", ("shoulder",))}),
    "an encoder that freezes": ("q", column(1, frozen), {("frozen", "q", ("elbow",))}),
    "motors that are said to be off": ("enabled", lambda v: 0.0 * v, {("motors off", "enabled", ())}),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_what_is_wrong_with_a_signal_is_said(name):
    signal, change, expected = DAMAGE[name]
    found = said(with_signal(signal, change))
    # Where a position freezes, its torque is none of the joint's, and more is suspected.
    assert found == expected if signal != "q" else expected <= found


def test_nothing_is_said_of_the_log_as_it_is():
    assert [said(run) for run in recorded().runs[:3]] == [set()] * 3


def test_gains_of_ten_times_the_size_are_a_note():
    run = recorded().runs[0]
    gains = {**GAINS, "kp": 10.0 * GAINS["kp"]}
    signals = {name: values for name, values in run.signals.items() if name != "tau"}
    wrong = replace(run, signals=signals, controller=replace(run.controller, gains=gains))
    (found,) = [one for one in diagnose(wrong, JOINTS, suspended(SPEC)) if one.kind == "gains"]
    assert found.size == pytest.approx(0.1, rel=0.15) and found.joints == JOINTS
    assert not found.misleading


def test_angles_that_are_kept_within_a_turn_are_named_and_nothing_else():
    run = recorded().runs[0]
    # The angle jumps where the shoulder passes most often, and begins on the side that the model has.
    middle = np.median(run.signals["q"][:, 0])
    low = middle if run.signals["q"][0, 0] > middle else middle - 2.0 * np.pi

    def around(values):
        return (values - low) % (2.0 * np.pi) + low

    wrapped = with_signal("target", column(0, around), with_signal("q", column(0, around)))
    assert said(wrapped) == {("wrapped", name, ("shoulder",)) for name in ("q", "target")}


def test_a_joint_that_stays_where_it_is_while_its_target_moves_is_said():
    still = with_signal("q", column(1, lambda v: 0.0 * v + v[0]), with_signal("dq", column(1, lambda v: 0.0 * v)))
    (found,) = [one for one in diagnose(still, JOINTS, suspended(SPEC)) if one.kind == "still"]
    assert found.joints == ("elbow",) and not found.misleading


def test_a_passive_joint_has_no_torque():
    passive = {**GAINS, "kp": np.array([40.0, 0.0]), "kd": np.array([2.0, 0.0])}
    run = with_signal("tau", column(1, lambda v: 0.0 * v))
    run = replace(run, controller=replace(run.controller, gains=passive))
    assert not [one for one in diagnose(run, JOINTS, suspended(SPEC)) if one.kind in ("constant", "still")]


def test_a_signal_that_is_constant_is_not_used():
    log = recorded()
    silent = replace(log, runs=tuple(with_signal("tau", lambda v: 0.0 * v, run) for run in log.runs))
    kept, notes = drop_useless(silent)
    assert all("tau" not in run.signals for run in kept.runs)
    assert "tau is constant" in " ".join(notes)
    assert all("tau" in run.signals for run in drop_useless(log)[0].runs)
