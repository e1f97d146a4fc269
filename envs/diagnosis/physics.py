"""Orders, signs, units, offsets, delays and the clock, by trying repairs; rounding and clipping of what is repaired."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import combinations

import mujoco
import numpy as np

from envs.diagnosis.finding import MEASURED, Finding
from envs.logs import Run
from envs.segments import quantum_of, smoothed

_MOST = 2.0
_BETTER = 0.25  # by how much all parts together must agree better, in units of one joint's whole signal
_SHARE = 0.1  # and by which share of what they disagree
_MOST_REPAIRS = 3
_UNITS = ("degrees", "radians twice", "millinewtonmetres")
_ROWS = 250  # that the model is evaluated at, at most
_DELAYS_S = (0.004, 0.008, 0.012, 0.016, 0.024, 0.032, 0.045)
_LEAST_OFFSET_RAD = 0.025
_LEAST_DRIFT = 0.015
_COARSE = 0.004  # share of a joint's motion: larger steps of an encoder hide what matters
_CLIPPED = 0.01  # share of rows at a signal's own largest or smallest value
_LEAST_CLIPPED = 8  # and number


@dataclass(frozen=True)
class _Repair:
    """What is tried."""

    kind: str
    signal: str
    joints: tuple[int, ...]
    size: float
    apply: Callable[[Run], Run]


def physics(run: Run, joints: tuple[str, ...], model: mujoco.MjModel, held: bool) -> list[Finding]:
    """Orders, signs, units, offsets and delays that a run agrees better without."""
    run, found = _thinned(run), []
    # Accelerations behind coarse encoders say nothing.
    disagreement = _Disagreement(run, joints, model, held and not _is_coarse(run))
    now = disagreement(run)
    for _ in range(_MOST_REPAIRS):
        repairs = _repairs(run, disagreement)
        chain, repaired, then = _best([[repair] for repair in repairs], run, disagreement)
        if chain[0].kind in _UNITS or not _believed(now, then):
            # Nothing agrees in wrong units, so what is wrong beside them does not show alone.
            units = [repair for repair in repairs if repair.kind in _UNITS]
            others = [repair for repair in repairs if repair.kind in ("swapped joints", "flipped sign")]
            both = _best([[unit, other] for unit in units for other in others], run, disagreement)
            if _believed(min(now, then), both[2]):
                chain, repaired, then = both
        if not _believed(now, then):
            break
        found += [_as_finding(repair, joints) for repair in chain]
        run, now = repaired, then
    # In the model's units, or degrees would look coarse.
    return [*found, *_drift(run), *_coarse(run, joints), *_clipped(run, joints)]


def _best(chains: list[list[_Repair]], run: Run, disagreement: "_Disagreement") -> tuple[list[_Repair], Run, float]:
    """The repairs, one after the other, after which a run disagrees least; that run; and how much it still does."""
    found = [(chain, reduce(lambda run, repair: repair.apply(run), chain, run)) for chain in chains]
    return min(((chain, one, disagreement(one)) for chain, one in found), key=lambda each: each[2])


def _believed(now: float, then: float) -> bool:
    return now - then > max(_BETTER, _SHARE * now)


def _thinned(run: Run) -> Run:
    """No more rows than are needed, in the piece in which most is moved."""
    count = 6 * _ROWS
    if len(run.time) <= count:
        return run
    moved = np.abs(np.diff(run.signals["q"], axis=0, prepend=run.signals["q"][:1])).sum(axis=1).cumsum()
    start = int(np.argmax(moved[count:] - moved[:-count]))
    rows = slice(start, start + count)
    return replace(run, time=run.time[rows], signals={name: values[rows] for name, values in run.signals.items()})


class _Disagreement:
    """How much a run disagrees with itself and with the model, [0, 2] for every part and joint, summed.

    Args:
      run: as it was read; what is not in it is not examined.
      joints: of the log.
      model: of the robot.
      dynamics: whether torques are examined.
    """

    def __init__(self, run: Run, joints: tuple[str, ...], model: mujoco.MjModel, dynamics: bool):
        self._model, self._data, self.dynamics = model, mujoco.MjData(model), dynamics
        self._driven = "target" in run.signals and run.controller.kind == "pd"
        places = [model.joint(name) for name in joints]
        self._qpos = np.array([place.qposadr[0] for place in places])
        self._dof = np.array([place.dofadr[0] for place in places])
        limited = np.array([bool(model.jnt_limited[place.id]) for place in places])
        span = np.array([place.range for place in places])
        self._range = np.where(limited[:, None], span, [-np.inf, np.inf]).T

    def __call__(self, run: Run) -> float:
        """Of a run."""
        return float(sum(part.sum() for part in self.parts(run).values()))

    def parts(self, run: Run) -> dict[str, np.ndarray]:
        """By name, [joints]."""
        position, slope = np.moveaxis(smoothed(replace(run, signals={"q": run.signals["q"]})), 1, 0)
        found = {}
        if "dq" in run.signals:
            found["velocity"] = _apart(run.signals["dq"], slope)
        commanded = self.commanded(run)
        if commanded is not None and "tau" in run.signals:
            found["torque"] = _apart(run.signals["tau"], commanded)
        if "target" in run.signals:
            found["target"] = 0.5 * _apart(run.signals["target"], position)
        low, high = self._range
        found["range"] = _MOST * ((position < low - 0.1) | (position > high + 0.1)).mean(axis=0)
        given = commanded if commanded is not None else run.signals.get("tau")
        if self.dynamics and given is not None:
            needed, rows = self.needed(run, position, slope)
            found["dynamics"] = _apart(_together(given)[rows], needed)
        return found

    def commanded(self, run: Run) -> np.ndarray | None:
        """Torque of the controller, [rows, joints]; None where it has none that is known."""
        if not self._driven:
            return None
        speed = run.signals["dq"] if "dq" in run.signals else smoothed(run)[:, 1]
        return run.impedance().torque(run.signals["target"], run.signals["q"], speed)

    def needed(self, run: Run, position: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Torque that the model needs for the motion [some rows, joints], and which rows."""
        acceleration = np.gradient(_together(slope), run.time, axis=0)
        # The ends are not smoothed.
        rows = np.unique(np.linspace(10, len(run.time) - 11, _ROWS).astype(int))
        found = np.empty((len(rows), len(self._dof)))
        for index, row in enumerate(rows):
            self._data.qpos[self._qpos], self._data.qvel[self._dof] = position[row], slope[row]
            self._data.qacc[self._dof] = acceleration[row]
            mujoco.mj_inverse(self._model, self._data)
            found[index] = self._data.qfrc_inverse[self._dof]
        return found, rows


def _together(values: np.ndarray) -> np.ndarray:
    """Means over a few rows, [rows, joints]."""
    kernel = np.ones(7) / 7.0
    return np.stack([np.convolve(column, kernel, "same") for column in values.T], axis=1)


def _apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How far two signals [rows, joints] are apart, as a share of the mean of their root mean squares, [joints]."""
    difference = np.sqrt(((one - other) ** 2).mean(axis=0))
    size = 0.5 * (np.sqrt((one**2).mean(axis=0)) + np.sqrt((other**2).mean(axis=0)))
    return np.minimum(difference / np.maximum(size, 1e-9), _MOST)


def _repairs(run: Run, disagreement: _Disagreement) -> list[_Repair]:
    """Everything that is tried."""
    count = run.signals["q"].shape[1]
    measured = tuple(name for name in MEASURED if name in run.signals)
    groups = {"measured": measured} | {name: (name,) for name in (*MEASURED, "target") if name in run.signals}
    groups["all"] = tuple(dict.fromkeys([*measured, *(["target"] if "target" in run.signals else [])]))
    found = []
    for label, names in groups.items():
        for pair in combinations(range(count), 2):
            order = np.arange(count)
            order[list(pair)] = pair[::-1]
            found.append(_Repair("swapped joints", label, pair, 0.0, _on(names, lambda v, order=order: v[:, order])))
        for joint in range(count):
            sign = np.where(np.arange(count) == joint, -1.0, 1.0)
            found.append(_Repair("flipped sign", label, (joint,), -1.0, _on(names, lambda v, sign=sign: v * sign)))
        angles = tuple(name for name in names if name != "tau")
        for kind, factor in (("degrees", np.pi / 180.0), ("radians twice", 180.0 / np.pi)) if angles else ():
            found.append(_Repair(kind, label, (), factor, _on(angles, lambda v, factor=factor: v * factor)))
    if "tau" in run.signals:
        found.append(_Repair("millinewtonmetres", "tau", (), 1e-3, _on(("tau",), lambda v: v * 1e-3)))
    return found + _delays(run, measured) + _offsets(run, disagreement)


def _on(names: tuple[str, ...], change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Run], Run]:
    """The run with some of its signals changed."""
    return lambda run: replace(run, signals={**run.signals, **{name: change(run.signals[name]) for name in names}})


def _delays(run: Run, measured: tuple[str, ...]) -> list[_Repair]:
    """What was measured, taken earlier; alone, and velocities alone."""
    period, found = float(np.median(np.diff(run.time))), []
    for label, names in {"measured": measured, "dq": ("dq",)}.items():
        for delay in _DELAYS_S if "target" in run.signals and set(names) <= set(measured) else ():
            rows = round(delay / period)
            if rows:
                found.append(_Repair("late", label, (), rows * period, partial(_earlier, names, rows)))
    return found


def _earlier(names: tuple[str, ...], rows: int, run: Run) -> Run:
    """The run with some of its signals taken some rows earlier."""
    signals = {name: values[rows:] if name in names else values[:-rows] for name, values in run.signals.items()}
    return replace(run, time=run.time[:-rows], signals=signals)


def _offsets(run: Run, disagreement: _Disagreement) -> list[_Repair]:
    """Positions moved by what the controller's torque lacks in the mean."""
    commanded = disagreement.commanded(run)
    if commanded is None or not disagreement.dynamics:
        return []
    position, slope = np.moveaxis(smoothed(replace(run, signals={"q": run.signals["q"]})), 1, 0)
    needed, rows = disagreement.needed(run, position, slope)
    free = np.abs(commanded[rows]) < 0.98 * run.controller.gains["torque_limit_nm"]
    on = run.signals.get("enabled", np.ones(len(run.time)))[rows, None] > 0
    lacks = np.where(free & on, commanded[rows] - needed, np.nan)
    found = []
    for joint, column in enumerate(lacks.T):
        if np.isnan(column).all():
            continue
        offset = float(np.nanmedian(column)) / run.controller.gains["kp"][joint]
        if abs(offset) >= _LEAST_OFFSET_RAD:
            shift = np.where(np.arange(len(run.signals["q"][0])) == joint, offset, 0.0)
            found.append(_Repair("offset", "q", (joint,), -offset, _on(("q",), lambda v, shift=shift: v + shift)))
    return found


def _drift(run: Run) -> list[Finding]:
    """A clock that runs fast or slow, by what velocities say of positions at all joints alike."""
    if "dq" not in run.signals:
        return []
    slope = smoothed(replace(run, signals={"q": run.signals["q"]}))[:, 1]
    ratio = (run.signals["dq"] * slope).sum(axis=0) / np.maximum((slope**2).sum(axis=0), 1e-12)
    drift = float(np.median(ratio) - 1.0)
    apart = [_apart(run.signals["dq"], slope * factor).mean() for factor in (1.0, np.median(ratio))]
    if abs(drift) < _LEAST_DRIFT or np.ptp(ratio) > 0.5 * abs(drift) or apart[1] > 0.6 * apart[0]:
        return []
    text = f"the clock runs {abs(drift):.1%} too {'fast' if drift > 0 else 'slow'}, by what velocities say of positions"
    return [Finding("clock drift", "t", (), drift, text)]


def _coarse(run: Run, joints: tuple[str, ...]) -> list[Finding]:
    quantum = quantum_of(run.signals["q"])
    if not _is_coarse(run):
        return []
    text = f"positions come in steps of {quantum:.3g} rad: what is smaller cannot be seen"
    return [Finding("quantised", "q", joints, quantum, text)]


def _is_coarse(run: Run) -> bool:
    return quantum_of(run.signals["q"]) > _COARSE * float(np.median(np.ptp(run.signals["q"], axis=0)))


def _clipped(run: Run, joints: tuple[str, ...]) -> list[Finding]:
    """Signals that stay at their own largest or smallest value, again and again."""
    found = []
    for name in ("q", "dq", "tau"):
        if name not in run.signals:
            continue
        values = run.signals[name]
        limit = (
            run.controller.gains.get("torque_limit_nm", np.full(values.shape[1], np.inf)) if name == "tau" else np.inf
        )
        quantum = max(quantum_of(values), 1e-9)
        for side, end in ((1.0, values.max(axis=0)), (-1.0, values.min(axis=0))):
            inward = side * (end - values)
            stays = (inward < 0.5 * quantum) & (np.abs(end) < 0.99 * limit)
            # What is rounded comes back to the same values, but to its ends no more often than to those beside them.
            beside = (inward < 3.5 * quantum).mean(axis=0) - stays.mean(axis=0)
            moving = np.ptp(values, axis=0) > 20 * quantum
            share = np.where(
                moving & (stays.sum(axis=0) >= _LEAST_CLIPPED) & (stays.mean(axis=0) > 2.0 * beside),
                stays.mean(axis=0),
                0.0,
            )
            for joint in np.flatnonzero(share > _CLIPPED):
                text = f"{name} of {joints[joint]} is cut off at {end[joint]:.4g}, in {share[joint]:.0%} of the rows"
                found.append(Finding("clipped", name, (joints[joint],), float(end[joint]), text))
    return found


_SENTENCES: Mapping[str, str] = {
    "swapped joints": "{signal}: {joints} are exchanged; say so under `columns` in meta.yaml",
    "flipped sign": "{signal}: {joints} turns the other way; say so under `sign` in meta.yaml, or turn the column",
    "degrees": "{signal}: angles are in degrees; say so under `units` in meta.yaml",
    "radians twice": "{signal}: angles are 57 times too small: they were made radians twice",
    "millinewtonmetres": "{signal}: torques are in mNm; say so under `units` in meta.yaml",
    "late": "{signal}: what was measured is {size:.0f} ms late",
    "offset": "{signal}: {joints} reads {size:+.3f} rad too much",
}


def _as_finding(repair: _Repair, joints: tuple[str, ...]) -> Finding:
    names = tuple(joints[joint] for joint in repair.joints)
    size = 1e3 * repair.size if repair.kind == "late" else repair.size
    sentence = _SENTENCES[repair.kind].format(signal=repair.signal, joints=" and ".join(names), size=size)
    return Finding(repair.kind, repair.signal, names, size, sentence)
