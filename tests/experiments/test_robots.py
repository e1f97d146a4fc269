"""Robots of another hand in the commands: `--robot` takes a name, an environment of a package, or a file."""

import json
from dataclasses import replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sled import TABLE

from envs import logs
from experiments import export, robot_stub, sim2real, sim2sim, sweep, train
from experiments.common.config import PRESETS
from experiments.robot.rounds import Terms
from experiments.robot.surrogate import Body
from experiments.walking import robots
from experiments.walking.learner import Learner
from experiments.walking.policies import default_policy, starting_policy
from experiments.walking.robots import kind
from jaxtune.network import Network

FILE = Path(__file__).parents[1] / "sled.py"
ROBOT = f"{FILE}:simulator"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("go3", "robot: got 'go3', expected biteno, go2, playground:NAME, playground-warp:NAME or"),
        ("no/file.py:make", "robot: no/file.py does not exist"),
        (f"{FILE}:sledge", "has no function 'sledge'"),
        (f"{FILE}:nothing", "robot '.*:nothing': env: got NoneType, which has no MJX model"),
        (f"{FILE}:without_keys", r"robot '.*:without_keys': observe: got None, expected some of seen, told"),
        (f"{FILE}:timeless", "robot '.*:timeless': env: has no dt, the control period in seconds"),
        (f"{FILE}:of_steps", r"got of_steps\(steps\), expected a function of no arguments"),
        ("biteno:fast", "robot: got 'biteno:fast'"),
    ],
)
def test_a_robot_that_cannot_be_is_named(name, message):
    with pytest.raises(ValueError, match=message):
        kind(name)


def test_a_playground_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mujoco_playground", None)
    with pytest.raises(ValueError, match="MuJoCo Playground is not installed; expected `pip install playground`"):
        kind("playground:CheetahRun")


def test_environments_of_playground_are_taken_by_name():
    pytest.importorskip("mujoco_playground", reason="needs the extra playground")
    assert {"torso_mass", "strength", "damping", "delay"} < kind("playground:CheetahRun").entries.keys()
    with pytest.raises(ValueError, match=r"robot: got 'playground:CheetahWalk', expected one of .*CheetahRun"):
        kind("playground:CheetahWalk")


def test_warp_simulates_an_environment_of_playground_on_one_device(monkeypatch):
    pytest.importorskip("mujoco_playground", reason="needs the extra playground")
    first = jax.devices()[0]
    monkeypatch.setattr(jax, "devices", lambda *_: [first, "second"])
    with pytest.raises(ValueError, match=r"'playground-warp:CheetahRun' on 2 devices, expected one: set CUDA_VISIBLE"):
        kind("playground-warp:CheetahRun")
    monkeypatch.setattr(jax, "devices", lambda *_: [first])
    warp, own = kind("playground-warp:CheetahRun"), kind("playground:CheetahRun")
    assert warp.entries == own.entries
    # What one has learnt, the other plays.
    assert warp.config(None) == own.config(None) == {"robot": "playground:CheetahRun"}


def test_a_file_may_have_the_name_of_a_package(tmp_path):
    file = tmp_path / "brax.py"
    file.write_text("from brax import envs\nfrom sled import simulator\n")
    assert list(kind(f"{file}:simulator").entries) == list(kind(ROBOT).entries)


def test_of_a_dictionary_the_state_is_compared():
    assert kind(f"{FILE}:with_a_state").make(PRESETS["smoke"], TABLE, None).layout == {"state": 2}


def test_episodes_shorter_than_a_window_are_refused_before_a_policy_is_trained():
    robot = kind(f"{FILE}:short")
    with pytest.raises(ValueError, match=r"robot '.*:short': got episodes of 30 steps, expected at least 50"):
        Learner(PRESETS["smoke"], robot.chosen(None), kind=robot)


def test_a_stand_in_takes_the_options_of_its_robot():
    options = {"folder": Path("anywhere")}
    with pytest.raises(ValueError, match="truth: got mass=2, but biteno has a body"):
        robot_stub.stand_in(robot_stub.Args(truth=("mass=2",), **options))
    with pytest.raises(ValueError, match=r"body: got .*, but .*simulator is its own simulation"):
        robot_stub.stand_in(robot_stub.Args(robot=ROBOT, body=Body(trunk_mass=2.0), **options))


def test_a_simulator_brings_its_table_and_an_environment_is_proposed_one():
    assert list(kind(ROBOT).chosen(None)) == ["mass", "damping", "strength", "delay"]
    assert list(kind(f"{FILE}:environment").chosen("sled_mass,strength")) == ["sled_mass", "strength"]
    with pytest.raises(ValueError, match="gravity"):
        kind(ROBOT).chosen("mass,gravity")


@pytest.mark.parametrize("name", ["simulator", pytest.param("keyed", marks=pytest.mark.slow)])
def test_a_policy_trains_on_robots_that_start_anew(name):
    robot = kind(f"{FILE}:{name}")
    learner = Learner(PRESETS["smoke"], robot.chosen("mass,delay"), kind=robot)
    assert learner.longest == 40  # 0.8 s of steps of 0.02 s
    assert learner.preset.episode_steps == 60  # the smaller of the preset's 80 and the simulator's
    policy = learner.init(jax.random.PRNGKey(0))
    before = policy.robots
    dist = learner.dist({"mass": 1.2}, 0.1)
    step = jax.jit(lambda key, policy: learner.train(key, policy, dist, 6))
    policy, metrics = step(jax.random.PRNGKey(1), policy)
    assert np.isfinite(metrics["loss"]).all()
    # 6 rollouts of 8 steps are longer than an episode.
    assert (np.asarray(policy.robots.pipeline_state.steps) < 40).all()
    assert not np.array_equal(policy.robots.obs, before.obs)
    drawn = np.asarray(policy.robots.info["params"]["mass"])
    assert np.abs(np.log(drawn / 1.2)).max() <= 0.1 + 1e-6
    assert np.ptp(drawn) > 0.05


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("sled") / "policy"
    train.main(train.Args(robot=ROBOT, preset="smoke", out=out))
    return out


@pytest.mark.slow
def test_the_whole_comparison_runs_on_another_robot(trained, tmp_path):
    out = tmp_path / "run"
    sim2sim.main(
        sim2sim.Args(
            robot=ROBOT,
            truth=("mass=1.3", "strength=0.8"),
            parameters="mass,damping",
            methods=("ours",),
            policy=str(trained),
            preset="smoke",
            out=out,
        )
    )
    summary = json.loads((out / "summary.json").read_text())
    assert summary["off"] == ["mass"]
    first = json.loads((out / "results" / "ours_0.json").read_text())["lines"][0]
    np.testing.assert_allclose(first["param_error"]["mass"], abs(1 / 1.3 - 1), rtol=1e-5)
    assert first["param_error"]["damping"] == 0
    assert len(summary["methods"]["ours"]["verdicts"][0]) >= 2


@pytest.fixture
def swept(trained, tmp_path):
    """Options of a sweep of four runs, one of them in a piece of its own."""
    options = {"step_sizes": (0.5,), "widen_factors": (1.5,), "radii": (0.2, 0.3), "levels": (0.9,), "seeds": (0, 1)}
    more = {"truth": ("damping=2",), "preset": "smoke", "lanes": 3, "policy": str(trained)}
    return sweep.Args(robot=ROBOT, parameters="mass,damping", out=tmp_path / "sweep", **options, **more)


EXCESSES = ("novelty", "threshold", "cover", "lost", "misfit", "beyond")


@pytest.mark.slow
def test_a_lane_of_a_sweep_is_a_run_of_its_own(trained, swept):
    sizes, robot, entries, case = sweep.check(swept)
    learner = Learner(sizes, entries, kind=robot)
    assert case.off(entries) == ("damping",)
    policy = starting_policy(str(trained), learner)
    one = sweep.lane(swept, learner, case.true_params(entries, 0.5), policy)
    rows = sweep.lanes(swept).reshape(-1, 5)[1:3]
    _, infos, returns, _ = jax.jit(jax.vmap(one))(rows)
    single = jax.jit(one)
    for index, row in enumerate(rows):
        _, info, value, _ = single(row)
        # The gate's excesses are quotients by the scatter of 19 sets, read by models of 24 episodes: both enlarge the
        # rounding of single precision (a fifth of a per cent was seen).
        for name in EXCESSES:
            np.testing.assert_allclose(infos.gate[name][index, 0], info.gate[name][0], rtol=1e-2, atol=1e-2)
        ours, theirs = (it.replace(gate=it.gate.replace(**dict.fromkeys(EXCESSES, 0.0))) for it in (infos, info))
        for one_leaf, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            if np.ndim(other):
                np.testing.assert_allclose(one_leaf[index, 0], other[0], rtol=1e-5, atol=1e-5)
        # Rounding may grow, but hardly over two short tunings.
        np.testing.assert_allclose(returns[index], value, atol=0.05)
    np.testing.assert_allclose(infos.radius[:, 0, 0], [0.2, 0.3], rtol=1e-6)


@chex.dataclass
class Found:
    """What a sweep reads of a run's infos."""

    calls: jax.Array
    verdicts: jax.Array


def test_a_sweep_goes_on_after_its_last_lanes(swept, monkeypatch):
    begun = []

    def lane(args, learner, truth, policy):
        near = learner.dist(truth, 0.2)

        def one(settings):
            begun.append(1)
            off = near.replace(centre={name: value + settings[2] for name, value in near.centre.items()})
            info = Found(calls=jnp.array([1, 2]), verdicts=jnp.array([[0, -1], [1, 0]]))
            return off, info, settings[4], jnp.zeros((), int)

        return one

    monkeypatch.setattr(sweep, "lane", lane)
    sweep.main(swept)
    summary = json.loads((swept.out / "summary.json").read_text())
    assert summary["lanes"] == 4 and summary["trained"]
    for row, radius in zip(summary["rows"], (0.2, 0.3), strict=True):
        assert row["radius"] == pytest.approx(radius)
        assert row["return"] == [0.0, 1.0]
        assert (row["gate_calls"], row["accepted"]) == ([3, 3], [2, 2])
        np.testing.assert_allclose(row["error"], np.exp(radius) - 1, rtol=1e-5)
    (swept.out / "lanes" / "0000.json").unlink()
    kept = (swept.out / "lanes" / "0003.json").stat().st_mtime_ns
    sweep.main(swept)
    assert json.loads((swept.out / "summary.json").read_text())["rows"] == summary["rows"]
    assert (swept.out / "lanes" / "0003.json").stat().st_mtime_ns == kept
    begun.clear()
    sweep.main(swept)
    assert not begun


def test_what_is_exported_acts_as_what_was_trained(trained, tmp_path):
    export.main(export.Args(robot=ROBOT, policy=str(trained), preset="smoke", out=tmp_path))
    assert {file.name for file in tmp_path.iterdir()} == {"policy.onnx", "policy.npz", "network.py"}
    network = Network(tmp_path / "policy.npz")
    assert network.meta["observation"] == [{"name": "obs", "size": 3}]
    assert network.meta["rate_hz"] == 50
    robot = kind(ROBOT)
    learner = Learner(PRESETS["smoke"], robot.chosen(None), kind=robot)
    act = learner.act(starting_policy(str(trained), learner))
    for obs in np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32):
        np.testing.assert_allclose(network(obs), act(obs, jax.random.PRNGKey(0)), rtol=1e-6, atol=1e-5)
    with pytest.raises(ValueError, match="obs: got a number that is not finite"):
        network(np.array([0.0, np.nan, 0.0]))


@pytest.mark.slow
def test_a_round_with_a_robot_that_answers_through_observations(trained, tmp_path):
    terms = Terms(walk_s=1.2, force=True, timeout_s=0.0)
    options = {"robot": ROBOT, "parameters": "mass,damping", "policy": str(trained), "preset": "smoke", "rounds": 1}
    args = sim2real.Args(out=tmp_path / "run", terms=terms, **options)
    with pytest.raises(ValueError, match="no log after 0 s"):
        sim2real.main(args)
    place = args.out / "round_000"
    robot, _ = robot_stub.stand_in(robot_stub.Args(robot=ROBOT, truth=("mass=1.6",), folder=tmp_path))
    falls = robot_stub.answer(place, robot, 0)
    log = logs.read_observed(place / "log")
    assert [len(run.time) for run in log.runs] == [62] * len(log.runs)  # 1.25 s of steps of 0.02 s
    sim2real.main(args)
    (line,) = json.loads((args.out / "summary.json").read_text())["rounds"]
    measured = line["measured"]
    assert measured["episodes"] == len(falls)
    assert measured["fall_rate"] == np.mean(falls)
    rewards = [run.other["reward"][:60].sum() for run in log.runs]
    np.testing.assert_allclose(measured["return"], np.mean(rewards), rtol=1e-4)
    assert line["tuning"]["compared_s"] == pytest.approx(1.2)
    assert line["tuning"]["moved"].keys() == {"mass", "damping"}
    # Measured and simulated episodes are of the same kind: on the robot that is simulated they are the same.
    kind_of = kind(ROBOT)
    recorded = kind_of.episodes(log, 60).trajectory
    values = {"mass": jnp.full(1, 1.6), "damping": jnp.ones(1), "strength": jnp.ones(1), "delay": jnp.zeros(1)}
    again = kind_of.make(None, kind_of.entries, None).rollout(
        jax.random.key(0), lambda actions, obs, key: actions, recorded.action[0, 0], values
    )
    np.testing.assert_allclose(again.obs[0, 1, 2], recorded.obs[0, 1, 2], atol=1e-6)


def test_what_another_robot_does_not_have_is_named(trained, tmp_path):
    robot = kind(ROBOT)
    learner = Learner(PRESETS["smoke"], robot.chosen(None), kind=robot)
    assert default_policy(robot) == "scratch"
    with pytest.raises(ValueError, match=r"policy: got 'walk', but .*sled.py:simulator ships none"):
        starting_policy("walk", learner)
    with pytest.raises(ValueError, match="case: got 'bullet', whose target is in bullet; this robot has mjx"):
        sim2sim.check(sim2sim.Args(robot=ROBOT, case="bullet"))
    with pytest.raises(ValueError, match="target: got 'mujoco_c', expected one of mjx"):
        sim2sim.check(sim2sim.Args(robot=ROBOT, target="mujoco_c"))
    with pytest.raises(ValueError, match=r"truth: got 'mass=9', expected 0.5 to 2"):
        sim2sim.check(sim2sim.Args(robot=ROBOT, truth=("mass=9",)))
    with pytest.raises(ValueError, match="case 'mass' needs one whose value differs"):
        sim2sim.check(sim2sim.Args(robot=ROBOT, parameters="damping"))
    with pytest.raises(ValueError, match="corrected model, which can be simulated with --robot biteno alone"):
        Learner(PRESETS["smoke"], robot.chosen(None), correction=object(), kind=robot)
    # A policy of another robot, even of the same sizes, is another policy.
    other = kind(f"{FILE}:environment")
    with pytest.raises(ValueError, match="robot"):
        starting_policy(str(trained), Learner(replace(PRESETS["smoke"]), other.chosen(None), kind=other))


@pytest.mark.slow
def test_a_go2_goes_through_every_step(tmp_path):
    common = {"robot": "go2", "preset": "smoke", "policy": str(tmp_path / "policy")}
    train.main(train.Args(robot="go2", preset="smoke", out=tmp_path / "policy"))
    tuned = {"parameters": "base_mass,calf_mass,strength", "truth": ("base_mass=1.3",), "methods": ("ours",)}
    sim2sim.main(sim2sim.Args(**common, **tuned, out=tmp_path / "tuned"))
    assert json.loads((tmp_path / "tuned" / "summary.json").read_text())["off"] == ["base_mass"]
    lanes = {"step_sizes": (0.5,), "widen_factors": (1.5,), "radii": (0.2,), "levels": (0.9,), "seeds": (0,)}
    of_sweep = {name: value for name, value in tuned.items() if name != "methods"}
    sweep.main(sweep.Args(**common, **of_sweep, **lanes, out=tmp_path / "swept"))
    assert (tmp_path / "swept" / "heat_map.png").exists()
    export.main(export.Args(**common, out=tmp_path / "exported"))
    assert Network(tmp_path / "exported" / "policy.npz")(np.zeros(45)).shape == (12,)
    terms = Terms(walk_s=1.6, force=True, timeout_s=0.0)
    args = sim2real.Args(**common, out=tmp_path / "run", parameters="base_mass,strength", rounds=1, terms=terms)
    with pytest.raises(ValueError, match="no log after 0 s"):
        sim2real.main(args)
    robot, _ = robot_stub.stand_in(robot_stub.Args(robot="go2", truth=("base_mass=1.3",), folder=tmp_path))
    falls = robot_stub.answer(args.out / "round_000", robot, 0)
    sim2real.main(args)
    (line,) = json.loads((args.out / "summary.json").read_text())["rounds"]
    assert line["measured"]["episodes"] == len(falls)
    assert line["tuning"]["verdicts"]


def test_a_run_is_of_a_robot_as_its_file_and_its_model_were(tmp_path):
    file = tmp_path / "own.py"
    text = FILE.read_text()
    file.write_text(text)
    before = kind(f"{file}:simulator").identity
    assert before == kind(f"{file}:simulator").identity
    (changed := tmp_path / "changed").mkdir()
    (changed / "own.py").write_text(text + "\nMORE = 1\n")
    assert kind(f"{changed / 'own.py'}:simulator").identity != before
    made = robots._from_file(file, "simulator")
    heavier = replace(made, model=made.model.replace(body_mass=1.5 * made.model.body_mass))
    assert robots._digest(file, heavier) != before["robot_sha256"]
    assert kind("go2").identity == {}


@pytest.mark.parametrize("command", [sim2sim, sweep])
def test_a_policy_that_cannot_be_loaded_leaves_no_run_behind(command, tmp_path):
    out = tmp_path / "run"
    with pytest.raises(ValueError, match="no/policy"):
        command.main(command.Args(robot=ROBOT, out=out, policy="no/policy", preset="smoke"))
    assert not (out / "config.json").exists()
