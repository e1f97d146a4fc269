"""What all tests share: single precision, silence of others' deprecations, and whatever takes long to compile."""

import datetime
import os
import shutil
import tempfile
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


_CACHE = "JAX_COMPILATION_CACHE_DIR"
_KEPT = pytest.StashKey[str]()


def pytest_configure(config):
    # Programs that several tests compile, in this process and in those that they start. The user's own cache, which a
    # command takes unless it is told otherwise, would hide what does not compile.
    if not hasattr(config, "workerinput"):
        os.environ[_CACHE] = config.stash[_KEPT] = tempfile.mkdtemp(prefix="jaxtune-tests-")
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"
    jax.config.update("jax_compilation_cache_dir", os.environ[_CACHE])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    # Another process may be writing it; then it is compiled.
    config.addinivalue_line("filterwarnings", "ignore:Error reading persistent compilation cache entry:UserWarning")
    # Brax imports JAXopt wherever its environments are imported.
    config.addinivalue_line("filterwarnings", "ignore:JAXopt is no longer maintained:DeprecationWarning")
    # What tests compile they run briefly. Flags are read when JAX makes its first array.
    with warnings.catch_warnings(action="ignore"):
        from experiments.common.config import QUICK_COMPILATION
    # Every process of pytest has a core, so none splits a program to compile it on several.
    os.environ.setdefault("XLA_FLAGS", f"{QUICK_COMPILATION} --xla_cpu_parallel_codegen_split_count=1")
    # As `experiments.common.compiler.set_up` does.
    os.environ.setdefault("NPROC", "8")


# Files that take longest. A process that begins with one of them at the end is waited for.
_LONGEST = ("test_tuner", "test_kills", "test_sim2real", "test_selftest", "test_devices", "test_rig")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.stem not in _LONGEST)


def pytest_unconfigure(config):
    shutil.rmtree(config.stash.get(_KEPT, ""), ignore_errors=True)


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
