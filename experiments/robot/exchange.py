"""Requests walks from a robot and waits for its answer, through files in a folder that both can see.

Files need no network protocol on the robot, and they remain as a record of what was requested and what was answered.
"""

import time
from pathlib import Path

from experiments.common.files import write_json

_LOOK_S = 1.0  # pause between two looks at the folder
_QUIET_LOOKS = 3  # a log that has not changed for so many looks is complete
_RESTLESS_S = 60.0  # how long a log may continue to change after the timeout
_SPARE_S = 0.05  # added to a walk: the reader drops its first tick, and its last where the robot did not fall


def request(place: Path, episodes: int, seconds: float, seed: int) -> None:
    """Requests walks with the policy in the same folder, by writing `request.json`.

    Call it after the policy was exported: a robot that finds the request may begin at once.

    Args:
      place: folder of the round.
      episodes: number of walks; each becomes one run of the log.
      seconds: length of the walks that will be compared, in s; a little more is requested.
      seed: for whatever the robot draws (commands, and its noise if it is simulated).
    """
    write_json(place / "request.json", {"episodes": episodes, "seconds": seconds + _SPARE_S, "seed": seed})


def wait(place: Path, timeout_s: float) -> None:
    """Waits until the robot's log is complete: `meta.yaml` is there, and no file has changed for a few looks.

    A robot may write run by run, over a network, so files that exist are not yet files that are finished.

    Args:
      place: folder of the round, in which the robot writes `log`.
      timeout_s: how long to wait for the log to appear, in s.

    Raises:
      ValueError: the robot has refused (`refused.txt`), has not answered in time, or does not stop writing.
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
            raise ValueError(f"{refused}: {refused.read_text().strip()} (to repeat the request, remove the file)")
        if not there and waited > timeout_s:
            raise ValueError(
                f"{place / 'log'}: no log after {timeout_s:g} s, expected one as {place / 'request.json'} asks for; "
                "put the log there and give the same command again"
            )
        if waited > timeout_s + _RESTLESS_S:
            raise ValueError(
                f"{place / 'log'}: still changes {_RESTLESS_S:g} s after the timeout, expected files that are complete "
                "before meta.yaml is written"
            )
        before = files
        time.sleep(_LOOK_S)


def _content(folder: Path) -> dict[Path, tuple[int, int]]:
    """Returns size and modification time of every file, which show whether anything was written between two looks."""
    found = {}
    for path in folder.rglob("*"):
        try:
            found[path] = (path.stat().st_size, path.stat().st_mtime_ns)
        except FileNotFoundError:  # a draft was renamed between listing and looking
            continue
    return found
