"""Saving and loading: checkpoints, JSON, and the folder of a run with its config and versions.

Every file is written whole or not at all: a run may be killed at any moment, and must be able to continue from its
files.
"""

import dataclasses
import importlib.metadata
import json
import os
import platform
import subprocess
import typing
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

_PACKAGES = ("jaxtune", "jax", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy")

_DRAFT = ".tmp"  # suffix of a file that is being written, or that a killed run left behind


def set_up_compiler(xla_flags: str) -> None:
    """Sets the flags of XLA, JAX's compiler, and keeps compiled programs on disk so that a second run starts sooner.

    Call it before JAX makes its first array, because JAX reads the flags then and never again. Programs are kept in the
    user's cache folder, or where `JAX_COMPILATION_CACHE_DIR` says.

    Args:
      xla_flags: added to `XLA_FLAGS`.
    """
    if xla_flags:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {xla_flags}".strip()
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    jax.config.update("jax_compilation_cache_dir", str(base / "jaxtune" / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def for_simulation(most: int = 8) -> str:
    """Returns XLA flags for programs that simulate robots on CPU; pass them to `set_up_compiler`.

    - Every core of this process is a JAX device. XLA uses a single CPU device otherwise, and a vmapped simulation would
      run on one core. Programs that shard their work over devices, as discovery does, use all of them.
    - The fusion emitters of JAX 0.10 are off. They compute each body's pose again for every body that hangs on it: a
      step of MJX took 84 times as long for a chain of six joints, and 6 times for five (github.com/jax-ml/jax,
      issue 33761). JAX 0.11 has no such flag, and does not need it.

    Args:
      most: largest number of devices.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    devices = f"--xla_force_host_platform_device_count={min(cores, most)}"
    # XLA ends the process at a flag that it does not know.
    return devices if jax.__version_info__ >= (0, 11) else f"{devices} --xla_cpu_use_fusion_emitters=false"


def versions() -> dict[str, str]:
    """Lists what a result depends on besides its config: versions of packages, the device, and the git revision.

    Every summary and config holds this list, so that a number can be traced to the code that produced it.
    """
    found = {"python": platform.python_version(), "device": jax.devices()[0].device_kind}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    if git.returncode == 0:
        found["revision"] = git.stdout.strip()
    return found


def as_json(value: Any) -> Any:
    """Converts dataclasses, arrays, paths and tuples to what `json` can write.

    A dataclass becomes an object with its fields' names as keys, or `metadata["key"]` where a field has another name in
    files. Numbers that are not finite become null: JSON has no form for them, and Python's own (`NaN`) is refused
    elsewhere.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {_key(field): as_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(name): as_json(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return as_json(value.tolist())
    if isinstance(value, float) and value not in (float("inf"), float("-inf")) and value == value:
        return value
    return None if isinstance(value, float) else value


def from_json(kind: Any, value: Any) -> Any:
    """Rebuilds a dataclass from its JSON form; the inverse of `as_json`, guided by the types of the fields.

    Args:
      kind: a dataclass, or a type that one of its fields may have (`tuple[T, ...]`, `dict[str, T]`, numbers, texts).
      value: what `json` has read.

    Raises:
      KeyError: a field is missing.
    """
    if dataclasses.is_dataclass(kind):
        types = typing.get_type_hints(kind)
        return kind(**{f.name: from_json(types[f.name], value[_key(f)]) for f in dataclasses.fields(kind)})
    if typing.get_origin(kind) is tuple:
        return tuple(from_json(typing.get_args(kind)[0], item) for item in value)
    if typing.get_origin(kind) is dict:
        return {name: from_json(typing.get_args(kind)[1], item) for name, item in value.items()}
    return value


def _key(field: dataclasses.Field) -> str:
    return field.metadata.get("key", field.name)


def write_json(path: Path, value: Any) -> None:
    """Writes a value as JSON, whole or not at all: a finished draft is renamed into place.

    A program that is killed in between leaves the old file, and a program that reads meanwhile never sees half of one.
    """
    draft = path.with_suffix(f".{os.getpid()}{_DRAFT}")
    draft.write_text(json.dumps(as_json(value), indent=1) + "\n")
    draft.replace(path)


def open_run(out: Path, config: Any) -> None:
    """Makes the folder of a run and writes its config, or checks that an earlier run there had the same config.

    A command calls it before it computes anything: results of two configs must never mix in one folder.

    Args:
      out: the folder.
      config: everything that the results depend on. Leave out options that a later call may change, such as the
        number of seeds.

    Raises:
      ValueError: the folder holds a run of another config (names the first field that differs), or other files.
    """
    wanted = as_json(config)
    path = out / "config.json"
    if path.exists():
        _same(f"out: {out} holds a run of another config", json.loads(path.read_text())["config"], wanted)
    elif out.exists() and any(item.suffix != _DRAFT for item in out.iterdir()):
        raise ValueError(f"out: {out} is not empty and holds no config.json; expected a new folder or an earlier run's")
    out.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        write_json(path, {"config": wanted, "versions": versions()})


def save(path: Path, state: Any, config: Any) -> None:
    """Writes a pytree of arrays as an orbax checkpoint, together with the config that `load` will compare.

    Args:
      path: folder of the checkpoint.
      state: the pytree.
      config: settings without which the state means nothing, such as the network's sizes. `load` refuses the state if
        the program that loads it has other ones.
    """
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path.absolute() / "state", _with_numbers(state), force=True)
    write_json(path / "config.json", {"config": as_json(config), "versions": versions()})


def load(path: Path, like: Any, config: Any) -> Any:
    """Reads a pytree that `save` wrote.

    Args:
      path: folder of the checkpoint.
      like: a pytree of the same structure, shapes and types, for example a state that was just initialised.
      config: the settings that the state must have been saved with.

    Returns:
      The pytree, with arrays on JAX's default device.

    Raises:
      ValueError: there is no checkpoint, or one of another config; names the first field that differs.
    """
    stored = path / "config.json"
    if not stored.exists():
        raise ValueError(f"policy: {path} holds no config.json; expected a folder that experiments.train has written")
    _same(f"policy: {path} was made with another config", json.loads(stored.read_text())["config"], as_json(config))
    with ocp.StandardCheckpointer() as checkpointer:
        wanted = jax.tree.map(ocp.utils.to_shape_dtype_struct, _with_numbers(like))
        state = checkpointer.restore(path.absolute() / "state", wanted)
    # Orbax commits arrays to a device, and a step with committed input and uncommitted output would compile twice.
    found = iter(jax.tree.map(jnp.asarray, jax.device_get(jax.tree.leaves(state))))
    return jax.tree.map(lambda leaf: next(found) if jnp.size(leaf) else leaf, like)


def _with_numbers(state: Any) -> Any:
    """Leaves out arrays without elements, such as a simulator has for what its model lacks: orbax cannot save them."""
    return jax.tree.map(lambda leaf: leaf if jnp.size(leaf) else None, state)


def _same(message: str, found: Any, wanted: Any, where: str = "config") -> None:
    if isinstance(found, dict) and isinstance(wanted, dict):
        for name in sorted({*found, *wanted}):
            _same(message, found.get(name), wanted.get(name), f"{where}.{name}")
    elif found != wanted:
        raise ValueError(f"{message}: {where} is {found} there, expected {wanted}")
