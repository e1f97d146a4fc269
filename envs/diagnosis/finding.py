"""The record of one thing that the log doctor suspects of a run."""

from dataclasses import dataclass

MEASURED = ("q", "dq", "tau")
"""Signals of the joints that sensors give, in contrast to targets."""

_WRONG = (
    "swapped joints",
    "flipped sign",
    "degrees",
    "radians twice",
    "millimetres",
    "millinewtonmetres",
    "scale",
    "motors off",
)
MISLEADING = (*_WRONG, "frozen", "wrapped", "missing rows", "clock jump", "misspelt column", "contact")
"""Kinds of findings that would make a discovery name something else, so that it refuses the log. All others (a low
rate, short gaps, repeated rows, quantisation, clipping, drift, a delay, an offset, constant signals, still joints,
gains) limit what can be learnt, are left out, or are effects."""


@dataclass(frozen=True)
class Finding:
    """One thing that is suspected of a run, for reports and for programs that refuse a damaged log.

    Two findings with the same kind, signal and joints say the same of two runs (`envs.diagnosis.shared_findings`).
    """

    kind: str
    """What is wrong, in one word or two (`swapped joints`, `late`, `clipped`); reports and files keep these words."""
    signal: str
    """Where it is wrong: a signal, `measured` for all signals of sensors, `all` for these and the targets, or `t`."""
    joints: tuple[str, ...]
    """Joints of the model whose signals are wrong; empty where all joints are, or where the finding is not about
    joints."""
    size: float
    """Size of the error, in the unit that the sentence has (ms of a delay, rad of an offset, a factor)."""
    sentence: str
    """The finding for a person, with the remedy where there is one."""

    @property
    def wrong(self) -> bool:
        """Whether numbers have another meaning than the log declares (joint, sign or unit).

        Nothing can be learnt from such a log before it is corrected; other findings only limit what can be learnt.
        """
        return self.kind in _WRONG

    @property
    def misleading(self) -> bool:
        """Whether a discovery from the log would answer wrongly; wrong numbers, wrong times and signals not read."""
        return self.kind in MISLEADING
