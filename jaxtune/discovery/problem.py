"""What discovery is asked: a simulator, hypotheses about what it lacks, and measured segments.

Nothing here knows a robot. A hypothesis is a handful of directions in a vector of coordinates that is zero for the
nominal model; the simulator is a function of that vector and of segments.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

Simulate = Callable[[jax.Array, Any], Mapping[str, jax.Array]]
"""`simulate(values [axes], inputs) -> {signal: [rows, components]}`, of one segment.

Programs are compiled once for every simulator that is equal to no other, and length of segments.
"""


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """An effect at some places, all of one size."""

    name: str
    family: str
    places: tuple[str, ...]
    directions: np.ndarray
    """[parameters, axes]: how far each axis goes for one unit of a parameter; one at the first place."""
    probes: np.ndarray
    """[probes, parameters] where it is looked for, the smallest size of interest first."""
    bounds: np.ndarray
    """[parameters, 2] least and largest coordinate."""
    prior: np.ndarray
    """[parameters] standard deviation of the coordinates, before anything was measured."""
    joints: tuple[int, ...]
    """Components of the signals beside which it sits; empty where it may show in any."""
    parts: tuple["Hypothesis", ...] = ()
    """What it is made of, where it is two at once."""

    @property
    def key(self) -> str:
        """Name and places as one word."""
        return f"{self.name}@{'+'.join(self.places)}"


def apart(one: Hypothesis, two: Hypothesis) -> bool:
    """Whether two hypotheses are two: of other names, or at other places."""
    return one.name != two.name or not set(one.places) & set(two.places)


def together(one: Hypothesis, two: Hypothesis) -> Hypothesis:
    """Two at once."""
    parts, zero = (one, two), np.zeros((len(one.probes), len(two.directions)))
    return Hypothesis(
        name=f"{one.name} and {two.name}",
        family=f"{one.family} and {two.family}",
        places=(*one.places, *two.places),
        directions=np.concatenate([part.directions for part in parts]),
        probes=np.block([[one.probes, zero], [np.zeros((len(two.probes), len(one.directions))), two.probes]]),
        bounds=np.concatenate([part.bounds for part in parts]),
        prior=np.concatenate([part.prior for part in parts]),
        joints=tuple(sorted({*one.joints, *two.joints})),
        parts=parts,
    )


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
    timing: np.ndarray
    """[directions, axes] a standard deviation along what nobody knows either: when the controller looks and acts."""
    data: Mapping[str, Mapping[float, Segments]]
    """Segments by split and horizon in s."""
    healthy: Sequence[Mapping[str, Mapping[float, Segments]]]
    """Segments by split and horizon of logs in which nothing is missing: the nominal model in another engine, with the
    log's noise."""
    bin_rows: int
    """Rows that are taken together."""
    regimes: tuple[str, ...]
    """Names of the regimes."""
    components: Mapping[str, tuple[str, ...]]
    """Names of the components of every signal."""
    values: Callable[[np.ndarray], np.ndarray] = lambda vectors: vectors
    """What the simulator is given for coordinates [n, axes], [n, axes]."""
    residual: Mapping[str, Hypothesis] = field(default_factory=dict)
    """A torque without a name, by joint: what stands in where nothing fits."""

    @property
    def horizons(self) -> tuple[float, ...]:
        """Lengths of segments in s, rising."""
        return tuple(sorted(self.data["train"]))

    @property
    def cells(self) -> list[tuple[str, str]]:
        """Signal and part of every component of the residuals."""
        return [(signal, part) for signal in sorted(self.components) for part in self.components[signal]]

    def is_nominal(self, hypothesis: Hypothesis) -> bool:
        """Whether it is about parameters that every model has."""
        return bool((self.prior[(hypothesis.directions != 0).any(axis=0)] > 0).all())


class Residuals:
    """Measured less simulated, in means over a few rows: [hypotheses, segments, bins, components of all signals].

    Every (vector, segment) is a simulation of its own; they are moved side by side, `width` at a time on every device,
    in a loop whose length is an argument. So it compiles once for every length of segments, whatever their number and
    the vectors'.
    """

    _CHUNKS = 32
    """Chunks that are handed over at once."""

    def __init__(self, problem: Problem, width: int = 64):
        self._problem, self._width = problem, width * len(jax.devices())

    def __call__(self, vectors: np.ndarray, segments: Segments) -> np.ndarray:
        """Residuals of vectors [hypotheses, axes]; those that are not finite come back as they are."""
        problem = self._problem
        vectors = np.asarray(problem.values(np.atleast_2d(vectors)), np.float32)
        measured = np.stack([binned(piece, problem.bin_rows) for piece in _pieces(segments.signals)])
        # Splits of other sizes are filled up.
        filled = np.arange(self._largest(segments)) % len(measured)
        inputs = jax.tree.map(lambda leaf: jnp.asarray(leaf[filled]), segments.inputs)
        each, piece = (grid.ravel() for grid in np.indices((len(vectors), len(measured))))
        shape, found = (self._CHUNKS, self._width), []
        once = self._CHUNKS * self._width
        for start in range(0, len(each), once):
            count = min(once, len(each) - start)
            mine = (start + np.arange(once) % count).reshape(shape)
            used, which = np.unique(each[mine], return_inverse=True)
            some = vectors[used[np.arange(once) % len(used)]]
            chunks = -(-count // self._width)
            out = _moved(problem.simulate, problem.bin_rows, chunks, some, which.reshape(shape), piece[mine], inputs)
            found.append(np.asarray(out).reshape(once, *measured.shape[1:])[:count])
        predicted = np.concatenate(found).reshape(len(vectors), *measured.shape)
        return measured[None] - predicted

    def _largest(self, segments: Segments) -> int:
        """Segments of the largest split of the same length."""
        rows = next(iter(segments.signals.values())).shape[1]
        splits = [one for split in self._problem.data.values() for one in split.values()]
        same = [len(one.run) for one in splits if next(iter(one.signals.values())).shape[1] == rows]
        return max([len(segments.run), *same])


@partial(jax.jit, static_argnums=(0, 1))
def _moved(simulate: Simulate, bin_rows: int, count, values, which, piece, inputs):
    """`count` chunks of values [n, axes] and segments, which of either by [chunks, width]."""

    def one(mine, segment):
        return binned(simulate(mine, segment), bin_rows)

    def all_of(count, values, which, piece, inputs):
        shape = jax.eval_shape(one, values[0], jax.tree.map(lambda leaf: leaf[0], inputs))

        def work(index, found):
            mine = jax.tree.map(lambda leaf: leaf[piece[index]], inputs)
            return found.at[index].set(jax.vmap(one)(values[which[index]], mine))

        return jax.lax.fori_loop(0, count, work, jnp.zeros((*which.shape, *shape.shape), shape.dtype))

    # Nothing is exchanged: devices share the width, and each loops by itself.
    mesh, across = Mesh(np.array(jax.devices()), ("width",)), PartitionSpec(None, "width")
    specs = (PartitionSpec(), PartitionSpec(), across, across, PartitionSpec())
    return jax.shard_map(all_of, mesh=mesh, in_specs=specs, out_specs=across, check_vma=False)(
        count, values, which, piece, inputs
    )


def _pieces(signals: Mapping[str, np.ndarray]):
    return [dict(zip(signals, values, strict=True)) for values in zip(*signals.values(), strict=True)]


def binned(signals: Mapping[str, Any], rows: int):
    """Means of `rows` rows of [rows, components], [bins, components of all signals], in the order of the names."""
    parts = [signal.reshape(-1, rows, signal.shape[-1]).mean(axis=1) for _, signal in sorted(signals.items())]
    return (jnp if isinstance(parts[0], jax.Array) else np).concatenate(parts, axis=-1)
