"""What a program has to compute and to move, counted from its jaxpr, and how fast this device computes and moves.

Both are estimates. What XLA finds to be unused counts as well, and so do operations on integers. The steps of a `while`
are not known, so they count once. Of the data only what must leave a kernel counts: inputs, outputs, and what a `scan`
carries from step to step.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

_SIDE = 4096  # of the matrices whose product is timed
_COPIED = 2**28  # numbers of four bytes that are copied
_TIMES = 5

# They move or choose numbers, and compute none.
_MOVES = {
    *("broadcast_in_dim", "reshape", "transpose", "squeeze", "expand_dims", "slice", "dynamic_slice", "gather", "pad"),
    *("dynamic_update_slice", "concatenate", "rev", "copy", "convert_element_type", "iota"),
    *("bitcast_convert_type", "stop_gradient", "split", "select_n"),
}


class Work(NamedTuple):
    """Floating-point operations, and bytes read and written."""

    flops: float = 0.0
    moved: float = 0.0

    def times(self, count: float) -> "Work":
        """The work of so many calls."""
        return Work(self.flops * count, self.moved * count)

    def plus(self, other: "Work") -> "Work":
        """The work of both."""
        return Work(self.flops + other.flops, self.moved + other.moved)


def work(program: Callable, *inputs: Any) -> Work:
    """Counts the work of a call of a program."""
    closed = jax.make_jaxpr(program)(*inputs)
    ends = sum(map(_bytes, (*closed.jaxpr.invars, *closed.jaxpr.outvars)))
    return _within(closed.jaxpr).plus(Work(moved=ends))


def peaks() -> Work:
    """Measures operations per second of a product of matrices in full precision, and bytes per second of a copy."""
    matrix, row = jnp.ones((_SIDE, _SIDE)), jnp.ones(_COPIED)
    product = jax.jit(lambda one: jnp.matmul(one, one, precision="highest"))
    return Work(2.0 * _SIDE**3 / _fastest(product, matrix), 2.0 * row.nbytes / _fastest(jax.jit(lambda x: x + 1), row))


def _fastest(program: Callable, *inputs: jax.Array) -> float:
    moments = []
    for _ in range(_TIMES + 1):
        moments.append(time.monotonic())
        jax.block_until_ready(program(*inputs))
    moments.append(time.monotonic())
    return min(after - before for before, after in itertools.pairwise(moments))


def _within(jaxpr) -> Work:
    found = Work()
    for equation in jaxpr.eqns:
        found = found.plus(_of(equation))
    return found


def _of(equation) -> Work:
    name, params = equation.primitive.name, equation.params
    if name == "scan":
        body = getattr(params["jaxpr"], "jaxpr", params["jaxpr"])
        # Slices have one axis more outside; how many there are has no name that all versions of JAX share.
        slices_in, slices_out = (
            sum(one.aval.ndim > inner.aval.ndim for one, inner in zip(*pair, strict=True))
            for pair in ((equation.invars, body.invars), (equation.outvars, body.outvars))
        )
        carry, stop = len(body.outvars) - slices_out, len(body.invars) - slices_in
        before, after = body.invars[stop - carry : stop], body.outvars[:carry]
        changed = sum(_bytes(new) for old, new in zip(before, after, strict=True) if old is not new)
        sliced = sum(map(_bytes, (*body.invars[stop:], *body.outvars[carry:])))
        return _within(body).plus(Work(moved=2.0 * changed + sliced)).times(params["length"])
    if name.startswith("scatter"):
        return Work(0.0 if name == "scatter" else float(equation.invars[2].aval.size))
    inner = list(_jaxprs(params))
    if name == "cond":
        return max(map(_within, inner))
    if inner:
        found = Work()
        for one in inner:
            found = found.plus(_within(one))
        return found
    out = sum(variable.aval.size for variable in equation.outvars)
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        return Work(2.0 * out * math.prod(equation.invars[0].aval.shape[axis] for axis in contracted))
    if name == "cholesky":
        return Work(out * equation.invars[0].aval.shape[-1] / 3.0)
    if name == "triangular_solve":
        return Work(float(out * equation.invars[0].aval.shape[-1]))
    if name in _MOVES:
        return Work()
    # A sum reads more than it writes.
    return Work(float(max([out, *(one.aval.size for one in equation.invars if hasattr(one.aval, "size"))])))


def _jaxprs(params: dict) -> Iterator:
    """The programs that an equation calls, such as those of `jit`, `while` and `cond`."""
    for value in params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            one = getattr(one, "jaxpr", one)
            if hasattr(one, "eqns"):
                yield one


def _bytes(variable) -> float:
    kind = variable.aval
    return float(kind.size * kind.dtype.itemsize) if hasattr(kind, "size") and hasattr(kind.dtype, "itemsize") else 0.0
