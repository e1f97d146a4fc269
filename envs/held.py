"""Which joints of a robot are held still while a log reads others: those of a gripper, say, or of the other arm."""

from collections.abc import Sequence

import mujoco
import numpy as np

_BASE_MOVES = 3  # directions in which a body on the world moves at least, if it is a base


def held_joints(spec: mujoco.MjSpec, joints: Sequence[str]) -> tuple[str, ...]:
    """Names the joints that are held still while others are read: a gripper, the other arm, or a base of slides.

    A joint that is not read counts as held if the model has an actuator for it, or for one that it is tied to by an
    equality or a tendon. So does a body on the world that may move in three directions or more, none of which is read:
    it is the base. Joints that are tied to one that is read are not held, nor is one without a motor, which may swing.

    Args:
      spec: of the robot.
      joints: names of those that are read.
    """
    *_, still = elements(spec.copy(), joints)
    return tuple(joint.name or f"joint {joint.id}" for joint in still)


def independent_joints(spec: mujoco.MjSpec) -> tuple[str, ...]:
    """Names the hinges and slides that no equality and no tendon ties to others; fingers of a gripper often are."""
    model = spec.copy().compile()
    tied = set().union(*_ties(model))
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return tuple(
        model.joint(number).name
        for number, kind in enumerate(model.jnt_type.tolist())
        if kind in kinds and number not in tied
    )


def elements(spec: mujoco.MjSpec, joints: Sequence[str]) -> tuple[list, list, list]:
    """Lists equalities, tendons and joints of a spec that are still because joints are held (`held_joints`).

    Deleted in this order, they leave the robot with these joints held where the model puts them.

    Args:
      spec: of the robot, without the files of its meshes; it is compiled, which numbers its elements.
      joints: names of those that are read.
    """
    read = set(joints)
    if all(joint.name in read or joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints):
        return [], [], []
    model = spec.compile()
    known = {joint.id for joint in spec.joints if joint.name in read}
    # A free joint is left out of a test rig in any case.
    unread = {joint.id for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE} - known
    driven, ties, held = _driven(model), _ties(model), set()
    while unread:
        tied = {unread.pop()}
        while more := [tie for tie in ties if tie & tied and not tie <= tied]:
            tied |= set().union(*more)
        unread -= tied
        if not tied & known and tied & driven:
            held |= tied
    for body in range(1, model.nbody):
        mine = _joints_of(model, body)
        moves = sum(3 if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL else 1 for joint in mine)
        if model.body_parentid[body] == 0 and moves >= _BASE_MOVES and not mine & known:
            held |= mine
    equalities = _tied(model)
    return (
        [one for one in spec.equalities if equalities[one.id] & held],
        [one for one in spec.tendons if _joints_of_tendon(model, one.id) & held],
        [one for one in spec.joints if one.id in held],
    )


def _driven(model: mujoco.MjModel) -> set[int]:
    """Numbers of the joints that some actuator moves, directly or through a tendon."""
    kinds, found = mujoco.mjtTrn, set()
    for kind, (number, _) in zip(model.actuator_trntype.tolist(), model.actuator_trnid, strict=True):
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            found.add(int(number))
        elif kind == kinds.mjTRN_TENDON:
            found |= _joints_of_tendon(model, number)
    return found


def _ties(model: mujoco.MjModel) -> list[set[int]]:
    """Numbers of the joints that cannot move independently, by what ties them; a tendon does if it pulls by itself."""
    pulls = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_limited)
    strong = np.any([np.asarray(one, float) != 0 for one in pulls], axis=0)
    return _tied(model) + [_joints_of_tendon(model, number) for number in np.flatnonzero(strong)]


def _tied(model: mujoco.MjModel) -> list[set[int]]:
    """Numbers of the joints that each equality ties to each other."""
    kinds, found = mujoco.mjtEq, []
    columns = (model.eq_type, model.eq_objtype, model.eq_obj1id, model.eq_obj2id)
    for kind, of, *pair in np.transpose(columns).tolist():
        pair = [number for number in pair if number >= 0]
        if kind == kinds.mjEQ_JOINT:
            found.append(set(pair))
        elif kind == kinds.mjEQ_TENDON:
            found.append(set().union(*(_joints_of_tendon(model, number) for number in pair)))
        elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            site = of == mujoco.mjtObj.mjOBJ_SITE
            found.append(_between(model, *(model.site_bodyid[pair] if site else pair)))
        else:
            found.append(set())
    return found


def _joints_of_tendon(model: mujoco.MjModel, number: int) -> set[int]:
    first = model.tendon_adr[number]
    wraps = slice(first, first + model.tendon_num[number])
    kinds, numbers = model.wrap_type[wraps], model.wrap_objid[wraps]
    joints = {int(one) for one in numbers[kinds == mujoco.mjtWrap.mjWRAP_JOINT]}
    bodies = model.site_bodyid[numbers[kinds == mujoco.mjtWrap.mjWRAP_SITE]]
    return joints.union(*(_between(model, bodies[0], body) for body in bodies[1:]))


def _between(model: mujoco.MjModel, one: int, other: int) -> set[int]:
    """Numbers of the joints between two bodies: those that move one of them and not the other."""

    def above(body: int) -> set[int]:
        found = set()
        while body:
            found |= _joints_of(model, body)
            body = int(model.body_parentid[body])
        return found

    return above(int(one)) ^ above(int(other))


def _joints_of(model: mujoco.MjModel, body: int) -> set[int]:
    first = int(model.body_jntadr[body])
    return set(range(first, first + int(model.body_jntnum[body]))) if first >= 0 else set()
