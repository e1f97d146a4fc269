import dataclasses
import functools
import types
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import toys
from brax import envs
from brax.envs.wrappers.training import DomainRandomizationVmapWrapper
from mujoco import mjx
from sled import SUBSTEPS, TABLE, Keyed, Sled

from jaxtune import dist as dists
from jaxtune import tuner
from jaxtune.mjx import Simulator, action_delay, apply_mujoco, field, from_coords, mass, to_coords

STEPS = 60


def act(policy, obs, key):
    """Pushes to and fro with the position, so that actions differ from step to step."""
    del key
    return jnp.sin(policy * (1.0 + 9.0 * obs[:1])) + 2.0


@pytest.fixture(scope="module")
def sim():
    return Simulator(Sled(), steps=STEPS, parameters=TABLE)


@pytest.fixture(scope="module")
def play(sim):
    rollout = jax.jit(lambda key, params: sim.rollout(key, act, 3.0, params))

    def run(**params):
        count = max(np.size(value) for value in params.values())
        values = {"mass": 1.0, "damping": 1.0, "strength": 1.0, "delay": 0.0, **params}
        return rollout(
            jax.random.key(7), {name: np.broadcast_to(np.float32(v), (count,)) for name, v in values.items()}
        )

    return run


def rollout(sim, seed, act, policy, params):
    """One compilation; op by op would take longer."""
    return jax.jit(lambda params: sim.rollout(jax.random.key(seed), act, policy, params))(params)


def in_mujoco(velocity, actions, **params):
    """Positions and velocities of the sled in MuJoCo C, given what its motor was told."""
    sled = Sled()
    model = apply_mujoco(sled.mj_model, params, {name: TABLE[name] for name in params})
    data = mujoco.MjData(model)
    data.qvel[:] = velocity
    found = []
    for action in actions:
        found.append([data.qpos[0], data.qvel[0]])
        data.ctrl[:] = action
        mujoco.mj_step(model, data, SUBSTEPS)
    return np.array(found)


def test_every_episode_has_a_model_of_its_own(play):
    params = {"mass": [0.6, 1.7, 1.0], "damping": [3.0, 1.0, 0.3], "strength": [1.0, 1.8, 0.7]}
    episodes = play(**params)
    for row in range(3):
        mine = {name: values[row] for name, values in params.items()}
        expected = in_mujoco(episodes.obs[row, 0, 1], episodes.action[row], **mine)
        np.testing.assert_allclose(episodes.obs[row, :, :2], expected, rtol=2e-4, atol=1e-5)
    assert episodes.alive.all()
    assert not episodes.fell.any()
    # The reward of a step is the speed at its end.
    np.testing.assert_allclose(episodes.score[:, :-1], episodes.obs[:, 1:, 1], rtol=1e-6)


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.03, 0.05])
def test_a_delayed_action_is_interpolated_between_two_that_were_given(play, delay_s):
    episodes = play(mass=1.0, delay=delay_s)
    given = np.asarray(episodes.action[0, :, 0])
    assert np.abs(np.diff(given)).max() > 0.1
    # Control steps of 0.02 s; before the first one the action is as it was then.
    time = np.arange(STEPS - 1)
    late = np.interp(time - delay_s / 0.02, time, given[:-1])
    np.testing.assert_allclose(episodes.obs[0, 1:, 2], late, atol=1e-5)


def test_an_episode_ends_where_the_environment_is_done(play):
    episodes = play(mass=[0.5, 2.0], strength=2.0, damping=0.2)
    lived = np.asarray(episodes.alive.sum(axis=1))
    assert lived[0] < STEPS == lived[1]
    np.testing.assert_array_equal(episodes.fell, [True, False])
    # The step that ends it is its last one, from within the bounds.
    assert np.abs(episodes.obs[0, lived[0] - 1, 0]) <= 1.5 < np.abs(episodes.obs[0, lived[0], 0])
    np.testing.assert_array_equal(episodes.score[0, lived[0] :], 0.0)
    assert not episodes.not_finite.any()


def test_a_step_that_is_not_finite_is_counted_and_masked(sim):
    def breaks(policy, obs, key):
        return jnp.where(obs[:1] > policy, jnp.nan, 2.0)

    episodes = rollout(sim, 7, breaks, 0.3, {"delay": jnp.zeros(2)})
    assert episodes.not_finite.all()
    lived = episodes.alive.sum(axis=1)
    assert np.all((lived > 5) & (lived < STEPS))
    assert np.isfinite(np.where(episodes.alive, episodes.score, 0.0)).all()


def test_a_step_that_explodes_is_not_finite():
    class Explosive(Sled):
        def step(self, state, action):
            state = super().step(state, action)
            return dataclasses.replace(state, obs=jnp.where(state.data.time > 0.3, 1e12, state.obs))

    episodes = rollout(Simulator(Explosive(), steps=STEPS, parameters=TABLE), 7, act, 3.0, {"delay": jnp.zeros(2)})
    assert episodes.not_finite.all()
    np.testing.assert_array_equal(episodes.alive.sum(axis=1), 15)


def test_double_precision_is_simulated():
    with jax.enable_x64(True):
        sim = Simulator(Sled(), steps=5, parameters=TABLE)
        params = {"mass": jnp.ones(2), "delay": jnp.zeros(2)}
        shapes = jax.eval_shape(lambda params: sim.rollout(jax.random.key(0), act, 3.0, params), params)
    assert shapes.obs.shape == (2, 5, 3)


def test_simulate_takes_coordinates_and_measure_hides_parameters(sim, play):
    key = jax.random.key(7)
    coords = {"mass": jnp.log(jnp.array([1.3])), "delay": jnp.array([0.8])}
    expected = play(mass=1.3, delay=0.02)
    measure = sim.measure(act, {"mass": 1.3, "delay": 0.02}, 1)
    for episodes in (jax.jit(sim.simulate(act))(key, 3.0, coords), jax.jit(measure)(key, 3.0)):
        np.testing.assert_allclose(episodes.obs, expected.obs, rtol=1e-4, atol=1e-5)


def test_a_replay_goes_on_from_any_state_as_the_episode_did(sim):
    truth = {"mass": 1.3, "damping": 2.0, "strength": 0.8, "delay": 0.03}
    episodes = jax.jit(sim.measure(act, truth, 2, states=True))(jax.random.key(7), 3.0)
    np.testing.assert_array_equal(episodes.state["qpos"][..., 0], episodes.obs[..., 0])
    replay, steps = sim.replay(), 7
    coords = {name: jnp.float32(value) for name, value in to_coords(TABLE, truth).items()}

    @jax.jit
    def end(state, actions, coords):
        return replay.play(state, actions, coords)

    for episode, begin in ((0, 0), (1, 1), (1, 2), (0, 40)):
        at = lambda step, episode=episode: jax.tree.map(lambda leaf: leaf[episode, step], episodes.state)  # noqa: E731
        actions, reached = episodes.action[episode, begin : begin + steps], replay.read(at(begin + steps))
        np.testing.assert_allclose(end(at(begin), actions, coords), reached, rtol=1e-5, atol=1e-6)
        for name in coords:
            other = end(at(begin), actions, coords | {name: coords[name] + 0.2})
            assert np.abs(other - reached).max() > 1e-4, name
        # Measured states may lack what a simulator alone knows.
        bare = {name: at(begin)[name] for name in ("qpos", "qvel", "past", "steps")}
        np.testing.assert_allclose(end(bare, actions, coords), reached, rtol=1e-4, atol=1e-5)


def test_states_are_kept_where_they_are_asked_for_alone(sim):
    coords = {"mass": jnp.zeros(2)}
    given = (jax.random.key(7), 3.0, coords)
    assert jax.eval_shape(sim.simulate(act), *given).state is None
    kept = jax.eval_shape(sim.simulate(act, states=True), *given).state
    assert kept["qvel"].shape == (2, STEPS, 1)


def test_an_environment_without_mujocos_data_cannot_be_replayed(sim):
    hidden = dataclasses.make_dataclass("Hidden", ["obs"])
    with pytest.raises(ValueError, match="env: got a state without data or pipeline_state"):
        sim.kept(types.SimpleNamespace(env=hidden(obs=0)))


def test_chunks_change_nothing(sim, monkeypatch):
    params = {"mass": jnp.linspace(0.5, 2.0, 5)}
    whole = rollout(sim, 1, act, 1.0, params)
    monkeypatch.setattr("jaxtune.mjx.episodes._CHUNK", {"cpu": 2})
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5),
        whole,
        rollout(sim, 1, act, 1.0, params),
    )


def test_a_distribution_reads_in_physical_values(sim):
    dist = sim.dist(radius=0.4, centre={"mass": 1.2})
    found = sim.physical(dist)
    # 1.2 exp(-0.4) and 1.2 exp(0.4); 0.4 of half of 0.05 s, cut at zero.
    assert found["mass"] == pytest.approx({"low": 0.80438, "value": 1.2, "high": 1.79019}, rel=1e-4)
    assert found["delay"] == pytest.approx({"low": 0.0, "value": 0.0, "high": 0.01}, abs=1e-6)


@pytest.mark.slow
def test_a_tuner_takes_it_as_it_is(sim):
    config = toys.TINY
    machine = tuner.Tuner(config=config, train_policy=tuner.keep, simulate=sim.simulate(act))
    measured = sim.measure(act, {"mass": 1.2}, config.set_episodes)(jax.random.key(3), 3.0)
    state = machine.init(3.0, sim.dist(radius=0.4), tuner.knobs())
    state, info = jax.jit(machine.tune)(jax.random.key(4), state, measured)
    assert info.calls >= 1
    assert "gate call" in tuner.explain(info)
    assert sim.physical(state.dist).keys() == TABLE.keys()


# Observations by key


@pytest.mark.parametrize(
    ("observe", "size"),
    [("state", 2), (("told", "state"), 3), (lambda obs: obs["state"][1:], 1)],
    ids=["key", "keys", "function"],
)
def test_dictionary_observations_are_compared_by_key(observe, size):
    sim = Simulator(Keyed(), steps=3, parameters=TABLE, observe=observe)
    start = lambda policy, obs, key: obs["state"][:1]  # noqa: E731
    episodes = jax.eval_shape(lambda mass: sim.rollout(jax.random.key(0), start, None, {"mass": mass}), jnp.ones(2))
    assert episodes.obs.shape == (2, 3, size)


@pytest.mark.parametrize("observe", [None, "states", ("state", "torque")], ids=["none", "misspelt", "one of two"])
def test_a_key_that_is_missing_is_named(observe):
    with pytest.raises(ValueError, match=r"observe: got .* expected some of state, told"):
        Simulator(Keyed(), steps=3, parameters=TABLE, observe=observe)


def test_a_key_for_an_observation_without_keys_is_refused():
    with pytest.raises(ValueError, match="observe: got 'state', but the environment's observation is one array"):
        Simulator(Sled(), steps=3, parameters=TABLE, observe="state")


# What is refused before anything compiles


class NoTime(Sled):
    dt = property()


class Elsewhere(Sled):
    """Simulates a model that nobody finds."""

    def __init__(self):
        super().__init__()
        self._own = self.__dict__.pop("_mjx_model")

    @property
    def mjx_model(self):
        return self._own

    def step(self, state, action):
        sled = Sled()
        sled._mjx_model = self._own
        return sled.step(state, action)


class Wrapped(Sled):
    """A wrapper, as Playground's and Brax's are."""

    @property
    def unwrapped(self):
        return Sled()


class Captured(Sled):
    """Its step was compiled with the model that it was made with."""

    def __init__(self):
        super().__init__()
        self.step = jax.jit(super().step)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Holding:
    data: mjx.Data
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    model: mjx.Model


class Carried(Sled):
    """Its step simulates the model that its reset has put into the state."""

    def reset(self, key):
        return Holding(**vars(super().reset(key)), model=self.mjx_model)

    def step(self, state, action):
        sled = Sled()
        sled._mjx_model = state.model
        return Holding(**vars(sled.step(state, action)), model=state.model)


class Several(Sled):
    def reset(self, key):
        return jax.vmap(super().reset)(jax.random.split(key, 4))


class Silent(Sled):
    def reset(self, key):
        return {"obs": jnp.zeros(2)}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "steps: got 0, expected at least 1"),
        ({"steps": 60.5}, "steps: got 60.5, expected at least 1, a whole number"),
        ({"steps": "60"}, "steps: got '60'"),
        ({"parameters": {}}, "parameters: got none"),
        ({"parameters": [TABLE["mass"]]}, "parameters: got list, expected rows"),
        ({"parameters": {"mass": (0.5, 2.0)}}, "parameter 'mass': got tuple, expected a row"),
        ({"parameters": {1: TABLE["mass"]}}, "parameters: got dict, expected rows .* by name"),
        (
            {"parameters": {"late": action_delay(bounds_s=(0.0, 30.0))}},
            r"parameter 'late', bounds: got \(0.0, 30.0\) s, expected at most an episode, 1.2 s",
        ),
        ({"observe": 3}, "observe: got 3, expected a key, keys, or a function"),
        ({"observe": ["state", 3]}, "observe: got .'state', 3., expected a key, keys"),
        ({"with_model": None}, "with_model: got None, expected a function"),
        ({"with_model": lambda env, model: None}, "with_model: got a function that returns NoneType"),
        ({"model": Sled().mj_model}, "model: got MjModel, expected mjx.Model"),
        ({"env": Elsewhere()}, "with_model: got none, and the default does not reach the model of Elsewhere"),
        ({"env": Wrapped()}, "env: got Wrapped around Sled, expected an environment without wrappers"),
        ({"env": Captured()}, "parameter 'mass': got an environment whose step does not depend on it"),
        ({"env": Several()}, r"an observation of shape \(4, 3\), .*, expected those of one robot"),
        ({"env": Silent()}, "env: got a reset that returns dict without 'obs'"),
        ({"parameters": {"m": mass("sledge", bounds=(0.5, 2.0))}}, "parameter 'm', targets: got body 'sledge'"),
        ({"parameters": {**TABLE, "more": TABLE["delay"]}}, "got delay and more, expected one action_delay at most"),
        ({"env": object()}, "env: got object, which has no MJX model in 'mjx_model'"),
        ({"env": NoTime()}, "parameter 'delay': the environment has no dt"),
    ],
)
def test_a_simulator_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Simulator(**{"env": Sled(), "steps": STEPS, "parameters": TABLE, **arguments})


def test_a_model_may_be_part_of_the_state():
    Simulator(Carried(), steps=STEPS, parameters=TABLE)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda obs: obs[:2], r"act: got shape \(2,\), expected an action of shape \(1,\)"),
        (lambda obs: obs[0], r"act: got shape \(\), expected an action of shape \(1,\)"),
        (lambda obs: (obs[:1], {}), r"act: got a tuple, expected an action"),
    ],
    ids=["two", "scalar", "and extras"],
)
def test_an_action_of_another_size_is_refused(sim, action, message):
    simulate = sim.simulate(lambda policy, obs, key: action(obs))
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(simulate, jax.random.key(0), 3.0, {"mass": jnp.zeros(2)})


def test_what_is_no_policy_or_no_episode_is_refused(sim):
    with pytest.raises(ValueError, match="act: got float, expected a function"):
        sim.simulate(3.0)
    with pytest.raises(ValueError, match="act: got NoneType, expected a function"):
        sim.measure(None, {}, 2)
    for episodes in (0, 5.0):
        with pytest.raises(ValueError, match=f"episodes: got {episodes}, expected a whole number"):
            sim.measure(act, {}, episodes)
    with pytest.raises(ValueError, match=r"parameter 'mass': got heavy, expected 0.5 to 2"):
        sim.measure(act, {"mass": "heavy"}, 2)


def test_a_distribution_that_cannot_be_is_refused(sim):
    for radius in (0.0, -1.0, float("nan"), float("inf"), "0.2"):
        with pytest.raises(ValueError, match=r"radius: got .*, expected a positive number"):
            sim.dist(radius)
    # A radius never exceeds the width of the bounds: log 4 = 1.386, and 2 for what is added.
    assert sim.dist(10.0).radius["mass"] == pytest.approx(1.386, abs=1e-3)
    assert sim.dist(10.0).radius["delay"] == 2.0
    other = Simulator(Sled(), steps=STEPS, parameters={"load": mass("sled", bounds=(1.2, 2.0))})
    with pytest.raises(ValueError, match=r"parameter 'load': got 1.0, expected 1.2 to 2"):
        other.dist()
    with pytest.raises(ValueError, match="parameters: got 'load', expected some of mass, damping, strength, delay"):
        sim.physical(other.dist(centre={"load": 1.5}))


def test_another_model_of_the_users_own(sim):
    """An environment of another make is simulated by a function that gives it a model."""

    def put(env, model):
        env = Elsewhere()
        env._own = model
        return env

    own = Simulator(Elsewhere(), steps=STEPS, parameters=TABLE, with_model=put)
    params = {"mass": jnp.array([0.6, 1.5]), "damping": jnp.array([2.0, 0.5])}
    episodes = rollout(own, 7, act, 3.0, params)
    expected = rollout(sim, 7, act, 3.0, params)
    np.testing.assert_allclose(episodes.obs, expected.obs, rtol=1e-5, atol=1e-6)
    assert np.abs(episodes.obs[0] - episodes.obs[1]).max() > 0.1


def test_a_hidden_parameter_out_of_bounds_is_refused(sim):
    with pytest.raises(ValueError, match=r"parameter 'mass': got 9.0, expected 0.5 to 2"):
        sim.measure(act, {"mass": 9.0}, 2)


# An environment of Brax


PENDULUM = {
    "pole": mass("pole", bounds=(0.3, 3.0)),
    "rail": field("dof_damping", joints="slider", bounds=(0.0, 2.0), offset=True),
}


@pytest.fixture(scope="module")
def pendulum():
    with warnings.catch_warnings():
        # Brax says that its own engines are no longer maintained.
        warnings.simplefilter("ignore", UserWarning)
        env = envs.get_environment("inverted_pendulum", backend="mjx")
    return Simulator(env, steps=5, parameters=PENDULUM)


# Brax reads contacts where MJX no longer wants them read.
@pytest.mark.filterwarnings("ignore:Accessing:DeprecationWarning")
def test_episodes_of_a_brax_environment_feel_their_parameters(pendulum):
    push = lambda policy, obs, key: jnp.ones(1)  # noqa: E731
    rollout = jax.jit(lambda params: pendulum.rollout(jax.random.key(0), push, None, params))
    episodes = rollout({"pole": jnp.array([1.0, 1.0, 3.0])})
    assert np.isfinite(episodes.obs).all()
    # Reset keys differ between episodes, and nothing but the pole differs between these two.
    same = rollout({"pole": jnp.array([1.0, 3.0, 3.0])})
    np.testing.assert_array_equal(same.obs[0], episodes.obs[0])
    assert np.abs(same.obs[1, 1:] - episodes.obs[1, 1:]).max() > 1e-3


@pytest.mark.filterwarnings("ignore:Accessing:DeprecationWarning")
def test_brax_randomises_with_draws_of_the_distribution(pendulum):
    env, count = pendulum.env, 3
    dist = pendulum.dist(radius=0.5)
    keys = jax.random.split(jax.random.PRNGKey(1), count)
    randomize = pendulum.randomization_fn(dist)
    # As the training functions of Brax and Playground bind them.
    wrapped = DomainRandomizationVmapWrapper(env, functools.partial(randomize, rng=keys))
    state = jax.jit(wrapped.reset)(keys)
    state = jax.jit(wrapped.step)(state, jnp.ones((count, 1)))

    @jax.jit
    def alone(model, key):
        one = pendulum.with_model(env, model)
        return one.step(one.reset(key), jnp.ones(1)).obs

    # The same robots, one after the other.
    for row in range(count):
        draw = jax.tree.map(lambda leaf: leaf[0], dists.sample(keys[row], dist, 1))
        robot = apply_mujoco(env.sys.mj_model, from_coords(PENDULUM, draw), PENDULUM)
        np.testing.assert_allclose(wrapped._sys_v.body_mass[row], robot.body_mass, rtol=1e-5)
        np.testing.assert_allclose(wrapped._sys_v.body_invweight0[row], robot.body_invweight0, rtol=1e-4, atol=1e-8)
        expected = alone(_row(wrapped._sys_v, wrapped._in_axes, row), keys[row])
        np.testing.assert_allclose(state.obs[row], expected, rtol=1e-4, atol=1e-5)


def _row(batch, axes, row):
    picked = {}
    for name in ("body_mass", "body_inertia", "dof_damping", "body_subtreemass", "body_invweight0", "dof_invweight0"):
        assert getattr(axes, name) == 0
        picked[name] = getattr(batch, name)[row]
    for name in ("dof_M0", "actuator_acc0"):
        picked[name] = getattr(batch, name)[row]
    picked["stat"] = batch.stat.replace(meaninertia=batch.stat.meaninertia[row])
    return batch.replace(**picked)


def test_a_delay_cannot_be_drawn_into_a_model(sim):
    with pytest.raises(ValueError, match=r"parameter 'delay': it is not part .*leave_out=\('delay',\)"):
        sim.randomization_fn(sim.dist())
    with pytest.raises(ValueError, match="parameters: got 'late'"):
        sim.randomization_fn(sim.dist(), leave_out=("late",))
    model, axes = sim.randomization_fn(sim.dist(), leave_out=("delay", "damping"))(
        sim.model, jax.random.split(jax.random.PRNGKey(0), 3)
    )
    assert np.ptp(model.body_mass[:, 1]) > 0.05
    assert (axes.body_mass, axes.dof_damping) == (0, None)


@pytest.mark.parametrize("backend", ["generalized", "positional", "spring"])
def test_brax_engines_that_ignore_the_model_are_refused(backend):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = envs.get_environment("inverted_pendulum", backend=backend)
    with pytest.raises(ValueError, match=f"env: got an environment of Brax's backend '{backend}', expected 'mjx'"):
        Simulator(env, steps=5, parameters=PENDULUM)
