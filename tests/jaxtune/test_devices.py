import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtune import devices

TESTS = Path(__file__).parents[1]
PATH = os.pathsep.join(map(str, (TESTS.parent, TESTS, TESTS / "jaxtune" / "discovery")))


def across(*functions):
    """What `across.py` computes: by function, numbers without a mesh, and on several devices."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(Path(__file__).with_name("across.py")), *functions],
        env={**os.environ, "PYTHONPATH": PATH},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def found():
    return across("episodes", "update", "lanes", "pairs")


@pytest.mark.parametrize("function", ["episodes", "update", "lanes", "pairs"])
def test_the_number_of_devices_changes_no_number(found, function):
    check_alike(found[function], 1e-5)


@pytest.mark.slow
def test_the_number_of_devices_changes_no_tuning():
    # A regression inverts a matrix, which magnifies the rounding of sums that are taken in another order.
    check_alike(across("tunings")["tunings"], 1e-3)


def check_alike(found, rounding):
    alone, *shared = np.array(found, float)
    assert shared
    assert np.isfinite(alone).any() and np.ptp(alone[np.isfinite(alone)]) > 0
    for numbers in shared:
        np.testing.assert_allclose(numbers, alone, rtol=rounding, atol=rounding)


def test_without_a_mesh_there_is_one_device():
    assert devices.count() == 1
    with jax.set_mesh(jax.make_mesh((1,), ("other",))):
        assert devices.count() == 1


def test_a_program_is_compiled_once_wherever_its_arrays_come_from():
    program = jax.jit(lambda values: values + 1.0)
    call = devices.on_all(program)
    fresh = jax.numpy.zeros(3)
    for values in (fresh, jax.device_put(fresh, jax.devices()[0]), call(fresh)):
        call(values)
    assert program._cache_size() == 1


@pytest.mark.parametrize("count", [0, 1000])
def test_a_mesh_has_as_many_devices_as_there_are(count):
    with pytest.raises(ValueError, match=f"devices: got {count}, expected 1 to"):
        devices.mesh(count)


def test_chunks_may_have_leaves_without_elements():
    found = devices.in_chunks(lambda x: (x, jnp.zeros(0)), (jnp.arange(5.0),), {"cpu": 2, "other": 2})
    assert found[1].shape == (5, 0)
    np.testing.assert_array_equal(found[0], np.arange(5.0))
