"""How a robot is asked for walks, and how it answers: through files in a folder that both can see."""

import time
from pathlib import Path

from experiments.common.checkpoint import write_json

_LOOK_S = 1.0  # pause between two looks at the folder
_QUIET_LOOKS = 3  # a log that has not changed for so many looks is complete
_RESTLESS_S = 60.0  # how long a log may go on changing after the timeout
_SPARE_S = 0.05  # added to a walk: the reader drops its first tick, and its last where the robot did not fall


def request(place: Path, episodes: int, seconds: float, seed: int) -> None:
    """Asks the robot for walks with the policy in the same folder, by writing `request.json`.

    The file is written last, so a robot that finds it finds the policy too and may begin at once.

    Args:
      place: folder of the round.
      episodes: number of walks, a run of the log each.
      seconds: how much of a walk is wanted.
      seed: for whatever the robot draws (commands, its own noise in a simulation).
    """
    write_json(place / "request.json", {"episodes": episodes, "seconds": seconds + _SPARE_S, "seed": seed})


def wait(place: Path, timeout_s: float) -> None:
    """Waits until the robot's log is complete: `meta.yaml` is there, and no file has changed for a few looks.

    A robot may write run by run, over a network, so files that exist are not yet files that are finished.

    Args:
      place: folder of the round, in which the robot writes `log`.
      timeout_s: how long to wait for the log to appear.

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
    """Size and time of change of every file, which tell whether anything was written between two looks."""
    found = {}
    for path in folder.rglob("*"):
        try:
            found[path] = (path.stat().st_size, path.stat().st_mtime_ns)
        except FileNotFoundError:  # a draft was renamed between listing and looking
            continue
    return found
