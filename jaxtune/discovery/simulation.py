"""Many simulations at once: residuals of many vectors on many segments, on all devices."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxtune.discovery.problem import Problem, Segments, Simulate

_WIDTH = 64  # simulations that a device runs side by side
_CHUNKS = 32  # how many such chunks one call of the compiled program takes at most

Evaluate = Callable[[np.ndarray], np.ndarray]
"""`evaluate(vectors [n, axes]) -> residuals [n, features]`, in floor units. Features: (segment, bin, component)."""


def residuals(problem: Problem, vectors: np.ndarray, segments: Segments, width: int = _WIDTH) -> np.ndarray:
    """Simulates vectors on segments and subtracts from what was measured, in means over `problem.bin_rows` rows.

    Every (vector, segment) is a simulation of its own. They run side by side, `width` at a time on every device, in a
    loop whose length is an argument of the compiled program. So there is one compilation for every length of segments,
    whatever their number and that of the vectors.

    Args:
      problem: the simulator and how its signals are binned.
      vectors: [n, axes] or [axes] coordinates.
      segments: what was measured.
      width: simulations side by side on one device.

    Returns:
      Residuals [n, segments, bins, components of all signals]; not finite where the simulation is not.
    """
    width *= len(jax.devices())
    vectors = np.asarray(problem.values(np.atleast_2d(vectors)), np.float32)
    measured = np.stack([binned(piece, problem.bin_rows) for piece in _pieces(segments.signals)])
    # Smaller splits are filled up to the largest one's size: another shape would be another compilation.
    filled = np.arange(_largest_split(problem, segments)) % len(measured)
    inputs = jax.tree.map(lambda leaf: jnp.asarray(leaf[filled]), segments.inputs)
    each, piece = (grid.ravel() for grid in np.indices((len(vectors), len(measured))))
    shape, found = (_CHUNKS, width), []
    once = _CHUNKS * width
    for start in range(0, len(each), once):
        count = min(once, len(each) - start)
        mine = (start + np.arange(once) % count).reshape(shape)
        used, which = np.unique(each[mine], return_inverse=True)
        some = vectors[used[np.arange(once) % len(used)]]
        chunks = -(-count // width)
        out = _simulate_chunks(
            problem.simulate, problem.bin_rows, chunks, some, which.reshape(shape), piece[mine], inputs
        )
        found.append(np.asarray(out).reshape(once, *measured.shape[1:])[:count])
    predicted = np.concatenate(found).reshape(len(vectors), *measured.shape)
    return measured[None] - predicted


def flat_residuals(problem: Problem, segments: Segments, scale: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Simulates vectors and returns residuals over a scale, flat; with all but the vectors given it is an `Evaluate`.

    Args:
      problem: the simulator.
      segments: what was measured.
      scale: [bins, components] the noise floor that residuals are divided by.
      vectors: [n, axes] coordinates.

    Returns:
      [n, features] in floor units.
    """
    return (residuals(problem, vectors, segments) / scale).reshape(len(vectors), -1)


def secants(problem: Problem, segments: Segments, vector: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Takes secants of the residuals, one simulation for each; delays, limits and backlash have no derivative at zero.

    Args:
      problem: the simulator.
      segments: what was measured.
      vector: [axes] where the secants begin.
      directions: [k, axes] how far they go.

    Returns:
      Differences r(vector + direction) - r(vector), [segments, bins, components, k].
    """
    found = residuals(problem, np.concatenate([vector[None], vector + directions]), segments)
    return np.moveaxis(found[1:] - found[:1], 0, -1)


def binned(signals: Mapping[str, Any], rows: int):
    """Averages signals [rows, components] over every `rows` rows and puts them side by side, in the order of names.

    Works on NumPy and JAX arrays alike. Returns [bins, components of all signals].
    """
    parts = [signal.reshape(-1, rows, signal.shape[-1]).mean(axis=1) for _, signal in sorted(signals.items())]
    return (jnp if isinstance(parts[0], jax.Array) else np).concatenate(parts, axis=-1)


@partial(jax.jit, static_argnums=(0, 1))
def _simulate_chunks(simulate: Simulate, bin_rows: int, count, values, which, piece, inputs):
    """Runs the first `count` chunks: `which` and `piece` [chunks, width] choose from values [n, axes] and inputs."""

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


def _largest_split(problem: Problem, segments: Segments) -> int:
    """Number of segments in the largest split of the same length."""
    rows = next(iter(segments.signals.values())).shape[1]
    splits = [one for split in problem.data.values() for one in split.values()]
    same = [len(one.run) for one in splits if next(iter(one.signals.values())).shape[1] == rows]
    return max([len(segments.run), *same])


def _pieces(signals: Mapping[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    """The signals of every segment, {name: [rows, components]}."""
    return [dict(zip(signals, values, strict=True)) for values in zip(*signals.values(), strict=True)]
