"""How much a discovery tries, what it finds, and what it leaves for the next one of the same robot and motion."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxtune.discovery.accept import Rung
from jaxtune.discovery.fit import Fit


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much is tried, and what it takes."""

    shortlist: int = 8
    """Hypotheses that are fitted beside the best of each family."""
    finalists: int = 4
    """Of those, how many are fitted with fresh slopes, at every horizon, and compared."""
    paired: int = 4
    """How many of the best are tried two by two where none pays alone."""
    most: int = 4
    """Effects that are accepted at most."""
    level: float = 0.05
    """Of naming something where nothing is missing."""
    share: float = 0.5
    """Of the energy above the floor that the named effects must explain together; else it is `unnamed`."""
    at_floor: float = 1.5
    """Floor units up to which a gap is none, and up to which, in every signal, nothing more is looked for."""
    promising: float = 0.3
    """Share of the gain it takes that the screen must see for a fit."""
    same: float = 0.8
    """Share of what is explained from which on another name may as well be right: effects have more forms than one."""
    changed: float = 3.0
    """Prior standard deviations beyond which a nominal parameter is another one."""
    rounds: int = 4
    """Of a fit."""


DEFAULTS = Settings()


@dataclass
class Result:
    """What was found."""

    verdict: str = ""
    rungs: list[Rung] = field(default_factory=list)
    fit: Fit | None = None
    errors: np.ndarray | None = None
    """Standard errors of the fit's coordinates."""
    null: Fit | None = None
    where: list[dict] = field(default_factory=list)
    """Cells above the floor before anything was accepted."""
    needs_torque: dict[str, float] = field(default_factory=dict)
    not_testable: list[str] = field(default_factory=list)
    not_finite: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)
    """What was accepted and no longer paid beside later effects."""
    rejected: dict[str, Any] = field(default_factory=dict)
    """The best that was not accepted, and its tests."""
    changed: dict[int, float] = field(default_factory=dict)
    """Nominal axes that moved too far to be the same parameter, with their standard deviations from the prior."""
    changed_alike: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Names of effects that these logs could not tell from such a change."""
    residual: Fit | None = None
    """With a free torque at one joint, where something has no name."""
    gap: dict[str, float] = field(default_factory=dict)
    proof: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Calibration:
    """What healthy logs say, which depends on the robot, its motion and its noise alone."""

    floors: dict[float, tuple[Mapping[str, np.ndarray], float]]
    """Floors [bins, components] by split, and independent share, by horizon."""
    gain: float
    """What the best hypothesis gains on them."""
    penalty: float
    """Under which no joint of them needs a torque."""
