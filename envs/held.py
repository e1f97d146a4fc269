"""Which joints of a robot are held still while a log reads others: those of a gripper, say, or of the other arm."""

from collections.abc import Sequence

import mujoco
import numpy as np

_BASE_FREEDOMS = 3  # degrees of freedom of a body on the world, from which on it is a base


def held_joints(spec: mujoco.MjSpec, joints: Sequence[str]) -> tuple[str, ...]:
    """Names the joints that are held still while others are read: a gripper, the other arm, or a base of slides.

    Joints are coupled by equalities, and by tendons that pull by themselves. Coupled ones of which none is read are
    held if an actuator moves one of them, directly or through a tendon that moves none but them. A base is held
    without an actuator: a body on the world with three degrees of freedom or more that carries joints that are read.
    All other joints that are not read may swing.

    Args:
      spec: of the robot.
      joints: names of those that are read.
    """
    still = elements(spec.copy(), joints)
    return tuple(one.name or f"joint {one.id}" for one in still if isinstance(one, mujoco.MjsJoint))


def unread_joints(model: mujoco.MjModel, joints: Sequence[str]) -> tuple[str, ...]:
    """Names the joints of a suspended robot that are not among those that are read."""
    names = (model.joint(number).name or f"joint {number}" for number in range(model.njnt))
    return tuple(name for name in names if name not in joints)


def independent_joints(spec: mujoco.MjSpec) -> tuple[str, ...]:
    """Names the hinges and slides that are not coupled to others, as fingers of a gripper often are."""
    model = spec.copy().compile()
    coupled = set().union(*(pair for pair in _couplings(model) if len(pair) > 1))
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return tuple(
        model.joint(number).name
        for number, kind in enumerate(model.jnt_type.tolist())
        if kind in kinds and number not in coupled
    )


def elements(
    spec: mujoco.MjSpec, joints: Sequence[str]
) -> list[mujoco.MjsEquality | mujoco.MjsTendon | mujoco.MjsJoint]:
    """Lists equalities, tendons and joints of a spec that are still because joints are held (`held_joints`).

    Deleted in this order, they leave the robot with these joints at zero, where the model is drawn.

    Args:
      spec: of the robot, without the files of its meshes; it is compiled, which numbers its elements.
      joints: names of those that are read.
    """
    read = set(joints)
    if all(joint.name in read or joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints):
        return []
    model = spec.compile()
    known = {joint.id for joint in spec.joints if joint.name in read}
    # A free joint is left out of a test rig in any case.
    unread = {joint.id for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE} - known
    bases, actuated = _bases(model, known), _actuated(model)
    couplings, held = _couplings(model) + bases, set()
    while unread:
        group = {unread.pop()}
        while more := [pair for pair in couplings if pair & group and not pair <= group]:
            group |= set().union(*more)
        unread -= group
        if not group & known and any(one <= group for one in actuated + bases):
            held |= group
    # What also holds on to a joint that is read does nothing: an equality that is off, or a tendon without a spring.
    equalities = _of_equalities(model)
    return [
        *(one for one in spec.equalities if equalities[one.id] & held),
        *(one for one in spec.tendons if _of_tendon(model, one.id) & held),
        *(one for one in spec.joints if one.id in held),
    ]


def _bases(model: mujoco.MjModel, known: set[int]) -> list[set[int]]:
    """Numbers of the joints of each base."""
    carrying = set()
    for joint in known:
        body = int(model.jnt_bodyid[joint])
        while body := int(model.body_parentid[body]):
            carrying.add(body)
    on_world = [_of_body(model, body) for body in carrying if model.body_parentid[body] == 0]
    ball = mujoco.mjtJoint.mjJNT_BALL
    freedoms = [sum(3 if model.jnt_type[joint] == ball else 1 for joint in joints) for joints in on_world]
    return [joints for joints, number in zip(on_world, freedoms, strict=True) if number >= _BASE_FREEDOMS]


def _actuated(model: mujoco.MjModel) -> list[set[int]]:
    """Numbers of the joints that each actuator moves, of those that act on joints or on tendons."""
    kinds, found = mujoco.mjtTrn, []
    for kind, (number, _) in zip(model.actuator_trntype.tolist(), model.actuator_trnid, strict=True):
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            found.append({int(number)})
        elif kind == kinds.mjTRN_TENDON:
            found.append(_of_tendon(model, number))
    return [joints for joints in found if joints]


def _couplings(model: mujoco.MjModel) -> list[set[int]]:
    """Numbers of the joints that do not move independently, by what couples them."""
    names = ("stiffness", "damping", "frictionloss", "limited", "armature", "stiffnesspoly", "dampingpoly")
    pulls = [np.asarray(getattr(model, f"tendon_{name}", np.zeros(model.ntendon)), float) for name in names]
    strong = np.any([one.any(axis=tuple(range(1, one.ndim))) for one in pulls], axis=0)
    active = [joints for joints, on in zip(_of_equalities(model), model.eq_active0, strict=True) if on]
    return active + [_of_tendon(model, number) for number in np.flatnonzero(strong)]


def _of_equalities(model: mujoco.MjModel) -> list[set[int]]:
    """Numbers of the joints that each equality couples."""
    kinds, found = mujoco.mjtEq, []
    columns = (model.eq_type, model.eq_objtype, model.eq_obj1id, model.eq_obj2id)
    for kind, of, *pair in np.transpose(columns).tolist():
        pair = [number for number in pair if number >= 0]
        if kind == kinds.mjEQ_JOINT:
            found.append(set(pair))
        elif kind == kinds.mjEQ_TENDON:
            found.append(set().union(*(_of_tendon(model, number) for number in pair)))
        elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            site = of == mujoco.mjtObj.mjOBJ_SITE
            found.append(_between(model, *(model.site_bodyid[pair] if site else pair)))
        else:
            found.append(set())
    return found


def _of_tendon(model: mujoco.MjModel, number: int) -> set[int]:
    """Numbers of the joints that change the length of a tendon."""
    kinds, joints, branch = mujoco.mjtWrap, set(), []
    first = model.tendon_adr[number]
    wraps = slice(first, first + model.tendon_num[number])
    for kind, index in zip(model.wrap_type[wraps].tolist(), model.wrap_objid[wraps], strict=True):
        if kind == kinds.mjWRAP_JOINT:
            joints.add(int(index))
        elif kind == kinds.mjWRAP_PULLEY:
            branch = []
        else:
            of_body = model.site_bodyid if kind == kinds.mjWRAP_SITE else model.geom_bodyid
            branch.append(int(of_body[index]))
            joints |= _between(model, branch[0], branch[-1])
    return joints


def _between(model: mujoco.MjModel, one: int, other: int) -> set[int]:
    """Numbers of the joints between two bodies: those that move one of them and not the other."""

    def above(body: int) -> set[int]:
        found = set()
        while body:
            found |= _of_body(model, body)
            body = int(model.body_parentid[body])
        return found

    return above(int(one)) ^ above(int(other))


def _of_body(model: mujoco.MjModel, body: int) -> set[int]:
    first = int(model.body_jntadr[body])
    return set(range(first, first + int(model.body_jntnum[body]))) if first >= 0 else set()
