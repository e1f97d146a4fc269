"""Checkpoints, and the folder of a run with its config, its versions and its locks.

A run may be killed at any moment, and must be able to continue from its files (`experiments.common.files`). In a run on
several hosts the first one writes and reads them all (`experiments.common.hosts`).
"""

import contextlib
import errno
import fcntl
import hashlib
import importlib.metadata
import os
import platform
import re
import secrets
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from experiments.common import hosts
from experiments.common.files import DRAFT, as_json, read_json, sync, write_json

_PACKAGES = ("jaxtune", "jax", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint", "numpy")

_ROOM = 1.5  # of a state's size, which a disk must have left
_LOCK = ".lock"  # suffix of a file whose lock says that a process works on a piece


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


@contextlib.contextmanager
def lock(path: Path) -> Iterator[None]:
    """Keeps other processes from working on the same piece of a run while this one does.

    The operating system drops the lock when its owner ends, however it ends. The empty lock file stays.

    Args:
      path: what is worked on: the lock file is beside it, hidden, with `.lock` behind its name.

    Raises:
      ValueError: another process works on it.
    """
    with contextlib.ExitStack() as held:
        hosts.from_first(lambda: _lock(path, held))
        yield


def _lock(path: Path, held: contextlib.ExitStack) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    file = held.enter_context(path.with_name(f".{path.name}{_LOCK}").open("w"))
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ValueError(f"out: another process works on {path}; wait for it, or choose another folder") from None


@hosts.on_first
def open_run(out: Path, config: Any) -> None:
    """Makes the folder of a run and writes its config, or checks that an earlier run there had the same config.

    A command calls it before it computes anything: results of two configs must never mix in one folder.

    Args:
      out: the folder.
      config: everything that the results depend on. Leave out options that a later call may change, such as the
        number of seeds.

    Raises:
      ValueError: the folder holds a run of another config (names the first field that differs), or other files, or
        nothing can be written there.
    """
    wanted = as_json(config)
    path = out / "config.json"
    check_writable(out)
    with (out / _LOCK).open("w") as file:
        # Of two runs that begin at once the second waits until the first has said what it is.
        fcntl.flock(file, fcntl.LOCK_EX)
        if path.exists():
            _same(f"out: {out} holds a run of another config", read_json(path, "config")["config"], wanted)
        elif any(not item.name.endswith((DRAFT, _LOCK)) for item in out.iterdir()):
            raise ValueError(
                f"out: {out} is not empty and holds no config.json; expected a new folder or an earlier run's"
            )
        else:
            write_json(path, {"config": wanted, "versions": versions()})


@hosts.on_first
def check_writable(out: Path) -> None:
    """Makes a folder, and checks that files can be written there, before hours are spent on what goes into them.

    Raises:
      ValueError: they cannot; says why.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        draft = out / f".{secrets.token_hex(4)}{DRAFT}"
        draft.write_bytes(bytes(1024))
        draft.unlink()
    except OSError as error:
        raise ValueError(f"out: got {out}, where nothing can be written: {error.strerror}") from None


@hosts.on_first
def save(path: Path, state: Any, config: Any, notes: Any = None) -> None:
    """Writes a pytree of arrays as an orbax checkpoint, together with the config that `load` will compare.

    The state goes into a folder of its own, and `config.json` says which, with its checksum. So the checkpoint that was
    there is whole until the new one is, and a process that is killed in between loses neither.

    Args:
      path: folder of the checkpoint.
      state: the pytree.
      config: settings without which the state means nothing, such as the network's sizes. `load` refuses the state if
        the program that loads it has other ones.
      notes: what else belongs to the state, as JSON (`read_notes`).
    """
    path.mkdir(parents=True, exist_ok=True)
    numbers = [int(old.name.rpartition("_")[2]) for old in path.glob("state_*") if old.name[6:].isdecimal()]
    new, arrays = path / f"state_{max(numbers, default=0) + 1}", _numbers(state)
    # Orbax prints a hundred lines where the disk is full.
    if shutil.disk_usage(path).free < _ROOM * sum(leaf.nbytes for leaf in jax.tree.leaves(arrays)):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(new))
    with _checkpointer() as checkpointer:
        checkpointer.save(new.absolute(), arrays)
    for item in (new, *new.rglob("*")):
        sync(item)
    sync(path)
    entry = {"config": as_json(config), "state": new.name, "sha256": _checksum(new), "versions": versions()}
    write_json(path / "config.json", entry if notes is None else entry | {"notes": notes})
    # Not all that begins like this is a checkpoint's: discovery keeps a `state.json`.
    for old in path.iterdir():
        if old != new and old.is_dir() and re.fullmatch(r"state(_\d+)?(\.orbax-checkpoint-tmp.*)?", old.name):
            shutil.rmtree(old)


@hosts.on_first
def load(path: Path, like: Any, config: Any) -> Any:
    """Reads a pytree that `save` wrote.

    Args:
      path: folder of the checkpoint.
      like: a pytree of the same structure, shapes and types, for example a state that was just initialised.
      config: the settings that the state must have been saved with.

    Returns:
      The pytree, with arrays on JAX's default device.

    Raises:
      ValueError: there is no checkpoint, a damaged one, or one of another config or of other shapes; names the first
        that differs.
    """
    stored = path / "config.json"
    if not stored.exists():
        raise ValueError(f"policy: {path} holds no config.json; expected a folder that experiments.train has written")
    entry = read_json(stored, "config")
    _same(f"policy: {path} was made with another config", entry["config"], as_json(config))
    # Checkpoints of the first version have neither the name of their state nor its checksum.
    place = path / entry.get("state", "state")
    if not place.is_dir() or ("sha256" in entry and _checksum(place) != entry["sha256"]):
        raise ValueError(f"policy: {path} is damaged: its checksum is not the one in its config.json")
    with _checkpointer() as checkpointer:
        found = checkpointer.restore(place.absolute(), _numbers(like))
    # What was left out is None, and stays as it is.
    fill = lambda leaf, new: leaf if new is None else jnp.asarray(new)  # noqa: E731
    whole = jax.tree.map(fill, _plain(like), found, is_leaf=lambda leaf: leaf is None)
    for (where, leaf), new in zip(jax.tree.leaves_with_path(_plain(like)), jax.tree.leaves(whole), strict=True):
        if jnp.shape(leaf) != jnp.shape(new):
            raise ValueError(
                f"policy: {path}: {jax.tree_util.keystr(where)} has shape {jnp.shape(new)} there, expected "
                f"{jnp.shape(leaf)}: it is of another robot"
            )
    return ocp.tree.deserialize_tree(whole, like, keep_empty_nodes=True)


def read_notes(path: Path) -> Any:
    """Returns the notes that a checkpoint was saved with."""
    return read_json(path / "config.json", "notes")["notes"]


def _checksum(folder: Path) -> str:
    """Returns the SHA-256 of all files of a folder, with their names."""
    found = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        found.update(f"{file.relative_to(folder).as_posix()} {file.stat().st_size}\n".encode())
        found.update(file.read_bytes())
    return found.hexdigest()


def check_finite(what: str, state: Any) -> None:
    """Checks the numbers of a pytree, before it is saved or handed to a robot.

    Raises:
      ValueError: one is not finite; names its place in the pytree.
    """
    for where, leaf in jax.tree_util.tree_leaves_with_path(state):
        if jnp.issubdtype(jnp.result_type(leaf), jnp.floating) and not np.isfinite(np.asarray(leaf)).all():
            raise ValueError(f"{what}: got a number that is not finite in {jax.tree_util.keystr(where)}")


def _checkpointer() -> ocp.StandardCheckpointer:
    """One that does not wait for other hosts, since the first alone calls it."""
    alone = ocp.options.MultiprocessingOptions(active_processes={0}, barrier_sync_key_prefix="first")
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


def _numbers(state: Any) -> Any:
    """Returns a pytree's arrays as NumPy's, in plain dicts and lists: so orbax saves them on any number of hosts.

    Arrays without elements, such as a simulator has for what its model lacks, are left out: orbax cannot save them.
    """
    return jax.tree.map(lambda leaf: np.asarray(leaf) if jnp.size(leaf) else None, _plain(state))


def _plain(state: Any) -> Any:
    return ocp.tree.serialize_tree(state, keep_empty_nodes=True)


def _same(message: str, found: Any, wanted: Any, where: str = "config") -> None:
    if isinstance(found, dict) and isinstance(wanted, dict):
        for name in sorted({*found, *wanted}):
            _same(message, found.get(name), wanted.get(name), f"{where}.{name}")
    elif found != wanted:
        raise ValueError(f"{message}: {where} is {found} there, expected {wanted}")
