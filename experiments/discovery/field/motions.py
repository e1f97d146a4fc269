"""Motions of the field benchmark: what the joints of a robot are told to do, drawn anew for each case.

A run consists of one or two kinds of motion at one controller gain. Kinds and gain are its condition.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from experiments.discovery.field.robots import Topology
from experiments.discovery.target_runs import TargetRun


@dataclass(frozen=True)
class _Ask:
    """What a kind of motion is drawn for."""

    rows: int
    rate_hz: float
    joints: int
    rng: np.random.Generator

    @property
    def time(self) -> np.ndarray:
        return np.arange(self.rows)[:, None] / self.rate_hz

    def steps(self, least_s: float, most_s: float) -> np.ndarray:
        """Draws levels in [-1, 1] that are held for a random time, [rows, joints]."""
        return np.stack([self._levels(least_s, most_s) for _ in range(self.joints)], axis=1)

    def _levels(self, least_s: float, most_s: float) -> np.ndarray:
        lengths = self.rng.uniform(least_s, most_s, int(self.rows / self.rate_hz / least_s) + 2)
        ends = np.cumsum(lengths)
        return self.rng.uniform(-1, 1, len(lengths))[np.searchsorted(ends, self.time[:, 0], side="right")]


def _triangles(ask: _Ask) -> np.ndarray:
    pace, phase = ask.rng.uniform(0.3, 0.9, ask.joints), ask.rng.uniform(0, 1, ask.joints)
    return 4 * np.abs((ask.time * pace + phase) % 1.0 - 0.5) - 1


def _chirp(ask: _Ask) -> np.ndarray:
    first, last = ask.rng.uniform(0.3, 0.7), ask.rng.uniform(5.0, 9.0)
    length = ask.rows / ask.rate_hz
    cycles = first * length / np.log(last / first) * ((last / first) ** (ask.time / length) - 1)
    return np.sin(2 * np.pi * (cycles + ask.rng.uniform(0, 1, ask.joints))) / (1 + 3 * ask.time / length)


def _steps(ask: _Ask) -> np.ndarray:
    return ask.steps(0.25, 0.6)


def _sines(ask: _Ask) -> np.ndarray:
    hertz, phase = ask.rng.uniform(0.2, 3.0, (4, 1, ask.joints)), ask.rng.uniform(0, 1, (4, 1, ask.joints))
    size = ask.rng.uniform(0.2, 0.5, (4, 1, ask.joints)) / (0.6 + 0.5 * hertz)
    return (size * np.sin(2 * np.pi * (hertz * ask.time + phase))).sum(axis=0)


def _holds(ask: _Ask) -> np.ndarray:
    # A step, then rest: static errors and stiction show.
    return ask.steps(0.7, 1.3)


def _prbs(ask: _Ask) -> np.ndarray:
    clock = max(1, round(ask.rng.uniform(0.08, 0.16) * ask.rate_hz))
    bits = ask.rng.choice([-0.4, 0.4], (ask.rows // clock + 1, ask.joints))
    return np.repeat(bits, clock, axis=0)[: ask.rows]


KINDS: dict[str, Callable[[_Ask], np.ndarray]] = {
    "triangles": _triangles,
    "chirp": _chirp,
    "steps": _steps,
    "sines": _sines,
    "holds": _holds,
    "prbs": _prbs,
}
"""Kinds of motion by name; each returns targets of order one, [rows, joints]."""


def draw(topology: Topology, rng: np.random.Generator) -> list[TargetRun]:
    """Draws the runs of a case: kinds, postures, amplitudes, gains, swings and splits.

    Half of the cases have two or three controller gains, half of them swings with the motors off, and half of them say
    which run is in which split.

    Args:
      topology: its joints, rates and number of runs.
      rng: random numbers.
    """
    count, rows = len(topology.joints), round(topology.seconds * topology.row_hz)
    gains = (1.0,) if rng.uniform() < 0.4 else ((1.0, 0.5), (1.0, 0.7, 0.4))[rng.integers(2)]
    swings, stated = rng.uniform() < 0.5, rng.uniform() < 0.5
    home = rng.uniform(-0.4, 0.4, count)
    size = rng.uniform(0.35, 0.75, count)
    # Every kind comes before any comes again.
    order = np.concatenate([rng.permutation(list(KINDS)) for _ in range(topology.runs)])
    runs, used = [], 0
    for number in range(topology.runs):
        pieces = 1 + int(rng.uniform() < 0.6)
        kinds, used = [str(kind) for kind in order[used : used + pieces]], used + pieces
        split = ("train", "select", "train", "sealed")[number % 4]
        # Gains change after every fourth run, or with every run where there are few runs.
        gain = gains[(number // 2 if topology.runs > 6 else number) % len(gains)]
        posture = home + rng.uniform(-0.25, 0.25, count)
        lengths = np.diff(np.linspace(0, rows, pieces + 1).astype(int))
        asks = [_Ask(int(length), topology.row_hz, count, rng) for length in lengths]
        target = posture + np.concatenate([size * KINDS[kind](ask) for kind, ask in zip(kinds, asks, strict=True)])
        enabled = np.ones(rows)
        if swings and rng.uniform() < 0.6:
            enabled[-round(rng.uniform(0.12, 0.22) * rows) :] = 0.0
        runs.append(
            TargetRun(
                name=f"run_{number:03d}",
                condition=f"{'_'.join(kinds)}_{number}_gain{gain:g}",
                gain=float(gain),
                split=split if stated else "",
                time=np.arange(rows) / topology.row_hz,
                target=target,
                enabled=enabled,
            )
        )
    return runs
