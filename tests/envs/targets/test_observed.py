"""Logs that hold a policy's observations and actions, of a robot that nobody knows."""

import numpy as np
import pytest
import yaml

from envs import logs
from envs.targets import observed, recorded

META = {"robot": "a robot of my own", "rate_hz": 50, "joints": ["a", "b"]}
PERIOD = 0.02


def rows(count, start=0.0, per_tick=1):
    """Rows of a policy at 50 Hz with three observations and two actions, all different from tick to tick."""
    tick = np.arange(count) // per_tick
    columns = {"t": start + np.arange(count) * PERIOD / per_tick}
    columns |= {f"obs.{i}": 10.0 * i + 0.1 * tick for i in range(3)}
    return columns | {"action.a": np.sin(tick + 0.5), "action.b": np.cos(tick + 0.5)}


def folder(place, *runs, suffix=".npz", **meta):
    place.mkdir(exist_ok=True)
    for number, columns in enumerate(runs):
        path = place / f"run_{number:03d}{suffix}"
        if suffix == ".npz":
            np.savez(path, **columns)
        else:
            table = np.stack(list(columns.values()), axis=1)
            np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="")
    (place / "meta.yaml").write_text(yaml.safe_dump(META | meta))
    return place


def episodes(place, steps=20):
    return observed.episodes(logs.read_observed(place), steps, control_s=PERIOD, obs=3, act=2)


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_every_row_is_a_step(tmp_path, suffix):
    columns = rows(20) | {"reward": np.arange(20.0)}
    found = episodes(folder(tmp_path / "log", columns, suffix=suffix)).trajectory
    np.testing.assert_allclose(found.obs[0], np.stack([columns[f"obs.{i}"] for i in range(3)], axis=1), rtol=1e-6)
    np.testing.assert_allclose(found.action[0], np.stack([columns["action.a"], columns["action.b"]], axis=1), rtol=1e-6)
    np.testing.assert_allclose(found.score[0], np.arange(20))
    assert found.alive.all()
    assert not found.fell.any()


def test_an_array_of_observations_is_its_columns(tmp_path):
    columns = rows(20)
    together = {"obs": np.stack([columns.pop(f"obs.{i}") for i in range(3)], axis=1), **columns}
    one = episodes(folder(tmp_path / "one", together)).trajectory
    other = episodes(folder(tmp_path / "other", rows(20))).trajectory
    np.testing.assert_array_equal(one.obs, other.obs)


def test_names_of_another_hand(tmp_path):
    columns = rows(20)
    columns["height"] = columns.pop("obs.2")
    found = episodes(folder(tmp_path / "log", columns, columns={"obs.2": "height"}))
    np.testing.assert_allclose(found.trajectory.obs[0, :, 2], columns["height"], rtol=1e-6)


def test_faster_rows_are_taken_where_the_action_changes(tmp_path):
    found = episodes(folder(tmp_path / "log", rows(100, per_tick=5), rate_hz=250)).trajectory
    np.testing.assert_allclose(found.obs[0, :, 0], 0.1 * np.arange(20), rtol=1e-5, atol=1e-6)


def lagging(count, lag, per_tick=10):
    """Rows at 500 Hz in which the action of a step comes `lag` [steps] rows after its observation."""
    columns = rows(count * per_tick, per_tick=per_tick)
    step = np.arange(count * per_tick) // per_tick
    answered = step - (np.arange(count * per_tick) % per_tick < lag[step])
    return columns | {"action.a": np.sin(answered + 0.5), "action.b": np.cos(answered + 0.5)}


@pytest.mark.parametrize("lag", [1, 3, 5, "1 to 5"])
def test_an_action_that_is_logged_after_its_observation_is_of_the_same_step(tmp_path, lag):
    lags = np.random.default_rng(0).integers(1, 6, 60) if lag == "1 to 5" else np.full(60, lag)
    found = episodes(folder(tmp_path / "log", lagging(60, lags), rate_hz=500), steps=60)
    np.testing.assert_array_equal(found.begin, [0])
    assert found.trajectory.alive.all()
    np.testing.assert_allclose(found.trajectory.obs[0, :, 0], 0.1 * np.arange(60), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.trajectory.action[0, :, 0], np.sin(np.arange(60) + 0.5), rtol=1e-5)


def test_a_policy_that_is_twice_as_fast_is_refused(tmp_path):
    columns = rows(300, per_tick=5) | {"t": np.arange(300) * PERIOD / 10}
    with pytest.raises(ValueError, match=r"observation or action changes every 0\.01 s, expected every 0\.02 s"):
        episodes(folder(tmp_path / "log", columns, rate_hz=500))


def test_steps_of_all_lengths_are_refused(tmp_path):
    """Their median is the period, but a third of them are half as long and a third half as long again."""
    step = np.repeat(np.arange(60), np.tile([5, 10, 15], 20))
    columns = {"t": 0.002 * np.arange(len(step))} | {f"obs.{i}": 10.0 * i + 0.1 * step for i in range(3)}
    columns |= {"action.a": np.sin(step), "action.b": np.cos(step)}
    named = r"run_000: observation or action changes at multiples of 0\.02 s in 3\d% of the steps, expected in 90%"
    with pytest.raises(ValueError, match=named):
        episodes(folder(tmp_path / "log", columns, rate_hz=500))


@pytest.mark.parametrize("per_tick", [1, 10])
def test_a_row_that_is_late_is_no_hole(tmp_path, per_tick):
    columns = rows(500 * per_tick, per_tick=per_tick)
    for tick in range(60, 420, 60):
        if per_tick == 1:
            columns["t"][tick] += 0.6 * PERIOD
        else:
            late = slice(tick * per_tick, tick * per_tick + 6)
            for name in columns.keys() - {"t"}:
                columns[name][late] = columns[name][tick * per_tick - 1]
    found = episodes(folder(tmp_path / "log", columns, rate_hz=50 * per_tick), steps=500)
    np.testing.assert_array_equal(found.begin, [0])
    assert found.trajectory.alive.all()
    np.testing.assert_allclose(found.trajectory.obs[0, :, 0], 0.1 * np.arange(500), rtol=1e-5, atol=1e-6)


def test_one_missing_row_is_a_hole(tmp_path):
    columns = {name: np.delete(values, 8) for name, values in rows(30).items()}
    found = episodes(folder(tmp_path / "log", columns), steps=30)
    np.testing.assert_array_equal(found.begin, [0, 9])


@pytest.mark.parametrize("per_tick", [1, 5])
def test_an_action_at_its_limit_leaves_no_hole(tmp_path, per_tick):
    columns = rows(60 * per_tick, per_tick=per_tick)
    for name in ("action.a", "action.b"):
        columns[name][20 * per_tick : 45 * per_tick] = 1.0
    found = episodes(folder(tmp_path / "log", columns, rate_hz=50 * per_tick), steps=60)
    np.testing.assert_array_equal(found.begin, [0])
    assert found.trajectory.alive.all()
    np.testing.assert_allclose(found.trajectory.obs[0, :, 0], 0.1 * np.arange(60), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("per_tick", [1, 5])
def test_rows_before_and_after_the_policy_are_no_walk(tmp_path, per_tick):
    columns = rows(90 * per_tick, per_tick=per_tick)
    for name in columns.keys() - {"t"}:
        columns[name][: 30 * per_tick] = columns[name][30 * per_tick]
        columns[name][60 * per_tick :] = columns[name][60 * per_tick - 1]
    found = episodes(folder(tmp_path / "log", columns, rate_hz=50 * per_tick), steps=90)
    # The first tick of the walk looks like the rows before it.
    assert 28 <= found.trajectory.alive.sum() <= 30
    assert len(found.run) == 1


def test_a_walk_begins_where_the_motors_are_switched_on(tmp_path):
    columns = rows(40) | {"enabled": ((np.arange(40) >= 10) & (np.arange(40) < 35)).astype(float)}
    found = episodes(folder(tmp_path / "log", columns), steps=30).trajectory
    np.testing.assert_allclose(found.obs[0, :25, 0], 0.1 * np.arange(10, 35), rtol=1e-5)
    assert found.alive.sum() == 25
    assert found.fell.all()


def test_a_policy_of_another_rate_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"policy.rate_hz: got 100, expected 50, as simulated"):
        episodes(folder(tmp_path / "log", rows(20), policy={"rate_hz": 100}))


def test_a_robot_that_is_switched_off_fell(tmp_path):
    columns = rows(30) | {"enabled": (np.arange(30) < 12).astype(float)}
    found = episodes(folder(tmp_path / "log", columns, rows(30)))
    # A run is one or several episodes; the first begins the walk.
    begin = recorded.beginning(found, 15).trajectory
    np.testing.assert_array_equal(begin.alive.sum(axis=1), [12, 15])
    np.testing.assert_array_equal(begin.fell, [True, False])
    whole, power = recorded.whole(found, 30)
    np.testing.assert_array_equal(whole.fell, [True, False])
    assert np.isnan(power[0, 0])
    assert np.isnan(whole.score[0, 0])


def test_a_hole_divides_a_run(tmp_path):
    columns = {name: np.delete(values, slice(8, 11)) for name, values in rows(30).items()}
    found = episodes(folder(tmp_path / "log", columns))
    np.testing.assert_array_equal(found.begin, [0, 11])
    np.testing.assert_array_equal(found.trajectory.alive.sum(axis=1), [8, 19])
    np.testing.assert_array_equal(found.run, [0, 0])


def test_what_is_written_is_read(tmp_path):
    log = logs.read_observed(folder(tmp_path / "log", rows(20), policy={"rate_hz": 50}))
    logs.write(log, tmp_path / "again", ".parquet")
    again = logs.read_observed(tmp_path / "again")
    assert (again.robot, again.joints, again.policy) == (log.robot, log.joints, log.policy)
    np.testing.assert_array_equal(again.runs[0].signals["obs"], log.runs[0].signals["obs"])
    assert again.runs[0].controller is None


def test_a_known_robots_log_may_have_observations_too(tmp_path):
    joints = ["left_abad", "left_hip", "left_knee"]
    columns = {"t": np.arange(20) * 0.01, "obs.0": np.arange(20.0), "obs.1": np.ones(20)}
    columns |= {f"{signal}.{joint}": np.zeros(20) for signal in ("q", "target") for joint in joints}
    controller = {"type": "pd", "kp": 60, "kd": 2, "rate_hz": 1000}
    meta = {"robot": "biteno", "base": "fixed", "rate_hz": 100, "joints": joints, "controller": controller}
    run = logs.read(folder(tmp_path / "log", columns, **meta)).runs[0]
    assert run.signals["obs"].shape == (20, 2)
    assert run.other == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("obs.1"), r"run_000.npz, column 'obs.1': is missing, although 'obs.2' is there"),
        (
            lambda c: [c.pop(f"obs.{i}") for i in range(3)],
            "column 'obs.0': is missing, which a log of what a policy did",
        ),
        (lambda c: c.update({"obs.x": c["obs.0"]}), "column 'obs.x': expected obs.0, obs.1"),
        (lambda c: c.update({"obs.00": c["obs.0"]}), "column 'obs.00': expected obs.0, obs.1"),
        (lambda c: c.pop("action.b"), "column 'action.b': is missing, although 'action.a' is there"),
        (lambda c: c.update({"obs.3": c["obs.0"]}), "run_000: got 4 components of 'obs', expected 3"),
        (lambda c: c["obs.2"].__setitem__(4, np.nan), "row 5, column 'obs.2': got nan, expected a finite number"),
        (
            lambda c: c.update({"action.c": c["action.a"]}),
            "column 'action.c': is not known; expected action.a",
        ),
        (lambda c: c.update(t=2 * c["t"]), "got 25 rows a second, expected the policy's 50"),
        (lambda c: c.update(enabled=np.zeros(20)), "run_000: got no step with the motors on"),
    ],
    ids=["gap", "no obs", "letter", "two digits", "half an action", "size", "nan", "another joint", "rate", "off"],
)
def test_what_cannot_be_used_is_named(tmp_path, change, message):
    columns = rows(20)
    change(columns)
    with pytest.raises(ValueError, match=message):
        episodes(folder(tmp_path / "log", columns))
