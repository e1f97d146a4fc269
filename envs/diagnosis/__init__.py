"""What is wrong with a log itself, before anything is learnt from it.

Structure first: time stamps, rows, steps of rounding, clipping. Then physics, by trying: a repair (two joints
exchanged, a sign turned, degrees made radians, an offset or a delay taken out, a clock set right) is believed where the
log agrees much better with itself and with the model after it. Agreement has up to five parts for every joint, each
between none (0) and all of it (2) of the signal's own size:

- measured velocities are the slopes of measured positions;
- the controller's torque is what the model needs for the measured motion (robots that are hung or clamped);
- the measured torque is the controller's;
- positions follow their targets, and stay within the joints' ranges.

Repairs are looked for one after the other, the best first.
"""

import mujoco

from envs.diagnosis.finding import Finding
from envs.diagnosis.physics import physics
from envs.diagnosis.structure import structure
from envs.logs import Run

__all__ = ["Finding", "diagnose"]

_LEAST_ROWS = 100  # in one piece


def diagnose(run: Run, joints: tuple[str, ...], model: mujoco.MjModel, base: str = "fixed") -> list[Finding]:
    """Everything that is suspected of a run.

    Args:
      run: as it was read.
      joints: of the log.
      model: of the robot, hung (`envs.rig.hung`) where the base is fixed.
      base: fixed or free; what a robot on the ground needs of its joints depends on forces that nobody measured.
    """
    found, clean = structure(run)
    if len(clean.time) < _LEAST_ROWS:
        text = f"no more than {len(clean.time)} rows follow on each other in order: nothing else can be said"
        return [*found, Finding("in pieces", "t", (), float(len(clean.time)), text)]
    return found + physics(clean, joints, model, base == "fixed")
