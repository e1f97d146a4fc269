"""Fields of an MJX model that follow from its masses, inertias and armatures: `mj_setConst` in JAX.

Scaling `body_mass` alone leaves the masses of subtrees and the inverse weights, which scale every constraint, at their
old values. MuJoCo C recomputes them in `mj_setConst`; MJX has no counterpart. The reference is
`engine_setconst.c` of MuJoCo 3.
"""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from jaxtune import devices

DERIVED = (
    "body_subtreemass",
    "body_invweight0",
    "dof_M0",
    "dof_invweight0",
    "tendon_invweight0",
    "actuator_acc0",
    "stat.meaninertia",
)
"""Fields that `set_const` recomputes."""
_MIN_VALUE = mujoco.mjMINVAL


def set_const(model: mjx.Model) -> mjx.Model:
    """Recomputes every field that depends on masses, inertias and armatures.

    Call it after changing such a field with `model.replace`; `jaxtune.mjx.apply` does so itself. All is evaluated at
    the model's reference pose `qpos0`, with M the joint-space inertia and J the Jacobian of a body's centre of mass:

        body_subtreemass    mass of the body and of all that it carries, kg
        dof_M0              diagonal of M, without the armatures of tendons
        dof_invweight0      diagonal of M^-1, averaged over the axes of a free joint's translation, of its rotation and
                            of a ball joint
        body_invweight0     mean of the diagonal of J M^-1 J^T over the three axes, for translation and for rotation;
                            zero for bodies that are welded to the world
        tendon_invweight0   diagonal of J M^-1 J^T, J the Jacobian of the tendons
        actuator_acc0       norm of M^-1 m, m the moment arms of the actuator
        stat.meaninertia    mean of the diagonal of M

    `mj_setConst` leaves `stat.meaninertia` to the compiler; here it is kept true as well. Lengths of tendons, and
    fields of cameras and lights, are not recomputed.

    Args:
      model: a model whose masses, inertias or armatures may have been changed.

    Returns:
      The same model with these seven fields replaced. In single precision they differ from `mj_setConst`'s by a
      relative 2e-6 at most.

    Raises:
      ValueError: the model is not of MJX's JAX implementation, the only one that has these stages.
    """
    check_implementation(model)
    return _recomputed(model)


@jax.jit  # traced once, however many programs it is part of
@devices.precisely
def _recomputed(model: mjx.Model) -> mjx.Model:
    model = model.replace(body_subtreemass=_subtree_mass(model))
    data = mjx.make_data(model).replace(qpos=model.qpos0)
    # The stages of MuJoCo's pipeline that the fields below read from: poses, the inertia M, and moment arms.
    for stage in (mjx.kinematics, mjx.com_pos, mjx.tendon, mjx.crb, mjx.transmission):
        data = stage(model, data)
    diagonal = jnp.diagonal(mjx.full_m(model, data))
    inverse = jnp.linalg.inv(mjx.full_m(model, mjx.tendon_armature(model, data)))
    return model.replace(
        body_invweight0=_body_weight(model, data, inverse),
        dof_M0=diagonal,
        dof_invweight0=_dof_weight(model, inverse),
        tendon_invweight0=jnp.einsum("ti,ij,tj->t", data._impl.ten_J, inverse, data._impl.ten_J),
        actuator_acc0=jnp.linalg.norm(data._impl.actuator_moment @ inverse, axis=-1),
        stat=model.stat.replace(meaninertia=diagonal.mean()),
    )


def check_implementation(model: mjx.Model) -> None:
    """Checks that a model is of the implementation whose stages JAX can trace.

    Raises:
      ValueError: it is not.
    """
    if not hasattr(model, "impl"):
        raise ValueError(f"model: got {type(model).__name__}, expected mjx.Model; make it with mjx.put_model(model)")
    if model.impl != mjx.Impl.JAX:
        raise ValueError(
            f"model, impl: got '{model.impl.value}', expected 'jax'; make it with mjx.put_model(model, impl='jax') "
            "(in MuJoCo Playground: config_overrides={'impl': 'jax'})"
        )


def _subtree_mass(model: mjx.Model) -> jax.Array:
    """Mass of every body and of all that it carries, [bodies] kg."""
    subtree = model.body_mass
    # Children stand behind their parents, so a walk from the end has every child whole before it is added.
    for body in range(model.nbody - 1, 0, -1):
        subtree = subtree.at[model.body_parentid[body]].add(subtree[body])
    return subtree


def _body_weight(model: mjx.Model, data: mjx.Data, inverse: jax.Array) -> jax.Array:
    """Mean of the diagonal of J M^-1 J^T at every body's inertial frame, [bodies, 2]: translation and rotation."""
    jacobians = jax.vmap(lambda point, body: jnp.stack(mjx.jac(model, data, point, body)))(
        data.xipos, jnp.arange(model.nbody)
    )
    weight = jnp.einsum("bkid,ij,bkjd->bk", jacobians, inverse, jacobians) / 3
    # As in MuJoCo C: a body that is welded to the world has a weight of zero, every other one at least mjMINVAL.
    moves = jnp.asarray(model.body_weldid > 0)[:, None]
    return jnp.where(moves, jnp.maximum(weight, _MIN_VALUE), 0.0)


def _dof_weight(model: mjx.Model, inverse: jax.Array) -> jax.Array:
    """Diagonal of M^-1, [dof], averaged where several axes belong to one motion."""
    weight = jnp.diagonal(inverse)
    for joint, kind in enumerate(model.jnt_type):
        start = model.jnt_dofadr[joint]
        # A free joint has three axes of translation and three of rotation, a ball joint three of rotation.
        triples = {mujoco.mjtJoint.mjJNT_FREE: 2, mujoco.mjtJoint.mjJNT_BALL: 1}.get(mujoco.mjtJoint(kind), 0)
        for first in range(start, start + 3 * triples, 3):
            weight = weight.at[first : first + 3].set(weight[first : first + 3].mean())
    return weight
