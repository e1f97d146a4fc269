"""An exported policy is the one that was trained, in onnxruntime and in NumPy without JAX."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

from envs import sensing
from envs.biteno import constants, env, gait
from experiments import export
from experiments.config import preset
from experiments.loop import Loop
from experiments.player import Player
from experiments.train import starting_policy


@pytest.fixture(scope="module")
def walk():
    """The loop and its policy."""
    loop = Loop(preset("cpu"), {})
    return loop, starting_policy("walk", loop)


@pytest.fixture(scope="module")
def folder(walk, tmp_path_factory):
    loop, policy = walk
    out = tmp_path_factory.mktemp("export") / "policy"
    export.export(out, policy.learner, loop.preset)
    return out


@pytest.fixture(scope="module")
def played(walk):
    """States of ten steps of eight robots, and what was done in them."""
    loop, policy = walk
    act = loop.act(policy)

    def step(state, key):
        action, _ = act(state.obs, key)
        drive = loop.robot.drive({}, state, action)
        return loop.robot.settle(state, drive, loop.robot.simulate({}, state, drive)), (state, drive)

    start = jax.vmap(lambda key: loop.robot.reset({}, key))(jax.random.split(jax.random.PRNGKey(0), 8))
    run = jax.jit(jax.vmap(lambda state: jax.lax.scan(step, state, jax.random.split(jax.random.PRNGKey(1), 10))[1]))
    return jax.device_get(run(start))


def test_onnxruntime_does_what_flax_does(walk, folder, played):
    loop, policy = walk
    session = onnxruntime.InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])
    obs = np.concatenate([played[0].obs.reshape(-1, 40), np.random.default_rng(0).normal(0, 1, (500, 40))])
    obs = obs.astype(np.float32)
    expected = loop.act(policy)(jnp.asarray(obs), jax.random.PRNGKey(0))[0]
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
            np.testing.assert_allclose(target, drive.target[robot, step], atol=1e-4)


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
