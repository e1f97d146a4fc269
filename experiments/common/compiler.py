"""XLA, JAX's compiler: its flags, its devices on a CPU, and where compiled programs are kept."""

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax

from experiments.common.cli import console
from jaxtune import devices

_LEAST_THREADS = 8  # of XLA's pool on a CPU
_LATEST = 4  # programs that may be unfinished
_DEVICES = "--xla_force_host_platform_device_count"


def set_up(xla_flags: str, most: int = 8) -> None:
    """Sets up XLA, JAX's compiler: its flags, its devices on a CPU, and where compiled programs are kept.

    Call it before JAX makes its first array, because JAX reads the flags then and never again.

    - On a CPU every core of this process is a device, so that all cores share the work (`jaxtune.devices`). XLA has a
      single CPU device unless it is told otherwise.
    - XLA gets more threads than there are devices (environment variable `NPROC`, unless it is set): with one for each,
      programs on two cores were seen to hang.
    - Programs are kept on disk, in the user's cache folder or where `JAX_COMPILATION_CACHE_DIR` says, so that a second
      run starts sooner.

    Args:
      xla_flags: added to `XLA_FLAGS`. A number of CPU devices that is set there already stays.
      most: largest number of CPU devices.
    """
    flags = f"{os.environ.get('XLA_FLAGS', '')} {xla_flags}".strip()
    if _DEVICES not in flags:
        flags = f"{flags} {_DEVICES}={min(cores(), most)}"
    os.environ["XLA_FLAGS"] = flags
    counts = [int(number) for number in re.findall(rf"{_DEVICES}=(\d+)", flags)]
    os.environ.setdefault("NPROC", str(max(_LEAST_THREADS, cores(), *(1 + number for number in counts))))
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    kept = Path(chosen) if chosen else base / "jaxtune" / "xla"
    if not kept.is_dir() or not any(kept.iterdir()):
        text = f"first run: programs are compiled, which takes minutes; later runs find them in {kept}"
        console.print(text, highlight=False, markup=False, soft_wrap=True)
    _drop_torn_programs(kept)
    if not chosen:
        jax.config.update("jax_compilation_cache_dir", str(kept))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def _drop_torn_programs(kept: Path) -> None:
    """Deletes compiled programs that a killed process left unfinished: JAX would neither read nor replace them."""
    # Others may use the same folder, delete what is found here, or be its owner. JAX may move what is private.
    with contextlib.suppress(OSError, ImportError):
        from jax._src import compilation_cache

        for file in sorted(kept.glob("*-cache"), key=lambda file: file.stat().st_mtime)[-_LATEST:]:
            stored = file.read_bytes()
            try:
                compilation_cache.decompress_executable(stored)
            except Exception:  # of whichever library has compressed it
                file.unlink(missing_ok=True)


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# JAX 0.11 has no such option, and ends the process at a flag that it does not know.
_WITHOUT_EMITTERS = {} if jax.__version_info__ >= (0, 11) else {"xla_cpu_use_fusion_emitters": False}


def for_simulation() -> str:
    """Returns XLA flags for programs that simulate any robot on CPU; pass them to `set_up`.

    The fusion emitters of JAX 0.10 are off. They compute each body's pose again for every body that hangs on it: a step
    of MJX took 84 times as long for a chain of six joints, and 6 times for five (github.com/jax-ml/jax, issue 33761).
    JAX 0.11 does not need it.
    """
    return " ".join(f"--{name}={str(value).lower()}" for name, value in _WITHOUT_EMITTERS.items())


def for_seconds() -> dict:
    """Returns XLA's options for a simulation that runs for seconds; pass them to `jax.jit` as `compiler_options`.

    Without fusion emitters a biped's simulation is compiled in two thirds of the time, and is 3 % slower.
    """
    return _WITHOUT_EMITTERS if jax.default_backend() == "cpu" else {}


def ahead(program: Callable) -> Callable:
    """Makes the function that compiles what `jax.jit` returned, for all devices and without running it."""
    return devices.on_all(lambda *args: program.lower(*args).compile())


@contextlib.contextmanager
def beside(program: Callable, *args) -> Iterator[None]:
    """Compiles a program that is called later, on a core that is free while other programs are compiled or run.

        with beside(second, *arguments):
            first(...)  # takes as long to compile
        second(*arguments)

    Several hosts compile when they call, since all must do so in the same order.

    Args:
      program: that `jax.jit` returned; it is called with `devices.on_all`.
      args: as of the call, in their shapes and types.
    """
    with ThreadPoolExecutor(1) as pool:
        if jax.process_count() == 1:
            # What goes wrong is told by the call.
            pool.submit(ahead(program), *args)
        yield
