"""Many simulations at once are what each is alone, compiled once, on any number of devices."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from slider import AXES, play, problem, simulate

from jaxtune.discovery.simulation import residuals


def test_residuals_compile_once_for_any_number_of_vectors_and_segments():
    traces = []
    asked = problem({})

    def counted(*args):
        traces.append(1)
        return simulate(*args)

    asked = replace(asked, simulate=counted)
    segments = asked.data["train"][0.2]
    few = replace(
        segments,
        inputs={name: value[:7] for name, value in segments.inputs.items()},
        signals={name: value[:7] for name, value in segments.signals.items()},
        run=segments.run[:7],
    )
    vectors = 0.1 * np.random.default_rng(0).standard_normal((5, len(AXES))) * (np.arange(len(AXES)) < 6)
    many = residuals(asked, vectors, segments, width=16)
    count = len(traces)
    assert residuals(asked, vectors[2:3], few, width=16).shape == (1, 7, 10, 2)
    # Other lengths of segments and other robots need no other program either.
    assert residuals(asked, vectors[:2], asked.data["train"][0.1], width=16).shape == (2, 40, 5, 2)
    heavier = residuals(replace(asked, system=np.float32(2.0)), vectors, segments, width=16)
    assert np.abs(heavier - many).max() > 0.01
    assert len(traces) == count
    # Each pair is what it is alone: binned means of measured less simulated, signals in the order of their names.
    alone = play(jnp.asarray(vectors[3], jnp.float32), segments.inputs)
    expected = np.concatenate([segments.signals[name] - np.asarray(alone[name]) for name in ("dq", "q")], axis=-1)
    np.testing.assert_allclose(many[3], expected.reshape(40, 10, 2, 2).mean(axis=2), atol=1e-5)


def test_devices_share_the_work():
    code = (
        "import jax, numpy as np, slider as toy\n"
        "from jaxtune.discovery.simulation import residuals\n"
        "problem = toy.problem({'coulomb': 0.5})\n"
        "vectors = np.random.default_rng(0).uniform(0, 0.3, (7, len(toy.AXES))) * (np.arange(len(toy.AXES)) < 6)\n"
        "found = residuals(problem, vectors, problem.data['train'][0.1], width=16)\n"
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
