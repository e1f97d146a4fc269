"""What every log leaves uncertain beside the model's own parameters; these rows are fitted, and never named as missing.

A controller's damping gain is rarely known to a percent, the constants of a servo's motor are those of a data sheet,
and the inertia of a link is known no better than its mass. Few logs say how their targets went on between two rows, and
a torque that was computed from a motor's current is as good as its constant. The engine's dry friction lets a joint
creep under a load, which that of gears does not. Logs of most simulators have positions of half a step later than
velocities and torques. Discovery fits these under every hypothesis, or it would call them a delay, friction, a load or
a weak motor.
"""

import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from envs.effects.actuator import scaled
from jaxtune.types import Effect, Parameter

_LEAST_CREEP = 0.01  # of the engine's; friction that is stiffer makes a solver slow, and holds no better


def _target_between_rows(values, target, now, memory):
    """target' = target + share (linear - held): targets that move on in a straight line to the next row."""
    return target + values["share"] * now.between, memory


def _holding(values, model: mjx.Model, dof: np.ndarray) -> mjx.Model:
    """Makes dry friction stiffer: the creep, (1 - d) / d of an impedance d, falls to a hundredth at a share of one."""
    least, most = model.dof_solimp[dof, 0], model.dof_solimp[dof, 1]
    creep = (1.0 - least) / least * _LEAST_CREEP ** values["share"]
    stiff = jnp.where(values["share"] > 0, 1.0 / (1.0 + creep), least)
    solimp = model.dof_solimp.at[dof, 0].set(stiff).at[dof, 1].set(jnp.maximum(stiff, most))
    return model.replace(dof_solimp=solimp)


def _position_lead(values, readings, now, memory):
    """q'(t) = q(t + seconds): positions of semi-implicit Euler, to first order; velocities are as they were.

    Where none were recorded, velocities were estimated from such positions, and lead by `velocity_seconds`; only
    `undo` uses it.
    """
    del now
    return readings.at[0].add(values["seconds"] * readings[1]), memory


def _undo_lead(values, readings, dt):
    """q(t) = q'(t - seconds) and v(t) = v'(t - velocity_seconds), to first order."""
    position, velocity = readings[:, 0], readings[:, 1]
    later = values["velocity_seconds"] * jnp.gradient(velocity, dt, axis=0)
    return readings.at[:, :2].set(jnp.stack([position - values["seconds"] * velocity, velocity - later], axis=1))


ROWS = (
    Effect(
        name="holding",
        family="joint_friction",
        on="joint",
        enters="model",
        parameters=(Parameter(name="share", bounds=(0.0, 1.0), prior=0.5),),
        sizes=(0.2,),
        act=_holding,
        sentence="Dry friction holds the joint, where the engine's lets it creep under a load.",
        excited_by="a load that is held for seconds",
    ),
    Effect(
        name="damping_gain",
        family="actuator",
        on="joint",
        enters="speed",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.05),),
        sizes=(0.05,),
        act=scaled,
        sentence="The controller's damping gain is not the one that was set.",
        excited_by="chirps at two controller gains",
    ),
    Effect(
        name="back_emf",
        family="actuator",
        on="joint",
        enters="back_emf",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.1),),
        sizes=(0.05,),
        act=scaled,
        sentence="The motor's back electromotive force brakes more, or less, than its constants say.",
        excited_by="a swing with the motor's terminals closed",
    ),
    Effect(
        name="link_inertia",
        family="inertia",
        on="body",
        enters="model",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.1, fields=("body_inertia",)),),
        sizes=(0.05,),
        sentence="The link's mass is spread farther from its centre, or nearer to it, than the model says.",
        excited_by="fast motion of the link about its centre",
    ),
    Effect(
        name="target_between_rows",
        family="actuator",
        on="robot",
        enters="command",
        parameters=(Parameter(name="share", bounds=(0.0, 1.0), prior=0.5),),
        sizes=(0.2,),
        act=_target_between_rows,
        sentence="Targets move on between two rows of the log.",
        excited_by="a log at a higher rate",
    ),
    Effect(
        name="position_lead",
        family="sensing",
        on="robot",
        enters="sensor",
        parameters=tuple(
            Parameter(name=name, bounds=(0.0, 0.005), prior=0.001) for name in ("seconds", "velocity_seconds")
        ),
        sizes=(0.001,),
        act=_position_lead,
        undo=_undo_lead,
        sentence="Positions are those of a moment after velocities and torques, as in a simulator's half step.",
        excited_by="fast swings at two controller gains",
    ),
    Effect(
        name="torque_reading",
        family="sensing",
        on="joint",
        enters="torque_reading",
        parameters=(Parameter(name="ratio", form="ratio", bounds=(-1.0, 1.0), prior=0.2),),
        sizes=(0.05,),
        act=scaled,
        sentence="The recorded torque is a multiple of the motor's.",
        excited_by="slow motion through postures of known gravity torque",
    ),
)
