"""What the log doctor says."""

from dataclasses import dataclass

MEASURED = ("q", "dq", "tau")
"""What sensors say of joints."""

_WRONG = ("swapped joints", "flipped sign", "degrees", "radians twice", "millinewtonmetres")


@dataclass(frozen=True)
class Finding:
    """One suspicion."""

    kind: str
    """What is wrong, as one word or two."""
    signal: str
    """Where: a signal, `measured` for all that sensors say, or `t`."""
    joints: tuple[str, ...]
    size: float
    """How much, in the unit of the sentence."""
    sentence: str
    """For a person, with what to do about it."""

    @property
    def wrong(self) -> bool:
        """Whether numbers mean something else than the log says: nothing can be learnt from it as it is."""
        return self.kind in _WRONG
