"""Many simulations at once: residuals of many vectors on many segments, on all devices."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtune import devices
from jaxtune.discovery.problem import Problem, Segments, Simulate

_WIDTH = 64  # simulations that a device runs side by side
_CHUNKS = 16  # how many such chunks one call of the compiled program takes at most

_BATCH = 32  # vectors between two reports of progress

Progress = Callable[[int, int], None]
"""Told how many of how many vectors were simulated."""


@dataclass(frozen=True)
class Evaluate:
    """Simulates vectors on some segments: `evaluate(vectors [n, axes])` returns residuals [n, features].

    Residuals are in floor units. A feature is a (segment, bin, component).
    """

    problem: Problem
    segments: Segments
    scale: np.ndarray
    """[bins, components] the noise floor that residuals are divided by."""
    shared: np.ndarray
    """[segments, bins, components] what a model that lacks nothing leaves, which is subtracted."""

    def __call__(self, vectors: np.ndarray) -> np.ndarray:
        """Simulates vectors; not finite where the simulation is not."""
        found = residuals(self.problem, vectors, self.segments)
        return ((found - self.shared) / self.scale).reshape(len(vectors), -1)

    def changes(
        self,
        vectors: Sequence[np.ndarray],
        residual: Sequence[np.ndarray],
        moves: Sequence[np.ndarray],
        progress: Progress = lambda done, count: None,
    ) -> list[np.ndarray]:
        """Simulates moves away from some vectors, each alone.

        Moves of different kinematic trees are simulated at a time, since the base is fixed.

        Args:
          vectors: [axes] each.
          residual: of the vectors, [features] each.
          moves: [moves, axes] away from each vector.
          progress: told after every batch.

        Returns:
          For every vector how its residuals change with each of its moves, [moves, features]; zero where the simulation
          is not finite.
        """
        packs = [_packs(self.problem, mine) for mine in moves]
        owner = np.repeat(np.arange(len(packs)), [len(mine) for mine in packs])
        every = [pack for mine in packs for pack in mine]
        parts = self.problem.cell_trees
        found = [np.zeros((len(mine), len(one)), np.float32) for mine, one in zip(moves, residual, strict=True)]
        while every:
            broken = []
            for start in range(0, len(every), _BATCH):
                progress(start, len(every))
                batch = range(start, min(start + _BATCH, len(every)))
                simulated = self(np.stack([vectors[owner[i]] + moves[owner[i]][every[i]].sum(axis=0) for i in batch]))
                for i, values in zip(batch, simulated, strict=True):
                    if not np.isfinite(values).all():
                        # One of them broke it; the others may not.
                        broken += [(owner[i], [move]) for move in every[i] if len(every[i]) > 1]
                        continue
                    change = (values - residual[owner[i]]).reshape(-1, len(parts))
                    for move in every[i]:
                        tree = _tree_of(self.problem, moves[owner[i]][move])
                        found[owner[i]][move] = np.where((parts == tree) | (tree < 0), change, 0.0).ravel()
            owner, every = [one for one, _ in broken], [pack for _, pack in broken]
        return found


def _packs(problem: Problem, moves: np.ndarray) -> list[list[int]]:
    """Numbers of moves [n, axes] that can be simulated together: one of each kinematic tree."""
    queues: dict[int, list[int]] = {}
    for number, move in enumerate(moves):
        queues.setdefault(_tree_of(problem, move), []).append(number)
    alone = [[number] for number in queues.pop(-1, [])]
    return alone + [[n for n in row if n is not None] for row in zip_longest(*queues.values())]


def _tree_of(problem: Problem, move: np.ndarray) -> int:
    """The kinematic tree that a move [axes] stays within, or -1."""
    trees = set(problem.axis_trees[move != 0].tolist())
    return trees.pop() if len(trees) == 1 else -1


def residuals(problem: Problem, vectors: np.ndarray, segments: Segments, width: int = _WIDTH) -> np.ndarray:
    """Simulates every vector on every segment and subtracts from what was measured, in means over `bin_rows` rows.

    Args:
      problem: the simulator and how its signals are binned.
      vectors: [n, axes] or [axes] coordinates.
      segments: what was measured.
      width: simulations side by side on one device.

    Returns:
      Residuals [n, segments, bins, components of all signals]; not finite where the simulation is not.
    """
    vectors = np.atleast_2d(vectors)
    each, piece = (grid.ravel() for grid in np.indices((len(vectors), len(segments.run))))
    found = paired_residuals(problem, vectors, segments, each, piece, width)
    return found.reshape(len(vectors), len(segments.run), *found.shape[1:])


def paired_residuals(
    problem: Problem,
    vectors: np.ndarray,
    segments: Segments,
    which: np.ndarray,
    piece: np.ndarray,
    width: int = _WIDTH,
) -> np.ndarray:
    """Simulates chosen pairs of a vector and a segment; `residuals` takes all pairs.

    Every pair is a simulation of its own. They run side by side, `width` at a time on every device, in a loop whose
    length is an argument of the compiled program. So there is one compilation for all segments, whatever their length
    and number, the number of the vectors, and the numbers of the robot.

    Args:
      problem: the simulator and how its signals are binned.
      vectors: [n, axes] coordinates.
      segments: what was measured.
      which: [pairs] index of each pair's vector.
      piece: [pairs] index of each pair's segment.
      width: simulations side by side on one device.

    Returns:
      [pairs, bins, components of all signals]; not finite where the simulation is not.
    """
    width *= len(jax.devices())
    values = np.asarray(problem.values(vectors), np.float32)
    measured = binned(segments.signals, problem.bin_rows)
    longest = problem.data["train"][problem.horizons[-1]].inputs
    once, found = _CHUNKS * width, []
    for start in range(0, len(which), once):
        count = min(once, len(which) - start)
        # A last call is filled up with pairs that are not simulated: another shape would be another compilation.
        mine = start + np.arange(once) % count
        chunks = -(-count // width)
        some = jax.tree.map(lambda leaf, like, mine=mine: _padded(leaf[piece[mine]], like), segments.inputs, longest)
        work = jax.tree.map(lambda leaf: leaf.reshape(_CHUNKS, width, *leaf.shape[1:]), (values[which[mine]], some))
        predicted = _simulate_chunks(problem.simulate, problem.bin_rows, problem.system, chunks, segments.steps, *work)
        flat = np.asarray(predicted).reshape(once, *predicted.shape[2:])
        found.append(flat[:count, : measured.shape[1]])
    return measured[piece] - np.concatenate(found)


def binned(signals: Mapping[str, Any], rows: int):
    """Averages signals [..., rows, components] over every `rows` rows and puts them side by side, in order of names.

    Works on NumPy and JAX arrays alike. Returns [..., bins, components of all signals].
    """
    parts = [
        signal.reshape(*signal.shape[:-2], -1, rows, signal.shape[-1]).mean(axis=-2)
        for _, signal in sorted(signals.items())
    ]
    return (jnp if isinstance(parts[0], jax.Array) else np).concatenate(parts, axis=-1)


@devices.on_all
@partial(jax.jit, static_argnums=(0, 1))
def _simulate_chunks(simulate: Simulate, bin_rows: int, system, count, steps, values, inputs):
    """Runs the first `count` chunks of values [chunks, width, axes] and inputs [chunks, width, ...]."""

    def all_of(system, count, steps, values, inputs):
        many = jax.vmap(lambda mine, segment: binned(simulate(system, mine, segment, steps), bin_rows))
        take = lambda index: jax.tree.map(lambda leaf: leaf[index], (values, inputs))  # noqa: E731
        shape = jax.eval_shape(many, *take(0))

        def work(index, found):
            return found.at[index].set(many(*take(index)))

        return jax.lax.fori_loop(0, count, work, jnp.zeros((len(values), *shape.shape), shape.dtype))

    # Devices share the width, and each loops by itself.
    return devices.spread(all_of, (values, inputs), shared=(system, count, steps), axis=1)


def _padded(leaf: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Repeats the last entry of a leaf [n, ...] along its second dimension until it is as long as that of `like`."""
    if leaf.ndim < 2 or leaf.shape[1] == like.shape[1]:
        return leaf
    return np.pad(leaf, [(0, 0), (0, like.shape[1] - leaf.shape[1]), *[(0, 0)] * (leaf.ndim - 2)], mode="edge")
