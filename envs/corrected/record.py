"""A corrected model as it is saved: an MJCF, and a JSON of the effects that MJCF cannot express."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envs.effects import EVERY
from jaxtune.types import Effect, Parameter

MODEL, EFFECTS = "model.xml", "effects.json"

Effects = Mapping[str, Mapping[str, Mapping[str, float]]]
"""Physical values by effect, place (a joint, body or foot) and parameter, in the unit of the parameter's name."""


@dataclass(frozen=True)
class Correction:
    """A corrected model as it was read from its folder: the path of its MJCF, and its effects.

    It is independent of what simulates it: `envs.corrected.make` builds a walking BITeno from it, and a run's identity
    contains its digest.
    """

    path: Path
    """Path of the MJCF."""
    effects: Effects
    """Effects that MJCF cannot express; empty where the MJCF holds all corrections."""

    @property
    def digest(self) -> str:
        """SHA-256 of the content of both files, wherever the folder is.

        A run saves it, and refuses to be resumed with another model.
        """
        # Sorted, so that the order of keys in the JSON does not matter.
        content = self.path.read_bytes() + json.dumps(self.effects, sort_keys=True).encode()
        return hashlib.sha256(content).hexdigest()

    @property
    def rows(self) -> tuple[Effect, ...]:
        """Its effects as rows of the library, in the library's order, which is the order in which they act."""
        return tuple(row for row in EVERY.values() if row.name in self.effects)

    def values(self, places: Mapping[str, Sequence[str]]) -> dict[str, dict[str, np.ndarray]]:
        """Translates the physical values into the arrays that the effects' functions read.

        A place without a value for an effect gets the value with which the effect does nothing there.

        Args:
          places: names of the robot's places by what an effect may be on: `joint`, `body`, `foot` and `robot`.

        Returns:
          Arrays [places] by effect and parameter, for `envs.chain.Chain`.

        Raises:
          ValueError: an effect is on a place, or has a parameter, that does not exist.
        """
        return {row.name: self._values_of(row, places[row.on]) for row in self.rows}

    def _values_of(self, row: Effect, places: Sequence[str]) -> dict[str, np.ndarray]:
        given = self.effects[row.name]
        known = [parameter.name for parameter in row.parameters]
        for place, values in given.items():
            for name in set(values) - set(known):
                raise ValueError(f"effects: got parameter '{name}' of '{row.name}', expected one of {', '.join(known)}")
            if place not in places:
                raise ValueError(f"effects: got '{row.name}' on '{place}', expected one of {', '.join(places)}")
        return {
            parameter.name: np.array(
                [_inner(parameter, given.get(place, {}).get(parameter.name)) for place in places], np.float32
            )
            for parameter in row.parameters
        }


def _inner(parameter: Parameter, value: float | None) -> float:
    """Converts a physical value into the number that the physics reads; None into the one that has no influence."""
    # Values in files are in the parameter's own unit, so the scale is one.
    return float(parameter.inner(0.0 if value is None else parameter.coordinate(value, 1.0), 1.0))


def read(folder: Path) -> Correction:
    """Reads a corrected model from the folder that `save` wrote.

    Args:
      folder: with `model.xml` and `effects.json`.

    Returns:
      The record of it; the MJCF is not compiled here.

    Raises:
      ValueError: a file is missing or damaged, or an effect is not in the library.
    """
    for name in (MODEL, EFFECTS):
        if not (folder / name).exists():
            raise ValueError(f"model: {folder / name} is missing")
    try:
        effects = json.loads((folder / EFFECTS).read_text())["effects"]
        values = [value for places in effects.values() for place in places.values() for value in place.values()]
        finite = np.isfinite(values).all()
    except (ValueError, KeyError, TypeError, AttributeError):
        finite = False
    if not finite:
        raise ValueError(f"{folder / EFFECTS}: is damaged, expected numbers by effect, place and parameter")
    # Checked here, not when it is simulated, so that a run is refused before anything is computed.
    for name in effects:
        if name not in EVERY:
            raise ValueError(f"{folder / EFFECTS}: got effect '{name}', expected one of {', '.join(EVERY)}")
    return Correction(folder / MODEL, effects)
