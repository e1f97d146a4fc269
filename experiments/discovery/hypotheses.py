"""What discovery tries: every effect of the library at every place alone, at left/right pairs, and at all places."""

from collections.abc import Mapping, Sequence

import numpy as np

from envs.rig import Axis
from jaxtune.discovery.problem import Hypothesis
from jaxtune.types import Effect


def hypotheses(
    axes: Sequence[Axis], places: Mapping[str, Sequence[str]], rows: Mapping[str, Effect]
) -> tuple[Hypothesis, ...]:
    """Lists the hypotheses about a rig, in the order of the library.

    An effect at several places has the same physical size at each of them, so a hypothesis is one direction per
    parameter through all its places.

    Args:
      axes: coordinates of the rig.
      places: names of places by what an effect may be on.
      rows: effects that are tried, by name.
    """
    index = {(axis.effect, axis.parameter, axis.place): number for number, axis in enumerate(axes)}
    return tuple(
        _hypothesis(axes, index, row, chosen) for row in rows.values() for chosen in place_sets(places[row.on])
    )


def place_sets(places: Sequence[str]) -> list[tuple[str, ...]]:
    """Lists where an effect is tried: each place alone, a left place with its right one, and all together."""
    pairs = [(one, one.replace("left", "right")) for one in places if "left" in one]
    sets = [(place,) for place in places] + [pair for pair in pairs if pair[1] in places]
    return sets if len(places) < 2 or tuple(places) in sets else [*sets, tuple(places)]


def timing_directions(axes: Sequence[Axis], control_hz: float) -> np.ndarray:
    """Returns half a period of the controller as a delay of all readings, and as one of all targets, [2, axes].

    Nobody knows when the controller looked and acted within its period, so discovery leaves both free everywhere.

    Args:
      axes: coordinates of the rig.
      control_hz: rate of the controller.
    """
    late = [[axis.effect == effect for axis in axes] for effect in ("sensor_delay", "command_delay")]
    return np.array(late, float) * 0.5 / control_hz


def _hypothesis(axes: Sequence[Axis], index: Mapping, row: Effect, places: tuple[str, ...]) -> Hypothesis:
    directions = np.zeros((len(row.parameters), len(axes)))
    bounds = np.array([parameter.bounds for parameter in row.parameters], float)
    for number, parameter in enumerate(row.parameters):
        mine = [index[row.name, parameter.name, place] for place in places]
        bounds[number, 0] = max(axes[axis].least for axis in mine)
        for axis in mine:
            # In single precision, as the physics has it.
            ratio = np.float32(axes[mine[0]].scale) / np.float32(axes[axis].scale)
            factor = 1.0 / ratio if parameter.form == "reciprocal" else ratio
            directions[number, axis] = 1.0 if parameter.form == "ratio" else factor
    first = [index[row.name, row.parameters[0].name, place] for place in places]
    return Hypothesis(
        name=row.name,
        family=row.family,
        places=places,
        directions=directions,
        probes=_probes(row),
        bounds=bounds,
        prior=np.array([parameter.prior for parameter in row.parameters]),
        joints=tuple(sorted({joint for axis in first for joint in axes[axis].joints})),
    )


def _probes(row: Effect) -> np.ndarray:
    """Coordinates [probes, parameters] at which the screen looks: shapes stay zero, several parameters are tried
    singly."""
    free = [number for number, parameter in enumerate(row.parameters) if not parameter.shape]
    if len(free) > 1:
        probes = np.zeros((len(free), len(row.parameters)))
        probes[np.arange(len(free)), free] = row.sizes[0]
        return probes
    probes = np.zeros((len(row.sizes), len(row.parameters)))
    probes[:, free[0]] = row.sizes
    return probes
