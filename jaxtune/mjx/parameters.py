"""The table of a model's parameters, and the model that has other values of them.

Mass is not one field of a MuJoCo model: a body's inertia scales with it, and MuJoCo derives further fields from both.
Parameters therefore enter a model through `apply` alone, which changes the fields that the table names and recomputes
all fields that depend on them. `apply_mujoco` does it for MuJoCo C.
"""

import copy
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from jaxtune import dist as dists
from jaxtune.mjx.derived_fields import check_implementation, set_const
from jaxtune.mjx.entry import Entry, is_number
from jaxtune.types import Coords, ParamDist

Params = Mapping[str, jax.Array]
"""Physical values by name: a multiplier of the nominal model for a logarithmic entry, an offset for a linear one.

The values that the tuner searches are coordinates, another type (`jaxtune.types.Coords`); `to_coords` translates.
"""


def select(entries: Mapping[str, Entry], names: Sequence[str]) -> dict[str, Entry]:
    """Takes the named rows of a table, in the order of the names.

    Use it to tune some parameters of a robot's whole table and leave the others nominal.

    Raises:
      ValueError: a name is not in the table.
    """
    for name in names:
        if name not in entries:
            raise ValueError(f"parameters: got '{name}', expected some of {', '.join(entries)}")
    return {name: entries[name] for name in names}


def check(model: mjx.Model, entries: Mapping[str, Entry]) -> None:
    """Checks that every parameter of a table can change a model (`Entry.check`).

    Raises:
      ValueError: one cannot, the table is none, or the model is not of MJX's JAX implementation.
    """
    check_implementation(model)
    if not isinstance(entries, Mapping) or not all(isinstance(name, str) for name in entries):
        raise ValueError(f"parameters: got {type(entries).__name__}, expected rows (jaxtune.mjx.Entry) by name")
    for name, entry in entries.items():
        if not isinstance(entry, Entry):
            raise ValueError(f"parameter '{name}': got {type(entry).__name__}, expected a row (jaxtune.mjx.Entry)")
        try:
            entry.check(model)
        except ValueError as error:
            raise ValueError(f"parameter '{name}', {error}") from None


def distribution(entries: Mapping[str, Entry], radius: float | Coords, centre: Params) -> ParamDist:
    """Makes the distribution over a table that a search begins with, bounded by the table's bounds.

    Args:
      entries: the table.
      radius: half width in coordinates, the same for every parameter or by name.
      centre: physical values by name; those that are left out are nominal.

    Raises:
      ValueError: a name is not in the table, a value is out of bounds (the nominal one too, where it is left out), or
        the radius is not positive.
    """
    check_values(entries, nominal(entries) | dict(centre))
    ends = ({name: entry.bounds[end] for name, entry in entries.items()} for end in (0, 1))
    middle, lower, upper = (
        {name: float(value) for name, value in to_coords(entries, values).items()}
        for values in (nominal(entries) | dict(centre), *ends)
    )
    return dists.make(middle, radius, lower, upper)


def check_values(entries: Mapping[str, Entry], params: Params) -> None:
    """Checks physical values by name against a table.

    Raises:
      ValueError: a name is not in the table, or a value is no number or out of bounds.
    """
    for name, entry in select(entries, tuple(params)).items():
        low, high = entry.bounds
        if not is_number(params[name]) or not low <= params[name] <= high:
            raise ValueError(f"parameter '{name}': got {params[name]}, expected {low:g} to {high:g}")


def nominal(entries: Mapping[str, Entry]) -> dict[str, float]:
    """Returns the values that leave a model as it is: 1 for a multiplier, 0 for an offset.

    Start from it and overwrite what differs: `nominal(entries) | {"shank_mass": 1.2}`. In coordinates it is the origin.
    """
    return {name: 1.0 if entry.log else 0.0 for name, entry in entries.items()}


def to_coords(entries: Mapping[str, Entry], params: Params) -> dict[str, jax.Array]:
    """Translates physical values into the coordinates that are searched.

    A multiplier becomes its logarithm, so that half and double are equally far from nominal (coordinate 0); an offset
    is divided by half the width of its bounds, so that coordinates of all parameters are of order one. `jaxtune.tuner`
    and its models see coordinates alone.

    Args:
      entries: the table; it may have more rows than there are values.
      params: physical values by name, of any shape.

    Returns:
      Coordinates by name, of the same shapes.

    Raises:
      ValueError: a name is not in the table.
    """
    return {
        name: jnp.log(params[name]) if entry.log else jnp.asarray(params[name]) / entry.unit
        for name, entry in select(entries, tuple(params)).items()
    }


def from_coords(entries: Mapping[str, Entry], coords: Coords) -> dict[str, jax.Array]:
    """Translates coordinates back into physical values, the inverse of `to_coords`.

    Call it where a value that the tuner proposes enters a simulation or a report.

    Args:
      entries: the table; it may have more rows than there are coordinates.
      coords: by name, of any shape.

    Returns:
      Physical values by name, of the same shapes.

    Raises:
      ValueError: a name is not in the table.
    """
    return {
        name: jnp.exp(coords[name]) if entry.log else jnp.asarray(coords[name]) * entry.unit
        for name, entry in select(entries, tuple(coords)).items()
    }


def apply(model: mjx.Model, params: Params, entries: Mapping[str, Entry]) -> mjx.Model:
    """Makes the model that has these parameters, with every derived field recomputed.

    It works inside `jit` and `vmap`: a batch of robots is `jax.vmap(lambda params: apply(model, params, entries))`.

    Args:
      model: the nominal model.
      params: physical values by name, each a scalar or one per target; those that are left out stay nominal.
      entries: the table that the names stand in.

    Returns:
      A model as if it had been compiled with these values (a relative 1e-5 in single precision).

    Raises:
      ValueError: a name is not in the table, or a target is not in the model.
    """
    fields = {}
    for field, index, entry, value in _cells(model, params, entries):
        # An earlier entry may have changed the same field.
        array = fields.get(field, getattr(model, field))
        cells = array.at[index]
        # One value per row must broadcast over the columns of its row.
        value = jnp.reshape(value, (*jnp.shape(value), *(1,) * (cells.get().ndim - 1)))
        fields[field] = cells.multiply(value) if entry.log else cells.add(value)
    return set_const(model.tree_replace(fields))


def apply_mujoco(model: mujoco.MjModel, params: Params, entries: Mapping[str, Entry]) -> mujoco.MjModel:
    """Makes the model of MuJoCo C that has these parameters; `apply` for the other engine.

    Use it to simulate the same robot in MuJoCo C, as a target to be tuned to or as a check of MJX.

    Args:
      model: the nominal model; it is copied, not changed.
      params: physical values by name, each a scalar; those that are left out stay nominal.
      entries: the table that the names stand in.

    Returns:
      The copy, its derived fields recomputed by `mj_setConst`.

    Raises:
      ValueError: a name is not in the table, or a target is not in the model.
    """
    model = copy.copy(model)
    for field, index, entry, value in _cells(model, params, entries):
        # A view of the model's own memory: assigning to it changes the model.
        array = getattr(model, field)
        array[index] = array[index] * float(value) if entry.log else array[index] + float(value)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _cells(model, params, entries):
    """Yields every field that a parameter enters, the index of its cells there, its entry and its values.

    The values are a scalar, or one per row where the parameter has one per target.
    """
    for name, entry in select(entries, tuple(params)).items():
        for field, *column in entry.cells:
            try:
                rows, owner = entry.rows(model, field)
            except ValueError as error:
                raise ValueError(f"parameter '{name}', {error}") from None
            value = params[name]
            yield field, (rows, *column), entry, jnp.asarray(value)[owner] if np.ndim(value) else value
