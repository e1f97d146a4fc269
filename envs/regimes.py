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
    """What the controller asked for and the most it could have, [rows, joints] Nm."""
    gains = run.controller.gains
    if "target" not in run.signals:
        return run.signals["tau"], np.full(position.shape, np.inf)
    on = run.signals.get("enabled", np.ones(len(position)))[:, None]
    error = run.signals["target"] - position
    if run.controller.kind == "servo":
        limit = on * run.signals["volts"][:, None] * gains["kt"] / gains["resistance_ohm"] * np.ones_like(error)
        return limit * np.clip(gains["gain"] * error, -1, 1), limit
    limit = np.where(on > 0, gains["torque_limit_nm"] * np.ones_like(error), 0.0)
    return np.clip(on * (gains["kp"] * error - gains["kd"] * speed), -limit, limit), limit


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0)) + 1e-9
