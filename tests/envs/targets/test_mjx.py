from collections.abc import Mapping
from dataclasses import dataclass, field

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from envs.biteno.constants import ENTRIES
from envs.targets import mjx
from envs.targets.mjx import MjxTarget
from jaxtune.mjx import Entry, to_coords

NEVER = 99


@chex.dataclass(frozen=True)
class Place:
    obs: jax.Array
    score: jax.Array
    done: jax.Array
    not_finite: jax.Array
    steps: jax.Array
    start: jax.Array


@dataclass(frozen=True)
class Script:
    """A robot that falls and breaks when its parameters say so.

    `obs` is a number drawn at the reset and the step; a step pays the number of the step that it leads to, plus the
    parameter `pay`.
    """

    entries: Mapping[str, Entry] = field(default_factory=dict)
    action_size = 3
    observed = staticmethod(lambda obs: obs)

    def reset(self, params, key):
        start = jax.random.uniform(key)
        nothing = jnp.zeros(())
        return Place(
            obs=jnp.stack([start, 0.0]), score=nothing, done=nothing, not_finite=nothing, steps=nothing, start=start
        )

    def move(self, params, state, action):
        steps = state.steps + 1
        broke = steps == params["breaks"]
        # Like BITeno's, what is left of a broken simulation is finite.
        following = state.replace(
            obs=jnp.stack([state.start, steps]),
            score=jnp.where(broke, 0.0, steps + params["pay"]),
            done=((steps == params["falls"]) | broke).astype(jnp.float32),
            not_finite=broke.astype(jnp.float32),
            steps=steps,
        )
        return following, ()


def act(obs, key):
    """An action that says which observation and which key it was made of."""
    return jnp.stack([obs[0], obs[1], jax.random.uniform(key)])


def scripted(count, falls=NEVER, breaks=NEVER, pay=0.0):
    params = {"falls": falls, "breaks": breaks, "pay": pay}
    return {name: jnp.broadcast_to(jnp.asarray(value, jnp.float32), count) for name, value in params.items()}


@pytest.fixture(scope="module")
def played():
    """Four episodes of six steps: to the end, a fall in the third, a break in the third, a fall in the last."""
    params = scripted(4, falls=jnp.array([NEVER, 3, NEVER, 6]), breaks=jnp.array([NEVER, NEVER, 3, NEVER]))
    return mjx.rollout(Script(), jax.random.key(0), act, params, 6)[0]


def test_a_step_counts_if_it_began_alive_and_left_a_number(played):
    np.testing.assert_array_equal(
        played.alive,
        [
            [True, True, True, True, True, True],
            [True, True, True, False, False, False],  # the step into the fall began in a living robot
            [True, True, False, False, False, False],  # the one into the break left nothing to learn from
            [True, True, True, True, True, True],
        ],
    )
    np.testing.assert_array_equal(played.fell, [False, True, True, True])
    np.testing.assert_array_equal(played.not_finite, [False, False, True, False])


def test_score_ends_with_the_episode(played):
    np.testing.assert_array_equal(
        played.score,
        [[1, 2, 3, 4, 5, 6], [1, 2, 3, 0, 0, 0], [1, 2, 0, 0, 0, 0], [1, 2, 3, 4, 5, 6]],
    )


def test_observation_and_action_of_a_step_belong_together(played):
    # The observation is the one the action was chosen by, the first of them that of the reset.
    np.testing.assert_array_equal(played.obs[..., 1], np.tile(np.arange(6), (4, 1)))
    np.testing.assert_array_equal(played.action[..., :2], played.obs)
    assert len(np.unique(played.action[..., 2])) == 24
    assert len(np.unique(played.obs[:, 0, 0])) == 4


def test_one_program_plays_episodes_of_any_length(played):
    params = scripted(4, falls=jnp.array([NEVER, 3, NEVER, 6]), breaks=jnp.array([NEVER, NEVER, 3, NEVER]))
    play = jax.jit(lambda until: mjx.rollout(Script(), jax.random.key(0), act, params, 9, until=until)[0])
    for until in (6, 2):
        found = play(until)
        shorter = mjx.rollout(Script(), jax.random.key(0), act, params, until)[0]
        for got, expected in zip(jax.tree.leaves(found), jax.tree.leaves(shorter), strict=True):
            np.testing.assert_array_equal(got[:, :until] if got.ndim > 1 else got, expected)
        assert not found.alive[:, until:].any()
    assert play._cache_size() == 1


@pytest.mark.parametrize("count", [257, 516])
def test_chunks_change_nothing(monkeypatch, count):
    # 257 are two chunks of 129, the last one filled up by a repetition; 516 are three of 172.
    params = scripted(count, falls=jnp.arange(count) % 7 + 1, pay=jnp.arange(count))
    chunked = mjx.rollout(Script(), jax.random.key(1), act, params, 8)[0]
    assert chunked.fell.shape == (count,)
    assert chunked.obs.shape == (count, 8, 2)
    monkeypatch.setattr("jaxtune.mjx.episodes._CHUNK", {"cpu": count})
    whole = mjx.rollout(Script(), jax.random.key(1), act, params, 8)[0]
    for got, expected in zip(jax.tree.leaves(chunked), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(got, expected)
    # In the order of the draws.
    np.testing.assert_array_equal(chunked.score[:, 0], 1 + np.arange(count))


def test_simulate_takes_search_coordinates():
    table = {"kind": "control", "targets": (), "fields": (), "bounds": (0.1, 100.0)}
    robot = Script(
        entries={
            "pay": Entry(**table),
            **{name: Entry(log=False, **table) for name in ("falls", "breaks")},
        }
    )
    params = scripted(3, falls=2.0, pay=jnp.array([1.0, 2.0, 4.0]))
    coordinates = to_coords(robot.entries, params)
    np.testing.assert_allclose(coordinates["pay"], jnp.log(params["pay"]))
    played = mjx.simulate(robot, jax.random.key(2), act, coordinates, 3)
    # 1 for the first step and 2 for the second, and the pay for each of them.
    np.testing.assert_allclose(played.score, [[2.0, 3.0, 0.0], [3.0, 4.0, 0.0], [5.0, 6.0, 0.0]], rtol=1e-6)


# BITeno itself

STEPS = 150
HEAVY, BROKEN, LIGHT = range(3)


def statue(obs, key):
    """Asks for the standing pose, on which point feet topple after some 1.3 s."""
    return jnp.zeros(6)


@pytest.fixture(scope="module")
def play(robot):
    return jax.jit(lambda key, params: mjx.rollout(robot, key, statue, params, STEPS)[0])


@pytest.fixture(scope="module")
def biteno(play):
    draws = [reference.params(trunk_mass=mass) for mass in (1.5, np.nan, 0.7)]
    params = {name: jnp.stack([draw[name] for draw in draws]) for name in ENTRIES}
    return play(jax.random.PRNGKey(3), params)


def test_bitenos_statue_topples_and_is_masked_from_then_on(biteno):
    alive = np.asarray(biteno.alive)
    lived = alive.sum(axis=1)
    assert np.all(alive == (np.arange(STEPS) < lived[:, None]))
    for row in (HEAVY, LIGHT):
        assert 40 < lived[row] < STEPS
        assert biteno.fell[row]
        assert not biteno.not_finite[row]
        assert np.all(biteno.score[row, : lived[row]] != 0.0)
        # The last step that counts is the one into the fall; gravity told of it in the step after, 45 degrees off.
        upright = -np.asarray(biteno.obs[row, :, 11])
        assert np.all(upright[1 : lived[row]] > np.cos(np.pi / 4) - 1e-6)
    np.testing.assert_array_equal(biteno.score[~alive], 0.0)


def test_a_broken_biteno_is_counted_and_masked(biteno):
    assert biteno.not_finite[BROKEN]
    assert biteno.fell[BROKEN]
    assert not np.any(biteno.alive[BROKEN])
    np.testing.assert_array_equal(biteno.not_finite, [False, True, False])
    assert np.all(np.isfinite(biteno.obs[biteno.alive]))
    assert np.all(np.isfinite(biteno.score))


def test_the_same_key_asks_the_same_of_every_robot(play, biteno):
    params = {name: jnp.full(3, value) for name, value in reference.params(thigh_mass=2.0).items()}
    other = play(jax.random.PRNGKey(3), params)
    # Velocity, command and clock of the start, and the command from then on.
    np.testing.assert_array_equal(other.obs[:, 0], biteno.obs[:, 0])
    np.testing.assert_array_equal(other.obs[..., 3:6], biteno.obs[..., 3:6])
    assert np.any(other.obs[HEAVY, 1] != biteno.obs[HEAVY, 1])
    # And another key another thing.
    third = play(jax.random.PRNGKey(4), params)
    assert np.all(np.any(third.obs[:, 0] != other.obs[:, 0], axis=-1))


def test_a_target_keeps_its_truth_and_answers_with_episodes(robot, monkeypatch):
    asked = {}

    def rollout(robot, key, act, params, steps, *, states, until):
        asked.update(params)
        return (steps, states), until

    monkeypatch.setattr(mjx, "rollout", rollout)
    target = MjxTarget(robot=robot, params={"trunk_mass": 1.5, "foot_friction": 0.7})
    assert target.episodes(jax.random.PRNGKey(3), statue, 4, STEPS) == (STEPS, False)
    assert target.episodes(jax.random.PRNGKey(3), statue, 4, STEPS, states=True) == (STEPS, True)
    assert asked.keys() == {"trunk_mass", "foot_friction"}
    np.testing.assert_array_equal(asked["trunk_mass"], np.full(4, 1.5, np.float32))
    np.testing.assert_array_equal(asked["foot_friction"], np.full(4, 0.7, np.float32))
