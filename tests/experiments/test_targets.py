"""Targets that are not JAX, in the learner and on the command line."""

import json
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import envs.targets
from experiments import evaluate, sim2sim
from experiments.common import film
from experiments.common.config import preset
from experiments.walking.cases import CASES
from experiments.walking.learner import Learner
from experiments.walking.robots import BITENO
from experiments.walking.targets import TARGETS
from jaxtune import tuner as tuners
from jaxtune.types import Verdict

NAMES = {"friction": 0.0, "mass": 0.0}


def gate(key, config, collected, measured, knobs):
    value = jax.random.normal(key) + measured.obs.mean()
    return tuners.GateInfo(novelty=value, threshold=jnp.zeros(()))


def test_a_step_with_a_foreign_target_is_that_of_the_tuner():
    slider = toys.Slider()
    machine = tuners.Tuner(
        config=toys.TINY,
        train_policy=toys.train_policy,
        simulate=slider.simulate,
        measure=slider.measure(NAMES, 2),
        verify=gate,
        update=tuners.vote_update,
    )
    state = machine.init(toys.policy(), toys.uniform(NAMES, 0.2), tuners.knobs())
    traces = []

    def play(key, policy, count, steps):
        # It is asked with numbers, not traced.
        traces.append(isinstance(key, jax.core.Tracer))
        assert (count, steps) == (sizes.tuner.set_episodes, sizes.episode_steps)
        return machine.measure(key, policy)

    sizes = preset("smoke")
    train = jax.jit(toys.train_policy)
    learner = types.SimpleNamespace(preset=sizes, _program=train, _train=train)
    step = Learner.step(learner, machine, play)
    got, expected = step(jax.random.key(0), state), jax.jit(machine.step)(jax.random.key(0), state)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), got, expected)
    assert traces == [False]


def test_a_run_whose_every_measured_episode_fails_stops_with_the_reason():
    class Stub:
        _learner = types.SimpleNamespace(preset=preset("cpu"))

    def info(verdict, falls):
        return types.SimpleNamespace(calls=1, verdicts=[verdict], measured_falls=falls)

    for verdict in (Verdict.NOT_FINITE, Verdict.NOT_COMPARABLE):
        with pytest.raises(ValueError, match="target: every measured episode fell or broke"):
            sim2sim.Runner._check_walked(Stub, info(verdict, 5))
    sim2sim.Runner._check_walked(Stub, info(Verdict.NOT_FINITE, 4))
    sim2sim.Runner._check_walked(Stub, info(Verdict.ACCEPT, 5))


def test_cases_have_the_target_of_their_figure():
    truth = CASES["weak_motor"].true_params(BITENO.chosen("whole_body"), start=0.5)
    assert truth["torque_scale"] == 0.75
    assert all(value == 1.0 for name, value in truth.items() if name != "torque_scale")
    assert CASES["weak_motor"].target == CASES["bullet"].target == "bullet"
    assert CASES["mass"].target == CASES["friction"].target == "mjx"


def test_the_target_is_played_by_the_engine_that_is_asked_for():
    assert sim2sim.check(sim2sim.Args(case="weak_motor"))[3].target == "bullet"
    assert sim2sim.check(sim2sim.Args(case="weak_motor", target="mujoco_c"))[3].target == "mujoco_c"


def test_a_hidden_parameter_that_is_tuned_is_off_and_hidden_no_more():
    entries = BITENO.chosen("foot_friction,torque_scale")
    assert CASES["weak_motor"].off(entries) == ("torque_scale",)
    assert CASES["mass"].off(entries) == ()
    assert CASES["friction"].off(entries) == ("foot_friction",)
    # In the same engine that makes a case of it.
    sim2sim.check(sim2sim.Args(case="weak_motor", target="mjx", parameters="foot_friction,torque_scale"))


def test_a_case_without_its_parameters_is_no_case():
    with pytest.raises(ValueError, match="case 'mass' needs"):
        sim2sim.check(sim2sim.Args(case="mass", target="mujoco_c", parameters="foot_friction"))


def test_a_target_of_the_same_engine_and_parameters_is_no_case():
    with pytest.raises(ValueError, match="case 'bullet' needs"):
        sim2sim.check(sim2sim.Args(case="bullet", target="mjx"))


def test_pybullet_that_is_missing_is_named_with_its_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "envs.targets.bullet", raising=False)
    monkeypatch.delattr(envs.targets, "bullet", raising=False)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ValueError, match=r"pip install 'jaxtune\[bullet\]'"):
        TARGETS["bullet"](None, {})


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("target", "gazebo", "mjx, mujoco_c, bullet"),
        ("preset", "huge", "smoke, cpu, gpu"),
        ("episodes", 0, "1 or more"),
        ("push", -1.0, "not negative"),
        ("set", ("foot_friction",), "name=value"),
        ("set", ("foot_friction=slippery",), "name=value"),
        ("set", ("foot_friction=9",), "0.15 to 4"),
        ("set", ("wind=1",), "got 'wind'"),
    ],
)
def test_bad_input_of_evaluate_is_named(field, value, named):
    with pytest.raises(ValueError, match=named):
        evaluate.check(evaluate.Args(**{field: value}))


def test_evaluate_writes_what_it_measured(tmp_path, monkeypatch, capsys):
    def no_gl(*_):
        raise film.NoPicture("no GL")

    # Where there is no GL, MuJoCo's half-made context complains long after.
    monkeypatch.setattr(film, "strip", no_gl)
    evaluate.main(evaluate.Args(target="mujoco_c", physics="fast", episodes=1, set=("torque_scale=0.9",), out=tmp_path))
    result = json.loads((tmp_path / "evaluation.json").read_text())
    assert result["rows"].keys() == {"grid", "none", "pushes"}
    assert len(result["grid"]) == len(evaluate.GRID) == 36
    # The policy that ships walks; a statue would have no touchdown and topple.
    grid = result["rows"]["grid"]
    assert 1.0 < grid["touchdowns_per_s"] < 5.0
    assert grid["clock_agreement"] > 0.7
    assert grid["swing_clearance_m"] > 0.02
    assert (tmp_path / "gait.png").stat().st_size > 5000
    assert "no film: no GL" in capsys.readouterr().out
