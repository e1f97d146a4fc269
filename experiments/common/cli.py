"""What every command shares: it reads arguments, prints, shows progress, and turns a user's error into one line."""

import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NoReturn

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

_WIDE = 160  # columns of a file or a pipe, where nothing says how wide it is and tables must not be cut off
console = Console()
"""Where commands print their results."""
if not console.is_terminal and not os.environ.get("COLUMNS"):
    console.width = _WIDE

_errors = Console(stderr=True)
_INTERRUPTED = 130  # exit code of a command that Ctrl-C ended, by the shell's convention
_DAY_S = 86400.0
_LINE_S = 60.0  # between two lines of progress where there is no terminal to draw bars on


def run(main: Callable[[Any], None], args_type: type) -> None:
    """Runs a command: parses the command line into its `Args` and calls its `main` with them.

    A `ValueError` means bad input, which the user can correct. It ends the process with exit code 2 and one line on
    stderr that names the field, what was found and what was expected. So does an error of the system, such as a full
    disk. Ctrl-C ends with the command that goes on. Any other exception is a defect of the program and keeps its
    traceback.

    Raises:
      SystemExit: with code 2, where `main` raised a `ValueError` or an `OSError`, or the command line cannot be parsed;
        with code 130 after Ctrl-C.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        main(tyro.cli(args_type, description=args_type.__doc__))
    except ValueError as error:
        _refuse(str(error), error)
    except OSError as error:
        # A full disk, a file that may not be read: the system's words, with the name of the file.
        place = f"{error.filename}: " if error.filename else ""
        _refuse(f"{place}{error.strerror or error}", error)
    except KeyboardInterrupt as error:
        command = shlex.join(["python", "-m", _module(), *sys.argv[1:]])
        _errors.print(f"stopped; to go on or begin anew: {command}", highlight=False, markup=False, soft_wrap=True)
        raise SystemExit(_INTERRUPTED) from error


def _refuse(message: str, error: Exception) -> NoReturn:
    _errors.print(f"[red]error:[/red] {escape(message)}", highlight=False, soft_wrap=True)
    raise SystemExit(2) from error


def _module() -> str:
    """Name of the module that `python -m` runs."""
    spec = sys.modules["__main__"].__spec__
    return spec.name if spec else sys.argv[0]


def bars() -> Progress:
    """Makes the progress display of a command, a context manager with a bar for every task.

    On a terminal the bars are drawn in place. Elsewhere (a file, a pipe, a job's log) every unfinished task prints a
    plain line once a minute, so that a long run can be followed without thousands of redrawn bars. Both say the time
    that is left, by the mean pace so far, once two steps are done.
    """
    columns = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn()
    kind = Progress if console.is_terminal else _Lines
    # A step may take minutes, and the pace is that of all steps within the period.
    return kind(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console, speed_estimate_period=_DAY_S)


def count(progress: Progress, task: TaskID, completed: int, kept: bool) -> None:
    """Says how many steps of a task are done.

    Args:
      progress: of `bars`.
      task: whose steps they are.
      completed: steps that are done, the last one among them.
      kept: whether an earlier call did the last one. It took no time now, so the pace by which the time that is left is
        foretold begins after it.
    """
    (progress.reset if kept else progress.update)(task, completed=completed)


class _Lines(Progress):
    """Prints one line a minute for every task that is not finished, in the place of bars."""

    def start(self) -> None:
        super().start()
        self._ended = threading.Event()
        self._begin = time.monotonic()
        # A thread, because one step of a task may take many minutes.
        threading.Thread(target=self._print_lines, daemon=True).start()

    def stop(self) -> None:
        self._ended.set()
        super().stop()

    def _print_lines(self) -> None:
        while not self._ended.wait(_LINE_S):
            minutes = (time.monotonic() - self._begin) / 60.0
            for task in self.tasks:
                if not task.finished:
                    total = "" if task.total is None else f" {task.completed:g}/{task.total:g}"
                    left = task.time_remaining
                    left = "" if left is None else f", {left / 60.0:.0f} min left"
                    line = f"{minutes:.0f} min: {task.description}{total}{left}"
                    self.console.print(line, highlight=False, markup=False)
