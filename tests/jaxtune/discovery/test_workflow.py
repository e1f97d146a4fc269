"""Discovery on a slider whose truth is known: mass, damping, and whatever is hidden in it."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtune.discovery import workflow
from jaxtune.discovery.problem import Hypothesis, Problem, Residuals, Segments
from jaxtune.discovery.result import Settings
from jaxtune.discovery.workflow import Discovery

AXES = ("mass", "damping", "coulomb", "push", "nothing", "cubic", "wild")
HORIZONS = (0.1, 0.2, 0.4)
DT, NOISE = 0.01, 0.002


def simulate(vector, segment):
    """A slider of 1 kg and 1 N s/m pushed by a force [steps]; coordinates are what is added to them."""
    mass, damping, coulomb, push, _, cubic, wild = vector

    def step(state, force):
        x, v = state
        rub = coulomb * jnp.tanh(v / 0.02) + cubic * x**3
        # A hypothesis that breaks the simulation wherever it is tried.
        broken = jnp.where(wild > 0, jnp.nan, 0.0)
        v = v + DT * (force + push - (1.0 + damping) * v - rub) / jnp.exp(mass) + broken
        x = x + DT * v
        return (x, v), (x, v)

    _, (x, v) = jax.lax.scan(step, (segment["x"], segment["v"]), segment["force"])
    return {"q": x[:, None], "dq": v[:, None]}


play = jax.jit(jax.vmap(simulate, (None, 0)))


def hypothesis(name, bounds, probes, family="friction"):
    direction = np.array([[float(axis == name) for axis in AXES]])
    return Hypothesis(
        name=name,
        family=family,
        places=("slider",),
        directions=direction,
        probes=np.array(probes)[:, None],
        bounds=np.array([bounds]),
        prior=np.array([1.0]),
        joints=(0,),
    )


HYPOTHESES = (
    hypothesis("mass", (-1.0, 1.0), [0.1], "inertia"),
    hypothesis("damping", (-0.9, 5.0), [0.3]),
    hypothesis("coulomb", (0.0, 5.0), [0.05, 0.3]),
    hypothesis("push", (-5.0, 5.0), [0.3], "external"),
    hypothesis("nothing", (-5.0, 5.0), [0.05], "external"),
)
WILD = hypothesis("wild", (0.0, 1.0), [0.1], "external")


def measured(truth, seed, split=0, count=40, motion=None):
    """Segments by horizon: the truth's motion with noise, from states that are known to within the noise."""
    rng, moved = np.random.default_rng((seed, 1)), np.random.default_rng(seed if motion is None else motion)
    vector = np.array([truth.get(axis, 0.0) for axis in AXES], np.float32)
    found = {}
    for horizon in HORIZONS:
        steps = round(horizon / DT)
        force = (
            6.0 * moved.uniform(-1, 1, (count, 1)) * np.sin(moved.uniform(2, 12, (count, 1)) * DT * np.arange(steps))
        )
        start = {"x": moved.normal(0, 0.5, count), "v": moved.normal(0, 0.7, count), "force": force}
        start = {name: value.astype(np.float32) for name, value in start.items()}
        read = {name: np.asarray(value) for name, value in play(vector, start).items()}
        read = {name: value + NOISE * rng.standard_normal(value.shape) for name, value in read.items()}
        inputs = start | {name: start[name] + np.float32(NOISE) * rng.standard_normal(count) for name in ("x", "v")}
        inputs = {name: value.astype(np.float32) for name, value in inputs.items()}
        found[horizon] = Segments(
            inputs=inputs,
            signals=read,
            run=4 * split + np.arange(count) // 10,
            regimes=np.zeros((count, steps, 1), int),
        )
    return found


def problem(truth, seed=0, hypotheses=HYPOTHESES):
    prior = np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    # Nobody knows the nominal parameters better than to a tenth.
    drawn = [{"mass": 0.1 * m, "damping": 0.1 * d} for m, d in DRAWS]
    splits = ("train", "select", "sealed")
    healthy = [
        {split: measured(one, 900 + 100 * k + i, k, motion=10 * seed + k) for k, split in enumerate(splits)}
        for i, one in enumerate(drawn)
    ]
    return Problem(
        simulate=simulate,
        axes=len(AXES),
        hypotheses=hypotheses,
        prior=prior,
        timing=np.zeros((0, len(AXES))),
        data={split: measured(truth, 10 * seed + i, i) for i, split in enumerate(splits)},
        healthy=healthy,
        bin_rows=2,
        regimes=("steady",),
        components={"q": ("slider",), "dq": ("slider",)},
    )


DRAWS = np.random.default_rng(5).standard_normal((12, 2)).clip(-2, 2)
PUSH = {"slider": AXES.index("push")}


def discover(truth, seed=0, **kwargs):
    return Discovery(problem(truth, seed, **kwargs), Settings(), PUSH).run()


def test_hidden_friction_is_named_with_its_size():
    result = discover({"coulomb": 0.5, "mass": 0.08, "damping": -0.1})
    assert result.verdict == "named"
    assert [rung.hypothesis.name for rung in result.rungs] == ["coulomb"]
    axis = AXES.index("coulomb")
    error = result.errors[-1]
    assert abs(result.fit.vector[axis] - 0.5) < max(4 * error, 0.02)
    assert error < 0.05
    # Nominal parameters were found beside it: a tenth of a prior deviation is 0.01.
    assert result.fit.vector[0] == pytest.approx(0.08, abs=0.03)
    assert result.gap["after"] < 1.3 < result.gap["null"] < result.gap["before"]


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_named_where_nothing_is_hidden(seed):
    truth = dict(zip(("mass", "damping"), 0.1 * np.random.default_rng(seed).uniform(-1, 1, 2), strict=True))
    result = discover(truth, seed + 1)
    assert result.verdict == "no_missing_effect"
    assert not result.rungs
    assert not result.changed


def test_a_parameter_far_from_its_prior_is_a_change_and_not_an_effect():
    result = discover({"damping": 1.5})
    assert result.verdict == "parameter_change"
    assert {rung.hypothesis.name for rung in result.rungs} | {AXES[axis] for axis in result.changed} == {"damping"}
    assert result.fit.vector[AXES.index("damping")] == pytest.approx(1.5, abs=0.1)


def test_two_effects_are_named_one_after_the_other():
    result = discover({"coulomb": 1.2, "push": 1.2})
    assert {rung.hypothesis.name for rung in result.rungs} == {"coulomb", "push"}
    assert result.proof["others"]["without push@slider"] > result.gap["after"] + 1.0
    assert result.proof["others"]["without coulomb@slider"] > result.gap["after"] + 1.0


def test_what_no_hypothesis_explains_is_unnamed():
    result = discover({"cubic": 12.0})
    assert result.verdict == "unnamed"
    assert not result.changed
    assert result.where[0]["excess_floor_units"] > 1.0


def test_two_that_do_not_pay_alone_are_tried_together(monkeypatch):
    accept = workflow.accept
    monkeypatch.setattr(workflow, "accept", lambda it, short, fits: bool(short[0].parts) and accept(it, short, fits))
    result = discover({"coulomb": 0.5, "push": 0.6})
    assert {rung.hypothesis.name for rung in result.rungs} == {"coulomb", "push"}
    assert result.verdict == "named"
    vector = result.fit.vector
    assert vector[AXES.index("coulomb")] == pytest.approx(0.5, abs=0.05)
    assert vector[AXES.index("push")] == pytest.approx(0.6, abs=0.05)
    assert result.gap["after"] < 1.3 < result.gap["null"]
    # Where nothing is missing none are tried.
    monkeypatch.setattr(workflow, "together", None)
    assert discover({}).verdict == "no_missing_effect"


def test_what_does_not_move_the_signals_is_not_testable():
    result = discover({"coulomb": 0.5})
    assert result.not_testable == ["nothing"]


def test_a_hypothesis_that_breaks_the_simulation_is_marked_and_the_rest_go_on(monkeypatch):
    # Its slopes are not finite, so no screen would choose it: it is put on the list by hand.
    discovery = Discovery(problem({"coulomb": 0.5}, hypotheses=(*HYPOTHESES, WILD)), Settings(), PUSH)
    monkeypatch.setattr(workflow, "shortlist", lambda scores, hypotheses, count: [HYPOTHESES[2], WILD])
    near = discovery.screen

    def visible(hypotheses, fit):
        screen = near(hypotheses, fit)
        scores = screen.scores
        screen.scores = lambda *args: {
            key: type(score)(score.gain, score.coordinates, 99.0) for key, score in scores(*args).items()
        }
        return screen

    discovery.screen = visible
    discovery.prepare()
    assert discovery.round()
    assert discovery.result.rungs[0].hypothesis.name == "coulomb"
    assert discovery.result.not_finite == ["wild@slider"]


def test_a_run_that_was_cut_goes_on_from_the_last_accepted_effect():
    truth = {"coulomb": 0.6, "push": 0.8}
    whole = Discovery(problem(truth), Settings(), PUSH)
    saved = []
    result = whole.run(save=lambda state: saved.append(json.loads(json.dumps(state))))
    assert len(saved) == 2
    looked = []
    resumed = Discovery(problem(truth), Settings(), PUSH, say=looked.append).run(saved[0])
    assert [rung.hypothesis.key for rung in resumed.rungs] == [rung.hypothesis.key for rung in result.rungs]
    assert resumed.rungs[0].evidence == result.rungs[0].evidence
    np.testing.assert_allclose(resumed.fit.vector, result.fit.vector, atol=1e-5)
    assert resumed.gap == pytest.approx(result.gap, rel=1e-4)
    assert resumed.proof["others"] == pytest.approx(result.proof["others"], rel=1e-3)
    assert resumed.not_testable == result.not_testable
    # The first effect was not decided upon again.
    assert not any(text.startswith(f"{result.rungs[0].hypothesis.key} Evidence") for text in looked)


def test_residuals_compile_once_for_any_number_of_vectors_and_segments():
    traces = []
    asked = problem({})

    def counted(vector, segment):
        traces.append(1)
        return simulate(vector, segment)

    measure = Residuals(replace(asked, simulate=counted), width=16)
    segments = asked.data["train"][0.2]
    few = replace(
        segments,
        inputs={name: value[:7] for name, value in segments.inputs.items()},
        signals={name: value[:7] for name, value in segments.signals.items()},
        run=segments.run[:7],
    )
    vectors = 0.1 * np.random.default_rng(0).standard_normal((5, len(AXES))) * (np.arange(len(AXES)) < 6)
    many = measure(vectors, segments)
    count = len(traces)
    assert measure(vectors[2:3], few).shape == (1, 7, 10, 2)
    assert len(traces) == count
    # Each pair is what it is alone: binned means of measured less simulated, signals in the order of their names.
    alone = play(jnp.asarray(vectors[3], jnp.float32), segments.inputs)
    expected = np.concatenate([segments.signals[name] - np.asarray(alone[name]) for name in ("dq", "q")], axis=-1)
    np.testing.assert_allclose(many[3], expected.reshape(40, 10, 2, 2).mean(axis=2), atol=1e-5)


@pytest.mark.parametrize(("at_floor", "screens"), [(1.5, 1), (0.0, 2)])
def test_at_the_floor_nobody_looks_for_more(monkeypatch, at_floor, screens):
    looked = []
    monkeypatch.setattr(
        Discovery, "screen", lambda self, *args, screen=Discovery.screen: looked.append(1) or screen(self, *args)
    )
    result = Discovery(problem({"coulomb": 0.5}), Settings(at_floor=at_floor), PUSH).run()
    assert [rung.hypothesis.name for rung in result.rungs] == ["coulomb"]
    assert len(looked) == screens


def test_what_promises_too_little_is_not_fitted(monkeypatch):
    begun = {}

    def compete(self, short, *args):
        begun.update({h.key: self.promise[h.key] / self.least_gain for h in short})
        return [], {}

    def tried(promising):
        begun.clear()
        Discovery(problem({"coulomb": 0.5}), Settings(promising=promising), PUSH).run()
        return dict(begun)

    monkeypatch.setattr(Discovery, "_compete", compete)
    everything = tried(0.0)
    best = max(everything, key=everything.get)
    assert best == "coulomb@slider"
    assert len(everything) > 1
    assert set(tried(0.9 * everything[best])) == {h for h in everything if everything[h] > 0.9 * everything[best]}
    assert not tried(1.1 * everything[best])


def test_devices_share_the_work():
    code = (
        "import jax, numpy as np, test_workflow as toy\n"
        "from jaxtune.discovery.problem import Residuals\n"
        "problem = toy.problem({'coulomb': 0.5})\n"
        "vectors = np.random.default_rng(0).uniform(0, 0.3, (7, len(toy.AXES))) * (np.arange(len(toy.AXES)) < 6)\n"
        "found = Residuals(problem, width=16)(vectors, problem.data['train'][0.1])\n"
        "print(len(jax.devices()), *found.shape, *found.ravel())\n"
    )
    said = []
    for devices in (1, 2):
        flags = f"--xla_force_host_platform_device_count={devices}"
        path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
        environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        said.append(done.stdout.split())
    assert [line[0] for line in said] == ["1", "2"]
    assert len(said[0]) > 1000
    np.testing.assert_allclose(*(np.array(line[1:], float) for line in said), rtol=1e-4, atol=1e-6)
