"""Measures how much a run disagrees with itself and with the model of its robot.

The log doctor tries a repair by comparing this number before and after it (`envs.diagnosis.physics`).
"""

from dataclasses import replace

import mujoco
import numpy as np

from envs.logs import Run
from envs.smoothing import smoothed

_MOST = 2.0  # disagreement of two signals that have opposite signs
_ROWS = 250  # at which inverse dynamics are evaluated, at most
_MEAN_S = 0.035  # over which accelerations are averaged; stamps that jitter make them noise over less
_LEAST_FREE = 0.1  # share of rows away from stops; of a joint with fewer the dynamics are unknown
_END = 7  # rows at either end of a run, where slopes are poor
_STOP = 0.02  # of a joint's range at either end, where a mechanical stop may carry any torque


class Disagreement:
    """Measures how much a run disagrees with itself and with the model; a repair is good if it lowers the number.

    It is the sum over joints of these parts, each from 0 to 2 (`target` to 1):

        velocity   dq against the slope of q
        torque     tau against the controller's torque
        target     target against q while motors are on, both about their means, since joints sag; weighted by half,
                   since joints lag behind
        range      share of rows outside the joint's range, times 2
        dynamics   the controller's (or the measured) torque against the model's inverse dynamics, away from stops

    Make it once for a run and call it with every repaired version of it.

    Args:
      run: as it was read. Parts whose signals it lacks are left out.
      joints: names of the joints, in the log's order.
      model: of the robot.
      dynamics: whether torques are compared with the model's inverse dynamics.
    """

    def __init__(self, run: Run, joints: tuple[str, ...], model: mujoco.MjModel, dynamics: bool):
        self._model, self._data, self.dynamics = model, mujoco.MjData(model), dynamics
        self._driven = "target" in run.signals and run.controller.kind == "pd"
        places = [model.joint(name) for name in joints]
        self._qpos = np.array([place.qposadr[0] for place in places])
        self._dof = np.array([place.dofadr[0] for place in places])
        limited = np.array([bool(model.jnt_limited[place.id]) for place in places])
        span = np.array([place.range for place in places])
        # Repairs leave most of a run as it is, so what was computed of positions is kept.
        self._smoothed: dict[int, np.ndarray] = {}
        self._free: dict[int, np.ndarray] = {}
        self._needed: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._range = np.where(limited[:, None], span, [-np.inf, np.inf]).T

    def __call__(self, run: Run) -> float:
        """Sums all parts over all joints, of a run with the same signals as the first one."""
        return float(self.by_joint(run).sum())

    def by_joint(self, run: Run) -> np.ndarray:
        """Sums all parts, [joints]."""
        return sum(self.parts(run).values())

    def parts(self, run: Run) -> dict[str, np.ndarray]:
        """Computes the parts by name, [joints] each. Parts whose signals the run lacks are left out.

        Use it to see which of the comparisons is responsible for a disagreement.
        """
        pairs = self._pairs(run)
        weights = {"target": 0.5}
        found = {name: weights.get(name, 1.0) * relative_difference(*pair) for name, pair in pairs.items()}
        if "dynamics" in found:
            # A repair must not seem good because it moves a joint into its stop.
            known = self.free(run).mean(axis=0) >= _LEAST_FREE
            found["dynamics"] = np.where(known, found["dynamics"], 1.0)
        position = self.motion(run)[0]
        low, high = self._range
        return found | {"range": _MOST * ((position < low - 0.1) | (position > high + 0.1)).mean(axis=0)}

    def magnitudes(self, run: Run) -> float:
        """Computes how much the sizes of compared signals differ, whatever their order and signs.

        Wrong units change it by the logarithm of their factor; swapped joints and flipped signs hardly change it. Use
        it to see cheaply whether units can be wrong at all.

        Returns:
          The sum over comparisons of the mean difference of logarithms of sizes, which are sorted over joints.
        """
        total = 0.0
        for pair in self._pairs(run).values():
            one, other = (np.sort(np.log(np.sqrt((values**2).mean(axis=0)) + 1e-6)) for values in pair)
            total += float(np.abs(one - other).mean())
        return total

    def _pairs(self, run: Run) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Lists the signals that should be equal, [rows, joints] each, by the name of their comparison."""
        position, slope = self.motion(run)
        found = {}
        if "dq" in run.signals:
            found["velocity"] = run.signals["dq"], slope
        commanded = self.commanded(run)
        if commanded is not None and "tau" in run.signals:
            found["torque"] = run.signals["tau"], commanded
        if "target" in run.signals:
            on = run.signals.get("enabled", np.ones(len(run.time))) > 0
            pair = run.signals["target"], position
            found["target"] = tuple(one[on] - one[on].mean(axis=0) if on.any() else 0.0 * one for one in pair)
        given = commanded if commanded is not None else run.signals.get("tau")
        if self.dynamics and given is not None:
            needed, rows = self.needed(run)
            free = self.free(run)[rows]
            # Averaged like the accelerations behind `needed`, so that both are equally smooth.
            found["dynamics"] = free * _together(given, run.time)[rows], free * needed
        return found

    def motion(self, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """Estimates smoothed positions in rad and their slopes in rad/s, [rows, joints] each.

        From positions alone, or the slopes would follow the velocities that they are compared with.
        """
        columns = np.ascontiguousarray(run.signals["q"].T)
        keys = [_key(run.time, column) for column in columns]
        new = {key: column for key, column in zip(keys, columns, strict=True) if key not in self._smoothed}
        if new:
            states = smoothed(replace(run, signals={"q": np.stack(list(new.values()), axis=1)}, known={}))
            self._smoothed |= dict(zip(new, np.moveaxis(states, 2, 0), strict=True))
        states = np.stack([self._smoothed[key] for key in keys], axis=2)
        return states[:, 0], states[:, 1]

    def commanded(self, run: Run) -> np.ndarray | None:
        """Computes the torque that the controller commanded, by its law and the readings of the log.

        Returns:
          [rows, joints] Nm; None for a servo, or where the log has no targets.
        """
        if not self._driven:
            return None
        speed = run.signals["dq"] if "dq" in run.signals else self.motion(run)[1]
        return run.impedance().torque(run.signals["target"], run.signals["q"], speed)

    def free(self, run: Run) -> np.ndarray:
        """Tells where a joint is away from the ends of its range, so that no stop carries its torque.

        Returns:
          [rows, joints]; False also a few rows before and after, since `needed` is smoothed.
        """
        key = _key(run.time, run.signals["q"])
        if key not in self._free:
            position, (low, high) = self.motion(run)[0], self._range
            ends = _STOP * np.where(np.isfinite(high - low), high - low, 0.0)
            away = _together((low + ends < position) & (position < high - ends), run.time)
            self._free[key] = away > 1.0 - 0.5 / _mean_rows(run.time)
        return self._free[key]

    def needed(self, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """Computes the torque that the model needs for the measured motion, by MuJoCo's inverse dynamics.

        Args:
          run: for its time stamps and positions.

        Returns:
          Torques [some rows, joints] Nm, and the indices of these rows.
        """
        key = _key(run.time, run.signals["q"])
        if key in self._needed:
            return self._needed[key]
        position, slope = self.motion(run)
        acceleration = np.gradient(_together(slope, run.time), run.time, axis=0)
        # Near an end the moving mean lacks rows, and the fit behind the smoothed states is one-sided.
        margin = _END + _mean_rows(run.time) // 2
        rows = np.unique(np.linspace(margin, len(run.time) - 1 - margin, _ROWS).astype(int))
        found = np.empty((len(rows), len(self._dof)))
        for index, row in enumerate(rows):
            self._data.qpos[self._qpos], self._data.qvel[self._dof] = position[row], slope[row]
            self._data.qacc[self._dof] = acceleration[row]
            mujoco.mj_inverse(self._model, self._data)
            found[index] = self._data.qfrc_inverse[self._dof]
        self._needed[key] = found, rows
        return self._needed[key]


def _key(*arrays: np.ndarray) -> int:
    return hash(tuple(values.tobytes() for values in arrays))


def _mean_rows(time: np.ndarray) -> int:
    """The odd number of rows that are averaged: seven, or as many as 35 ms have, up to a quarter of a short run."""
    half = round(0.5 * _MEAN_S / float(np.median(np.diff(time))))
    return 2 * max(3, min(half, len(time) // 8)) + 1


def _together(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Averages over neighbouring rows (a moving mean), [rows, joints]."""
    count = _mean_rows(time)
    return np.stack([np.convolve(column, np.ones(count) / count, "same") for column in values.T], axis=1)


def relative_difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Computes the rms difference of two signals, divided by the mean of their own rms, at most 2.

    All parts of a disagreement but `range` have this form.

    Args:
      one: [rows, joints].
      other: [rows, joints].

    Returns:
      [joints]: 0 where the signals are equal, 2 where they are opposite.
    """
    difference = np.sqrt(((one - other) ** 2).mean(axis=0))
    size = 0.5 * (np.sqrt((one**2).mean(axis=0)) + np.sqrt((other**2).mean(axis=0)))
    return np.minimum(difference / np.maximum(size, 1e-9), _MOST)
