"""Saves and loads a corrected model as a robot on the test rig.

Discovery saves a rig and the coordinates that it found. Loaded again, the rig moves as the one that was saved.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.corrected.record import EFFECTS, MODEL, Effects
from envs.effects import EVERY
from envs.models import free_joints, with_rotors, without_files, write_inertia
from envs.rig import Rig


def save(folder: Path, spec: mujoco.MjSpec, rig: Rig, vector: np.ndarray) -> None:
    """Writes a corrected model to a folder.

    Corrections that MJCF can express go into `model.xml`. Every other effect with a coordinate that is not zero goes
    into `effects.json`, in physical units.

    Args:
      folder: to write to; it is created where it does not exist.
      spec: of the nominal robot. Its base, geometries and keyframes stay as they are.
      rig: the same robot on the test rig, on which the corrections were fitted.
      vector: coordinates [axes] of the rig's effects; a zero means that nothing is corrected.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MODEL).write_text(_corrected_spec(spec, rig, vector).to_xml())
    effects = _physical(rig, vector, hung=bool(free_joints(spec)))
    content = {"joints": list(rig.joints), "control_hz": rig.control_hz, "effects": effects}
    (folder / EFFECTS).write_text(json.dumps(content, indent=1) + "\n")


def _corrected_spec(spec: mujoco.MjSpec, rig: Rig, vector: np.ndarray) -> mujoco.MjSpec:
    """Makes the nominal MJCF with the corrected inertias, armatures, dampings, springs and dry frictions, compiled."""
    values = rig.values(rig.tree(jnp.asarray(vector, jnp.float32)))
    model, device = rig.mj_model, jax.jit(rig.model)(values)
    spec = with_rotors(without_files(spec.copy()))
    for name in rig.bodies:
        body, number = spec.body(name), model.body(name).id
        write_inertia(body, device, number)
        # A controller carries what the nominal link weighs.
        body.gravcomp = float(model.body_gravcomp[number] * model.body_mass[number] / device.body_mass[number])
    for number, name in enumerate(rig.joints):
        dof, joint = rig.dof[number], spec.joint(name)
        joint.armature = float(device.dof_armature[dof])
        joint.damping = [float(device.dof_damping[dof]), *np.ravel(joint.damping)[1:]]
        joint.stiffness = [float(device.jnt_stiffness[model.joint(name).id]), *np.ravel(joint.stiffness)[1:]]
        # From the nominal model: on the device every joint has a trace of friction, which MJX needs.
        joint.frictionloss = max(float(model.dof_frictionloss[dof] + values["coulomb"]["torque_nm"][number]), 0.0)
        joint.solimp_friction = np.asarray(device.dof_solimp[dof], float)
    if any(np.any(value) for value in values["ground_slope"].values()) and not free_joints(spec):
        spec.option.gravity = np.asarray(device.opt.gravity, float)
    # A spec is written as XML only after it compiled.
    spec.compile()
    return spec


def _physical(rig: Rig, vector: np.ndarray, hung: bool) -> dict[str, dict[str, dict[str, float]]]:
    """Computes physical values, by effect, place and parameter, of the effects that MJCF cannot express."""
    # Coulomb friction is a signal on the rig, but a field (`frictionloss`) in MJCF.
    in_model = {name for name, row in rig.effects.items() if row.enters == "model"} | {"coulomb"}
    # How a robot hung says nothing of the ground that it will walk on.
    in_model -= {"ground_slope"} if hung else set()
    # A coordinate of zero means no effect, except for a shape: there zero is a value of its own where the effect acts.
    there = {(axis.effect, axis.place) for axis, coordinate in zip(rig.axes, vector, strict=True) if coordinate}
    effects = {}
    for axis, coordinate in zip(rig.axes, vector, strict=True):
        row = rig.effects[axis.effect]
        parameter = next(p for p in row.parameters if p.name == axis.parameter)
        means = coordinate or (parameter.shape and (axis.effect, axis.place) in there)
        if axis.effect not in in_model and means:
            value = parameter.value(float(coordinate), float(rig.scale(row, parameter)[axis.index]))
            effects.setdefault(axis.effect, {}).setdefault(axis.place, {})[axis.parameter] = float(value)
    return effects


def load(folder: Path) -> tuple[Rig, np.ndarray]:
    """Reads a corrected model as a robot on the test rig.

    Args:
      folder: that `save` wrote.

    Returns:
      The rig of the corrected MJCF, and the coordinates [axes] of the effects that are not in it. Simulated with these,
      it moves as the rig that was saved.

    Raises:
      ValueError: the rig has no such effect, place or parameter.
    """
    content = json.loads((folder / EFFECTS).read_text())
    rig = Rig(mujoco.MjSpec.from_file(str(folder / MODEL)), content["joints"], content["control_hz"])
    return rig, coordinates(rig, content["effects"])


def coordinates(rig: Rig, effects: Effects) -> np.ndarray:
    """Translates physical values of effects into the rig's vector of coordinates.

    Args:
      rig: whose scales the coordinates are in.
      effects: physical values by effect, place and parameter.

    Returns:
      Coordinates [axes]; zero where no value is given.

    Raises:
      ValueError: the rig has no such effect, place or parameter.
    """
    vector = np.zeros(len(rig.axes))
    index = {(axis.effect, axis.place, axis.parameter): number for number, axis in enumerate(rig.axes)}
    for effect, places in effects.items():
        for place, parameters in places.items():
            for name, value in parameters.items():
                if (effect, place, name) not in index:
                    raise ValueError(f"effects: got '{name}' of '{effect}' at '{place}', expected one that the rig has")
                row = EVERY[effect]
                parameter = next(p for p in row.parameters if p.name == name)
                number = index[effect, place, name]
                vector[number] = parameter.coordinate(value, float(rig.scale(row, parameter)[rig.axes[number].index]))
    return vector
