"""The field benchmark: writes the log of each case, lets discovery answer as for a user, and scores the answers."""

import json
import time
import traceback
from collections.abc import Mapping
from pathlib import Path

from experiments.common import checkpoint
from experiments.common.checkpoint import write_json
from experiments.discovery.field import scores
from experiments.discovery.field.cases import FIELD_SIZES, FieldCase, cases
from experiments.discovery.field.writing import write_case
from experiments.discovery.investigate import investigate


class FieldBench:
    """The cases of the field benchmark: their logs, truths, answers and scores, each in files.

    Call `answer` for every case in `cases`, then `report`.

    Args:
      out: folder of the benchmark.
      size: one of `cases.FIELD_SIZES`.
      seed: of everything random. After somebody has looked at the cases of a seed and improved discovery with them,
        they are no test any more.
      nominal_error: relative error of the nominal parameters.
    """

    def __init__(self, out: Path, size: str, seed: int, nominal_error: float):
        self._out, self._seed, self._nominal_error = out, seed, nominal_error
        self.cases: list[FieldCase] = cases(FIELD_SIZES[size], seed)

    def write(self, case: FieldCase) -> Path:
        """Writes a case's log, and its truth into the folder that only the scorer reads, unless they exist.

        Returns:
          Folder of the log.
        """
        return write_case(case, self._nominal_error, self._seed, self._out)

    def answer(self, case: FieldCase) -> dict:
        """Lets discovery answer a case as it answers a user, or reads an earlier answer.

        A case that raises is recorded with the verdict `failed` and its message.

        Returns:
          Content of `summary.json`.
        """
        folder = self._out / "answers" / f"case_{case.number:03d}"
        summary, failed = folder / "summary.json", folder / "failed.json"
        if failed.exists():
            return json.loads(failed.read_text())
        if not summary.exists():
            log, began = self.write(case), time.monotonic()
            try:
                investigate([log], folder)
            except Exception as error:  # one bad case must not end a night's work; it counts as wrong
                folder.mkdir(parents=True, exist_ok=True)
                answer = {"verdict": "failed", "message": f"{type(error).__name__}: {error}"}
                answer |= {"traceback": traceback.format_exc(), "seconds": time.monotonic() - began}
                write_json(failed, answer | {"effects": [], "parameter_changes": []})
                return self.answer(case)
        return json.loads(summary.read_text())

    def scored(self) -> list[dict]:
        """Scores every case that is answered. No other function opens the truth.

        Returns:
          Rows of `scores.score`, with the folder of the `case`.
        """
        rows = []
        for case in self.cases:
            name = f"case_{case.number:03d}"
            found = [self._out / "answers" / name / file for file in ("summary.json", "failed.json")]
            there = [path for path in found if path.exists()]
            if there:
                truth = json.loads((self._out / "sealed" / f"{name}.json").read_text())
                rows.append(scores.score(truth, json.loads(there[0].read_text())) | {"case": name})
        return rows

    def report(self, identity: Mapping[str, object]) -> list[dict]:
        """Writes scores and page of the cases that are answered so far.

        Args:
          identity: options of the benchmark, for the page.

        Returns:
          The table of rates (`scores.tally`).
        """
        rows = self.scored()
        lines = scores.tally(rows)
        write_json(self._out / "scores.json", {"cases": rows, "table": lines, "versions": checkpoint.versions()})
        (self._out / "README.md").write_text(scores.page(identity, len(self.cases), rows, lines))
        return lines
