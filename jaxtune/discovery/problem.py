"""What discovery is asked: a simulator, hypotheses about what it lacks, and measured segments.

Nothing here knows a robot. A hypothesis is a handful of directions in a vector of coordinates that is zero for the
nominal model; the simulator is a function of that vector and of segments.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Simulate = Callable[[jax.Array, Any], Mapping[str, jax.Array]]
"""`simulate(coordinates [axes], inputs [segments, ...]) -> {signal: [segments, rows, components]}`."""


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """An effect at some places, all of one size."""

    name: str
    family: str
    places: tuple[str, ...]
    directions: np.ndarray
    """[parameters, axes] of zeros and ones."""
    probes: np.ndarray
    """[probes, parameters] where it is looked for, the smallest size of interest first."""
    bounds: np.ndarray
    """[parameters, 2] least and largest coordinate."""
    joints: tuple[int, ...]
    """Components of the signals beside which it sits; empty where it may show in any."""

    @property
    def key(self) -> str:
        """Name and places as one word."""
        return f"{self.name}@{'+'.join(self.places)}"

    @property
    def complexity(self) -> tuple[int, int]:
        """Simpler ones are smaller: parameters first."""
        return len(self.directions), -len(self.places)


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Measured segments of one length."""

    inputs: Any
    """[segments, ...] on every leaf: what the simulator is given."""
    signals: Mapping[str, np.ndarray]
    """[segments, rows, components] by name: what was measured."""
    run: np.ndarray
    """[segments] index of the run."""
    regimes: np.ndarray
    """[segments, rows, components] index of the regime."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A question to discovery."""

    simulate: Simulate
    axes: int
    hypotheses: Sequence[Hypothesis]
    prior: np.ndarray
    """[axes] standard deviation of the nominal parameters, zero for every other axis."""
    data: Mapping[str, Mapping[float, Segments]]
    """Segments by split and horizon in s."""
    healthy: Sequence[Mapping[str, Mapping[float, Segments]]]
    """The same of logs in which nothing is missing: the nominal model in another engine, with the log's noise."""
    bin_rows: int
    """Rows that are taken together."""
    regimes: tuple[str, ...]
    """Names of the regimes."""
    components: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of the components of every signal."""

    @property
    def horizons(self) -> tuple[float, ...]:
        """Lengths of segments in s, rising."""
        return tuple(sorted(self.data["train"]))


class Residuals:
    """Measured less simulated, in means over a few rows: [hypotheses, segments, bins, components of all signals].

    Works through (vector, chunk of segments) pairs in a loop whose length is an argument, so it compiles once for every
    length of segments, whatever their number and that of the vectors.
    """

    _BATCH = 32
    """Pairs that are handed over at once."""

    def __init__(self, problem: Problem, chunk: int = 64):
        self._problem, self._chunk = problem, chunk
        self._compiled = jax.jit(self._loop)

    def _loop(self, count, vectors, inputs):
        simulate = lambda vector, segments: binned(self._problem.simulate(vector, segments), self._problem.bin_rows)
        first = lambda tree: jax.tree.map(lambda leaf: leaf[0], tree)
        shape = jax.eval_shape(simulate, vectors[0], first(inputs))

        def work(index, found):
            at = lambda tree: jax.tree.map(lambda leaf: leaf[index], tree)
            return found.at[index].set(simulate(vectors[index], at(inputs)))

        return jax.lax.fori_loop(0, count, work, jnp.zeros((self._BATCH, *shape.shape), shape.dtype))

    def __call__(self, vectors: np.ndarray, segments: Segments) -> np.ndarray:
        """Residuals of vectors [hypotheses, axes]; those that are not finite come back as they are."""
        vectors = np.atleast_2d(np.asarray(vectors, np.float32))
        measured = binned(segments.signals, self._problem.bin_rows)
        count, size = len(measured), self._chunk
        chunks = -(-count // size)
        filled = jax.tree.map(
            lambda leaf: np.asarray(leaf)[np.arange(chunks * size) % count].reshape(chunks, size, *leaf.shape[1:]),
            segments.inputs,
        )
        pairs = [(vector, chunk) for vector in range(len(vectors)) for chunk in range(chunks)]
        found = []
        for start in range(0, len(pairs), self._BATCH):
            some = pairs[start : start + self._BATCH]
            which = np.array(some + [some[-1]] * (self._BATCH - len(some)))
            inputs = jax.tree.map(lambda leaf, chunk=which[:, 1]: leaf[chunk], filled)
            found.append(np.asarray(self._compiled(len(some), vectors[which[:, 0]], inputs))[: len(some)])
        predicted = np.concatenate(found).reshape(len(vectors), chunks * size, *measured.shape[1:])[:, :count]
        return measured[None] - predicted


def binned(signals: Mapping[str, Any], rows: int):
    """Means of `rows` rows, [segments, bins, components of all signals], signals in the order of their names."""
    parts = [
        signal.reshape(signal.shape[0], -1, rows, signal.shape[-1]).mean(axis=2)
        for _, signal in sorted(signals.items())
    ]
    # What the simulator reads beyond what was measured is left out where the two are made (see `Problem.simulate`).
    return (jnp if isinstance(parts[0], jax.Array) else np).concatenate(parts, axis=-1)
