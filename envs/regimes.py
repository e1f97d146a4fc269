"""What a joint was doing: the rows of a run by regime."""

import numpy as np

from envs.logs import Run
from envs.segments import smoothed

REGIMES = ("steady", "fast", "loaded", "reversal", "saturated", "motor off")
"""Later ones rule where two apply."""

_FAST, _LOADED, _STILL, _SATURATED = (
    1.5,
    1.5,
    0.15,
    0.98,
)  # shares of the joint's own root mean square, and of the limit


def regimes(run: Run) -> np.ndarray:
    """Index of the regime, [rows, joints]."""
    position, speed = np.moveaxis(smoothed(run), 1, 0)
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

    Of a run without targets the recorded torque is what was commanded, and nothing limited it.

    Args:
      run: as it was read.
      position: [rows, joints] rad, what the controller is taken to have read.
      speed: [rows, joints] rad/s, likewise.

    Returns:
      Torque and limit, [rows, joints] Nm each.
    """
    controller = run.impedance()
    if "target" not in run.signals:
        return run.signals["tau"], controller.limit
    return controller.torque(run.signals["target"], position, speed), controller.limit


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0)) + 1e-9
