"""What all tests share: single precision, silence of others' deprecations, and whatever takes long to compile."""

import datetime
import os
import warnings

import jax
import pytest
from hypothesis import HealthCheck, settings

# The precision that everything runs in, whatever the environment says.
jax.config.update("jax_enable_x64", False)

# `--hypothesis-profile thorough` looks longer.
for name, examples in {"quick": 300, "thorough": 2000}.items():
    settings.register_profile(
        name,
        max_examples=examples,
        deadline=datetime.timedelta(seconds=10),
        suppress_health_check=list(HealthCheck),
        derandomize=True,
    )
settings.load_profile("quick")


def pytest_configure(config):
    # Brax imports JAXopt wherever its environments are imported.
    config.addinivalue_line("filterwarnings", "ignore:JAXopt is no longer maintained:DeprecationWarning")
    # What tests compile they run briefly. Flags are read when JAX makes its first array.
    with warnings.catch_warnings(action="ignore"):
        from experiments.common.config import QUICK_COMPILATION
    # Every process of pytest has a core, so none splits a program to compile it on several.
    os.environ.setdefault("XLA_FLAGS", f"{QUICK_COMPILATION} --xla_cpu_parallel_codegen_split_count=1")
    # As `experiments.common.checkpoint.set_up_compiler` does.
    os.environ.setdefault("NPROC", "8")


# The fixtures import for themselves, since the line above rules only after this file has been read.


@pytest.fixture(scope="session")
def robot():
    from envs.biteno import Biteno, TaskConfig

    return Biteno(TaskConfig())


@pytest.fixture(scope="session")
def arm():
    """The arm on the rig."""
    import rigs

    return rigs.arm()


@pytest.fixture(scope="session")
def apply(robot):
    """The robot's model with given parameters; pass all of them, or it compiles again."""
    return jax.jit(robot.model)


@pytest.fixture(scope="session")
def fresh(robot, reset_keys):
    """A robot after a reset for each of `reset_keys`."""
    return jax.jit(jax.vmap(lambda key: robot.reset({}, key)))(reset_keys)


@pytest.fixture(scope="session")
def reset_keys():
    return jax.random.split(jax.random.PRNGKey(0), 2000)


@pytest.fixture(scope="session")
def start(fresh):
    """One robot after a reset."""
    return jax.tree.map(lambda leaf: leaf[0], fresh)


@pytest.fixture(scope="session")
def step(robot):
    """One robot's step; pass all parameters, or it compiles again."""
    return jax.jit(robot.step)
