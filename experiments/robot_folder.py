"""How a robot is asked, and how it answers: files in a folder that both can see."""

import time
from pathlib import Path

from experiments.checkpoint import write_json

_LOOK_S = 1.0  # between two looks for a log
_QUIET_LOOKS = 3  # after which a log that has not changed is whole
_RESTLESS_S = 60.0  # that a log may go on changing when time is up
_SPARE_S = 0.05  # of a walk, for the ticks at its ends of which nobody knows what was before or after them


def request(place: Path, episodes: int, seconds: float, seed: int) -> None:
    """Asks the robot for walks with the policy that is there: whoever finds the request may begin."""
    write_json(place / "request.json", {"episodes": episodes, "seconds": seconds + _SPARE_S, "seed": seed})


def wait(place: Path, timeout_s: float) -> None:
    """Waits for a log that is whole: it has its `meta.yaml`, and nothing of it has changed for some looks.

    Raises:
      ValueError: the robot has refused, or has not answered in time, or does not stop writing.
    """
    begin, before, quiet = time.monotonic(), None, 0
    while True:
        files, waited = _content(place / "log"), time.monotonic() - begin
        there = place / "log" / "meta.yaml" in files
        quiet = quiet + 1 if there and files == before else 0
        if quiet == _QUIET_LOOKS:
            return
        refused = place / "refused.txt"
        if not there and refused.exists():
            raise ValueError(f"{refused}: {refused.read_text().strip()} (remove the file to ask again)")
        if not there and waited > timeout_s:
            raise ValueError(
                f"{place / 'log'}: no log after {timeout_s:g} s, expected one as {place / 'request.json'} asks for; "
                "put it there and give the same command again"
            )
        if waited > timeout_s + _RESTLESS_S:
            raise ValueError(
                f"{place / 'log'}: still changes {_RESTLESS_S:g} s after the time that it had, expected files that are "
                "closed before meta.yaml is written"
            )
        before = files
        time.sleep(_LOOK_S)


def _content(folder: Path) -> dict[Path, tuple[int, int]]:
    """Sizes and times of all files."""
    found = {}
    for path in folder.rglob("*"):
        try:
            found[path] = (path.stat().st_size, path.stat().st_mtime_ns)
        except FileNotFoundError:  # a copy in the making was renamed
            continue
    return found
