"""How much a discovery tries, and what it finds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxtune.discovery.fit import Fit
from jaxtune.discovery.state import AcceptedTerm


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much a discovery tries, and how much evidence it asks for.

    The defaults are those that the blind benchmark was measured with. More hypotheses on the shortlist cost time; the
    other numbers trade missed effects against invented ones.
    """

    shortlist: int = 8
    """Hypotheses that are fitted beside the best of each family."""
    finalists: int = 4
    """How many of those are fitted with fresh slopes, at every horizon, and compared."""
    paired: int = 4
    """How many of the best are tried two by two where none passes alone. Pairs are tried only while nothing was
    accepted and the model is above the floor."""
    most: int = 4
    """Largest number of effects that are accepted."""
    level: float = 0.05
    """Probability of naming something where nothing is missing, which the thresholds allow."""
    share: float = 0.5
    """Share of the energy above the floor that the accepted effects must explain together; with less the verdict is
    `unnamed`."""
    at_floor: float = 1.5
    """Gap in floor units that counts as none. No further effect is looked for once every signal is below it."""
    promising: float = 0.3
    """Share of the smallest accepted gain that the screen must see in a hypothesis before it is fitted."""
    same: float = 0.8
    """Share of the best explanation from which on another name may as well be right, since effects have more functional
    forms than the one in the library."""
    changed: float = 3.0
    """Prior standard deviations beyond which a nominal parameter is reported as changed."""
    rounds: int = 4
    """Rounds of a fit."""


DEFAULTS = Settings()


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a discovery found, for reports.

    The corrected model is `residual` where there is one, else `fit`; its `vector` is what the simulator is given.
    """

    verdict: str
    """`named` (an effect is missing), `parameter_change` (nominal parameters alone are off), `no_missing_effect` (the
    model is at the floor) or `unnamed` (something is missing that no hypothesis explains)."""
    terms: tuple[AcceptedTerm, ...]
    fit: Fit
    """The model with all accepted effects, at the main horizon."""
    errors: np.ndarray
    """[coordinates] standard errors of `fit`."""
    null: Fit
    """The model with none, its nominal parameters fitted."""
    where: tuple[Mapping[str, Any], ...]
    """Cells above the floor before anything was accepted, largest first; see `localise.cells`."""
    needs_torque: Mapping[str, float]
    """How much every joint needs a torque of its own beside the last model that was looked at."""
    not_testable: tuple[str, ...]
    """Names of effects that these logs could not show. They are not absent: other motions could show them."""
    not_finite: tuple[str, ...]
    """Keys of hypotheses that broke the simulation."""
    dropped: tuple[str, ...]
    """Keys of hypotheses that were accepted and no longer paid beside later ones."""
    rejected: Mapping[str, Any]
    """The best hypothesis that was not accepted, with its tests and evidence."""
    changed: Mapping[int, float]
    """Nominal axes that moved too far to be the same parameter, with the distance in prior standard deviations."""
    changed_alike: Mapping[int, tuple[str, ...]]
    """Names of effects that these logs cannot distinguish from such a change, by axis."""
    residual: Fit | None
    """The model with a learned torque at one joint, where something is missing that has no name."""
    gap: Mapping[str, float]
    """Rms of the worst position on the sealed segments, in floor units: `before`, `null` and `after`."""
    proof: Mapping[str, Any]
    """`cells` (rms of every component), `no_cell_worse` (no component is more than a floor unit above the null's), and
    `others`: the gap of ablations and placebos."""
