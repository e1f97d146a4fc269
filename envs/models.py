"""Loads the model of a robot by the name that a log gives it, and suspends it on a test rig.

A suspended robot has no free base and no contacts. Discovery works on it, because the motion of a base is rarely
measured and contact is chaotic.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from mujoco import mjx

from envs import go2, held, pendulum
from envs.biteno import constants

_OTHER_FILES = re.compile(r"<include\b|\bfile\w*\s*=")

BUILT_IN = {
    "biteno": (constants.MODEL_PATH, constants.JOINTS),
    "pendulum": (pendulum.MODEL_PATH, pendulum.JOINTS),
    "go2": (go2.MODEL_PATH, go2.JOINTS),
}
"""Path of the MJCF and the joints that may be logged; any other robot is the path of an MJCF file."""


def spec(robot: str) -> mujoco.MjSpec:
    """Loads the MJCF of a robot as a spec, which can be changed before it is compiled.

    It needs no other file: included files are part of it, and meshes, height fields and textures are left out
    (`without_files`). Saved as XML, it loads again from any folder. A body without a name that a joint moves is called
    after the joint, as a place where effects may be. Rotors and dampers that the file gives to actuators are joints'
    (`with_rotors`).

    Args:
      robot: the name of a built-in robot, or the path of an MJCF file, as in a log's `meta.yaml`.

    Raises:
      ValueError: it is neither, the file is no MJCF, or a file that it refers to is missing.
    """
    path = BUILT_IN[robot][0] if robot in BUILT_IN else Path(robot)
    if not path.is_file():
        raise ValueError(f"robot: got '{robot}', expected {', '.join(BUILT_IN)} or the path of an MJCF file")
    try:
        found = with_rotors(without_files(mujoco.MjSpec.from_file(str(path))))
    except ValueError as error:
        raise ValueError(f"robot: {path}: {error}") from error
    taken = {body.name for body in found.bodies}
    for body in found.bodies:
        moves = [joint.name for joint in body.joints if joint.name]
        if not body.name and moves and f"{moves[-1]}_link" not in taken:
            body.name = f"{moves[-1]}_link"
    return found


def one_file(robot: str) -> str:
    """Returns a robot as the text of one MJCF; as it was written, where it refers to no other file.

    Args:
      robot: path of the MJCF.

    Raises:
      ValueError: it cannot be read, or not without its meshes.
    """
    text = Path(robot).read_text(encoding="utf-8")
    # A comment may speak of files.
    if not _OTHER_FILES.search(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)):
        return text
    try:
        return spec(robot).to_xml()
    except ValueError as error:
        raise ValueError(f"robot: {robot} without its meshes: {error}") from error


def without_files(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Returns a robot without what is stored in files of its own: meshes, height fields, skins and textures.

    Inertias that follow from a mesh are written out. So are all that the compiler computes anew each time, from
    geometries, a total mass or fused bodies: they would undo what is changed in them. Bodies stay as they are, also
    where the model asks for static ones to be fused. Contacts of meshes are lost, and sensors that name one; on a test
    rig there are none.

    Args:
      spec: of the robot; it may be changed.

    Raises:
      ValueError: a file is missing.
    """
    textures = [texture for texture in spec.textures if texture.file or any(texture.cubefiles)]
    elements = (*spec.meshes, *spec.hfields, *spec.skins, *textures)
    compiler = spec.compiler
    anew = (
        compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        or compiler.settotalmass > 0
        or compiler.fusestatic
    )
    if not elements and not anew:
        return spec
    whole = spec.copy()
    whole.compiler.fusestatic = whole.compiler.discardvisual = False
    model = whole.compile()
    filed = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)
    lost_geoms = []
    for body, compiled in zip(spec.bodies, whole.bodies, strict=True):
        # A primitive may be fitted to a mesh, which it then names.
        mine = [geom for geom in body.geoms if geom.type in filed or geom.meshname]
        if (mine or anew) and body.name != "world":
            write_inertia(body, model, compiled.id)
        lost_geoms += mine
    _delete_geoms(spec, lost_geoms)
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    compiler.settotalmass, compiler.fusestatic = -1.0, False
    lost = {texture.name for texture in textures}
    for material in spec.materials:
        material.textures = ["" if name in lost else name for name in material.textures]
    for element in elements:
        spec.delete(element)
    return spec


def _delete_geoms(spec: mujoco.MjSpec, geoms: Sequence[mujoco.MjsGeom]) -> None:
    """Deletes geoms, and before them the contact pairs and sensors that name one."""
    names = {geom.name for geom in geoms} - {""}
    kind = mujoco.mjtObj.mjOBJ_GEOM
    named = [pair for pair in spec.pairs if names & {pair.geomname1, pair.geomname2}]
    for sensor in spec.sensors:
        objects = ((sensor.objtype, sensor.objname), (sensor.reftype, sensor.refname))
        if any(of == kind and name in names for of, name in objects):
            named.append(sensor)
    for element in (*named, *geoms):
        spec.delete(element)


def with_rotors(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Gives joints the rotors and dampers that their actuators have (MJCF's `actuator/armature` and `damping`).

    MuJoCo has them act through the square of the gear. MJX has none, and a rig brings motors of its own.

    Args:
      spec: of the robot; it is changed.

    Raises:
      ValueError: such an actuator acts on something else, as a tendon.
    """
    for actuator in spec.actuators:
        damping = np.asarray(actuator.damping)
        if actuator.armature == 0 and not damping.any():
            continue
        if actuator.trntype not in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            raise ValueError(f"actuator '{actuator.name}': got an armature or damping, expected them on a joint alone")
        joint = spec.joint(actuator.target)
        joint.armature += actuator.gear[0] ** 2 * actuator.armature
        joint.damping = np.asarray(joint.damping) + actuator.gear[0] ** 2 * damping
        actuator.armature, actuator.damping = 0.0, np.zeros_like(damping)
    return spec


def write_inertia(body: mujoco.MjsBody, model: mujoco.MjModel | mjx.Model, number: int) -> None:
    """Gives a body mass and inertia of its own, those of a body of a model, in whatever form they were before.

    Args:
      body: of a spec.
      model: that has them.
      number: of the body in the model. One without mass is left as it is.
    """
    if not model.body_mass[number]:
        return
    # Without this the compiler would compute mass and inertia from the geometries again.
    body.explicitinertial = True
    inertia = np.array(model.body_inertia[number], float)
    # A disc has as much about its axis as about the two others together. Rounding would make it more, which the
    # compiler refuses.
    low, middle, high = np.argsort(inertia)
    inertia[low] = max(inertia[low], (1.0 + _ROUNDING) * inertia[high] - inertia[middle])
    body.mass, body.inertia = float(model.body_mass[number]), inertia
    body.ipos, body.iquat = (np.asarray(getattr(model, f"body_{field}")[number], float) for field in ("ipos", "iquat"))
    # The compiler refuses a body that has both forms of inertia, and prefers other forms of an orientation.
    body.fullinertia = np.full(6, np.nan)
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


_ROUNDING = 2e-5  # relative, of three numbers of six digits
_SMALL = 0.1  # of the mass of the largest body that a body is fixed to
_PHYSICS = ("constraint", "equality", "frictionloss", "limit", "spring", "damper", "gravity")


def check_flags(spec: mujoco.MjSpec, clear: bool = False) -> tuple[str, ...]:
    """Refuses a model whose flags switch physics off that effects need, or clears these flags.

    Args:
      spec: of the robot; it is changed where flags are cleared.
      clear: whether to clear them.

    Returns:
      Names of the flags that were cleared.

    Raises:
      ValueError: there are some, and they are not to be cleared.
    """
    bits = {name: int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}")) for name in _PHYSICS}
    off = tuple(name for name, bit in bits.items() if spec.option.disableflags & bit)
    if off and not clear:
        raise ValueError(
            f"robot: option flag: got {', '.join(off)} disabled, expected enabled: no effect that works through it "
            "could be seen. Correct the MJCF, or clear the flags with --clear-flags"
        )
    for name in off:
        spec.option.disableflags &= ~bits[name]
    return off


def suspended(spec: mujoco.MjSpec, joints: Sequence[str] | None = None) -> mujoco.MjModel:
    """Compiles a robot as it is on a test rig: without its free joints, and with contacts switched off.

    Its own actuators, sensors and keyframes are left out, and its choice of a solver, an integrator and diagnostics:
    who simulates a rig brings torques, readings and these. Gravity compensation that went through actuators stays, and
    so do their rotors (`with_rotors`).

    Args:
      spec: of the robot; it is copied, not changed.
      joints: those that are read. Others are held where the model puts them (`envs.held`); None if all are read.
    """
    spec = with_rotors(without_files(spec.copy()))
    still = [] if joints is None else held.elements(spec, joints)
    for element in (*spec.keys, *spec.actuators, *spec.sensors, *spec.pairs, *spec.tuples, *still, *free_joints(spec)):
        spec.delete(element)
    for joint in spec.joints:
        joint.actgravcomp = False
    for body in spec.bodies:
        # What the compiler would leave out of the inertia matrix may be there once a centre of mass is another.
        body.simple = False
    default = mujoco.MjOption()
    for name in ("solver", "integrator", "enableflags", "noslip_iterations"):
        setattr(spec.option, name, getattr(default, name))
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model


def free_joints(spec: mujoco.MjSpec) -> list:
    """Lists the free joints of a robot: those of a base that moves, or hangs on the test rig."""
    return [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]


def hinges(model: mujoco.MjModel, joints: Sequence[str]) -> np.ndarray:
    """Tells hinges (in rad) from slides (in m), [joints]."""
    return np.array([model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_HINGE for name in joints])


def links(model: mujoco.MjModel) -> np.ndarray:
    """Numbers of the bodies of a suspended robot that effects may have as places.

    They move, and have a mass and a name. Of bodies that are fixed to each other, those with a tenth of the largest
    one's mass or less are left out: what changes in a fingertip could as well be in the hand. So is what has no joint
    but moves all the same, since a simulation puts it anywhere (a mocap body).
    """
    group, mass = model.body_weldid, model.body_mass
    largest = np.zeros(model.nbody)
    np.maximum.at(largest, group, mass)
    moves = (group > 0) & (model.body_mocapid[group] < 0)
    named = np.array([bool(model.body(number).name) for number in range(model.nbody)])
    return np.flatnonzero(moves & named & (mass > _SMALL * largest[group]))
