"""A corrected model as it lies in a folder: an MJCF, and a JSON of the effects that MuJoCo has no form for."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envs.effects import EVERY
from jaxtune.types import Effect, Parameter

MODEL, EFFECTS = "model.xml", "effects.json"


@dataclass(frozen=True)
class Correction:
    """A corrected model, for whatever moves it."""

    path: Path
    """Of the MJCF."""
    effects: Mapping[str, Mapping[str, Mapping[str, float]]]
    """Physical values by effect, place and parameter, of what MuJoCo has no form for."""

    @property
    def digest(self) -> str:
        """SHA-256 of what it says, wherever it lies."""
        said = self.path.read_bytes() + json.dumps(self.effects, sort_keys=True).encode()
        return hashlib.sha256(said).hexdigest()

    @property
    def rows(self) -> tuple[Effect, ...]:
        """Its effects, in the library's order: the order in which they act."""
        return tuple(row for row in EVERY.values() if row.name in self.effects)

    def values(self, places: Mapping[str, Sequence[str]]) -> dict[str, dict[str, np.ndarray]]:
        """What the physics reads of every effect, by effect and parameter, [places].

        Args:
          places: names by what an effect may be on.

        Raises:
          ValueError: there is no such place or parameter.
        """
        found = {}
        for row in self.rows:
            there = self.effects[row.name]
            for place in there:
                for name in set(there[place]) - {parameter.name for parameter in row.parameters}:
                    raise ValueError(f"effects: there is no '{name}' of '{row.name}'")
                if place not in places[row.on]:
                    raise ValueError(
                        f"effects: '{row.name}' is on '{place}', expected one of {', '.join(places[row.on])}"
                    )
            found[row.name] = {
                parameter.name: np.array(
                    [_inner(parameter, there.get(place, {}).get(parameter.name)) for place in places[row.on]],
                    np.float32,
                )
                for parameter in row.parameters
            }
        return found


def _inner(parameter: Parameter, value: float | None) -> float:
    """What the physics reads of a value; of none, what leaves the robot as it is."""
    return float(parameter.inner(0.0 if value is None else parameter.coordinate(value, 1.0), 1.0))


def read(folder: Path) -> Correction:
    """Reads a corrected model from its folder.

    Raises:
      ValueError: a file is missing, or an effect is not in the library.
    """
    for name in (MODEL, EFFECTS):
        if not (folder / name).exists():
            raise ValueError(f"model: {folder / name} is missing")
    effects = json.loads((folder / EFFECTS).read_text())["effects"]
    for name in effects:
        if name not in EVERY:
            raise ValueError(f"{folder / EFFECTS}: there is no effect '{name}'")
    return Correction(folder / MODEL, effects)
