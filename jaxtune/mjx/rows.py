"""Rows of a parameter table that most robots need: masses, joints, motors, friction and the controller's delay.

    parameters = {
        "torso": mass("torso", bounds=(0.4, 2.5)),
        "damping": field("dof_damping", joints=("hip", "knee"), bounds=(0.3, 3.0)),
        "strength": strength(("hip", "knee"), bounds=(0.4, 2.0)),
        "friction": friction(bounds=(0.3, 3.0)),
        "delay": action_delay(bounds_s=(0.0, 0.03)),
    }

Bounds are multipliers of the model's own values, seconds for a delay, and the field's unit for an `offset`.
"""

import re
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco import mjx

from jaxtune.mjx.entry import Entry

Names = str | Sequence[str] | None
"""One name, several, or None for all objects of the kind."""
Bounds = tuple[float, float]
_LINK, _JOINT, _MOTOR, _GRIP = (0.5, 2.0), (0.3, 3.0), (0.5, 1.5), (0.3, 3.0)
_SIDES = {"left": "", "right": "", "l": "", "r": "", "fl": "f", "fr": "f", "rl": "r", "rr": "r", "hl": "h", "hr": "h"}
_SIDES |= {"lf": "f", "rf": "f", "lr": "r", "lh": "h", "rh": "h"}
_KINDS = {"bodies": "body", "geoms": "geom", "joints": "joint", "actuators": "actuator"}


def mass(bodies: Names, *, bounds: Bounds) -> Entry:
    """Multiplies mass and inertia of bodies by one value: heavier links of the same shape."""
    return Entry(kind="body", targets=_names(bodies), fields=("body_mass", "body_inertia"), bounds=bounds)


def strength(joints: Names, *, bounds: Bounds) -> Entry:
    """Multiplies the torque of motors, and of position and velocity servos, by one value.

    Gains, biases and force limits are multiplied alike, and so are the limits of actuator force at the joints and
    tendons that they drive, so that every torque is this share of the nominal one. Muscles are refused.

    Args:
      joints: names of actuators, or of the joints that they drive; None for all actuators.
      bounds: smallest and largest multiplier.
    """
    limits = ("actuator_forcerange", "jnt_actfrcrange", "tendon_actfrcrange")
    fields = ("actuator_gainprm", "actuator_biasprm", *limits)
    return Entry(kind="actuator", targets=_names(joints), fields=fields, bounds=bounds)


def friction(geoms: Names = None, *, bounds: Bounds) -> Entry:
    """Multiplies sliding friction of geoms by one value, in the contact pairs that have a friction of their own too.

    A contact has the larger friction of its two geoms, unless one has priority. So multiply that of all geoms (the
    default), or of the slippier half and of none that is rougher.
    """
    fields = (("geom_friction", 0), ("pair_friction", 0), ("pair_friction", 1))
    return Entry(kind="geom", targets=_names(geoms), fields=fields, bounds=bounds)


def action_delay(*, bounds_s: Bounds) -> Entry:
    """Delays the policy's actions by a time in seconds, the same for all of an episode (`jaxtune.mjx.Simulator`)."""
    entry = Entry(kind="control", targets=(), fields=(), bounds=bounds_s, log=False)
    if bounds_s[0] < 0:
        raise ValueError(f"bounds_s: got {bounds_s}, expected no negative delay")
    return entry


def field(name: str, *, bounds: Bounds, column: int | None = None, offset: bool = False, **targets: Names) -> Entry:
    """Changes any field of the model, such as `dof_damping`, `dof_armature`, `jnt_stiffness` or `geom_solref`.

    Args:
      name: of the field.
      bounds: smallest and largest value.
      column: of the field; all columns where None.
      offset: adds the value instead of multiplying by it.
      **targets: `bodies`, `geoms`, `joints` or `actuators`, one of them: names, or None for all.

    Raises:
      ValueError: another kind of target, or none or two of them, or a field of another kind.
    """
    if len(targets) != 1 or not targets.keys() <= _KINDS.keys():
        raise ValueError(
            f"field '{name}': got {', '.join(targets) or 'no targets'}, expected one of {', '.join(_KINDS)}"
        )
    ((kind, names),) = targets.items()
    fields = (name if column is None else (name, column),)
    return Entry(kind=_KINDS[kind], targets=_names(names), fields=fields, bounds=bounds, log=not offset)


def parameters_of(model: mujoco.MjModel | mjx.Model, *, control_s: float | None = None) -> dict[str, Entry]:
    """Proposes a table for any model, to be cut down to what may be wrong and what the episodes can show.

    It has the mass of every named moving link, left and right tied by their names (`left_knee` and `right_knee`,
    `FL_hip` and `FR_hip`). The joints share damping, armature and dry friction, as far as the model has them. All
    motors share their strength, and all contacts their friction.

    Args:
      model: of MuJoCo C or of MJX.
      control_s: control period in seconds. With it, there is a delay of up to two periods.

    Returns:
      Rows by name. Bounds are wide: factors of 2 for masses, 3 for joints and friction, 1.5 to a half for motors.
    """
    links = {}
    for body in range(1, model.nbody):
        name = mjx.id2name(model, mujoco.mjtObj.mjOBJ_BODY, body)
        if name and model.body_weldid[body] > 0 and model.body_mass[body] > 0:
            links.setdefault(_without_side(name), []).append(name)
    table = {f"{stem}_mass": mass(names, bounds=_LINK) for stem, names in links.items()}
    for what in ("damping", "armature", "frictionloss"):
        having = np.unique(np.asarray(model.dof_jntid)[np.asarray(getattr(model, f"dof_{what}")) > 0])
        names = [mjx.id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in having]
        if any(names):
            table[what] = field(f"dof_{what}", joints=list(filter(None, names)), bounds=_JOINT)
    motors = np.asarray(model.actuator_gaintype) != mujoco.mjtGain.mjGAIN_MUSCLE
    if motors.all() and motors.size:
        table["strength"] = strength(None, bounds=_MOTOR)
    if model.npair or np.any((np.asarray(model.geom_contype) | np.asarray(model.geom_conaffinity)) > 0):
        table["friction"] = friction(bounds=_GRIP)
    if control_s:
        table["delay"] = action_delay(bounds_s=(0.0, 2 * control_s))
    return table


def _without_side(name: str) -> str:
    """Leaves out the part of a name that says left or right: `FL_hip` becomes `f_hip`, `left_shank` `shank`."""
    parts = [_SIDES.get(part.lower(), part) for part in re.split(r"[_\-. ]", name)]
    return "_".join(filter(None, parts)) or name


def _names(names: Names) -> tuple[str, ...] | None:
    if names is None or isinstance(names, str):
        return names if names is None else (names,)
    if not isinstance(names, Sequence) or isinstance(names, bytes):
        raise ValueError(f"targets: got {names!r}, expected a name, several, or None for all")
    return tuple(names)
