"""What carries a robot's links: the joints before them, and a controller that holds their weight (`gravcomp`)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from jaxtune import devices


@dataclass(frozen=True)
class Lift:
    """What a controller adds to carry a robot's weight (MJCF's `gravcomp`): that of the nominal model's links."""

    bodies: np.ndarray
    """[lifted] ids of the bodies."""
    points: np.ndarray
    """[lifted, 3] m, their nominal centres of mass, in their frames."""
    forces: np.ndarray
    """[lifted, 3] N in the world."""

    @staticmethod
    def of(model: mujoco.MjModel) -> "Lift | None":
        """Reads it off a nominal model; None where no link is carried."""
        bodies = np.flatnonzero(model.body_gravcomp)
        if not len(bodies):
            return None
        weights = (model.body_mass * model.body_gravcomp)[bodies, None] * model.opt.gravity
        return Lift(bodies, model.body_ipos[bodies].copy(), -weights)

    @property
    def layout(self) -> tuple[bytes, ...]:
        """All of it, as compiled programs hold it."""
        return self.bodies.tobytes(), self.points.tobytes(), self.forces.tobytes()

    @devices.precisely
    def torques(self, model: mjx.Model, data: mjx.Data) -> jax.Array:
        """Computes its torques on the joints, [dofs] Nm, where `data` says that the links are."""

        def of(body, point, force):
            there = data.xpos[body] + data.xmat[body] @ point
            return mjx.jac(model, data, there, body)[0] @ force

        points, forces = (jnp.asarray(rows, jnp.float32) for rows in (self.points, self.forces))
        return jax.vmap(of)(jnp.asarray(self.bodies), points, forces).sum(axis=0)


def carriers(model: mujoco.MjModel, dof: np.ndarray) -> np.ndarray:
    """Finds the joint that carries each joint, [joints] indices; as many as joints where none does.

    Args:
      model: of the robot.
      dof: addresses of the joints' velocities.
    """
    numbers = {int(address): number for number, address in enumerate(dof)}
    found = []
    for address in dof:
        parent = int(model.dof_parentid[address])
        while parent >= 0 and parent not in numbers:
            parent = int(model.dof_parentid[parent])
        found.append(numbers.get(parent, len(dof)))
    return np.array(found)
