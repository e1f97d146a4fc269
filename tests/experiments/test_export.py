"""An exported policy is the one that was trained, in onnxruntime and in NumPy without JAX."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

from envs import logs, sensing
from envs.biteno import constants, env, gait, walks
from envs.biteno.player import Player
from experiments import robot_stub
from experiments.common.config import preset
from experiments.robot import policy_files
from experiments.robot.surrogate import Body, Robot
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from jaxtune.network import Network


@pytest.fixture(scope="module")
def walk():
    """The learner and its policy."""
    learner = Learner(preset("cpu"), {})
    return learner, starting_policy("walk", learner)


@pytest.fixture(scope="module")
def folder(walk, tmp_path_factory):
    learner, policy = walk
    out = tmp_path_factory.mktemp("export") / "policy"
    policy_files.export(out, policy.learner, learner)
    return out


@pytest.fixture(scope="module")
def played(walk):
    """States of ten steps of eight robots, and what was done in them."""
    learner, policy = walk
    act = learner.act(policy)

    def step(state, key):
        drive = learner.robot.drive({}, state, act(state.obs, key))
        return learner.robot.settle(state, drive, learner.robot.simulate({}, state, drive)), (state, drive)

    start = jax.vmap(lambda key: learner.robot.reset({}, key))(jax.random.split(jax.random.PRNGKey(0), 8))
    run = jax.jit(jax.vmap(lambda state: jax.lax.scan(step, state, jax.random.split(jax.random.PRNGKey(1), 10))[1]))
    return jax.device_get(run(start))


def test_a_policy_that_is_not_finite_is_neither_exported_nor_played(walk, folder, tmp_path):
    learner, policy = walk
    broken = jax.tree.map(lambda leaf: leaf.at[..., 0].set(jnp.nan) if leaf.ndim == 2 else leaf, policy.learner)
    with pytest.raises(ValueError, match=r"policy: got a number that is not finite in \['layers'\]\[0\]"):
        policy_files.export(tmp_path / "policy", broken, learner)
    assert not (tmp_path / "policy").exists()
    with np.load(folder / "policy.npz", allow_pickle=False) as stored:
        arrays = dict(stored)
    arrays["bias_1"] = np.full_like(arrays["bias_1"], np.inf)
    np.savez(tmp_path / "policy.npz", **arrays)
    with pytest.raises(ValueError, match=r"policy.npz: bias_1: got a number that is not finite"):
        Network(tmp_path / "policy.npz")


def test_a_player_whose_description_or_file_is_damaged_does_not_begin(folder, tmp_path):
    path = tmp_path / "policy.npz"
    with np.load(folder / "policy.npz", allow_pickle=False) as stored:
        arrays = dict(stored)
    meta = str(arrays["meta"])
    scale = json.loads(meta)["action_scale"]
    for number in ("NaN", "-Infinity", "1e999"):
        changed = meta.replace(f'"action_scale": {scale}', f'"action_scale": {number}')
        assert changed != meta
        np.savez(path, **arrays | {"meta": changed})
        with pytest.raises(ValueError, match=rf"meta: got {number}, expected a number that is finite"):
            Network(path)
    path.write_bytes((folder / "policy.npz").read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"policy.npz: is damaged"):
        Network(path)


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid:RuntimeWarning")
def test_a_player_never_answers_what_is_not_finite(folder):
    network = Network(folder / "policy.npz")
    with pytest.raises(ValueError, match=r"action: got a number that is not finite, for observations of up to 1e\+308"):
        network(np.full(40, 1e308))


def test_onnxruntime_does_what_flax_does(walk, folder, played):
    learner, policy = walk
    session = onnxruntime.InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])
    obs = np.concatenate([played[0].obs.reshape(-1, 40), np.random.default_rng(0).normal(0, 1, (500, 40))])
    obs = obs.astype(np.float32)
    expected = learner.act(policy)(jnp.asarray(obs), jax.random.PRNGKey(0))
    (found,) = session.run(None, {"obs": obs})
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found, expected, atol=1e-5, rtol=1e-5)
    assert json.loads(session.get_modelmeta().custom_metadata_map["meta"]) == Player(folder / "policy.npz").meta


def test_the_player_walks_as_the_simulator_does(folder, played):
    state, drive = played
    assert len(np.unique(np.sign(state.command[:, 0, 0]))) > 1
    for robot in range(8):
        player = Player(folder / "policy.npz", phase=float(state.phase[robot, 0, 0]))
        for step in range(10):
            at = jax.tree.map(lambda leaf, r=robot, s=step: leaf[r, s], state)
            np.testing.assert_allclose(player.phase, at.phase, atol=1e-5)
            target = player.step(
                velocity=sensing.rotate_inverse(at.qpos[3:7], at.qvel[:3]),
                command=at.command,
                gyro=at.qvel[3:6],
                gravity=sensing.projected_gravity(at.qpos[3:7]),
                joint=at.qpos[7:],
                joint_velocity=at.qvel[6:],
            )
            player.tick()
            np.testing.assert_allclose(player.action, drive.action[robot, step], atol=2e-4)
            np.testing.assert_allclose(player.target, drive.target[robot, step], atol=1e-4)
            # What reaches the joints is what it reaches in simulation.
            np.testing.assert_allclose(target, drive.targets[robot, step, -1], atol=1e-4)


UPRIGHT = {name: np.zeros(3) for name in ("velocity", "command", "gyro")} | {
    "gravity": np.array([0, 0, -1.0]),
    "joint": np.array(constants.STAND_RAD),
    "joint_velocity": np.zeros(6),
}


@pytest.mark.parametrize(
    ("readings", "message"),
    [
        ({"gyro": [0.0, np.nan, 0.0]}, "gyro: got a number that is not finite"),
        ({"gravity": [0.0, np.nan, -1.0]}, "gravity: got a number that is not finite"),
        ({"gravity": [0.0, 0.0, 0.0]}, "gravity: got a length of 0.00, expected 1"),
        ({"gravity": [0.0, 0.9, -0.4]}, "gravity: got a tilt of 1.15 rad, expected at most 1: the robot has fallen"),
        ({"gravity": [0.0, 0.0, 1.0]}, "gravity: got a tilt of 3.14 rad"),
    ],
)
def test_the_player_refuses_what_no_standing_robot_reads(folder, readings, message):
    player = Player(folder / "policy.npz")
    before = player.step(**UPRIGHT)
    with pytest.raises(ValueError, match=message):
        player.step(**UPRIGHT | {name: np.array(value) for name, value in readings.items()})
    np.testing.assert_array_equal(player.target, before)


def test_a_walk_begins_near_the_stand(folder):
    player = Player(folder / "policy.npz")
    sitting = UPRIGHT | {"joint": UPRIGHT["joint"] + np.array([0, 0, 1.0, 0, 0, 0])}
    with pytest.raises(ValueError, match=r"joint: left_knee is 1.00 rad off the stand, expected at most 0.4 at first"):
        player.step(**sitting)
    assert player.target is None
    player.step(**UPRIGHT)
    player.step(**sitting)


def test_no_command_is_larger_than_in_training(folder):
    player = Player(folder / "policy.npz")
    targets = []
    for factor in (0.0, 1.0, 5.0):
        player.reset()
        targets.append(player.step(**UPRIGHT | {"command": factor * np.array(env.TaskConfig().command_max)}))
    np.testing.assert_array_equal(targets[1], targets[2])
    assert np.abs(targets[1] - targets[0]).max() > 0.01


def test_no_target_leaves_the_joints_ranges(folder):
    player = Player(folder / "policy.npz")
    low, high = np.array(player.meta["joint_range_rad"]).T
    np.testing.assert_allclose(low, [-0.4, -1.4, 0.1, -0.8, -1.4, 0.1])
    # Readings of a robot that was thrown make large actions.
    rng, left = np.random.default_rng(0), 0
    for _ in range(200):
        parts = {name: 5.0 * rng.normal(size=3) for name in ("velocity", "command", "gyro")}
        joint = UPRIGHT["joint"] + (rng.normal(size=6) if player.target is not None else 0.0)
        parts |= {"gravity": UPRIGHT["gravity"], "joint": joint, "joint_velocity": 30.0 * rng.normal(size=6)}
        target = player.step(**parts)
        assert ((low <= target) & (target <= high)).all()
        left += bool((target != player.target).any())
    assert left > 50


def test_reference_and_observation_are_the_simulators(folder):
    player, rng = Player(folder / "policy.npz"), np.random.default_rng(0)
    sizes = {row["name"]: row["size"] for row in player.meta["observation"]}
    assert sum(sizes.values()) == env.Biteno.observation_size
    for _ in range(50):
        phase, command = rng.uniform(0, 1, 2), rng.uniform(-1, 1, 3)
        np.testing.assert_allclose(player.reference(phase, command), gait.joint_reference(phase, command), atol=1e-5)
        parts = {name: rng.normal(size=sizes[name]) for name in sizes if name not in ("clock", "last_action")}
        action = rng.normal(size=6)
        expected = sensing.observe(**parts, last_action=action, phase=phase, stand=jnp.asarray(constants.STAND_RAD))
        error = parts.pop("joint_error")
        found = player.observe(*parts.values(), action, error, phase)
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_robot_needs_numpy_alone(folder):
    code = (
        "import sys\n"
        "for name in ('jax', 'flax', 'brax', 'mujoco', 'onnx'): sys.modules[name] = None\n"
        "import numpy as np, player\n"
        "p = player.Player('policy.npz')\n"
        "zero = np.zeros(3)\n"
        "print(p.step(velocity=zero, command=zero, gyro=zero, gravity=np.array([0, 0, -1.0]),"
        " joint=np.array(p.meta['stand_rad']), joint_velocity=np.zeros(6)).tolist())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(folder), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert np.abs(np.array(json.loads(done.stdout)) - constants.STAND_RAD).max() < 0.6


IDEAL = Body(
    foot_friction=1.0,
    transport_s=0.0,
    motor_lag_s=0.0005,
    no_load_rad_s=1e9,
    encoder_rad=1e-9,
    velocity_noise_rad_s=0.0,
    gyro_noise_rad_s=0.0,
    gyro_bias_rad_s=0.0,
    tilt_bias_rad=0.0,
    drift_mps=0.0,
)


def answered(folder, place, body, episodes=2, seconds=4.0):
    """Has a robot answer a request; returns its falls and its log."""
    place.mkdir()
    (place / "policy").symlink_to(folder)
    (place / "request.json").write_text(json.dumps({"episodes": episodes, "seconds": seconds, "seed": 0}))
    falls = robot_stub.answer(place, Robot(body), seed=0)
    return falls, logs.read(place / "log")


def test_the_ideal_robot_walks_as_well_as_the_simulator(folder, tmp_path):
    falls, log = answered(folder, tmp_path / "round_000", IDEAL)
    assert falls == [False, False]
    assert [len(run.time) for run in log.runs] == [2000, 2000]
    found = walks.episodes(log, 400)
    # Of 4 s; the walk earns 59 in 20 s, and at most 70 can be had.
    assert 2000 * float(found.trajectory.score.sum() / found.trajectory.alive.sum()) > 50
    # The row of a tick is what the policy saw: it does the same again.
    player = Player(folder / "policy.npz")
    for step in range(0, 390, 13):
        action = player(np.asarray(found.trajectory.obs[0, step], float))
        np.testing.assert_allclose(action, found.trajectory.action[0, step], atol=1e-4)


def test_a_robot_that_falls_says_so(folder, tmp_path):
    falls, log = answered(folder, tmp_path / "round_000", replace(IDEAL, torque_scale=0.2), episodes=1)
    assert falls == [True]
    (run,) = log.runs
    assert run.time[-1] < 3.9
    assert run.signals["enabled"][-1] == 0.0
    np.testing.assert_array_equal(walks.episodes(log, 400).trajectory.fell, [True])


def test_what_the_robot_lacks_is_in_its_log(folder, tmp_path):
    def second(body):
        (tmp_path / str(len(list(tmp_path.iterdir())))).mkdir()
        place = tmp_path / str(len(list(tmp_path.iterdir())) - 1) / "round_000"
        return answered(folder, place, body, episodes=1, seconds=1.0)[1].runs[0].signals

    plain = second(IDEAL)
    coarse = second(replace(IDEAL, encoder_rad=0.01))["q"]
    np.testing.assert_allclose(coarse, np.round(coarse / 0.01) * 0.01, atol=1e-12)
    for field, size, signal in (("gyro_noise_rad_s", 0.5, "gyro"), ("velocity_noise_rad_s", 0.5, "dq")):
        shaken = second(replace(IDEAL, **{field: size}))[signal]
        assert np.diff(shaken, axis=0).std() > max(0.5, 2 * np.diff(plain[signal], axis=0).std())
    drifted = second(replace(IDEAL, drift_mps=0.5))["vel"]
    assert np.abs(drifted[:5] - plain["vel"][:5]).mean() > 0.1
    # With a time constant of 20 ms a motor gives 5 % of what it is asked for in the first millisecond.
    slow = second(replace(IDEAL, motor_lag_s=0.02))["tau"]
    assert np.abs(np.diff(slow, axis=0)).max() < 0.3 * np.abs(np.diff(plain["tau"], axis=0)).max()
