"""A row of the table of a model's parameters: which fields of which objects share a value, within which bounds."""

import math
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from mujoco import mjx

from jaxtune.mjx.derived_fields import DERIVED

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
    "actuator": ("actuator_", "jnt_actfrcrange", "tendon_actfrcrange"),
    "control": (),
}
"""How the fields begin that have rows for objects of a kind."""
_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_TENDONS = (mujoco.mjtTrn.mjTRN_TENDON,)
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
        if len(np.shape(self.bounds)) != 1 or not all(map(is_number, self.bounds)) or len(self.bounds) != 2:
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
            an offset may take a mass, a friction or the like below zero; friction is added to a joint for which MJX
            does not solve it; or the model was compiled without what the field needs.
        """
        if not self.fields and self.kind != "control":
            raise ValueError("fields: got none, expected at least one")
        met = []
        for name, *column in self.cells:
            array = getattr(model, name, None)
            if not hasattr(array, "shape"):
                raise ValueError(f"fields: got '{name}', which mjx.Model does not have")
            if not np.issubdtype(array.dtype, np.floating):
                raise ValueError(f"fields: got '{name}', which holds {array.dtype}; expected one of real numbers")
            if column and not (array.ndim == 2 and 0 <= column[0] < array.shape[1]):
                raise ValueError(f"column: got {column[0]} of '{name}', which has {math.prod(array.shape[1:])}")
            rows, _ = self.rows(model, name)
            met.append(np.asarray(array)[(rows, *column)])
            self._check_compiled(model, (name, *column), rows, met[-1])
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

    def _check_compiled(self, model: mjx.Model, cell: tuple, rows: np.ndarray, values: np.ndarray) -> None:
        """Refuses what a compiled model can no longer express."""
        name = cell[0]
        if name == "dof_frictionloss" and not self.log and not values.all():
            raise ValueError(
                "fields: MJX solves for dof_frictionloss only in joints that had some when the model was put on the "
                "device; give all of these joints 1e-6 in the MuJoCo model, and put it there again"
            )
        if name in ("body_ipos", "body_iquat") and np.asarray(model.body_simple)[rows].any():
            raise ValueError(
                f"fields: {name} of a body that is alone and has its centre of mass at its origin: the compiler left "
                'out what couples its motions; set simple="false" in the <body>'
            )
        if name == "body_gravcomp" and not model.ngravcomp:
            raise ValueError("fields: no body has gravity compensation, so MJX computes none; give one body 1e-9 of it")
        muscle = mujoco.mjtGain.mjGAIN_MUSCLE
        if (
            cell in (("actuator_gainprm",), ("actuator_biasprm",))
            and (np.asarray(model.actuator_gaintype)[rows] == muscle).any()
        ):
            raise ValueError(
                f"fields: {name} of a muscle, whose numbers are not all forces; name the motors, and change muscles by "
                "columns 2 and 3 (force, scale)"
            )

    @property
    def cells(self) -> tuple[tuple, ...]:
        """Fields as tuples: (name, column), or (name,) for all columns."""
        return tuple((field,) if isinstance(field, str) else field for field in self.fields)

    @property
    def field_names(self) -> tuple[str, ...]:
        """Names of the fields, without their columns."""
        return tuple(name for name, *_ in self.cells)

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
            numbers, joints = _driven(model, np.arange(model.nu), _JOINTS)
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
        elif self.kind == "actuator" and field.startswith(("jnt_", "tendon_")):
            joints = field.startswith("jnt_")
            numbers, driven = _driven(model, ids, _JOINTS if joints else _TENDONS)
            count = model.njnt if joints else model.ntendon
            holds = (np.arange(count)[:, None] == driven) @ (numbers[:, None] == ids)
        else:
            return ids, owner
        rows = np.flatnonzero(holds.any(axis=1))
        return rows, owner[holds[rows].argmax(axis=1)]


def is_number(value) -> bool:
    """Tells whether a value is one real number, of Python, NumPy or JAX."""
    return np.ndim(value) == 0 and np.issubdtype(getattr(value, "dtype", type(value)), np.number)


def _driven(model, actuators: np.ndarray, kinds: tuple[mujoco.mjtTrn, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Returns those of the actuators that drive a joint or a tendon, and which they drive."""
    actuators = actuators[np.isin(np.asarray(model.actuator_trntype)[actuators], kinds)]
    return actuators, np.asarray(model.actuator_trnid)[actuators, 0]
