"""What `meta.yaml` says beside the columns: facts of signals, targets between rows, currents, a supply not recorded."""

import numpy as np
import pytest

from envs import logs
from tests.envs.logs.test_files import JOINTS, META, ROWS, columns, put

PD = META["controller"]
SERVO = {"type": "servo", "gain": 1.15, "kt": 0.38, "resistance_ohm": 3.6, "rate_hz": 500}


def read(tmp_path, table=None, **meta):
    return logs.read(put(tmp_path / "log", table, meta)).runs[0]


def currents():
    return columns() | {f"current.{joint}": np.arange(ROWS) + 1.0 for joint in JOINTS}


def without(table, signal):
    return {name: values for name, values in table.items() if not name.startswith(f"{signal}.")}


def test_facts_of_a_column_count_for_it_and_those_of_a_signal_for_the_rest(tmp_path):
    said = {"q.left_knee": {"noise_sd": 0.002}, "q": {"noise_sd": 0.001, "offset_s": -0.003}, "dq": {"filter_hz": 20}}
    run = read(tmp_path, signals=said)
    np.testing.assert_array_equal(run.fact("q", "noise_sd"), [0.001, 0.002])
    np.testing.assert_array_equal(run.fact("q", "offset_s"), [-0.003, -0.003])
    np.testing.assert_array_equal(run.fact("dq", "filter_hz"), [20.0, 20.0])
    assert np.isnan(run.fact("q", "quantum")).all()
    assert np.isnan(run.fact("tau", "noise_sd")).all()


def test_facts_are_in_the_columns_unit(tmp_path):
    said = {"q": {"quantum": 0.1, "offset_s": 0.002}, "tau": {"noise_sd": 50.0}}
    run = read(tmp_path, signals=said, units={"angle": "deg", "torque": "mNm"})
    np.testing.assert_allclose(run.fact("q", "quantum"), 0.1 * np.pi / 180)
    np.testing.assert_allclose(run.fact("tau", "noise_sd"), 0.05)
    np.testing.assert_array_equal(run.fact("q", "offset_s"), 0.002)


@pytest.mark.parametrize(
    ("said", "named"),
    [
        ({"dg": {"filter_hz": 20}}, "signals.dg: there is no such key; expected some of q, dq, tau"),
        ({"q.left_elbow": {}}, "signals.q.left_elbow: there is no such key"),
        ({"target": {"offset_s": 0.1}}, "signals.target: there is no such key"),
        ({"dq": {"filter": 20}}, "signals.dq.filter: there is no such key; did you mean 'filter_hz'"),
        ({"dq": {"filter_hz": 0}}, "signals.dq.filter_hz: got 0, expected a positive number"),
        ({"q": {"offset_s": "late"}}, "signals.q.offset_s: got 'late', expected a number"),
        ({"q": {"noise_sd": -0.1}}, "signals.q.noise_sd: got -0.1, expected a number that is not negative"),
        ({"q": 0.1}, "signals.q: got 0.1, expected a mapping"),
    ],
)
def test_facts_that_are_none_are_named(tmp_path, said, named):
    with pytest.raises(ValueError, match=named):
        read(tmp_path, signals=said)


def test_targets_between_rows_are_unknown_unless_the_log_says(tmp_path):
    assert read(tmp_path).controller.between_rows == "unknown"
    assert read(tmp_path, controller=PD | {"target_between_rows": "linear"}).controller.between_rows == "linear"
    with pytest.raises(ValueError, match=r"controller\.target_between_rows: got 'held', expected one of hold, linear"):
        read(tmp_path, controller=PD | {"target_between_rows": "held"})


def test_currents_are_torques(tmp_path):
    run = read(
        tmp_path,
        without(currents(), "tau"),
        controller=PD | {"kt": [0.5, 2.0]},
        sign={"left_knee": -1},
        signals={"current": {"noise_sd": 0.1}},
    )
    np.testing.assert_allclose(run.signals["tau"], (np.arange(ROWS) + 1.0)[:, None] * [0.5, -2.0])
    np.testing.assert_allclose(run.fact("tau", "noise_sd"), [0.05, 0.2])
    assert "current" not in run.signals
    with pytest.raises(ValueError, match=r"column 'current\.left_hip'.*controller\.kt: is missing"):
        read(tmp_path, without(currents(), "tau"))


def test_torques_that_were_recorded_count_before_currents(tmp_path):
    run = read(tmp_path, currents())
    np.testing.assert_array_equal(run.signals["tau"][:, 0], columns()["tau.left_hip"])
    np.testing.assert_array_equal(run.signals["current"][:, 0], np.arange(ROWS) + 1.0)


def test_torques_without_a_sign_are_not_negative_and_not_turned(tmp_path):
    table = columns() | {f"abs_tau.{joint}": np.arange(ROWS) + 0.5 for joint in JOINTS}
    run = read(tmp_path, table, sign={"left_hip": -1})
    np.testing.assert_array_equal(run.signals["abs_tau"][:, 0], np.arange(ROWS) + 0.5)
    table["abs_tau.left_knee"][2] = -1.0
    with pytest.raises(ValueError, match=r"row 3, column 'abs_tau\.left_knee': got -1\.0, expected"):
        read(tmp_path, table)


def test_a_supply_that_was_not_recorded_is_the_controllers(tmp_path):
    run = read(tmp_path, controller=SERVO | {"volts": 7.4})
    np.testing.assert_allclose(run.impedance().limit, np.full((ROWS, 2), 7.4 * 0.38 / 3.6))
    # A recorded one counts before it.
    run = read(tmp_path, columns() | {"volts": np.full(ROWS, 3.7)}, controller=SERVO | {"volts": 7.4})
    np.testing.assert_allclose(run.impedance().limit, np.full((ROWS, 2), 3.7 * 0.38 / 3.6))
    with pytest.raises(ValueError, match=r"controller\.volts: is missing, and so is a column 'volts'"):
        read(tmp_path, controller=SERVO).impedance()


def test_what_was_known_is_written(tmp_path):
    said = {"q.left_knee": {"noise_sd": 0.002, "offset_s": 0.004}, "dq": {"filter_hz": 20}}
    controller = PD | {"target_between_rows": "hold", "kt": 0.5}
    log = logs.read(put(tmp_path / "log", without(currents(), "tau"), {"signals": said, "controller": controller}))
    logs.write(log, tmp_path / "again")
    (run,), (again,) = log.runs, logs.read(tmp_path / "again").runs
    assert again.controller.between_rows == "hold"
    np.testing.assert_array_equal(again.signals["tau"], run.signals["tau"])
    for signal in ("q", "dq", "tau"):
        for fact in ("filter_hz", "offset_s", "noise_sd", "quantum"):
            np.testing.assert_array_equal(again.fact(signal, fact), run.fact(signal, fact))
