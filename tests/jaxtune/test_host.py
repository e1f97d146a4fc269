import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxtune import pooling
from jaxtune.gate import calibrated_gate
from jaxtune.host import HostTuner, one_by_one, pieces_one_by_one
from jaxtune.shooting import ReplayConfig
from jaxtune.tuner import Tuner, TunerState, explain, keep, knobs
from jaxtune.types import Trajectory, Verdict
from jaxtune.update import posterior_update

TWO = {"friction": 0.0, "mass": 0.0}
# Enough episodes that rounding does not choose another regression.
SIZES = dataclasses.replace(toys.TINY, episodes=96, refinements=1)
SLIDER = toys.Slider()


def state(radius=0.2):
    dist = toys.uniform(TWO, radius)
    past = pooling.Past(estimate=jnp.array([0.1, -0.1]), errors=0.02 * jnp.eye(2), tunings=jnp.int32(1))
    return TunerState(policy=toys.policy(), dist=dist, knobs=knobs(), past=past)


@pytest.fixture(scope="module")
def tuners():
    """The tuner in one program, and the one whose simulator is any Python function."""
    coords_seen = []

    def simulate(key, policy, coords):
        coords_seen.append(coords)
        return jax.tree.map(np.asarray, SLIDER.simulate(key, policy, coords))

    def train(key, policy, dist):
        return policy, {"steps": np.ones(())}

    traced = Tuner(config=SIZES, train_policy=keep, simulate=SLIDER.simulate)
    measure = SLIDER.measure({"friction": 0.05, "mass": 0.0}, 2)
    host = HostTuner(config=SIZES, simulate=simulate, measure=measure, train_policy=train)
    return jax.jit(traced.tune), host, coords_seen


@pytest.mark.parametrize("mass", [0.0, 1.1])
def test_the_loop_in_python_gives_what_the_traced_one_gives(tuners, mass):
    traced, host, seen = tuners
    measured = SLIDER.measure({"friction": 0.0, "mass": mass}, 2)(jax.random.key(0), toys.policy())
    moved, info = traced(jax.random.key(1), state(), measured)
    seen.clear()
    host_moved, host_info = host.tune(jax.random.key(1), state(), jax.tree.map(np.asarray, measured))
    # Accepted sets are read again.
    assert len(seen) >= info.calls
    assert all(isinstance(values, np.ndarray) for coords in seen for values in coords.values())
    for got, expected in zip(jax.tree.leaves((host_moved, host_info)), jax.tree.leaves((moved, info)), strict=True):
        np.testing.assert_allclose(got, expected, rtol=2e-3, atol=2e-3)
    assert explain(host_info).splitlines()[0] == explain(info).splitlines()[0]


def test_states_are_simulated_again_in_python():
    sizes = dataclasses.replace(SIZES, replay=ReplayConfig(sets=19))
    slider = toys.Slider(noise=0.0)
    traced = Tuner(config=sizes, train_policy=keep, simulate=slider.simulate, replay=slider.replay())
    asked = []

    def move(state, force, coords):
        position, velocity = state["slider"]
        push = force - np.exp(coords["friction"]) * velocity - slider.stiffness * position
        velocity = velocity + slider.dt * push / np.exp(coords["mass"])
        return {"slider": np.array([position + slider.dt * velocity, velocity])}

    def go_on(state, actions, coords):
        asked.append(coords)
        for action in actions:
            state = move(state, action[0], coords)
        return state

    host = HostTuner(config=sizes, simulate=slider.simulate, replay=pieces_one_by_one(go_on))
    measured = slider.measure({"friction": 0.06, "mass": -0.04}, 2)(jax.random.key(0), toys.policy())
    moved, info = jax.jit(traced.tune)(jax.random.key(1), state(), measured)
    host_moved, host_info = host.tune(jax.random.key(1), state(), measured)
    assert info.update.replayed and host_info.update.replayed
    assert all(isinstance(value, float) for coords in asked for value in coords.values())
    for name, truth in (("friction", 0.06), ("mass", -0.04)):
        assert moved.dist.centre[name] == pytest.approx(truth, abs=1e-3)
        assert host_moved.dist.centre[name] == pytest.approx(truth, abs=1e-3)
    with pytest.raises(ValueError, match="measured, state: got none, expected arrays by name"):
        host.tune(jax.random.key(1), state(), measured.replace(state=None))


def test_a_policy_is_whatever_simulate_takes(tuners):
    _, host, _ = tuners
    host = dataclasses.replace(host, simulate=lambda key, policy, coords: SLIDER.simulate(key, policy(), coords))
    measured = SLIDER.measure(TWO, 2)(jax.random.key(0), toys.policy())
    moved, info = host.tune(jax.random.key(1), state().replace(policy=toys.policy), measured)
    assert moved.policy is toys.policy
    assert info.calls >= 1


def test_a_distribution_that_changes_compiles_nothing_anew(tuners):
    traced = []

    def gate(*args):
        traced.append("gate")
        return calibrated_gate(*args)

    def update(*args):
        traced.append("update")
        return posterior_update(*args)

    host = HostTuner(config=SIZES, simulate=SLIDER.simulate, verify=gate, update=update)
    measured = SLIDER.measure(TWO, 2)(jax.random.key(0), toys.policy())
    for seed, radius in ((1, 0.2), (2, 0.5)):
        _, info = host.tune(jax.random.key(seed), state(radius), measured)
        assert info.verdicts[info.calls - 1] == Verdict.ACCEPT
    assert traced == ["gate", "update"]


def test_misfits_are_those_of_the_traced_tuner(tuners):
    _, host, _ = tuners
    measured = SLIDER.measure(TWO, 2)(jax.random.key(0), toys.policy())
    traced = Tuner(config=SIZES, train_policy=keep, simulate=SLIDER.simulate)
    expected = jax.jit(traced.misfits)(jax.random.key(1), state(), measured)
    assert expected.channels.shape == (3,)
    found = host.misfits(jax.random.key(1), state(), measured)
    np.testing.assert_allclose(found.channels, expected.channels, rtol=1e-2)
    np.testing.assert_allclose(found.phases, expected.phases, rtol=1e-2)


def test_a_measured_set_of_another_length_is_refused(tuners):
    _, host, _ = tuners
    measured = toys.Slider(steps=55).measure(TWO, 2)(jax.random.key(0), toys.policy())
    with pytest.raises(ValueError, match="measured: got episodes of 55 steps, expected 60, as simulated"):
        host.tune(jax.random.key(1), state(), measured)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda set_: None, "measured: got NoneType, expected a jaxtune.types.Trajectory"),
        (lambda set_: jax.tree.map(lambda leaf: leaf[:1], set_), r"measured, alive: got shape \(1, 60\), expected 2"),
        (lambda set_: set_.replace(alive=set_.alive.astype(int)), "measured, alive: got int32, expected .* bool"),
        (lambda set_: set_.replace(fell=[False, False]), "measured, fell: got list, expected an array of bool"),
    ],
    ids=["nothing", "too few", "numbers", "list"],
)
def test_a_measured_set_is_looked_at_before_anything_is_simulated(tuners, change, message):
    _, host, seen = tuners
    measured = SLIDER.measure(TWO, 2)(jax.random.key(0), toys.policy())
    seen.clear()
    with pytest.raises(ValueError, match=message):
        host.tune(jax.random.key(1), state(), change(measured))
    assert not seen


def test_observations_that_never_change_are_named():
    def simulate(key, policy, coords):
        episodes = SLIDER.simulate(key, policy, coords)
        return episodes.replace(obs=jnp.ones_like(episodes.obs))

    measured = SLIDER.measure(TWO, 2)(jax.random.key(0), toys.policy())
    with pytest.raises(ValueError, match="simulate, obs: got 2 numbers that are the same in every step"):
        HostTuner(config=SIZES, simulate=simulate).tune(jax.random.key(1), state(), measured)


def test_a_run_is_a_loop_of_tunings(tuners):
    _, host, _ = tuners
    begin = state()
    moved, infos = host.run(jax.random.key(5), begin, 2)
    assert infos.calls.shape == (2,)
    np.testing.assert_array_equal(infos.train["steps"], [1.0, 1.0])
    for number, key in enumerate(jax.random.split(jax.random.key(5), 2)):
        key_measure, key_tune, _ = jax.random.split(key, 3)
        measured = host.measure(key_measure, begin.policy)
        begin, info = host.tune(key_tune, begin, measured)
        np.testing.assert_array_equal(infos.update.step[number], info.update.step)
    for got, wanted in zip(jax.tree.leaves(moved), jax.tree.leaves(begin), strict=True):
        np.testing.assert_array_equal(got, wanted)


def test_episodes_are_played_one_by_one():
    seen = []

    def play(seed, policy, coords):
        seen.append((seed, policy, coords))
        return episode(4 if coords["mass"] < 0 else 6)

    coords = {"mass": np.array([-0.5, 0.5]), "drag": np.array([1.0, 2.0])}
    episodes = one_by_one(play)(jax.random.key(0), "walk", coords)
    assert [one[1:] for one in seen] == [("walk", {"mass": -0.5, "drag": 1.0}), ("walk", {"mass": 0.5, "drag": 2.0})]
    assert seen[0][0] != seen[1][0]
    np.testing.assert_array_equal(episodes.alive.sum(axis=1), [4, 6])
    assert one_by_one(play, steps=9)(jax.random.key(0), "walk", coords).obs.shape == (2, 9, 2)


# Episodes of a Gymnasium loop


def episode(length, terminated=False, **changes):
    rows = np.arange(length)
    record = {
        "observation": [[float(t), 10.0 + t] for t in range(length)],
        "action": [[0.1 * t] for t in range(length)],
        "reward": list(1.0 + rows),
        "terminated": terminated,
        "truncated": not terminated,
    }
    return {**record, **changes}


def test_episodes_of_any_length_become_one_set():
    ends = [False] * 3 + [True]
    episodes = Trajectory.from_episodes([episode(6), episode(4, terminated=ends), episode(3)], steps=5)
    assert episodes.obs.shape == (3, 5, 2)
    assert episodes.action.shape == (3, 5, 1)
    np.testing.assert_array_equal(episodes.alive.sum(axis=1), [5, 4, 3])
    # The first was cut, the second fell, the third was stopped.
    np.testing.assert_array_equal(episodes.fell, [False, True, False])
    np.testing.assert_array_equal(episodes.obs[1, :, 1], [10.0, 11.0, 12.0, 13.0, 0.0])
    np.testing.assert_array_equal(episodes.score[2], [1.0, 2.0, 3.0, 0.0, 0.0])
    assert not episodes.not_finite.any()


def test_states_are_cut_and_padded_as_observations_are():
    rows = np.arange(6.0)
    states = [{"qpos": rows[:count, None] + [0.0, 10.0], "time": rows[:count].copy()} for count in (6, 4)]
    # One state more is that after the last step.
    sets = [episode(6, state=states[0]), episode(3, state=states[1])]
    state = Trajectory.from_episodes(sets, steps=5).state
    assert state["qpos"].shape == (2, 5, 2)
    np.testing.assert_array_equal(state["qpos"][1, :, 1], [10.0, 11.0, 12.0, 0.0, 0.0])
    np.testing.assert_array_equal(state["time"], [[0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 2.0, 0.0, 0.0]])
    assert Trajectory.from_episodes([episode(3)]).state is None
    # A state that is not finite ends an episode as an observation does.
    sets[0]["state"]["time"][2] = np.nan
    np.testing.assert_array_equal(Trajectory.from_episodes(sets).alive.sum(axis=1), [2, 3])


def test_a_simulator_may_return_what_it_changes_later():
    buffer = np.zeros(2, np.float32)

    def go_on(state, actions, coords):
        buffer[:] = state["x"] + coords["mass"]
        state["x"] += 1.0
        return {"x": buffer}

    play = jax.vmap(pieces_one_by_one(go_on).play)
    ended = play({"x": jnp.arange(8.0).reshape(4, 2)}, jnp.zeros((4, 3, 1)), {"mass": jnp.arange(4.0)})
    np.testing.assert_array_equal(ended, np.arange(8.0).reshape(4, 2) + np.arange(4.0)[:, None])
    whole = jax.vmap(pieces_one_by_one(lambda state, *_: state).play)
    assert whole({"steps": jnp.arange(3)}, jnp.zeros((3, 1, 1)), {}).tolist() == [[0], [1], [2]]


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ({"y": np.zeros(2)}, r"go_on, x: got y, expected shape \(2,\)"),
        ({"x": np.zeros((2, 1))}, r"go_on, x: got shape \(2, 1\), expected shape \(2,\)"),
    ],
)
def test_a_state_of_another_name_or_shape_is_named(returned, message):
    play = pieces_one_by_one(lambda *_: returned).play
    with pytest.raises(Exception, match=message):
        jax.block_until_ready(play({"x": jnp.zeros(2)}, jnp.zeros((1, 1)), {}))


def test_the_longest_episode_sets_the_length_and_a_last_observation_is_left_out():
    longer = episode(4, observation=[[0.0, 0.0]] * 5)
    assert Trajectory.from_episodes([episode(3), longer]).obs.shape == (2, 4, 2)


def test_an_episode_is_masked_from_its_first_number_that_is_not_finite():
    broken = episode(5)
    broken["observation"][2][1] = float("nan")
    episodes = Trajectory.from_episodes([broken, episode(5)])
    np.testing.assert_array_equal(episodes.alive.sum(axis=1), [2, 5])
    np.testing.assert_array_equal(episodes.not_finite, [True, False])
    # As in a simulation that breaks.
    np.testing.assert_array_equal(episodes.fell, [True, False])
    np.testing.assert_array_equal(episodes.score[0], [1.0, 2.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "episodes: got none"),
        (
            [{"obs": [[1.0]], "action": [[1.0]]}],
            "episode 0: got obs, action, expected observation, reward, terminated as",
        ),
        (
            [episode(3), episode(3, action=[[0.0]] * 2)],
            r"episode 1: got 3 observations, 2 actions, rewards of shape \(3,\)",
        ),
        ([episode(3, reward=[[1.0]] * 3)], r"rewards of shape \(3, 1\)"),
        ([episode(3, observation=[[1.0], [1.0, 2.0], [1.0]])], "episode 0, observation: expected one list of numbers"),
        ([episode(3, observation=[{"camera": 1.0}] * 3)], "episode 0, observation: expected one list of numbers"),
        ([episode(3), episode(3, action=[[0.0, 1.0]] * 3)], "episodes, action: got 2 widths"),
        (episode(3), "episodes: got dict, expected a list of episodes"),
        (None, "episodes: got NoneType, expected a list"),
        ([episode(3), None], "episode 1: got NoneType, expected observation, action, reward, terminated by name"),
        ([episode(0)], "episode 0, observation: got no step"),
        ([episode(3, terminated="False")], "episode 0, terminated: got <U5"),
        ([episode(3, terminated=None)], "episode 0, terminated: got object"),
        ([episode(3, terminated=[])], r"terminated: got float64 of shape \(0,\)"),
        ([episode(3, terminated=[False, True, False])], "True in none but the last"),
        ([episode(3, state={"qpos": [0.0] * 3}), episode(3)], "episode 1, state: got none, expected qpos"),
        ([episode(3, state={"qpos": [0.0] * 2})], r"episode 0, state, qpos: got shape \(2,\), expected \(3,\)"),
        (
            [episode(2, state={"qpos": [[0.0]] * 2}), episode(2, state={"qpos": [[0.0, 1.0]] * 2})],
            r"episode 1, state, qpos: got shape \(2, 2\), expected \(2, 1\)",
        ),
        ([episode(2, state=[[0.0], [0.0]])], r"episode 0, state: got list, expected arrays \[time, ...\] by name"),
        ([episode(2, state={"qpos": [[0.0], [0.0, 1.0]]})], "episode 0, state, qpos: expected numbers of one shape"),
    ],
)
def test_episodes_that_do_not_fit_together_are_refused(episodes, message):
    with pytest.raises(ValueError, match=message):
        Trajectory.from_episodes(episodes)


def test_a_set_of_episodes_can_be_measured_by_a_tuner(tuners):
    whole = SLIDER.measure(TWO, 2)(jax.random.key(0), toys.policy())
    lists = [
        {"observation": obs, "action": action, "reward": score, "terminated": False}
        for obs, action, score in zip(whole.obs.tolist(), whole.action.tolist(), whole.score.tolist(), strict=True)
    ]
    measured = Trajectory.from_episodes(lists)
    _, info = tuners[1].tune(jax.random.key(1), state(), jax.tree.map(jnp.asarray, measured))
    assert info.verdicts[0] in (Verdict.ACCEPT, Verdict.WIDEN)
