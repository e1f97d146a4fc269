"""The table of a model's parameters, and the model that has other values of them.

Mass is not one field of a MuJoCo model: a body's inertia scales with it, and MuJoCo derives further fields from both.
Parameters therefore enter a model through `apply` alone, which changes the fields that the table names and recomputes
all fields that depend on them. `apply_mujoco` does it for MuJoCo C.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from jaxtune import dist as dists
from jaxtune.mjx.derived_fields import DERIVED, check_implementation, set_const
from jaxtune.types import Coords, ParamDist

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
_COUNTS = {"body": "nbody", "geom": "ngeom", "joint": "njnt", "actuator": "nu"}
_PREFIXES = {
    "body": ("body_",),
    "geom": ("geom_", "pair_"),
    "joint": ("jnt_", "dof_"),
    "actuator": ("actuator_", "jnt_actfrcrange"),
    "control": (),
}
"""How the fields begin that have rows for objects of a kind."""
_NOT_NEGATIVE = {"body_mass", "body_inertia", "dof_armature", "dof_damping", "dof_frictionloss", "jnt_stiffness"}
_NOT_NEGATIVE |= {"geom_friction", "pair_friction"}


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Describes one parameter: which fields of which objects of the model share its value, and within which bounds.

    It is a row of the table that `apply` reads; the table maps the parameter's name to it. `jaxtune.mjx.rows` makes the
    usual ones. Entries that share a field are applied one after the other, so that two multipliers of one field
    multiply.

        table = {"shank_mass": Entry(kind="body", targets=("left_shank", "right_shank"),
                                     fields=("body_mass", "body_inertia"), bounds=(0.5, 2.0))}
    """

    kind: Literal["body", "geom", "joint", "actuator", "control"]
    """What the targets are. A `control` parameter, such as a delay of the controller, is not part of the model. It has
    neither targets nor fields, so `apply` ignores it, and the code that simulates the controller reads it."""
    targets: tuple[str, ...] | None
    """Names of the objects that share this value; None for all of the kind. An actuator may also be named by the joint
    that it drives."""
    fields: tuple[str | tuple[str, int], ...]
    """Fields of `mjx.Model` that the value enters: a name for all columns of the field, or (name, column) for one of
    them. The stiffness of position servos is `(("actuator_gainprm", 0), ("actuator_biasprm", 1))`. Fields of a joint
    have rows by joint (`jnt_stiffness`) or by degree of freedom (`dof_damping`); all those of the joint are changed.
    Fields of a contact pair (`pair_friction`) are changed where a target is one of its two geoms."""
    bounds: tuple[float, float]
    """Smallest and largest physical value. `apply` does not check them: they bound the distribution that is
    searched."""
    log: bool = True
    """True: the value multiplies the nominal one and its logarithm is searched. False: it is added, and searched in
    units of half the width of its bounds."""

    def __post_init__(self) -> None:
        """Checks the row before anything is compiled.

        Raises:
          ValueError: the kind is unknown; a target has no name or stands there twice; a field belongs to another kind
            of object or is recomputed in any case; or the bounds are not two finite numbers that ascend (above zero for
            a multiplier).
        """
        if self.kind not in _PREFIXES:
            raise ValueError(f"kind: got {self.kind!r}, expected one of {', '.join(_PREFIXES)}")
        self._check_targets()
        self._check_fields()
        if len(np.shape(self.bounds)) != 1 or not all(map(_is_number, self.bounds)) or len(self.bounds) != 2:
            raise ValueError(f"bounds: got {self.bounds!r}, expected two numbers")
        low, high = self.bounds
        if not -math.inf < low < high < math.inf or (self.log and low <= 0):
            expected = "ascending ones, above zero for a multiplier" if self.log else "ascending ones"
            raise ValueError(f"bounds: got {self.bounds}, expected {expected}")

    def _check_targets(self) -> None:
        if self.targets is None:
            return
        named = isinstance(self.targets, tuple) and all(isinstance(name, str) for name in self.targets)
        if not named or (not self.targets and self.kind != "control"):
            raise ValueError(f"targets: got {self.targets!r}, expected a tuple of names, or None for all")
        if "" in self.targets or len(set(self.targets)) < len(self.targets):
            raise ValueError(
                f"targets: got {self.targets}, expected distinct names; an object without one must get one in the model"
            )

    def _check_fields(self) -> None:
        if not isinstance(self.fields, tuple):
            raise ValueError(f"fields: got {self.fields!r}, expected a tuple")
        for field in self.fields:
            kinds = (str,) if isinstance(field, str) else (str, int)
            parts = (field,) if isinstance(field, str) or not isinstance(field, tuple) else field
            if len(parts) != len(kinds) or not all(map(isinstance, parts, kinds)):
                raise ValueError(f"fields: got {field!r}, expected a name, or a name and the number of a column")
            name = parts[0]
            if name in DERIVED:
                raise ValueError(f"fields: got '{name}', which follows from masses and inertias; change those")
            if not name.startswith(_PREFIXES[self.kind]):
                prefixes = " or ".join(_PREFIXES[self.kind])
                expected = f"fields of a {self.kind}, which begin with {prefixes}" if prefixes else "none"
                raise ValueError(f"fields: got '{name}', expected {expected}")

    def check(self, model: mjx.Model) -> None:
        """Checks that the value can change this model.

        Raises:
          ValueError: there is no field; the model has no such target, field or column; a multiplier meets zeros alone;
            an offset may take a mass, a friction or the like below zero; or friction is added to a joint for which MJX
            does not solve it.
        """
        if not self.fields and self.kind != "control":
            raise ValueError("fields: got none, expected at least one")
        met = []
        for field in self.fields:
            name, *column = (field,) if isinstance(field, str) else field
            array = getattr(model, name, None)
            if not hasattr(array, "shape"):
                raise ValueError(f"fields: got '{name}', which mjx.Model does not have")
            if not np.issubdtype(array.dtype, np.floating):
                raise ValueError(f"fields: got '{name}', which holds {array.dtype}; expected one of real numbers")
            if column and not (array.ndim == 2 and 0 <= column[0] < array.shape[1]):
                raise ValueError(f"column: got {column[0]} of '{name}', which has {math.prod(array.shape[1:])}")
            rows, _ = self.rows(model, name)
            met.append(np.asarray(array)[(rows, *column)])
            if name == "dof_frictionloss" and not self.log and not met[-1].all():
                raise ValueError(
                    "fields: MJX solves for dof_frictionloss only in joints that had some when the model was put on "
                    "the device; give all of these joints 1e-6 in the MuJoCo model, and put it there again"
                )
            smallest = met[-1].min(initial=np.inf)
            if not self.log and name in _NOT_NEGATIVE and smallest + self.bounds[0] < 0:
                raise ValueError(
                    f"bounds: got {self.bounds}, which makes {name} negative; expected at least {-smallest:g}"
                )
        if self.log and met and not any(values.any() for values in met):
            raise ValueError(
                f"{' and '.join(self.field_names)}: zero for {', '.join(self.targets or ['all'])}, so a multiplier "
                "changes nothing; add to it (offset=True)"
            )

    @property
    def field_names(self) -> tuple[str, ...]:
        """Names of the fields, without their columns."""
        return tuple(field if isinstance(field, str) else field[0] for field in self.fields)

    @property
    def unit(self) -> float:
        """Physical size of one coordinate: one for a multiplier, else half the width of the bounds."""
        return 1.0 if self.log else (self.bounds[1] - self.bounds[0]) / 2

    def ids(self, model: mjx.Model | mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
        """Finds the targets in a model.

        Returns:
          [objects] ids, and [objects] which of the targets each belongs to: a joint may have several actuators.

        Raises:
          ValueError: the model has no object of that kind and name.
        """
        count = getattr(model, _COUNTS[self.kind]) if self.kind in _COUNTS else 0
        if self.targets is None:
            return np.arange(count), np.zeros(count, int)
        found = [self._find(model, target) for target in self.targets]
        ids = np.concatenate([*found, []]).astype(int)
        if len(set(ids)) < len(ids):
            raise ValueError(f"targets: got {', '.join(self.targets)}, two of which are the same {self.kind}")
        return ids, np.array([number for number, ids in enumerate(found) for _ in ids], int)

    def _find(self, model, target: str) -> np.ndarray:
        index = mjx.name2id(model, _OBJECTS[self.kind], target)
        if index >= 0:
            return np.array([index])
        driven = {}
        if self.kind == "actuator":
            numbers, joints = _driven(model, np.arange(model.nu))
            for number, joint in zip(numbers, joints, strict=True):
                driven.setdefault(mjx.id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint), []).append(number)
            if target in driven:
                return np.array(driven[target])
        named = [
            mjx.id2name(model, _OBJECTS[self.kind], number) for number in range(getattr(model, _COUNTS[self.kind]))
        ]
        raise ValueError(
            f"targets: got {self.kind} '{target}', which the model does not have; expected some of "
            f"{', '.join(dict.fromkeys(filter(None, [*named, *driven])))}"
        )

    def rows(self, model: mjx.Model | mujoco.MjModel, field: str) -> tuple[np.ndarray, np.ndarray]:
        """Finds the rows of a field that belong to the targets.

        Args:
          model: in which the targets are looked up by name.
          field: name of a field.

        Returns:
          [rows] indices into the field, and [rows] which of the targets each belongs to.

        Raises:
          ValueError: the model has no object of that kind and name.
        """
        ids, owner = self.ids(model)
        if field.startswith("dof_"):
            holds = np.asarray(model.dof_jntid)[:, None] == ids
        elif field.startswith("pair_"):
            holds = (np.asarray(model.pair_geom1)[:, None] == ids) | (np.asarray(model.pair_geom2)[:, None] == ids)
        elif self.kind == "actuator" and field.startswith("jnt_"):
            numbers, joints = _driven(model, ids)
            holds = (np.arange(model.njnt)[:, None] == joints) @ (numbers[:, None] == ids)
        else:
            return ids, owner
        rows = np.flatnonzero(holds.any(axis=1))
        return rows, owner[holds[rows].argmax(axis=1)]


def _is_number(value) -> bool:
    """Tells whether a value is one real number, of Python, NumPy or JAX."""
    return np.ndim(value) == 0 and np.issubdtype(getattr(value, "dtype", type(value)), np.number)


def _driven(model, actuators: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns those of the actuators that drive a joint, and the joints that they drive."""
    kinds = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    actuators = actuators[np.isin(np.asarray(model.actuator_trntype)[actuators], kinds)]
    return actuators, np.asarray(model.actuator_trnid)[actuators, 0]


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


def distribution(entries: Mapping[str, Entry], radius: float, centre: Params) -> ParamDist:
    """Makes the distribution over a table that a search begins with, bounded by the table's bounds.

    Args:
      entries: the table.
      radius: half width in coordinates, the same for every parameter.
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
        if not _is_number(params[name]) or not low <= params[name] <= high:
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
        for field in entry.fields:
            field, *column = (field,) if isinstance(field, str) else field
            try:
                rows, owner = entry.rows(model, field)
            except ValueError as error:
                raise ValueError(f"parameter '{name}', {error}") from None
            value = params[name]
            yield field, (rows, *column), entry, jnp.asarray(value)[owner] if np.ndim(value) else value
