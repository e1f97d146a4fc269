import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from envs.biteno import Biteno, constants
from envs.targets import mujoco_c
from envs.targets.mjx import MjxTarget
from envs.targets.protocol import Commands

VALUES = reference.params(left_thigh_mass=1.5, torque_scale=0.8, foot_friction=0.7, action_delay_s=0.004)
COUNT, STEPS = 3, 40
KEY = jax.random.PRNGKey(3)


def restless(obs, key):
    """A policy that reads the observation and is not still."""
    return 0.3 * jax.random.normal(key, (6,)) + 0.1 * obs[12:18]


@pytest.fixture(scope="module")
def recorded(robot):
    """The same episodes in MuJoCo C and in MJX."""
    command = jnp.array([[0.5, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.6]])
    # Half way through each takes the next one's.
    command = jnp.repeat(jnp.stack([command, jnp.roll(command, 1, axis=0)], axis=1), STEPS // 2, axis=1)
    commands = Commands(command=command, phase=jnp.array([[0.0, 0.5], [0.25, 0.75], [0.6, 0.1]]))
    here = mujoco_c.target(robot, VALUES, threads=2).record(KEY, restless, COUNT, STEPS, commands)
    there = MjxTarget(robot=robot, params=VALUES)
    return here, jax.jit(lambda key: there.record(key, restless, COUNT, STEPS, commands))(KEY)


def test_episodes_are_those_of_mjx(recorded):
    (here, motion), (there, expected) = recorded
    # MJX stops its solver after a few iterations, so they part slowly; a step alone agrees to 1e-6.
    for steps, atol in ((1, 1e-6), (10, 1e-4)):
        np.testing.assert_allclose(motion.qpos[:, :steps], expected.qpos[:, :steps], atol=atol)
        np.testing.assert_allclose(here.obs[:, :steps], there.obs[:, :steps], atol=20 * atol)
        np.testing.assert_allclose(here.action[:, :steps], there.action[:, :steps], atol=20 * atol)
        np.testing.assert_allclose(here.score[:, :steps], there.score[:, :steps], atol=100 * atol)
        np.testing.assert_allclose(motion.torque[:, :steps], expected.torque[:, :steps], atol=500 * atol)
    np.testing.assert_array_equal(motion.command, expected.command)
    np.testing.assert_allclose(motion.phase, expected.phase, atol=1e-6)


def test_a_measured_state_goes_on_in_mjx_as_it_did_in_the_engine(robot):
    target = mujoco_c.target(robot, VALUES, threads=2)
    episodes = target.episodes(KEY, restless, COUNT, 5, states=True)
    step = jax.jit(lambda kept, action: robot.step(VALUES, robot.resumed(VALUES, kept), action))
    for episode, index in ((0, 0), (2, 3)):
        kept = jax.tree.map(lambda leaf, at=(episode, index): leaf[at], episodes.state)
        after = step(kept, episodes.action[episode, index])
        np.testing.assert_allclose(after.qpos, episodes.state["qpos"][episode, index + 1], atol=1e-5)
        np.testing.assert_allclose(after.qvel, episodes.state["qvel"][episode, index + 1], atol=1e-3)


def test_forces_of_the_floor_push_up_alike(recorded):
    (_, motion), (_, expected) = recorded
    # Up to a first bounce, whose moment is a matter of micrometres.
    np.testing.assert_allclose(motion.foot_force[:, :3], expected.foot_force[:, :3], rtol=1e-2, atol=1.0)
    assert motion.foot_force[..., 2].min() >= 0.0
    assert motion.foot_force[..., 2].max() > 50.0


def test_given_commands_are_observed_and_rewarded(recorded):
    for trajectory, motion in recorded:
        np.testing.assert_allclose(trajectory.obs[..., 3:6], motion.command * jnp.array([2.0, 2.0, 0.25]), atol=1e-6)
        np.testing.assert_allclose(motion.command[0, [0, 19, 20]], [[0.5, 0, 0], [0.5, 0, 0], [0, 0, 0.6]], rtol=1e-6)
        # Sine and cosine of the clocks at the start, and a step of 0.0175 cycles later.
        np.testing.assert_allclose(trajectory.obs[1, 0, 36:], [1, 0, -1, 0], atol=1e-6)
        np.testing.assert_allclose(motion.phase[:, 0, 0], [0.0175, 0.2675, 0.6175], atol=1e-6)


def test_falls_are_masked_as_in_mjx(robot):
    def collapse(obs, key):
        return jnp.array([0.0, 0.0, 10.0] * 2)

    steps = 150
    here = mujoco_c.target(robot, VALUES, threads=1).episodes(KEY, collapse, COUNT, steps)
    there = MjxTarget(robot=robot, params=VALUES)
    expected = jax.jit(lambda key: there.episodes(key, collapse, COUNT, steps))(KEY)
    assert here.fell.all()
    np.testing.assert_allclose(here.alive.sum(axis=1), expected.alive.sum(axis=1), atol=2)
    for row in range(COUNT):
        assert np.all(np.diff(here.alive[row].astype(int)) <= 0)
        assert np.all(here.score[row][~here.alive[row]] == 0.0)
    assert not here.not_finite.any()


def test_a_state_that_is_not_finite_ends_its_episode_alone(robot, monkeypatch):
    target = mujoco_c.target(robot, VALUES, threads=1)
    move, calls = target._engine.move, []

    def breaking(state, drive):
        calls.append(None)
        motion = move(state, drive)
        return motion.replace(qvel=motion.qvel.at[1, 3].set(jnp.nan)) if len(calls) == 5 else motion

    monkeypatch.setattr(target._engine, "move", breaking)
    trajectory = target.episodes(KEY, restless, COUNT, 10)
    np.testing.assert_array_equal(trajectory.not_finite, [False, True, False])
    np.testing.assert_array_equal(trajectory.alive[1], [True] * 4 + [False] * 6)
    assert np.isfinite(trajectory.obs).all()


def test_a_robot_that_explodes_is_not_put_back_on_its_feet(robot, monkeypatch):
    target = mujoco_c.target(robot, VALUES, threads=1)
    move, calls = target._engine.move, []

    def thrown(state, drive):
        calls.append(None)
        return move(state.replace(qvel=state.qvel.at[1, 8].set(1e11)) if len(calls) == 5 else state, drive)

    monkeypatch.setattr(target._engine, "move", thrown)
    trajectory = target.episodes(KEY, restless, COUNT, 10)
    np.testing.assert_array_equal(trajectory.not_finite, [False, True, False])


def test_options_make_it_another_engine(robot):
    plain = mujoco_c.target(robot, VALUES, threads=1).record(KEY, restless, COUNT, 20)[1]
    finer = mujoco_c.target(robot, VALUES, threads=1, timestep=0.0005).record(KEY, restless, COUNT, 20)[1]
    difference = np.abs(plain.qpos - finer.qpos).max()
    assert 1e-5 < difference < 0.05


def test_a_time_step_that_does_not_fit_is_named(robot):
    with pytest.raises(ValueError, match=r"timestep: got 0.0007, expected a divisor of 0.001"):
        mujoco_c.target(robot, VALUES, timestep=0.0007)


def test_the_shipped_policy_walks_20_seconds():
    from experiments.common.config import preset
    from experiments.walking.learner import Learner
    from experiments.walking.policies import starting_policy
    from experiments.walking.robots import BITENO

    sizes = preset("cpu")
    learner = Learner(
        dataclasses.replace(sizes, task=dataclasses.replace(sizes.task, physics="exact")), BITENO.chosen("legs6")
    )
    assert isinstance(learner.robot, Biteno)
    act = learner.act(starting_policy("walk", learner))
    steps = round(20.0 / constants.POLICY_DT_S)
    trajectory = mujoco_c.target(learner.robot, {"foot_friction": 1.0}).episodes(KEY, act, 4, steps)
    assert not trajectory.fell.any()
