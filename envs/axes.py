"""The coordinates of a rig: what a unit of each stands for, how far it may go, and what is believed of it before."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from jaxtune.types import Effect, Parameter

# Parameters that every model has, by the effect that changes them, and by which share of its nominal value each may be
# wrong (one prior standard deviation). Discovery fits them under all hypotheses, the null included, so that an
# inaccurate number is not taken for a missing effect. Gains are set, and better known than a mass; a damping gain less
# so, since the velocity that it multiplies was filtered.
_PRIOR_SHARE = 0.1
_NOMINAL_RATIOS = {"link_mass": _PRIOR_SHARE, "link_inertia": _PRIOR_SHARE, "gain_error": 0.035, "damping_gain": 0.05}
# What else a servo's log gives, and instead: of its motor's constants it gives the torque at the stall (kt volts /
# resistance_ohm) and the braking (kt^2 / resistance_ohm), each as a data sheet does. It has no damping gain.
SERVO_RATIOS = {"torque_scale": 0.07, "back_emf": 0.1, "damping_gain": 0.0}
_NOMINAL_FIELDS = {
    "armature": "dof_armature",
    "viscous": "dof_damping",
    "coulomb": "dof_frictionloss",
    "joint_spring": "jnt_stiffness",
}
_LOOSE, _LEAST_LOOSE_M = 0.01, 1e-3  # by which a centre of mass is off: of the radius of gyration, and in m
_MOST_TAKEN = 0.99  # of a field of the model: armature, damping and stiffness must stay positive


def loose(mass: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """How far the centres of mass of links are off in each direction, [links] m, one prior standard deviation.

    A share of the link's radius of gyration, and a millimetre at least.

    Args:
      mass: [links] kg.
      inertia: [links, 3] kg m^2, about their principal axes.
    """
    return np.maximum(_LEAST_LOOSE_M, _LOOSE * np.sqrt(0.5 * inertia.sum(axis=-1) / np.maximum(mass, 1e-9)))


@dataclass(frozen=True)
class Axis:
    """One coordinate of a rig: one parameter of one effect at one place.

    A coordinate of zero leaves the robot as it is. `Rig.scaled` changes the unit of a coordinate, and with it `scale`,
    `least` and `prior_sd`.
    """

    effect: str
    parameter: str
    place: str
    """A joint, a body, or `robot`."""
    index: int
    """Number of the place among all places where the effect may sit."""
    scale: float
    """What one unit of the coordinate stands for, in the unit of the parameter."""
    least: float
    """Smallest coordinate. An effect that subtracts from a field of the model (armature, damping, dry friction, a
    spring) may take all but a hundredth of it, so that the field stays positive."""
    prior_sd: float
    """Prior standard deviation, in coordinates, of a parameter that every model has (a nuisance that every hypothesis
    fits); zero for an effect that models lack."""
    joints: tuple[int, ...]
    """Indices of the joints in which an effect at this place shows directly: the joint itself, or for a link all joints
    that carry it, nearest first."""

    @property
    def takes(self) -> bool:
        """Says whether `least` takes away nearly all that the model has."""
        return self.effect in _NOMINAL_FIELDS


def describe_axis(
    model: mujoco.MjModel,
    dof: Sequence[int],
    row: Effect,
    parameter: Parameter,
    place: str,
    index: int,
    scale: float,
    joints: Sequence[int],
) -> Axis:
    """Describes the coordinate of one parameter of one effect at one place.

    Args:
      model: the nominal model, suspended.
      dof: address of every controlled joint's degree of freedom.
      row: the effect.
      parameter: one of its parameters.
      place: where the effect sits.
      index: number of the place.
      scale: what one unit of the coordinate stands for.
      joints: indices of the joints in which the effect shows directly, nearest first.
    """
    least, prior_sd = parameter.bounds[0], 0.0
    # What only shapes a ratio, such as up to which errors it holds, is no nuisance.
    if row.name in _NOMINAL_RATIOS and parameter.form == "ratio":
        prior_sd = _NOMINAL_RATIOS[row.name]
    elif row.name in _NOMINAL_FIELDS:
        field, number = _NOMINAL_FIELDS[row.name], dof[index]
        number = model.dof_jntid[number] if field.startswith("jnt") else number
        nominal = float(getattr(model, field)[number] / scale)
        # Dry friction acts on a signal, but what the model has of it can be taken as well. What many models have is a
        # placeholder, ten times what it should be.
        least, prior_sd = -_MOST_TAKEN * nominal, _PRIOR_SHARE * nominal
    return Axis(
        effect=row.name,
        parameter=parameter.name,
        place=place,
        index=index,
        scale=scale,
        least=float(least),
        prior_sd=prior_sd,
        joints=tuple(joints),
    )
