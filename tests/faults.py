"""Kills at every step on the disk, within one process."""

import json
import os
import shutil
from functools import partial

from processes import same


class Killed(BaseException):
    """Ends a process at once: no `except Exception` sees it."""


def killed_at(monkeypatch, moment, write):
    """Calls `write`, killed before or after one of its steps on the disk; tells whether there was such a step."""
    steps = [0]

    def counted(function):
        def step(*args, **kwargs):
            steps[0] += 1
            if 2 * steps[0] == moment:
                raise Killed
            result = function(*args, **kwargs)
            if 2 * steps[0] + 1 == moment:
                raise Killed
            return result

        return step

    with monkeypatch.context() as patch:
        for module, name in ((os, "fsync"), (os, "replace"), (os, "rename"), (shutil, "rmtree")):
            patch.setattr(module, name, counted(getattr(module, name)))
        try:
            write()
        except Killed:
            return True
    return False


def contents(folder):
    """All files of a folder that a person or a later command reads, by path."""
    found = {}
    for path in sorted(folder.rglob("*")):
        # A process that was killed leaves its lock files and drafts.
        if path.is_file() and not path.name.startswith(".") and path.suffix != ".tmp":
            text = path.read_text()
            if path.suffix == ".json":
                text = json.loads(text)
            elif path.suffix == ".jsonl":
                text = [json.loads(line) for line in text.splitlines()]
            found[str(path.relative_to(folder))] = text
    return found


def check_every_kill(monkeypatch, tmp_path, command):
    """Kills `command(folder)` at each of its steps on the disk: given again, it ends as if that had not been.

    Returns:
      The number of moments at which it was killed.
    """
    command(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    moment = 2
    while killed_at(monkeypatch, moment, partial(command, out := tmp_path / str(moment))):
        command(out)
        same(contents(out), whole)
        moment += 1
    return moment - 2
