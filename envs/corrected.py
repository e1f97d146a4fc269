"""A model as discovery leaves it: an MJCF where MuJoCo has the form, and a JSON of effects for the rest."""

import json
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.correction import EFFECTS, MODEL
from envs.effects import EVERY
from envs.rig import Rig


def save(folder: Path, spec: mujoco.MjSpec, rig: Rig, vector: np.ndarray) -> None:
    """Writes `model.xml`, with what the vector [axes] changes of the model's own fields, and `effects.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    values = rig.values(rig.tree(jnp.asarray(vector, jnp.float32)))
    model, device = rig.mj_model, jax.jit(rig.model)(values)
    spec = spec.copy()
    for name in rig.bodies:
        body, number = spec.body(name), model.body(name).id
        body.explicitinertial = True
        body.mass = float(device.body_mass[number])
        for field in ("ipos", "iquat", "inertia"):
            setattr(body, field, np.asarray(getattr(device, f"body_{field}")[number], float))
        body.fullinertia = np.full(6, np.nan)
    for number, name in enumerate(rig.joints):
        dof, joint = rig.dof[number], spec.joint(name)
        joint.armature = float(device.dof_armature[dof])
        joint.damping = [float(device.dof_damping[dof]), *np.ravel(joint.damping)[1:]]
        joint.frictionloss = max(float(model.dof_frictionloss[dof] + values["coulomb"]["torque_nm"][number]), 0.0)
    spec.compile()
    (folder / MODEL).write_text(spec.to_xml())
    in_model = {name for name, row in rig.effects.items() if row.enters == "model"} | {"coulomb"}
    # A parameter that is a shape means something at zero, where its effect is there.
    there = {(axis.effect, axis.place) for axis, coordinate in zip(rig.axes, vector, strict=True) if coordinate}
    effects = {}
    for axis, coordinate in zip(rig.axes, vector, strict=True):
        row = rig.effects[axis.effect]
        parameter = next(p for p in row.parameters if p.name == axis.parameter)
        means = coordinate or (parameter.shape and (axis.effect, axis.place) in there)
        if axis.effect not in in_model and means:
            value = parameter.value(float(coordinate), float(rig.scale(row, parameter)[axis.index]))
            effects.setdefault(axis.effect, {}).setdefault(axis.place, {})[axis.parameter] = float(value)
    said = {"joints": list(rig.joints), "control_hz": rig.control_hz, "effects": effects}
    (folder / EFFECTS).write_text(json.dumps(said, indent=1) + "\n")


def load(folder: Path) -> tuple[Rig, np.ndarray]:
    """Reads what `save` wrote: the robot on the rig, and the coordinates [axes] of its effects.

    Raises:
      ValueError: an effect or a place is none of the rig's.
    """
    said = json.loads((folder / EFFECTS).read_text())
    rig = Rig(mujoco.MjSpec.from_file(str(folder / MODEL)), said["joints"], said["control_hz"])
    return rig, coordinates(rig, said["effects"])


def coordinates(rig: Rig, effects: Mapping[str, Mapping[str, Mapping[str, float]]]) -> np.ndarray:
    """Coordinates [axes] of physical values by effect, place and parameter.

    Raises:
      ValueError: an effect, a place or a parameter is none of the rig's.
    """
    vector = np.zeros(len(rig.axes))
    index = {(axis.effect, axis.place, axis.parameter): number for number, axis in enumerate(rig.axes)}
    for effect, places in effects.items():
        for place, parameters in places.items():
            for name, value in parameters.items():
                if (effect, place, name) not in index:
                    raise ValueError(f"effects: there is no '{name}' of '{effect}' at '{place}'")
                row = EVERY[effect]
                parameter = next(p for p in row.parameters if p.name == name)
                number = index[effect, place, name]
                vector[number] = parameter.coordinate(value, float(rig.scale(row, parameter)[rig.axes[number].index]))
    return vector
