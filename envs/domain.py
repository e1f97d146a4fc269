"""Which parameters of a model may be wrong, and how a model with other values of them is made.

Mass is not one field of a MuJoCo model: scaling `body_mass` alone leaves inertia, subtree mass and the inverse weights
that scale every constraint at their old values. MuJoCo C recomputes them in `mj_setConst`, which MJX does not have;
`set_const` is that function in JAX, and `apply` is the only door through which parameters enter a model.
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

Params = Mapping[str, jax.Array]
"""Named physical values: a multiplier of the nominal model for a logarithmic entry, an offset for a linear one."""

_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}
_MIN_VALUE = mujoco.mjMINVAL


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One row of the parameter table."""

    name: str
    kind: Literal["body", "geom", "joint", "actuator", "control"]
    """What the targets are; `control` is no part of the model and has neither targets nor fields."""
    targets: tuple[str, ...]
    """Names of the objects that share this value."""
    fields: tuple[str, ...]
    """Fields of the model that the value enters."""
    bounds: tuple[float, float]
    """Least and largest physical value."""
    column: int | None = None
    """Which column of the fields; every one where None."""
    log: bool = True
    """Multiplies the nominal value and is tuned by its logarithm; else it is added and tuned as it is."""

    def rows(self, model: mjx.Model | mujoco.MjModel) -> np.ndarray:
        """Rows of the fields that belong to the targets.

        Raises:
          ValueError: a target is no object of the model.
        """
        ids = []
        for target in self.targets:
            index = mjx.name2id(model, _OBJECTS[self.kind], target)
            if index < 0:
                raise ValueError(f"parameter '{self.name}': the model has no {self.kind} named '{target}'")
            ids.append(index)
        ids = np.array(ids)
        return model.jnt_dofadr[ids] if self.kind == "joint" else ids


def select(entries: Mapping[str, Entry], names: Sequence[str]) -> dict[str, Entry]:
    """Takes the named rows of a table.

    Raises:
      ValueError: a name is not in the table.
    """
    for name in names:
        if name not in entries:
            raise ValueError(f"parameters: '{name}' is unknown; allowed: {', '.join(entries)}")
    return {name: entries[name] for name in names}


def nominal(entries: Mapping[str, Entry]) -> dict[str, float]:
    """The values that leave a model as it is."""
    return {name: 1.0 if entry.log else 0.0 for name, entry in entries.items()}


def to_coordinates(entries: Mapping[str, Entry], params: Params) -> dict[str, jax.Array]:
    """Physical values to the coordinates that are searched: the logarithm of a multiplier, an offset as it is."""
    return {name: jnp.log(value) if entries[name].log else jnp.asarray(value) for name, value in params.items()}


def from_coordinates(entries: Mapping[str, Entry], coordinates: Params) -> dict[str, jax.Array]:
    """The inverse of `to_coordinates`."""
    return {name: jnp.exp(value) if entries[name].log else jnp.asarray(value) for name, value in coordinates.items()}


def apply(model: mjx.Model, params: Params, entries: Mapping[str, Entry]) -> mjx.Model:
    """Makes the model that has these parameters, every derived field included.

    Args:
      model: the nominal model.
      params: physical values by name, each a scalar or one per target; those that are left out stay nominal.
      entries: the table the names stand in.

    Returns:
      A model as if it had been compiled with these values.

    Raises:
      ValueError: a name is not in the table.
    """
    fields = {}
    for field, index, entry, value in _cells(model, params, entries):
        array = fields.get(field, getattr(model, field))
        columns = (1,) * (array.ndim - 1 if entry.column is None else 0)
        cell, value = array.at[index], jnp.reshape(value, (*jnp.shape(value), *columns))
        fields[field] = cell.multiply(value) if entry.log else cell.add(value)
    return set_const(model.tree_replace(fields))


def apply_mujoco(model: mujoco.MjModel, params: Params, entries: Mapping[str, Entry]) -> mujoco.MjModel:
    """`apply` for a model of MuJoCo C, which is copied."""
    model = copy.copy(model)
    for field, index, entry, value in _cells(model, params, entries):
        array = getattr(model, field)
        array[index] = array[index] * float(value) if entry.log else array[index] + float(value)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _cells(model, params, entries):
    """Every field that a parameter enters, with the index of its cells there."""
    for name, entry in select(entries, tuple(params)).items():
        rows = entry.rows(model)
        for field in entry.fields:
            yield field, rows if entry.column is None else (rows, entry.column), entry, params[name]


def set_const(model: mjx.Model) -> mjx.Model:
    """Recomputes the fields that depend on masses, inertias and armatures: `mj_setConst` in JAX.

    Like the compiler, and unlike `mj_setConst`, it keeps `stat.meaninertia` true as well.

    Covers `body_subtreemass`, `body_invweight0`, `dof_M0`, `dof_invweight0`, `actuator_acc0` and `stat.meaninertia`;
    fields of tendons, cameras and lights are left alone.
    """
    # Where the default precision of products is a shortened one (on GPUs), weights would be off by a thousandth.
    with jax.default_matmul_precision("highest"):
        return _set_const(model)


def _set_const(model: mjx.Model) -> mjx.Model:
    subtree = model.body_mass
    for body in range(model.nbody - 1, 0, -1):
        subtree = subtree.at[model.body_parentid[body]].add(subtree[body])
    model = model.replace(body_subtreemass=subtree)

    data = mjx.make_data(model).replace(qpos=model.qpos0)
    for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.transmission):
        data = stage(model, data)
    inertia = mjx.full_m(model, data)
    inverse = jnp.linalg.inv(inertia)

    # J M^-1 J' of every body's inertial frame, the mean over its three axes of translation and of rotation.
    jacobians = jax.vmap(lambda point, body: jnp.stack(mjx.jac(model, data, point, body)))(
        data.xipos, jnp.arange(model.nbody)
    )
    body_weight = jnp.einsum("bkid,ij,bkjd->bk", jacobians, inverse, jacobians) / 3
    moves = jnp.asarray(model.body_weldid > 0)[:, None]
    body_weight = jnp.where(moves, jnp.maximum(body_weight, _MIN_VALUE), 0.0)

    # The three axes of a free joint's translation share one weight, so do those of its rotation and of a ball joint.
    dof_weight = jnp.diagonal(inverse)
    for joint, kind in enumerate(model.jnt_type):
        start = model.jnt_dofadr[joint]
        triples = {mujoco.mjtJoint.mjJNT_FREE: 2, mujoco.mjtJoint.mjJNT_BALL: 1}.get(mujoco.mjtJoint(kind), 0)
        for first in range(start, start + 3 * triples, 3):
            dof_weight = dof_weight.at[first : first + 3].set(dof_weight[first : first + 3].mean())

    diagonal = jnp.diagonal(inertia)
    return model.replace(
        body_invweight0=body_weight,
        dof_M0=diagonal,
        dof_invweight0=dof_weight,
        actuator_acc0=jnp.linalg.norm(data._impl.actuator_moment @ inverse, axis=-1),
        stat=model.stat.replace(meaninertia=diagonal.mean()),
    )
