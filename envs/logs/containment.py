"""Keeps a log within its folder: whoever wrote it must not choose which other files of this machine are read.

A link, an absolute path or one with `..` would have another file quoted in a message, or used as the robot's model.
"""

import zipfile
from pathlib import Path
from xml.etree import ElementTree

LARGEST_BYTES = 2**31
"""Largest size of what an archive holds: an hour of 60 columns at 1 kHz is 1.7 GB."""
_NAMES = ("file", "filename", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_FOLDERS = ("meshdir", "texturedir", "assetdir")
_OR_NAMED = ", or a model that is named on the command line (--robot)"


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
    for one in (path, *(path.rglob("*") if path.is_dir() and not path.is_symlink() else ())):
        if not one.resolve().is_relative_to(within):
            raise ValueError(
                f"{what}: got {one}, which leads out of the log's folder {folder}; expected a file in it{otherwise}"
            )


def check_model(folder: Path, path: Path, what: str) -> None:
    """Checks an MJCF of a log, and all files that it refers to: included files, meshes, height fields, textures.

    Args:
      folder: of the log.
      path: of the MJCF.
      what: begins the message.

    Raises:
      ValueError: one of them leads out of the folder, or is no XML.
    """
    texts, waiting = {}, [path]
    while waiting:
        one = waiting.pop()
        check_inside(folder, one, what, _OR_NAMED)
        if one.resolve() in texts or not one.is_file():
            continue  # MuJoCo names a file that is missing
        try:
            root = texts[one.resolve()] = ElementTree.parse(one).getroot()
        except ElementTree.ParseError as error:
            raise ValueError(f"{what}: {one}: {error}") from None
        waiting += [path.parent / item.get("file", "") for item in root.iter("include")]
        # MuJoCo looks there first, and then beside the file that includes.
        waiting += [one.parent / item.get("file", "") for item in root.iter("include")]
    elements = [item for root in texts.values() for item in root.iter()]
    folders = {"", *(item.get(name, "") for item in elements for name in _FOLDERS)}
    named = {item.get(name) for item in elements for name in _NAMES} - {None}
    for place in folders:
        for name in named:
            check_inside(folder, path.parent / place / name.removeprefix("package://"), what, _OR_NAMED)


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
    if size > LARGEST_BYTES:
        raise ValueError(f"{path}: got {size / 2**30:.1f} GiB unpacked, expected at most {LARGEST_BYTES / 2**30:g} GiB")
