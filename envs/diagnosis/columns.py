"""Finds columns that are probably misspelt: a reader takes them for columns that it does not know."""

from collections.abc import Sequence

from envs.diagnosis.finding import Finding
from envs.logs import Run
from envs.logs.format import JOINT_SIGNALS, SCALAR_SIGNALS, VECTOR_SIGNALS, alike, column_names


def misspelt(run: Run, joints: Sequence[str]) -> list[Finding]:
    """Finds unknown columns whose names differ from a known one only in case, or by one letter.

    Args:
      run: as it was read; a known column that it has cannot be the one that was meant.
      joints: names of the joints of the log.
    """
    absent = [name for name in (*JOINT_SIGNALS, *VECTOR_SIGNALS, *SCALAR_SIGNALS) if name not in run.signals]
    known = [column for name in absent for column in column_names(name, joints)]
    found = []
    for name in run.other:
        meant = [column for column in known if alike(name, column)]
        if meant:
            text = f"column '{name}' is not known; rename it to '{meant[0]}', or to something less like it"
            found.append(Finding("misspelt column", meant[0], (), 0.0, text))
    return found
