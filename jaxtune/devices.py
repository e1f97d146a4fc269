"""Which devices share the work: those of the mesh that is in scope.

    with jax.set_mesh(devices.mesh()):  # all devices of this machine, or of all hosts
        state, info = tuner.run(key, state, num_tunings)

Robots do not touch each other, so every device simulates its share of them from reset to end, and nothing crosses
devices in between (`spread`). What learns from the episodes computes on shares of every batch, and its gradients are
summed over devices (`share`). What is left runs on all devices alike.

Without a mesh in scope everything runs on one device. So it does inside a function that is spread itself, such as a
sweep whose lanes are on different devices. Random numbers depend on keys alone, never on the number of devices.
"""

from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding

AXIS = "devices"
"""Name of the mesh's axis. A mesh of the user's own, with an axis of this name, does as well."""


def mesh(count: int | None = None) -> Mesh:
    """Makes a mesh of the first `count` devices, or of all.

    With JAX 0.11 it also turns the partitioner Shardy off, for the whole process: on an empty constant in a function
    that is spread, such as MJX makes for whatever a model lacks, that one ends the process (seen with 0.11.2). A
    program with a mesh of its own sets `jax_use_shardy_partitioner` to False itself.

    Raises:
      ValueError: there are not so many.
    """
    every = jax.devices()
    count = len(every) if count is None else count
    if not 1 <= count <= len(every):
        raise ValueError(f"devices: got {count}, expected 1 to {len(every)}")
    if count > 1 and jax.__version_info__ >= (0, 11):
        jax.config.update("jax_use_shardy_partitioner", False)
    return jax.make_mesh((count,), (AXIS,), devices=every[:count], axis_types=(AxisType.Auto,))


def count() -> int:
    """Number of devices that share what is called here: 1 without a mesh, and inside what is spread already."""
    here = jax.sharding.get_abstract_mesh()
    return 1 if here.empty or AXIS not in here.axis_names or AXIS in here.manual_axes else here.shape[AXIS]


def spread(function: Callable[..., Any], inputs: tuple, *, shared: tuple = (), axis: int = 0) -> Any:
    """Calls a function of many independent rows on all devices, each with its share of the rows.

    Args:
      function: `(*shared, *inputs)`, of some of the rows; it gives as many back, and each depends on its own inputs
        alone. It closes over constants only: JAX does not let it index what is traced outside.
      inputs: pytrees whose leaves have the rows along `axis`.
      shared: pytrees that are the same for all rows, such as a policy.
      axis: where the rows are, in inputs and outputs.

    Returns:
      What the function returns, for all rows.
    """
    devices = count()
    if devices == 1:
        return function(*shared, *inputs)
    rows = jax.tree.leaves(inputs)[0].shape[axis]
    across = PartitionSpec(*[None] * axis, AXIS)
    # Shares are of one size; the last one is filled up with repetitions.
    fill = jnp.arange(-(-rows // devices) * devices) % rows
    if len(fill) > rows:
        inputs = jax.tree.map(lambda leaf: jnp.take(leaf, fill, axis=axis), inputs)
    specs = (*[PartitionSpec()] * len(shared), *[across] * len(inputs))
    found = jax.shard_map(function, in_specs=specs, out_specs=across, check_vma=False)(*shared, *inputs)
    if len(fill) > rows:
        found = jax.tree.map(lambda leaf: jax.lax.slice_in_dim(leaf, 0, rows, axis=axis), found)
    return found


def in_chunks(function: Callable[..., Any], inputs: tuple, sizes: Mapping[str, int], *, shared: tuple = ()) -> Any:
    """Maps a function over the first axis of its inputs on all devices, on each so many at a time as suit it.

    Args:
      function: `(*shared, *inputs)`, of one item; it is vmapped.
      inputs: pytrees whose leaves are all [count, ...].
      sizes: largest number of items side by side on a device, for `cpu` and `other` devices.
      shared: pytrees that are the same for all items.

    Returns:
      What the function returns, [count, ...].
    """
    axes = (*[None] * len(shared), *[0] * len(inputs))
    several, most = jax.vmap(function, axes), sizes["cpu" if jax.default_backend() == "cpu" else "other"]
    kept = len(shared)

    def in_turn(*arguments):
        shared, inputs = arguments[:kept], arguments[kept:]
        count = len(jax.tree.leaves(inputs)[0])
        if count <= most:
            return several(*shared, *inputs)
        # Chunks of equal size need one compilation; the last one is filled up with repetitions.
        chunks = -(-count // most)
        size = -(-count // chunks)
        fill = jnp.arange(chunks * size) % count
        inputs = jax.tree.map(lambda x: x[fill].reshape(chunks, size, *x.shape[1:]), inputs)
        stacked = jax.lax.map(lambda item: several(*shared, *item), inputs)
        return jax.tree.map(lambda x: merged(x)[:count], stacked)

    return spread(in_turn, inputs, shared=shared)


def merged(leaf: jax.Array) -> jax.Array:
    """Merges the first two axes of an array, which may have no elements (a model's activations without muscles)."""
    return leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])


def share(batch: Any, *, axis: int = 0) -> Any:
    """Has every device compute on its share of a batch, a pytree whose leaves have the batch along `axis`.

    Numbers stay the same but for rounding: means over the batch are means over all shares. A batch that devices cannot
    share evenly is left as it is.
    """
    devices = count()
    if devices == 1 or any(leaf.shape[axis] % devices for leaf in jax.tree.leaves(batch)):
        return batch
    return jax.lax.with_sharding_constraint(batch, PartitionSpec(*[None] * axis, AXIS))


def precisely(function: Callable[..., Any]) -> Callable[..., Any]:
    """Has the products in a function computed in full single precision, where GPUs shorten them (TF32) by default.

    Physics, distances and sums of terms that cancel need it; networks that learn do not.
    """

    @wraps(function)
    def call(*args, **kwargs):
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return call


def gather(values: Any) -> Any:
    """Puts a pytree on every device, whole: what was simulated in shares, before batches are drawn from it."""
    return values if count() == 1 else jax.lax.with_sharding_constraint(values, PartitionSpec())


def on_all(program: Callable[..., Any]) -> Callable[..., Any]:
    """Lets a compiled program use all devices, of all hosts, unless a mesh is in scope already.

    With several hosts (`jax.distributed`) all call it with equal arguments, and each gets all results, on its first
    device.

    The mesh is in scope while the program runs, not longer: models of MJX lie on one device, and JAX would refuse
    whatever is computed with them outside a program.
    """

    @wraps(program)
    def call(*args, **kwargs):
        if not jax.sharding.get_abstract_mesh().empty:
            return program(*args, **kwargs)
        here = mesh()
        whole = NamedSharding(here, PartitionSpec()) if here.size > 1 else SingleDeviceSharding(jax.devices()[0])
        # Arrays come from no device in particular, from one or, where an earlier call made them, from all: JAX would
        # compile for each.
        args, kwargs = jax.tree.map(lambda leaf: _whole(leaf, whole), (args, kwargs))
        if here.size == 1:
            return program(*args, **kwargs)
        with jax.set_mesh(here):
            found = program(*args, **kwargs)
            if jax.process_count() == 1:
                return found
            # No host can read what other hosts hold a share of, so each gets a copy of its own.
            return jax.tree.map(lambda leaf: leaf.addressable_data(0), _gathered(found))

    return call


_gathered = jax.jit(gather)


def _whole(leaf: Any, sharding: Sharding) -> Any:
    """Puts an array on all devices; hosts that hold equal copies of it make one array of them."""
    if not isinstance(leaf, jax.Array):
        return leaf
    if sharding.is_fully_addressable:
        return jax.device_put(leaf, sharding)
    copies = [jax.device_put(leaf, device) for device in sharding.addressable_devices]
    return jax.make_array_from_single_device_arrays(leaf.shape, sharding, copies)
