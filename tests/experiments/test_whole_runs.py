"""Whole runs, and the experiment that would decide between two models."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import segments
from envs.logs import Controller
from envs.rig import Rig
from experiments.discovery.blind_cases import ARM
from experiments.discovery.blind_drive import Truth
from experiments.discovery.blind_robots import record
from experiments.discovery.excitation import excitation
from experiments.discovery.next_experiment import deciding_experiment
from experiments.discovery.question import _Simulator
from experiments.discovery.whole_runs import simulate_runs

JOINTS = ("shoulder", "elbow")
GAINS = {"kp": np.array([40.0, 20.0]), "kd": np.array([2.0, 0.8]), "torque_limit_nm": np.array([15.0, 15.0])}
CONTROLLER = Controller(kind="pd", rate_hz=1000.0, gains=GAINS)


@pytest.fixture(scope="module")
def asked():
    """What both functions look at of a question, and a log of runs of two lengths."""
    spec = mujoco.MjSpec.from_file(str(ARM))
    motions = excitation(spec, JOINTS, 4, 1.0, 200.0)
    log = record(spec, JOINTS, motions, CONTROLLER, Truth(None, (), 0.0), nominal_error=0.0, seed=3, noise=False)
    first = log.runs[0]
    short = replace(first, time=first.time[:120], signals={name: v[:120] for name, v in first.signals.items()})
    rig = Rig(spec, JOINTS, 1000.0)
    problem = SimpleNamespace(simulate=_Simulator(rig, rig.layout, ("q",)), system=rig.system)
    question = SimpleNamespace(rig=rig, problem=problem, spec=spec, of_whole_runs="q")
    return question, replace(log, runs=(short, *log.runs[1:3]))


def vector(rig, **coordinates):
    return np.array([coordinates.get(axis.effect, 0.0) * (axis.place == "elbow") for axis in rig.axes])


def test_whole_runs_are_simulated_to_their_ends_each_as_if_alone(asked):
    question, log = asked
    vectors = np.stack([vector(question.rig), vector(question.rig, coulomb=0.5)])
    rows, found = simulate_runs(question, log.runs, vectors)
    for run, own, positions in zip(log.runs, rows, found, strict=True):
        assert own[-1] == len(run.time) - 1
        assert run.time[own[0]] - run.time[0] >= segments.HISTORY_S
        one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), segments.whole([run], question.rig.dt).segments)
        alone = question.rig.simulate(question.rig.tree(jnp.asarray(question.rig.inner(vectors[1]))), one)
        np.testing.assert_allclose(positions[1], alone["q"], atol=1e-4)
        # What was recorded has no effect, so the nominal model follows it.
        assert np.abs(positions[0] - run.signals["q"][own]).max() < 0.02
        assert np.abs(positions[1] - positions[0]).max() > 0.02


@pytest.mark.slow
def test_the_deciding_motion_is_the_one_in_which_two_models_differ_most(asked):
    question, log = asked
    # A limit that slow motion does not reach decides in large steps.
    models = (("null", vector(question.rig)), ("torque_limit@elbow", vector(question.rig, torque_limit=0.1)))
    said = deciding_experiment(question, log, Path("logs/arm"), SimpleNamespace(rivals=models))
    assert said.startswith("python -m experiments.excite --like logs/arm --motion large_steps ")
    assert "torque_limit@elbow" in said
    assert deciding_experiment(question, log, Path("logs/arm"), SimpleNamespace(rivals=models[:1])) is None
