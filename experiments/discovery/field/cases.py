"""The cases of the field benchmark: how often what is hidden, in which kind of robot and which generator."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.discovery.field.outside import OUTSIDE
from experiments.discovery.field.sizes import FAMILY

GENERATORS = ("mujoco_c", "bullet", "pinocchio")
_SHARES = {"arm2": 4, "arm3": 5, "leg4": 4, "arm5": 3, "biped": 3, "arm7": 1}
_OUTSIDE_SEVERITY = (6.0, 20.0)


@dataclass(frozen=True)
class FieldCase:
    """One robot of the field benchmark; its numbers, motions and places are drawn when its log is written."""

    number: int
    """Position in the shuffled list of cases; it names the files."""
    kind: str
    """`single`, `weak`, `pair`, `triple`, `outside`, or one without any effect: `empty`, `linear` (targets move between
    rows) or `wandering` (frictions and dampings differ from run to run)."""
    effects: tuple[str, ...]
    severities: tuple[float, ...]
    """Intended, in floor units."""
    topology: str
    generator: str
    late_stamps: bool = False
    """Whether its rows are stamped late, each by a time of its own; else stamps are exact."""


@dataclass(frozen=True)
class FieldSize:
    """How many cases of each kind, and whether their time stamps are late."""

    single: int
    weak: int
    pair: int
    triple: int
    empty: int
    linear: int
    outside: int
    wandering: int = 0
    late_stamps: bool = False


FIELD_SIZES = {
    "field": FieldSize(single=60, weak=20, pair=16, triple=8, empty=50, linear=10, outside=20),
    "field_smoke": FieldSize(single=2, weak=0, pair=1, triple=0, empty=1, linear=1, outside=1),
    "field_wandering": FieldSize(single=0, weak=0, pair=0, triple=0, empty=0, linear=0, outside=0, wandering=24),
    "field_late": FieldSize(single=16, weak=0, pair=0, triple=0, empty=8, linear=0, outside=0, late_stamps=True),
}
"""Sizes by the name that `--size` takes: `field` for a measurement, `field_smoke` to see that it works,
`field_wandering` for how often something is named where nothing is missing, but runs differ, and `field_late` for logs
whose rows are stamped late."""


def cases(size: FieldSize, seed: int) -> list[FieldCase]:
    """Draws the cases, in an order that says nothing about what they hide.

    Args:
      size: how many of each kind.
      seed: of everything random.
    """
    rng = np.random.default_rng((seed, 7))
    hidden = [
        *(("single", (name,), (_severity(rng, 5.0, 20.0),)) for name in _in_turn(tuple(FAMILY), size.single, rng)),
        *(("weak", (name,), (2.0,)) for name in _in_turn(tuple(FAMILY), size.weak, rng)),
        *(_several("pair", 2, rng) for _ in range(size.pair)),
        *(_several("triple", 3, rng) for _ in range(size.triple)),
        *(("empty", (), ()) for _ in range(size.empty)),
        *(("linear", (), ()) for _ in range(size.linear)),
        *(
            ("outside", (name,), (_severity(rng, *_OUTSIDE_SEVERITY),))
            for name in _in_turn(tuple(OUTSIDE), size.outside, rng)
        ),
        *(("wandering", (), ()) for _ in range(size.wandering)),
    ]
    names = [name for name, share in _SHARES.items() for _ in range(share)]
    topologies = _in_turn(names, len(hidden), rng)
    # Effects come in turn, so generators in turn would give each effect one generator alone.
    generators = _in_turn(GENERATORS, len(hidden), rng)
    # Three effects need three joints.
    topologies = [
        "arm3" if len(one[1]) > 2 and name == "arm2" else name for one, name in zip(hidden, topologies, strict=True)
    ]
    order = rng.permutation(len(hidden))
    return [
        FieldCase(number, *hidden[at], topologies[at], generators[at], size.late_stamps)
        for number, at in enumerate(order)
    ]


def _severity(rng: np.random.Generator, low: float, high: float) -> float:
    return float(round(np.exp(rng.uniform(np.log(low), np.log(high))), 2))


def _in_turn(names: Sequence[str], count: int, rng: np.random.Generator) -> list[str]:
    """Lists names so that each comes equally often, but for one, in a random order."""
    rounds = [str(name) for _ in range(-(-count // len(names))) for name in rng.permutation(names)]
    return rounds[:count]


def _several(kind: str, count: int, rng: np.random.Generator) -> tuple[str, tuple[str, ...], tuple[float, ...]]:
    names: list[str] = []
    while len(names) < count:
        name = str(rng.choice(list(FAMILY)))
        if FAMILY[name] not in {FAMILY[other] for other in names}:
            names.append(name)
    return kind, tuple(names), tuple(_severity(rng, 6.0, 20.0) for _ in names)
