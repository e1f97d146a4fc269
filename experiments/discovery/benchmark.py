"""What all benchmarks of discovery have in common: answers by the procedure that users have, and their scores."""

import time
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from experiments.common import checkpoint, plots
from experiments.common.files import read_json, write_json, write_text
from experiments.discovery import gate
from experiments.discovery.investigate import investigate
from experiments.discovery.measured import read_logs
from experiments.discovery.scores import page, score, tally


class Case(Protocol):
    """One robot of a benchmark."""

    @property
    def number(self) -> int:
        """It names the files of the case."""


class Benchmark:
    """Cases whose logs, truths, answers and scores are files, so that an interrupted benchmark goes on.

    A benchmark says what its `cases` are, and writes their logs and truths (`write`). Call `answer` for every case,
    then `report`.

    Args:
      out: folder of the benchmark, with `logs`, `answers` and `sealed`, which only `scored` opens.
    """

    cases: Sequence[Case]

    def __init__(self, out: Path):
        self.out = out

    def write(self, case: Case) -> Path:
        """Writes a case's log, and its truth into the folder that only `scored` reads, unless they exist.

        Returns:
          Folder of the log.
        """
        raise NotImplementedError

    def truth_path(self, case: Case) -> Path:
        """Returns the file of a case's truth."""
        return self.out / "sealed" / f"{name_of(case)}.json"

    def answer(self, case: Case) -> dict:
        """Lets discovery answer a case as it answers a user, or reads an earlier answer.

        A case that raises gets the verdict `failed` with its message, and counts as wrong.

        Returns:
          Content of `summary.json`.

        Raises:
          ValueError: another process answers the case.
        """
        folder = self.out / "answers" / name_of(case)
        with checkpoint.lock(folder):
            return self.answered(case) or self._answer(case, folder)

    def _answer(self, case: Case, folder: Path) -> dict:
        log, began = self.write(case), time.monotonic()
        try:
            gate.check(*read_logs([log]))
            return investigate([log], folder).summary
        except Exception as error:  # one bad case must not end a night's work
            folder.mkdir(parents=True, exist_ok=True)
            answer = {"verdict": "failed", "message": f"{type(error).__name__}: {error}", "effects": []}
            answer |= {"parameter_changes": [], "seconds": time.monotonic() - began}
            write_json(folder / "failed.json", answer | {"traceback": traceback.format_exc()})
            return answer

    def answered(self, case: Case) -> dict | None:
        """Reads an earlier answer to a case, as `answer` returns it; None where there is none."""
        folder = self.out / "answers" / name_of(case)
        there = [path for name in ("summary.json", "failed.json") if (path := folder / name).exists()]
        return read_json(there[0]) if there else None

    def scored(self) -> list[dict]:
        """Scores every case that is answered. No other function opens the truth.

        Returns:
          Rows of `scores.score`, with the name of the `case`.
        """
        rows = []
        for case in self.cases:
            answer = self.answered(case)
            if answer is not None:
                truth = read_json(self.truth_path(case))
                rows.append(score(truth, answer) | {"case": name_of(case)})
        return rows

    def report(self, identity: Mapping[str, object]) -> list[dict]:
        """Writes scores, confusion matrix and page of the cases that are answered so far.

        Args:
          identity: options of the benchmark, for the page.

        Returns:
          The table of rates (`scores.tally`).
        """
        rows, out = self.scored(), self.out
        lines = tally(rows)
        write_json(out / "scores.json", {"cases": rows, "table": lines, "versions": checkpoint.versions()})
        single = [row for row in rows if len(row["effects"]) < 2]
        if single:
            plots.confusion(out / "confusion.png", [row | {"asked": _class_of(row)} for row in single])
        write_text(out / "README.md", page(identity, len(self.cases), rows, lines))
        return lines


def name_of(case: Case) -> str:
    """Returns the name of a case's files."""
    return f"case_{case.number:03d}"


def _class_of(row: Mapping) -> float:
    """Returns the least severity, of a few, that a case was meant to have, for panels of a picture."""
    return max((least for least in (0.0, 2.0, 5.0, 15.0) if row["asked"] >= least), default=0.0)
