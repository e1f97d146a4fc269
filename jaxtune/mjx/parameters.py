"""The table of a model's parameters, and the model that has other values of them.

Mass is not one field of a MuJoCo model: a body's inertia scales with it, and MuJoCo derives further fields from both.
Parameters therefore enter a model through `apply` alone, which changes the fields that the table names and recomputes
all fields that depend on them. `apply_mujoco` does it for MuJoCo C.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from jaxtune.mjx.derived_fields import set_const
from jaxtune.types import Coords

Params = Mapping[str, jax.Array]
"""Physical values by name: a multiplier of the nominal model for a logarithmic entry, an offset for a linear one.

The values that the tuner searches are coordinates, another type (`jaxtune.types.Coords`); `to_coords` translates.
"""

_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Describes one parameter: which fields of which objects of the model share its value, and within which bounds.

    It is a row of the table that `apply` reads. Entries that share a field are applied one after the other, so that
    two multipliers of one field multiply.

        mass = Entry(name="shank_mass", kind="body", targets=("left_shank", "right_shank"),
                     fields=("body_mass", "body_inertia"), bounds=(0.5, 2.0))
    """

    name: str
    kind: Literal["body", "geom", "joint", "actuator", "control"]
    """What the targets are. A `control` parameter, such as a delay of the controller, is not part of the model. It has
    neither targets nor fields, so `apply` ignores it, and the code that simulates the controller reads it."""
    targets: tuple[str, ...]
    """Names of the objects that share this value."""
    fields: tuple[str, ...]
    """Fields of `mjx.Model` that the value enters. Those of a joint must have one row per degree of freedom, such as
    `dof_damping`; of a ball or free joint only the first row is changed."""
    bounds: tuple[float, float]
    """Smallest and largest physical value. `apply` does not check them: they bound the distribution that is
    searched."""
    column: int | None = None
    """Which column of the fields (the first of `geom_friction` is sliding friction); all of them where None."""
    log: bool = True
    """True: the value multiplies the nominal one and its logarithm is searched. False: it is added, and searched as it
    is."""

    def rows(self, model: mjx.Model | mujoco.MjModel) -> np.ndarray:
        """Finds the rows of the fields that belong to the targets.

        Args:
          model: in which the targets are looked up by name.

        Returns:
          [targets] indices: ids of bodies, geoms or actuators; of a joint the address of its first degree of freedom.

        Raises:
          ValueError: the model has no object of that kind and name.
        """
        ids = []
        for target in self.targets:
            index = mjx.name2id(model, _OBJECTS[self.kind], target)
            if index < 0:
                raise ValueError(f"parameter '{self.name}': got {self.kind} '{target}', which the model does not have")
            ids.append(index)
        ids = np.array(ids)
        # Damping, armature and friction of a joint are stored by degree of freedom.
        return model.jnt_dofadr[ids] if self.kind == "joint" else ids


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


def nominal(entries: Mapping[str, Entry]) -> dict[str, float]:
    """Returns the values that leave a model as it is: 1 for a multiplier, 0 for an offset.

    Start from it and overwrite what differs: `nominal(entries) | {"shank_mass": 1.2}`. In coordinates it is the origin.
    """
    return {name: 1.0 if entry.log else 0.0 for name, entry in entries.items()}


def to_coords(entries: Mapping[str, Entry], params: Params) -> dict[str, jax.Array]:
    """Translates physical values into the coordinates that are searched.

    A multiplier becomes its logarithm, so that half and double are equally far from nominal (coordinate 0); an offset
    stays as it is. `jaxtune.tuner` and its models see coordinates alone.

    Args:
      entries: the table; it may have more rows than there are values.
      params: physical values by name, of any shape.

    Returns:
      Coordinates by name, of the same shapes.
    """
    return {name: jnp.log(value) if entries[name].log else jnp.asarray(value) for name, value in params.items()}


def from_coords(entries: Mapping[str, Entry], coords: Coords) -> dict[str, jax.Array]:
    """Translates coordinates back into physical values, the inverse of `to_coords`.

    Call it where a value that the tuner proposes enters a simulation or a report.

    Args:
      entries: the table; it may have more rows than there are coordinates.
      coords: by name, of any shape.

    Returns:
      Physical values by name, of the same shapes.
    """
    return {name: jnp.exp(value) if entries[name].log else jnp.asarray(value) for name, value in coords.items()}


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
        # One value per target must broadcast over the columns of its row.
        columns = (1,) * (array.ndim - 1 if entry.column is None else 0)
        cell, value = array.at[index], jnp.reshape(value, (*jnp.shape(value), *columns))
        fields[field] = cell.multiply(value) if entry.log else cell.add(value)
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
    """Yields every field that a parameter enters, the index of its cells there, its entry and its value."""
    for name, entry in select(entries, tuple(params)).items():
        rows = entry.rows(model)
        for field in entry.fields:
            yield field, rows if entry.column is None else (rows, entry.column), entry, params[name]
