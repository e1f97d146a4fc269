"""Several hosts that work on one run, with one command on each:

    python -m experiments.train --out policy --coordinator first:9876 --hosts 2 --host 0    # on the host `first`
    python -m experiments.train --out policy --coordinator first:9876 --hosts 2 --host 1    # on another

All hosts compute the same; where devices share work (`jaxtune.devices`), the devices of all hosts do. Files are the
first host's: it alone reads, writes and prints, and the others are sent what it read. So the folder of a run need not
be visible to them, and what decides how a run goes on is decided once.
"""

import os
import pickle
import types
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from mujoco.mjx._src import io

from experiments.common.cli import console
from jaxtune import devices

OPTIONS = ("coordinator", "hosts", "host")
"""Names of the options; results do not depend on them."""

_PATIENCE_S = 3600
_FAREWELL_S = 10  # that a host which ends waits for the others, also where it ends with an error
_reading = False  # whether the first host is in a function that the others do not call


@dataclass(frozen=True, kw_only=True)
class HostArgs:
    """Options of the commands that can run on several hosts."""

    coordinator: str | None = None
    """Address and port of the first host, NAME:PORT, for a run on several hosts, where the same command is given on
    each."""
    hosts: int = 1
    """Number of hosts."""
    host: int = 0
    """Number of this host, from 0; host 0 is the coordinator and writes all files."""


def join(args: HostArgs) -> None:
    """Waits until all hosts of the run are there. Call it before JAX makes its first array.

    Raises:
      ValueError: an option is wrong; names it.
    """
    if args.hosts < 1:
        raise ValueError(f"hosts: got {args.hosts}, expected 1 or more")
    if not 0 <= args.host < args.hosts:
        raise ValueError(f"host: got {args.host}, expected 0 to {args.hosts - 1}")
    if args.hosts == 1:
        if args.coordinator:
            raise ValueError("hosts: got 1, expected 2 or more with a coordinator")
        return
    name, _, port = (args.coordinator or "").rpartition(":")
    if not name or not port.isdecimal() or int(port) > 65535:
        raise ValueError(f"coordinator: got {args.coordinator!r}, expected NAME:PORT of host 0")
    # Between CPUs JAX waits half a minute only, but one host may still compile what another begins to run.
    flags = [f"--xla_cpu_collective_{name}_seconds={_PATIENCE_S}" for name in ("timeout", "call_terminate_timeout")]
    # GPUs would share the search for the fastest kernels, and wait for a host that has found its program on disk.
    flags.append("--xla_gpu_shard_autotuning=false")
    os.environ["XLA_FLAGS"] = " ".join((os.environ.get("XLA_FLAGS", ""), *flags))
    # JAX would ignore a polite kill, to save its state first; ours is saved all along.
    jax.config.update("jax_enable_preemption_service", False)
    console.print(f"host {args.host} of {args.hosts}: waiting for the others at {args.coordinator}", highlight=False)
    jax.distributed.initialize(args.coordinator, args.hosts, args.host, shutdown_timeout_seconds=_FAREWELL_S)
    each = Counter(device.process_index for device in jax.devices())
    if len(set(each.values())) > 1:
        raise ValueError(
            f"hosts: got {' and '.join(str(each[host]) for host in sorted(each))} devices, expected as many on each; "
            "on CPUs XLA_FLAGS=--xla_force_host_platform_device_count=N says how many"
        )
    console.quiet = args.host > 0
    _keep_models_here()
    # Connections are made now, while all are here: for these no patience can be set.
    from_first(lambda: None)
    devices.on_all(jax.jit(lambda rows: devices.spread(jnp.square, (rows,))))(jnp.zeros(1))


def _keep_models_here() -> None:
    """Lets MJX put models on a device of this host: it takes the first of all, which other hosts cannot read."""
    own = types.ModuleType(jax.__name__)
    own.__dict__.update(jax.__dict__, devices=lambda backend=None: jax.local_devices(backend=backend))
    io.jax = own


def from_first(read: Callable[[], Any]) -> Any:
    """Calls a function on the first host, and returns on every host what it returned there.

    Args:
      read: reads or writes files, or decides by the clock. What it returns is pickled.

    Raises:
      Exception: what the function raised on the first host is raised on all, so that none waits for another.
    """
    global _reading
    if _reading or not jax.distributed.is_initialized():
        return read()
    found = None
    if jax.process_index() == 0:
        _reading = True
        try:
            found = read(), None
        except Exception as error:  # whatever it is: the others wait for an answer
            found = None, error
        finally:
            _reading = False
    value, error = _broadcast(found)
    if error is not None:
        raise error
    return value


def on_first(function: Callable[..., Any]) -> Callable[..., Any]:
    """Lets the first host alone run a function, such as one that writes a file; see `from_first`."""

    @wraps(function)
    def call(*args, **kwargs):
        return from_first(lambda: function(*args, **kwargs))

    return call


def _broadcast(value: Any) -> Any:
    """Returns the first host's value on all hosts."""
    data = np.frombuffer(pickle.dumps(value), np.uint8) if jax.process_index() == 0 else np.zeros(0, np.uint8)
    length = int(multihost_utils.broadcast_one_to_all(np.int32(len(data))))
    # JAX compiles for every size, so there are few.
    padded = np.zeros(1 << (length - 1).bit_length(), np.uint8)
    padded[: len(data)] = data
    return pickle.loads(np.asarray(multihost_utils.broadcast_one_to_all(padded))[:length].tobytes())
