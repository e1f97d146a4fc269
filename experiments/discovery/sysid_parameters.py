"""Parameters of a robot's model that `mujoco.sysid` (extra `sysid`) can fit: what they are, and where they enter."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from envs import segments
from envs.logs import Log, splits
from experiments.discovery.playback import Pieces, play, playable

_JOINTS = ("armature", "damping", "friction")
_ACTUATORS = (*_JOINTS, "gain", "brake", "limit")
_SENSING = (*_ACTUATORS, "delay", "bias")
SUBSETS = {
    "joints": _JOINTS,
    "actuators": _ACTUATORS,
    "sensing": _SENSING,
    "masses": (*_SENSING, "mass"),
    "inertia": (*_SENSING, "inertia"),
}
"""Kinds of parameters by the name of a subset.

`armature`, `damping` and `friction` are fields of a joint. `gain` scales the controller's stiffness, `brake` its
damping or back electromotive force, `limit` its torque limit; one per joint each, left out where the log cannot show
it. `delay` is one for all commands, `bias` one per position sensor. `mass` is one per moving body, with its inertia in
proportion; `inertia` is its pseudo-inertia, ten numbers."""

_FRACTION_RAD = 0.01  # the unit of friction, where the model has none, is the torque of this position error


def package() -> Any:
    """Returns `mujoco.sysid`.

    Raises:
      ValueError: its dependencies are not installed.
    """
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):
        raise ValueError("mujoco.sysid: got no 'optimize', expected its dependencies: pip install 'jaxtune[sysid]'")
    return sysid


@dataclass(frozen=True)
class Robot:
    """A robot whose parameters are fitted: its model with a controller, the log's joints, and typical sizes."""

    spec: mujoco.MjSpec
    """Of `playback.playable`."""
    joints: tuple[str, ...]
    stiffness: np.ndarray
    """[joints] Nm/rad of the controller, a typical one, from which units of parameters follow."""
    visible: dict[str, np.ndarray]
    """[joints] by `gain`, `brake` and `limit`: whether the controller has it, or comes near it."""

    def compile(self, parameters) -> mujoco.MjModel:
        """Compiles the model with given parameters, from a copy, because the package changes what it is given."""
        return package().apply_param_modifiers(parameters, self.spec.copy())

    def play(self, parameters, pieces: Pieces, model: mujoco.MjModel | None = None) -> np.ndarray:
        """Simulates pieces of a log with given parameters (`playback.play`).

        Args:
          parameters: of `declare`; `model` must have them where it is given.
          pieces: what to simulate.
          model: compiled with these parameters; compiled here where None.
        """
        model = model or self.compile(parameters)
        delay = 0.01 * float(parameters["delay"].value[0]) if "delay" in parameters else 0.0
        bias = parameters["bias"].value / 10.0 if "bias" in parameters else 0.0
        return play(model, self.joints, pieces, delay, bias)


def robot_of(spec: mujoco.MjSpec, log: Log) -> Robot:
    """Makes the robot whose parameters are fitted, from its nominal model and unsealed runs of a log.

    Args:
      spec: the nominal model.
      log: of the robot.

    Raises:
      ValueError: a run has no targets, or no joint follows any.
    """
    for run in log.runs:
        if "target" not in run.signals:
            raise ValueError(f"{run.name}: got torques alone, expected the targets of a controller")
    runs = [run for split, own in splits(log).items() if split != "sealed" for run in own]
    laws = [run.impedance() for run in runs]
    shape = [run.signals["q"].shape for run in runs]
    stiffness, damping, limit = (
        np.concatenate([np.broadcast_to(part(law), size) for law, size in zip(laws, shape, strict=True)])
        for part in (lambda law: law.stiffness, lambda law: law.damping + law.back_emf, lambda law: law.limit)
    )
    error = np.concatenate([np.abs(run.signals["target"] - run.signals["q"]) for run in runs])
    on = (stiffness > 0).any(axis=1)
    if not on.any():
        raise ValueError("controller: got no row with motors on and a gain above 0, expected a joint that is driven")
    visible = {
        "gain": (stiffness > 0).any(axis=0),
        "brake": (damping > 0).any(axis=0),
        "limit": (on[:, None] & (stiffness * error > 0.5 * limit)).any(axis=0),
    }
    typical = np.array([np.median(own[own > 0]) if own.any() else 0.0 for own in stiffness.T])
    # A passive joint has no stiffness of its own, by which its parameters could be measured.
    return Robot(playable(spec, log), log.joints, np.where(typical > 0, typical, typical.max()), visible)


def declare(robot: Robot, subset: str):
    """Declares the parameters of a subset at their nominal values, as a `mujoco.sysid.ParameterDict`.

    Fields of joints are in units of the nominal value, or of a typical one where that is zero; scales are ratios, the
    delay is in 10 ms and biases are in 0.1 rad. So one is a large change of each.

    Args:
      robot: whose parameters they are.
      subset: one of `SUBSETS`.
    """
    sysid, kinds = package(), SUBSETS[subset]
    declared, model = sysid.ParameterDict(), robot.spec.compile()
    for index, joint in enumerate(robot.joints):
        for kind in (kind for kind in _FIELDS if kind in kinds):
            unit, nominal = _unit(robot, model, index, kind), float(getattr(model.joint(joint), _FIELDS[kind])[0])
            modifier = _field(joint, _FIELDS[kind], unit)
            declared.add(sysid.Parameter(f"{kind}.{joint}", nominal / unit, 0.0, 20.0, modifier=modifier))
        for kind in (kind for kind in _SCALES if kind in kinds and robot.visible[kind][index]):
            declared.add(sysid.Parameter(f"{kind}.{joint}", 1.0, 0.2, 5.0, modifier=_SCALES[kind](joint)))
    if "delay" in kinds:
        declared.add(sysid.Parameter("delay", 0.0, 0.0, 100.0 * segments.HISTORY_S - 0.5))
    if "bias" in kinds:
        zero = np.zeros(len(robot.joints))
        declared.add(sysid.Parameter("bias", zero, zero - 3.0, zero + 3.0))
    for body in range(1, model.nbody):
        if model.body_weldid[body] > 0 and model.body_mass[body] > 0 and {"mass", "inertia"} & set(kinds):
            declared.add(_inertia(robot, model, model.body(body).name, whole="inertia" in kinds))
    return declared


def physical(robot: Robot, parameters) -> dict[str, float | list[float]]:
    """Returns parameters in physical units by name: kg m^2, Nm s/rad, Nm, ratios, s, rad, and masses in kg."""
    found, nominal = {}, robot.spec.compile()
    for name, parameter in parameters.items():
        kind, _, joint = name.partition(".")
        if kind in _FIELDS:
            value = float(parameter.value[0] * _unit(robot, nominal, robot.joints.index(joint), kind))
        elif name.endswith("_inertia"):
            body = name.removesuffix("_inertia")
            value = float(robot.compile(parameters).body(body).mass[0])
            name = f"mass.{body}"
        else:
            value = (parameter.value * {"delay": 0.01, "bias": 0.1}.get(kind, 1.0)).tolist()
            value = value if kind == "bias" else value[0]
        found[name] = value
    return found


def _inertia(robot: Robot, model: mujoco.MjModel, body: str, whole: bool):
    """Declares the mass of a body or its whole pseudo-inertia, whose centre of mass may move by 0.1 m."""
    sysid = package()

    def modify(spec, parameter):
        # With the package's own modifiers MuJoCo 3.17 refuses both: the mass, an array, and the NaN beside an inertia.
        if whole:
            sysid.apply_body_inertia(spec, body, parameter)
            spec.body(body).iquat = [1.0, 0.0, 0.0, 0.0]
            spec.body(body).ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        else:
            mass = float(parameter.value[0])
            sysid.model_modifier.apply_body_mass_ipos(spec, body, mass=mass, rot_inertia_scale=True)

    return sysid.body_inertia_param(
        robot.spec.copy(),  # the package changes what it is given
        model,
        body,
        sysid.InertiaType.Pseudo if whole else sysid.InertiaType.Mass,
        scale_rot_inertia=not whole,
        mass_bound_mult=np.array([0.2, 5.0]),
        ipos_bound_off=np.array([-0.1, 0.1]),
        modifier=modify,
    )


def _unit(robot: Robot, model: mujoco.MjModel, index: int, kind: str) -> float:
    """Returns the unit of a joint's field: the nominal value, or a typical one where that is zero."""
    joint = model.joint(robot.joints[index])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    dense = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, dense)
    inertia = dense[joint.dofadr[0], joint.dofadr[0]]
    typical = {
        "armature": 0.1 * inertia,
        "damping": 0.1 * np.sqrt(robot.stiffness[index] * inertia),
        "friction": _FRACTION_RAD * robot.stiffness[index],
    }
    return float(max(getattr(joint, _FIELDS[kind])[0], typical[kind]))


def _field(joint: str, field: str, unit: float) -> Callable:
    def modify(spec, parameter):
        value = unit * float(parameter.value[0])
        found = spec.joint(joint)
        # Damping has coefficients of higher order too.
        setattr(found, field, [value, *found.damping[1:]] if field == "damping" else value)

    return modify


def _scaled(*actuators: str) -> Callable[[str], Callable]:
    def of_joint(joint: str) -> Callable:
        def modify(spec, parameter):
            for name in actuators:
                actuator = spec.actuator(f"{name}.{joint}")
                actuator.gainprm[:3] = np.sign(actuator.gainprm[:3]) * float(parameter.value[0])

        return modify

    return of_joint


def _limited(joint: str) -> Callable:
    def modify(spec, parameter):
        tendon = spec.tendon(f"drive.{joint}")
        tendon.actfrcrange = np.asarray(tendon.actfrcrange) * float(parameter.value[0])

    return modify


_FIELDS = {"armature": "armature", "damping": "damping", "friction": "frictionloss"}
_SCALES = {"gain": _scaled("command", "stiffness"), "brake": _scaled("damping"), "limit": _limited}
