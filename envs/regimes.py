"""Sorts the rows of a run by what each joint was doing, so that a misfit can be localised.

Effects show in different regimes: dry friction near a reversal, a torque limit where the controller saturates.
"""

import numpy as np

from envs.logs import Run

REGIMES = ("steady", "fast", "loaded", "reversal", "saturated", "motor off")
"""Names of the regimes; where two apply to a row, it gets the later one."""

# In units of the joint's own rms speed or rms torque in the run.
_FAST, _LOADED, _STILL = 1.5, 1.5, 0.15
_SATURATED = 0.98  # share of the controller's limit


def regimes(run: Run, states: np.ndarray) -> np.ndarray:
    """Assigns a regime to every joint at every row.

    `fast` and `loaded` are 1.5 times the joint's own rms of speed and of commanded torque, `reversal` is below 0.15 of
    the rms speed, `saturated` is within 2 % of the torque limit, and `steady` is what is left.

    Args:
      run: with positions, and targets or torques.
      states: [rows, 2, joints] rad and rad/s, of `smoothing.smoothed`.

    Returns:
      Indices into `REGIMES`, [rows, joints].
    """
    position, speed = np.moveaxis(states, 1, 0)
    torque, limit = control_torque(run, position, speed)
    found = np.zeros(position.shape, int)
    found[np.abs(speed) > _FAST * _rms(speed)] = REGIMES.index("fast")
    found[np.abs(torque) > _LOADED * _rms(torque)] = REGIMES.index("loaded")
    found[np.abs(speed) < _STILL * _rms(speed)] = REGIMES.index("reversal")
    found[(np.abs(torque) >= _SATURATED * limit) & (limit > 0)] = REGIMES.index("saturated")
    if "enabled" in run.signals:
        found[run.signals["enabled"] == 0] = REGIMES.index("motor off")
    return found


def control_torque(run: Run, position: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes the torque that the controller commanded, and the largest that it could have commanded.

    In a run without targets the recorded torques are the commanded ones, and nothing limited them.

    Args:
      run: as it was read.
      position: [rows, joints] rad, as the controller read it; mostly smoothed readings of the log.
      speed: [rows, joints] rad/s, likewise.

    Returns:
      Torque and limit, [rows, joints] Nm each.
    """
    controller = run.impedance()
    if "target" not in run.signals:
        return run.sent_torque(), controller.limit
    return controller.torque(run.signals["target"], position, speed), controller.limit


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0)) + 1e-9
