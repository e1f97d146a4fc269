"""Keeps a log within its folder: whoever wrote it must not choose which other files of this machine are read.

A link, an absolute path or one with `..` would have another file quoted in a message, or used as the robot's model.
"""

import os
import re
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import mujoco

LARGEST_BYTES = 2**31
"""Largest size of what an archive holds: an hour of 60 columns at 1 kHz is 1.7 GB."""
_OR_NAMED = ", or a model that is named on the command line (--robot)"
# What readers of XML and file systems understand differently: MuJoCo takes a backslash for a slash, and reads what
# others take for a definition.
_AMBIGUOUS = re.compile(rb"\\|<!(?!--|\[CDATA\[)")
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_URDF_FILE = re.compile(rb"""filename\s*=\s*["']([^"']*)["']""")  # MuJoCo does not list those


def check_inside(folder: Path, path: Path, what: str, otherwise: str = "") -> None:
    """Checks that a path does not lead out of a log's folder.

    Args:
      folder: of the log.
      path: of a file or a folder with files.
      what: begins the message.
      otherwise: ends it.

    Raises:
      ValueError: it does, itself or by a link in it.
    """
    within = folder.resolve()

    def check(one: Path) -> Path:
        try:
            found = one.resolve()
        except (OSError, RuntimeError) as error:
            raise ValueError(f"{what}: {one}: {error}") from None
        if not found.is_relative_to(within):
            raise ValueError(
                f"{what}: got {one}, which leads out of the log's folder {folder}; expected a file in it{otherwise}"
            )
        return found

    found = check(path)
    for one in found.rglob("*") if found.is_dir() else ():
        check(one)


def check_model(folder: Path, path: Path, what: str) -> None:
    """Checks an MJCF of a log, and all files that it refers to: included files, models, meshes, textures.

    Args:
      folder: of the log.
      path: of the MJCF.
      what: begins the message.

    Raises:
      ValueError: one of them leads out of the folder, or the model cannot be read.
    """
    check_inside(folder, path, what, _OR_NAMED)
    for item in folder.rglob("*"):
        # Whoever opens a pipe waits for ever.
        if item.exists() and not (item.is_file() or item.is_dir()):
            raise ValueError(f"{what}: got {item}, expected files and folders alone beside a model")
    _check_included(folder, path, what)
    try:
        needed = [Path(one) for one in mujoco.mju_getXMLDependencies(str(path))]
    except mujoco.FatalError as error:
        raise ValueError(f"{what}: {error}") from None
    for one in needed:
        check_inside(folder, one, what, _OR_NAMED)
    for one in needed:
        if one.suffix.lower() in (".xml", ".mjcf", ".urdf") and one.is_file():
            _check_text(one, what)
            for name in _URDF_FILE.findall(one.read_bytes()):
                place = one.parent / name.decode(errors="replace").removeprefix("package://")
                check_inside(folder, place, what, _OR_NAMED)


def _check_included(folder: Path, model: Path, what: str) -> None:
    """Checks a model and what it includes or attaches, before MuJoCo opens any of it."""
    found, pending = set(), [model]
    while pending:
        path = pending.pop()
        found.add(path.resolve())
        _check_text(path, what)
        # Beside the model, or beside the file that includes them.
        for place in [base / name for name in _included(path, what) for base in (model.parent, path.parent)]:
            check_inside(folder, place, what, _OR_NAMED)
            pending += [place] if os.path.isfile(place) and place.resolve() not in found else []


def _included(path: Path, what: str) -> list[str]:
    """Names of the XML files that one refers to: MuJoCo opens them to look for others."""
    text = path.read_bytes()
    # MuJoCo takes comments that XML does not, such as rows of hyphens.
    plain = _COMMENT.sub(b"", text)
    if any(b"include" in comment or b"<model" in comment for comment in _COMMENT.findall(text)):
        # What is cut out may have been no comment to MuJoCo.
        plain = text
    try:
        root = ElementTree.fromstring(plain)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"{what}: {path}: {error}") from None
    return [one.get("file", "") for one in root.iter() if one.tag.rpartition("}")[2] in ("include", "model")]


def _check_text(path: Path, what: str) -> None:
    found = _AMBIGUOUS.search(path.read_bytes())
    if found:
        raise ValueError(f"{what}: {path}: got '{found[0].decode()}', expected neither backslashes nor definitions")


def check_archive(path: Path) -> None:
    """Checks what an NPZ file holds before it is unpacked: a small archive may fill the memory.

    Raises:
      ValueError: it holds more than `LARGEST_BYTES`, or is no archive.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
    except (zipfile.BadZipFile, OSError) as error:
        raise ValueError(f"{path}: {type(error).__name__}: {error}") from error
    check_size(path, size)


class TooLarge(ValueError):
    """A file that would fill the memory."""


def check_size(path: Path, size: int) -> None:
    """Refuses what would fill the memory.

    Args:
      path: of the file, for the message.
      size: in bytes, once it is unpacked.

    Raises:
      TooLarge: it is more than `LARGEST_BYTES`.
    """
    if size > LARGEST_BYTES:
        raise TooLarge(f"{path}: got {size / 2**30:.1f} GiB unpacked, expected at most {LARGEST_BYTES / 2**30:g} GiB")
