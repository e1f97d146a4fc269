"""Saving and loading, and the folder of a run: what was asked, with what, and what came of it."""

import dataclasses
import importlib.metadata
import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

_PACKAGES = ("jaxtune", "jax", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy")

_DRAFT = ".tmp"  # of a file that is being written, or was when a run was killed


def set_up_compiler(xla_flags: str) -> None:
    """Adds a preset's flags to XLA_FLAGS, and keeps what is compiled, so that a second run starts quicker.

    To be called before JAX makes its first array, which is when it reads the flags. Programs are kept in the user's
    cache folder, or where `JAX_COMPILATION_CACHE_DIR` says.
    """
    if xla_flags:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {xla_flags}".strip()
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    jax.config.update("jax_compilation_cache_dir", str(base / "jaxtune" / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def a_device_a_core(most: int = 8) -> str:
    """The flag that makes every core which this process may use a device of its own, for what shares its work out."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return f"--xla_force_host_platform_device_count={min(cores, most)}"


def versions() -> dict[str, str]:
    """Versions of what a result depends on, the device, and the git revision where there is one."""
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
    """Dataclasses, arrays and tuples to what `json` writes; numbers that are not finite become null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: as_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
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


def write_json(path: Path, value: Any) -> None:
    """Writes JSON whole or not at all."""
    draft = path.with_suffix(f".{os.getpid()}{_DRAFT}")
    draft.write_text(json.dumps(as_json(value), indent=1) + "\n")
    draft.replace(path)


def open_run(out: Path, config: Any) -> None:
    """Makes a run's folder, or goes on in one of the same config.

    Raises:
      ValueError: the folder holds a run of another config; names the first field that differs.
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
    """Writes a pytree of arrays with the config that it belongs to."""
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path.absolute() / "state", state, force=True)
    write_json(path / "config.json", {"config": as_json(config), "versions": versions()})


def load(path: Path, like: Any, config: Any) -> Any:
    """Reads a pytree of the same structure and shapes as `like`.

    Raises:
      ValueError: there is none, or it belongs to another config; names the first field that differs.
    """
    stored = path / "config.json"
    if not stored.exists():
        raise ValueError(f"policy: {path} holds no config.json; expected a folder that experiments.train has written")
    _same(f"policy: {path} was made with another config", json.loads(stored.read_text())["config"], as_json(config))
    with ocp.StandardCheckpointer() as checkpointer:
        state = checkpointer.restore(path.absolute() / "state", jax.tree.map(ocp.utils.to_shape_dtype_struct, like))
    # Orbax ties arrays to their device; a step whose input is tied and whose output is not would be compiled twice.
    return jax.tree.map(jnp.asarray, jax.device_get(state))


def _same(message: str, found: Any, wanted: Any, where: str = "config") -> None:
    if isinstance(found, dict) and isinstance(wanted, dict):
        for name in sorted({*found, *wanted}):
            _same(message, found.get(name), wanted.get(name), f"{where}.{name}")
    elif found != wanted:
        raise ValueError(f"{message}: {where} is {found} there, expected {wanted}")
