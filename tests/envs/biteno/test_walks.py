"""Episodes through a log file and back: the same windows, however the log was sampled, cut at falls and holes."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import logs, sensing
from envs.biteno import constants, walks
from envs.biteno.onboard import joint_ranges
from envs.logs import Controller, Log, Run
from envs.logs.sampling import HELD
from envs.targets import mujoco_c, recorded
from experiments.common.config import preset
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from jaxtune import windows

STEPS, LENGTH = 200, 50


@pytest.fixture(scope="module")
def simulated():
    """Two episodes of a walk and two of a fall in MuJoCo C, as episodes and as a log of one row a policy step."""
    learner = Learner(preset("smoke"), {})
    walk = learner.act(starting_policy("walk", learner))
    flail = lambda obs, key: 0.5 * jax.random.normal(key, (6,))  # noqa: E731
    target = mujoco_c.target(learner.robot, {})
    found = [target.record(jax.random.PRNGKey(3), act, 2, STEPS) for act in (walk, flail)]
    trajectory, recording = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
    np.testing.assert_array_equal(trajectory.fell, [False, False, True, True])
    return trajectory, as_log(trajectory, recording)


def as_log(trajectory, recording):
    """What a robot would have written: everything from the second step on, and a row after the last."""
    turn = jax.vmap(jax.vmap(sensing.rotate_inverse))
    quat = recording.qpos[..., 3:7]
    joint = recording.qpos[..., 7:]
    target = trajectory.obs[..., 30:36] + trajectory.obs[..., 12:18] + jnp.asarray(constants.STAND_RAD)
    signals = {
        "q": joint,
        "dq": recording.qvel[..., 6:],
        "tau": recording.torque,
        "gyro": recording.qvel[..., 3:6],
        "gravity": jax.vmap(jax.vmap(sensing.projected_gravity))(quat),
        "vel": turn(quat, recording.qvel[..., :3]),
        "pos": recording.qpos[..., :3],
        "phase": recording.phase,
        # The row of a step's end is that of the next step's beginning.
        "action": jnp.roll(trajectory.action, -1, axis=1),
        "target": jnp.roll(target, -2, axis=1),
        "cmd": jnp.roll(recording.command, -1, axis=1),
    }
    gains = {"kp": np.full(6, 60.0), "kd": np.full(6, 2.0), "torque_limit_nm": np.full(6, 60.0)}
    runs = tuple(
        Run(
            name=f"run_{index:03d}",
            condition="walk",
            split=None,
            controller=Controller(kind="pd", rate_hz=1000.0, gains=gains),
            time=0.01 * np.arange(STEPS - 1),
            signals={name: np.asarray(values[index, : STEPS - 1], float) for name, values in signals.items()},
        )
        for index in range(len(trajectory.fell))
    )
    policy = {"rate_hz": 100.0, "action_scale": 0.25, "base": "raibert"}
    return Log(robot="biteno", base="free", rate_hz=100.0, joints=constants.JOINTS, policy=policy, runs=runs)


def same(found, trajectory, tolerance=1e-6):
    """Windows are those of simulated episodes from their third step on, but for a last one of which no end is known."""
    expected = jax.tree.map(lambda leaf: leaf[:, 2:] if leaf.ndim > 1 else leaf, trajectory)
    np.testing.assert_array_equal(found.fell, expected.fell)
    ends = jnp.where(expected.fell, expected.alive.sum(axis=1), STEPS - 3)
    np.testing.assert_array_equal(found.alive.sum(axis=1), ends)
    ours, alive = windows.grid(found, LENGTH, 1)
    theirs, valid = windows.grid(expected, LENGTH, 1)
    assert alive.sum(axis=1).min() > 0
    assert not (alive & ~valid).any()
    np.testing.assert_allclose(ours[alive], theirs[alive], atol=tolerance)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_windows_are_those_of_the_simulator(simulated, tmp_path, suffix):
    trajectory, log = simulated
    logs.write(log, tmp_path / "log", suffix)
    found = walks.episodes(logs.read(tmp_path / "log"), STEPS - 2).trajectory
    same(found, trajectory)
    # Accelerations are differences over 10 ms of velocities that were rounded.
    known = found.alive & jnp.isfinite(found.score)
    np.testing.assert_allclose(found.score[known], trajectory.score[:, 2:][known], rtol=1e-3, atol=1e-5)


def test_targets_that_a_robot_clips_are_observed_as_the_policy_meant_them(simulated):
    _, log = simulated
    low, high = joint_ranges()
    runs, cut = [], 0.0
    for run in log.runs:
        sent = np.clip(run.signals["target"], low, high)
        cut = max(cut, np.abs(sent - run.signals["target"]).max())
        runs.append(replace(run, signals=run.signals | {"target": sent}))
    assert cut > 0.03
    found, expected = (walks.episodes(one, STEPS).trajectory for one in (replace(log, runs=tuple(runs)), log))
    np.testing.assert_allclose(found.obs, expected.obs, atol=1e-5)


def test_joints_may_come_in_another_order(simulated):
    trajectory, log = simulated
    order = [3, 1, 5, 0, 4, 2]
    joints = ("q", "dq", "target", "tau", "action")
    runs = tuple(
        replace(run, signals={n: v[:, order] if n in joints else v for n, v in run.signals.items()}) for run in log.runs
    )
    turned = replace(log, joints=tuple(constants.JOINTS[i] for i in order), runs=runs)
    same(walks.episodes(turned, STEPS - 2).trajectory, trajectory)


def faster(run, rows_per_tick, shift=0.0):
    """The run recorded faster: held signals as they are, measured ones along lines, rows `shift` s off the ticks."""
    time = np.arange(0, run.time[-1], 0.01 / rows_per_tick) + shift
    signals = {}
    for name, values in run.signals.items():
        if name in HELD:
            signals[name] = values[np.floor(time / 0.01 + 1e-6).astype(int)]
        else:
            signals[name] = np.stack([np.interp(time, run.time, column) for column in values.T], axis=1)
    return replace(run, time=time, signals=signals)


def test_rows_that_keep_step_with_the_policy_are_taken_as_they_are(simulated):
    trajectory, log = simulated
    fast = replace(log, rate_hz=500.0, runs=tuple(faster(run, 5) for run in log.runs))
    # The first tick is not heard: nothing changes there.
    found = walks.episodes(fast, STEPS - 2).trajectory
    np.testing.assert_array_equal(found.fell, trajectory.fell)
    ours, alive = windows.grid(found, LENGTH, 1)
    theirs, valid = windows.grid(jax.tree.map(lambda x: x[:, 3:] if x.ndim > 1 else x, trajectory), LENGTH, 1)
    count = alive.shape[1] - 1
    assert not (alive[:, :count] & ~valid[:, :count]).any()
    np.testing.assert_allclose(ours[:, :count][alive[:, :count]], theirs[:, :count][alive[:, :count]], atol=1e-6)


def test_rows_between_the_ticks_are_filtered(simulated):
    # 330 rows a second: the row in which an action shows is up to 3 ms late, and so is what was measured there.
    _, log = simulated
    run = log.runs[0]
    late = replace(log, rate_hz=330.0, runs=(faster(run, 3.3, 0.0005),))
    on_time = walks.episodes(replace(log, runs=(run,)), STEPS).trajectory
    found = walks.episodes(late, STEPS).trajectory
    alive = np.asarray(found.alive[0, 1:-1] & on_time.alive[0, 2:])
    ours, theirs = np.asarray(found.obs[0, 1:-1])[alive], np.asarray(on_time.obs[0, 2:])[alive]
    held_channels = [*range(3, 6), *range(24, 30), *range(36, 40)]
    np.testing.assert_allclose(ours[:, held_channels], theirs[:, held_channels], atol=1e-6)
    # Joints move by less than 0.1 rad in 10 ms; a mean over a period around the tick is hardly off.
    assert (
        np.abs(ours[:, 12:18] - theirs[:, 12:18]).mean() < 0.1 * np.abs(np.diff(theirs[:, 12:18], axis=0)).mean() + 1e-3
    )


def test_a_hole_ends_an_episode_without_a_fall(simulated):
    _, log = simulated
    stays = log.runs[0]
    keep = np.r_[0:100, 105 : len(stays.time)]
    broken = replace(stays, time=stays.time[keep], signals={n: v[keep] for n, v in stays.signals.items()})
    found = walks.episodes(replace(log, runs=(broken,)), STEPS).trajectory
    # The first tick of each piece and, because neither falls, the last one are not known.
    np.testing.assert_array_equal(found.alive.sum(axis=1), [98, len(keep) - 100 - 2])
    assert not found.fell.any()


def test_rows_that_are_late_end_no_episode(simulated):
    _, log = simulated
    stays = log.runs[0]
    time = stays.time.copy()
    time[20:140:20] += 0.006
    found = walks.episodes(replace(log, runs=(replace(stays, time=time),)), STEPS).trajectory
    np.testing.assert_array_equal(found.alive.sum(axis=1), [len(time) - 2])


def test_a_robot_that_gets_up_starts_another_episode(simulated):
    _, log = simulated
    stays = log.runs[0]
    gravity = stays.signals["gravity"].copy()
    gravity[60:80] = gravity[90:100] = [1.0, 0.0, 0.0]  # it tumbles between two falls, and does not stand
    found = walks.episodes(replace(log, runs=(replace(stays, signals=stays.signals | {"gravity": gravity}),)), STEPS)
    np.testing.assert_array_equal(found.trajectory.fell, [True, False])
    np.testing.assert_array_equal(found.trajectory.alive.sum(axis=1), [59, len(stays.time) - 100 - 2])


def test_motors_off_are_a_fall(simulated):
    _, log = simulated
    stays = log.runs[0]
    enabled = np.where(np.arange(len(stays.time)) < 100, 1.0, 0.0)
    found = walks.episodes(replace(log, runs=(replace(stays, signals=stays.signals | {"enabled": enabled}),)), STEPS)
    np.testing.assert_array_equal(found.trajectory.fell, [True])
    np.testing.assert_array_equal(found.trajectory.alive.sum(axis=1), [99])


def test_a_fall_is_seen_after_the_policy_has_stopped(simulated):
    _, log = simulated
    run = faster(log.runs[2], 5)
    onset = np.flatnonzero(run.signals["gravity"][:, 2] > -np.cos(np.pi / 4))[0]
    action = run.signals["action"].copy()
    action[onset - 2 :] = action[onset - 2]
    stopped = replace(run, signals=run.signals | {"action": action})
    found = walks.episodes(replace(log, rate_hz=500.0, runs=(stopped,)), STEPS).trajectory
    np.testing.assert_array_equal(found.fell, [True])


@pytest.mark.parametrize("rows_per_tick", [1, 5])
def test_a_policy_that_stops_is_not_made_up(simulated, rows_per_tick):
    _, log = simulated
    run = faster(log.runs[0], rows_per_tick)
    action = run.signals["action"].copy()
    action[60 * rows_per_tick : 140 * rows_per_tick] = action[60 * rows_per_tick]
    paused = replace(run, signals=run.signals | {"action": action})
    found = walks.episodes(replace(log, rate_hz=100.0 * rows_per_tick, runs=(paused,)), STEPS).trajectory
    # 60 ticks before and the rest of 199 after 140, the first, the last and what borders on the pause left out.
    assert found.alive.shape[0] == 2
    np.testing.assert_allclose(found.alive.sum(axis=1), [58, 57], atol=2)
    assert not found.fell.any()


def test_a_long_run_is_several_episodes(simulated):
    _, log = simulated
    stays = log.runs[0]
    whole = walks.episodes(replace(log, runs=(stays,)), STEPS)
    parts = walks.episodes(replace(log, runs=(stays,)), 80)
    assert parts.trajectory.obs.shape == (3, 80, 40)
    np.testing.assert_array_equal(parts.trajectory.alive.sum(axis=1), [80, 80, STEPS - 3 - 160])
    for one, other in (
        (parts.trajectory.obs, whole.trajectory.obs),
        (parts.commands.command[:, 1:], whole.commands.command[:, 1:]),
    ):
        np.testing.assert_allclose(one.reshape(240, -1)[: STEPS - 3], other[0, : STEPS - 3], atol=1e-6)


def test_beginnings_are_of_every_run_the_first_steps_of_its_first_episode(simulated):
    _, log = simulated
    whole = walks.episodes(log, STEPS)
    steps = int(whole.trajectory.alive[3].sum())
    for length in (steps - 1, steps, steps + 1):
        pieces = walks.episodes(log, length)
        first = np.unique(np.asarray(pieces.run), return_index=True)[1]
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6),
            recorded.beginning(whole, length),
            jax.tree.map(lambda leaf, first=first: leaf[first], pieces),
        )
        assert recorded.beginning(whole, length).trajectory.fell[3] == (length >= steps)
    # Longer than what was cut, which is shorter than the walks.
    assert recorded.beginning(walks.episodes(log, 50), 60).power.shape == (4, 50)


def test_a_walk_is_the_same_in_one_piece_and_in_several(simulated):
    _, log = simulated
    one, power = recorded.whole(walks.episodes(log, STEPS), 150)
    other, same_power = recorded.whole(walks.episodes(log, 40), 150)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6), (one, power), (other, same_power))
    ends = walks.episodes(log, STEPS).trajectory.alive.sum(axis=1)
    np.testing.assert_array_equal(one.fell, [False, False, *(ends[2:] <= 150)])
    np.testing.assert_array_equal(one.alive.sum(axis=1), np.minimum(ends, 150))
    assert one.fell.any()
    # A fall in the last step is one, in the step after it is none.
    last = int(ends[3])
    assert [bool(recorded.whole(walks.episodes(log, STEPS), last + more)[0].fell[3]) for more in (-1, 0)] == [0, 1]


def test_a_lost_row_is_no_end_of_a_walk(simulated):
    """Of one walk a row is lost, of one that falls as well: what comes after the gap counts."""
    _, log = simulated
    entire, _ = recorded.whole(walks.episodes(log, STEPS), STEPS)
    fall = int(entire.alive[2].sum())
    runs = []
    for run, row in ((log.runs[0], 100), (log.runs[2], fall - 10)):
        keep = np.delete(np.arange(len(run.time)), row)
        runs.append(replace(run, time=run.time[keep], signals={n: v[keep] for n, v in run.signals.items()}))
    walked, _ = recorded.whole(walks.episodes(replace(log, runs=tuple(runs)), STEPS), STEPS - 3)
    np.testing.assert_array_equal(walked.fell, [False, True])
    for found, expected, row in zip(walked.alive, entire.alive[np.array([0, 2]), :-3], (100, fall - 10), strict=True):
        # A step is a row with the ones before and after it; the first step is that of the second row.
        gap = np.arange(row - 2, row + 1)
        np.testing.assert_array_equal(np.flatnonzero(found != expected), gap)


def test_a_walk_ends_with_its_first_fall(simulated):
    _, log = simulated
    gravity = log.runs[0].signals["gravity"].copy()
    gravity[60:62] = [1.0, 0.0, 0.0]
    tripped = replace(log, runs=(replace(log.runs[0], signals=log.runs[0].signals | {"gravity": gravity}), log.runs[1]))
    pieces = walks.episodes(tripped, STEPS)
    np.testing.assert_array_equal(pieces.run, [0, 0, 1])
    np.testing.assert_array_equal(pieces.begin, [0, 62, 0])
    walked, power = recorded.whole(pieces, STEPS)
    np.testing.assert_array_equal(walked.fell, [True, False])
    np.testing.assert_array_equal(walked.alive.sum(axis=1), [59, STEPS - 3])
    assert (power[0, 59:] == 0).all()


def test_a_fall_in_a_hole_of_the_rows_is_a_fall(simulated):
    """It stands, nothing is known for a while, it lies, and it is put on its feet again."""
    _, log = simulated
    run = log.runs[0]
    gravity = run.signals["gravity"].copy()
    gravity[100:110] = [1.0, 0.0, 0.0]
    keep = np.r_[0:80, 105 : len(run.time)]
    signals = {name: values[keep] for name, values in (run.signals | {"gravity": gravity}).items()}
    pieces = walks.episodes(replace(log, runs=(replace(run, time=run.time[keep], signals=signals),)), STEPS)
    np.testing.assert_array_equal(pieces.trajectory.fell, [True, False])
    walked, _ = recorded.whole(pieces, STEPS)
    np.testing.assert_array_equal(walked.fell, [True])
    np.testing.assert_array_equal(walked.alive.sum(axis=1), [79])


def test_a_trunk_that_sinks_has_fallen_whether_its_height_was_measured_or_not(simulated):
    """Its knees give way, its trunk stays upright, its motors stay on."""
    _, log = simulated
    run = log.runs[0]
    folded = run.signals["q"].copy()
    folded[120:] = [0.0, 1.2, -2.4, 0.0, 1.2, -2.4]  # feet under the hips, 0.22 m below them
    signals = run.signals | {"q": folded}
    del signals["pos"]
    found = walks.episodes(replace(log, runs=(replace(run, signals=signals),)), STEPS).trajectory
    np.testing.assert_array_equal(found.fell, [True])
    np.testing.assert_array_equal(found.alive.sum(axis=1), [119])
    # Of a walk the legs say what was measured, and as long as it is up on its feet they never say that it sinks.
    upright = without(log, "pos")
    same_fell = walks.episodes(upright, STEPS).trajectory
    np.testing.assert_array_equal(same_fell.alive, walks.episodes(without(log), STEPS).trajectory.alive)


def test_commands_to_repeat_an_episode_hold_until_its_end_and_beyond(simulated):
    _, log = simulated
    found = walks.episodes(log, STEPS)
    for episode in (0, 2):
        obs, alive = found.trajectory.obs[episode], int(found.trajectory.alive[episode].sum())
        # The first row is the tick before the first step.
        command = found.commands.command[episode]
        assert command.shape == (STEPS + 1, 3)
        np.testing.assert_array_equal(command[0], command[1])
        scaled = command[1:] * jnp.array([2.0, 2.0, 0.25])
        np.testing.assert_allclose(scaled[:alive], obs[:alive, 3:6], atol=1e-6)
        np.testing.assert_array_equal(scaled[alive:], jnp.broadcast_to(scaled[alive - 1], (STEPS - alive, 3)))
        np.testing.assert_allclose(sensing.clock(found.commands.phase[episode] + 0.0175), obs[0, 36:], atol=1e-6)


def test_a_first_action_that_cannot_be_heard_is_a_step_too(simulated):
    _, log = simulated
    fast = replace(log, rate_hz=500.0, runs=tuple(faster(run, 5) for run in log.runs))
    slow, found = walks.episodes(log, STEPS), walks.episodes(fast, STEPS)
    assert found.commands.command.shape == (4, STEPS + 2, 3)
    np.testing.assert_allclose(found.commands.phase, slow.commands.phase, atol=1e-6)


def test_torque_that_was_not_measured_is_what_the_controller_commanded(simulated):
    _, log = simulated
    run = log.runs[0]
    signals = {name: values for name, values in run.signals.items() if name != "tau"}
    found = walks.episodes(replace(log, runs=(replace(run, signals=signals),)), STEPS)
    target = run.signals["target"]
    target = np.concatenate([target[:1], target[:-1]])
    wanted = np.clip(60 * (target - run.signals["q"]) - 2 * run.signals["dq"], -60, 60)
    # Of the log's own torques, at the end of a step: MuJoCo's are those of its last millisecond.
    assert np.corrcoef(wanted[1:90].ravel(), run.signals["tau"][1:90].ravel())[0, 1] > 0.98
    power = np.maximum(wanted * run.signals["dq"], 0.0).sum(axis=1)
    alive = np.flatnonzero(found.trajectory.alive[0])
    np.testing.assert_allclose(found.power[0, alive], power[1 + alive], rtol=1e-4)


def without(log, *names):
    run = log.runs[0]
    return replace(log, runs=(replace(run, signals={n: v for n, v in run.signals.items() if n not in names}),))


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda log: replace(log, robot="pendulum"), "robot: got 'pendulum'"),
        (lambda log: replace(log, joints=log.joints[:5]), "expected biteno with all its joints"),
        (lambda log: replace(log, policy={"rate_hz": 50.0}), r"policy\.rate_hz: got 50, expected 100"),
        (lambda log: without(log, "vel"), "run_000: there is no 'vel', expected q, dq, target"),
        (lambda log: without(log, "gravity"), "run_000: there is no 'gravity'"),
        (lambda log: replace(log, runs=(still(log.runs[0]),)), r"run_000: 'action' changes 0 time\(s\)"),
        (
            lambda log: replace(log, runs=(slow(log.runs[0]),)),
            "run_000: got 50 rows a second, expected the policy's 100",
        ),
        (lambda log: replace(log, runs=(faster(log.runs[0], 1.2),)), "run_000: got 120 rows a second, expected"),
        (
            lambda log: replace(log, runs=(*log.runs, lying(log.runs[1]))),
            "run_001: got no two consecutive ticks with the robot on its feet",
        ),
        (lambda log: replace(log, base="fixed"), "base: got fixed, expected free"),
    ],
)
def test_what_is_no_walk_is_named(simulated, damage, named):
    with pytest.raises(ValueError, match=named):
        walks.episodes(damage(simulated[1]), STEPS)


def still(run):
    fast = faster(run, 5)
    return replace(fast, signals=fast.signals | {"action": 0 * fast.signals["action"]})


def slow(run):
    return replace(run, time=run.time[::2], signals={name: values[::2] for name, values in run.signals.items()})


def lying(run):
    return replace(run, signals=run.signals | {"gravity": np.tile([1.0, 0.0, 0.0], (len(run.time), 1))})
