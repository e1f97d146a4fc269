"""Files of a run: JSON and text, each written whole or not at all.

A run may be killed at any moment, and must be able to continue from its files. A draft is written, put on the disk
(fsync), and renamed into place. In a run on several hosts the first one does all this (`experiments.common.hosts`).
"""

import dataclasses
import json
import os
import secrets
import typing
from pathlib import Path
from typing import Any

from experiments.common import hosts

DRAFT = ".tmp"
"""Suffix of a file that is being written, or that a killed run left behind."""


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
    write_text(path, json.dumps(as_json(value), indent=1) + "\n")


@hosts.on_first
def write_text(path: Path, text: str) -> None:
    """Writes a text file, whole or not at all, as `write_json` does."""
    draft = path.with_suffix(f".{secrets.token_hex(4)}{DRAFT}")
    try:
        with draft.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError:
        # A full disk: the draft is of no use, and takes the room that others need.
        draft.unlink(missing_ok=True)
        raise
    sync(path.parent)


@hosts.on_first
def append_line(path: Path, value: Any) -> None:
    """Adds a value to a log of JSON lines. A process that is killed in between leaves part of a line."""
    with path.open("a") as log:
        log.write(json.dumps(as_json(value)) + "\n")


@hosts.on_first
def exists(path: Path) -> bool:
    """Whether a file of a run is there."""
    return path.exists()


@hosts.on_first
def read_json(path: Path, *needs: str) -> Any:
    """Reads a JSON file of a run, an object.

    Args:
      path: of the file.
      *needs: keys that it must have.

    Raises:
      ValueError: the file was emptied or damaged, holds no object, or lacks a key; names it.
    """
    try:
        found = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is damaged: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: is damaged: got {type(found).__name__}, expected an object")
    for name in needs:
        if name not in found:
            raise ValueError(f"{path}: is damaged: '{name}' is missing")
    return found


def sync(item: Path) -> None:
    """Puts a file, or the names in a folder, on the disk: a renamed file may have its old name after a power cut."""
    handle = os.open(item, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
