"""Finds swapped joints, flipped signs, wrong units, offsets and delays by trying repairs; then drift and quantisation.

Drift and quantisation are looked for in the repaired run, because an encoder would look coarse in degrees.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import combinations

import mujoco
import numpy as np

from envs.diagnosis.disagreement import Disagreement, relative_difference
from envs.diagnosis.finding import MEASURED, Finding
from envs.logs import Run
from envs.readings import quantum_of

# A repair is believed if the disagreement falls by more than both of these.
_BETTER = 0.25  # in units of one joint's whole signal
_SHARE = 0.1  # of the disagreement before
_MOST_REPAIRS = 3
_LEFT = 0.6  # of what the joints of a change of units disagree, and may still disagree after it
_LEAST_MOTION = (1e-3, 5.0)  # rad or m, and quanta: where all joints move less, nothing shows signs, order or units
_KEPT_ROWS = 1500  # of a long run; more take time and change nothing
_ANGLES = ("degrees", "radians twice", "millimetres")
_UNITS = (*_ANGLES, "millinewtonmetres")
_LEAST_UNITS = 1.0  # by which a change of units must lower `Disagreement.magnitudes` to be tried with another repair
_DELAYS_S = (0.004, 0.008, 0.012, 0.016, 0.024, 0.032, 0.045)
_LONGEST_DELAY = 0.25  # of the rows, so that most of them remain
_LEAST_OFFSET_RAD = 0.025
_LEAST_DRIFT = 0.015
_MOVES = 0.02  # of the largest motion, in rad or m, below which a joint counts as still
_COARSE = 0.004  # largest step of an encoder, as a share of the joint's range of motion


@dataclass(frozen=True)
class _Repair:
    """One repair to be tried: what it would mean, and the function that applies it."""

    kind: str
    signal: str
    joints: tuple[int, ...]
    size: float
    apply: Callable[[Run], Run]
    places: tuple[int, ...] = ()
    """Joints that a change of units changes, also where it is of all hinges and names none."""


def physics(run: Run, joints: tuple[str, ...], model: mujoco.MjModel, held: bool) -> list[Finding]:
    """Finds the repairs after which a run agrees best with itself and the model, and the defects of the repaired run.

    Args:
      run: a piece without structural defects (`structure`).
      joints: names of the joints, in the log's order.
      model: of the robot, suspended where its base is fixed.
      held: whether the base is fixed, so that the model's inverse dynamics hold.

    Returns:
      Findings: repairs in the order in which they were made, then drift of the clock and quantisation.
    """
    run, done = _thinned(run), []
    if not _moving(run).any():
        return _coarse(run, joints) if (np.ptp(run.signals["q"], axis=0) > _LEAST_MOTION[0]).any() else []
    # With coarse encoders accelerations are mostly rounding errors, so the inverse dynamics are not compared.
    disagreement = Disagreement(run, joints, model, held and not _is_coarse(run))
    turns = np.array([model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_HINGE for name in joints])
    now = disagreement(run)
    for _ in range(_MOST_REPAIRS):
        repairs = _repairs(run, disagreement, turns)
        chain, repaired, then = _best([[repair] for repair in repairs], run, disagreement)
        if chain[0].kind in _UNITS or not _believed(now, then):
            # Nothing agrees in wrong units, so a second error shows only once the units are repaired: try both at once.
            size = disagreement.magnitudes(run) - _LEAST_UNITS
            units = [one for one in repairs if one.kind in _UNITS and not one.joints]
            units = [one for one in units if disagreement.magnitudes(one.apply(run)) < size]
            others = [repair for repair in repairs if repair.kind in ("swapped joints", "flipped sign")]
            both = [[unit, other] for unit in units for other in others]
            if both and _believed(min(now, then), (best := _best(both, run, disagreement))[2]):
                chain, repaired, then = best
        if not _believed(now, then):
            break
        done += chain
        run, now = repaired, then
    found = [_as_finding(repair, joints) for repair in _summed(done)]
    return [*found, *_drift(run, disagreement), *_coarse(run, joints)]


def _summed(repairs: list[_Repair]) -> list[_Repair]:
    """Makes one delay of those of one signal, which are taken back in steps."""
    total: dict[tuple, _Repair] = {}
    for number, one in enumerate(repairs):
        key = (one.kind, one.signal) if one.kind == "late" else (number,)
        total[key] = replace(one, size=one.size + (total[key].size if key in total else 0.0))
    return list(total.values())


def _best(chains: list[list[_Repair]], run: Run, disagreement: Disagreement) -> tuple[list[_Repair], Run, float]:
    """Returns the chain of repairs after which a run disagrees least, the repaired run, and its disagreement."""
    found, before = [], disagreement.by_joint(run)
    for chain in chains:
        repaired = reduce(lambda run, repair: repair.apply(run), chain, run)
        after = disagreement.by_joint(repaired)
        # Wrong units spoil all that is compared of a joint. If much remains, sizes have changed for another reason.
        named = [list(one.places) for one in chain if one.kind in _ANGLES]
        explained = all(after[joints].sum() < _LEFT * before[joints].sum() for joints in named)
        found.append((chain, repaired, float(after.sum()) if explained else np.inf))
    return min(found, key=lambda each: each[2])


def _believed(now: float, then: float) -> bool:
    return now - then > max(_BETTER, _SHARE * now)


def _thinned(run: Run) -> Run:
    """Cuts a long run down to the piece in which the joints move most."""
    count = _KEPT_ROWS
    if len(run.time) <= count:
        return run
    moved = np.abs(np.diff(run.signals["q"], axis=0, prepend=run.signals["q"][:1])).sum(axis=1).cumsum()
    start = int(np.argmax(moved[count:] - moved[:-count]))
    rows = slice(start, start + count)
    return replace(run, time=run.time[rows], signals={name: values[rows] for name, values in run.signals.items()})


def _repairs(run: Run, disagreement: Disagreement, turns: np.ndarray) -> list[_Repair]:
    """Lists every repair to be tried; `turns` [joints] tells hinges from slides."""
    count = run.signals["q"].shape[1]
    # An error may be in one signal, in all signals of sensors (a mistake in the driver), or in targets as well.
    measured = tuple(name for name in MEASURED if name in run.signals)
    groups = {"measured": measured} | {name: (name,) for name in (*MEASURED, "target") if name in run.signals}
    groups["all"] = tuple(dict.fromkeys([*measured, *(["target"] if "target" in run.signals else [])]))
    found = []
    # Groups may be of the same signals; the first name is kept.
    for label, names in {names: (label, names) for label, names in reversed(groups.items())}.values():
        for pair in combinations(range(count), 2):
            order = np.arange(count)
            order[list(pair)] = pair[::-1]
            found.append(_Repair("swapped joints", label, pair, 0.0, _on(names, lambda v, order=order: v[:, order])))
        for joint in range(count):
            sign = np.where(np.arange(count) == joint, -1.0, 1.0)
            found.append(_Repair("flipped sign", label, (joint,), -1.0, _on(names, lambda v, sign=sign: v * sign)))
        # Torques are not angles, so a group is converted without them.
        angles = tuple(name for name in names if name != "tau")
        found += _positions(label, angles, turns) if angles else []
    if "tau" in run.signals:
        found.append(_Repair("millinewtonmetres", "tau", (), 1e-3, _on(("tau",), lambda v: v * 1e-3)))
    return found + _delays(run, measured, disagreement) + _offsets(run, disagreement)


def _positions(label: str, names: tuple[str, ...], turns: np.ndarray) -> list[_Repair]:
    """Repairs of the units of positions: of all hinges or all slides, and of one joint alone."""
    found = []
    for kind, factor, own in (
        ("degrees", np.pi / 180.0, turns),
        ("radians twice", 180.0 / np.pi, turns),
        ("millimetres", 1e-3, ~turns),
    ):
        places = tuple(np.flatnonzero(own))
        alone = [(joint,) for joint in places] if len(places) > 1 and kind != "radians twice" else []
        for joints in filter(None, (places, *alone)):
            factors = np.where(np.isin(np.arange(len(turns)), joints), factor, 1.0)
            # `units` in meta.yaml is about all hinges, so these are not named.
            named = () if len(joints) == turns.sum() and kind != "millimetres" else joints
            found.append(
                _Repair(kind, label, named, factor, _on(names, lambda v, factors=factors: v * factors), joints)
            )
    return found


def _on(names: tuple[str, ...], change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Run], Run]:
    """Returns a function that changes some signals of a run."""
    return lambda run: replace(run, signals={**run.signals, **{name: change(run.signals[name]) for name in names}})


def _delays(run: Run, measured: tuple[str, ...], disagreement: Disagreement) -> list[_Repair]:
    """Repairs of a delay: all measured signals taken earlier, or velocities alone."""
    period, found = float(np.median(np.diff(run.time))), []
    # Only the inverse dynamics distinguish a delay from the time that a joint takes to follow its target; behind coarse
    # encoders and without torques they are not compared.
    told_apart = "dynamics" in disagreement.parts(run) and not _is_coarse(run)
    groups = {"dq": ("dq",)} | ({"measured": measured} if told_apart else {})
    for label, names in groups.items():
        for delay in _DELAYS_S if "target" in run.signals and set(names) <= set(measured) else ():
            rows = round(delay / period)
            if 0 < rows <= _LONGEST_DELAY * len(run.time):
                found.append(_Repair("late", label, (), rows * period, partial(_earlier, names, rows)))
    return found


def _earlier(names: tuple[str, ...], rows: int, run: Run) -> Run:
    """Takes some signals of a run some rows earlier."""
    signals = {name: values[rows:] if name in names else values[:-rows] for name, values in run.signals.items()}
    return replace(run, time=run.time[:-rows], signals=signals)


def _offsets(run: Run, disagreement: Disagreement) -> list[_Repair]:
    """Repairs of a constant offset of positions.

    An offset shows as a constant difference of the controller's torque from what the model needs, kp times the offset.
    """
    commanded = disagreement.commanded(run)
    if commanded is None or not disagreement.dynamics:
        return []
    needed, rows = disagreement.needed(run)
    # A torque at its limit, at a stop or of motors that are off says nothing of the offset.
    free = disagreement.free(run)[rows] & (np.abs(commanded[rows]) < 0.98 * run.controller.gains["torque_limit_nm"])
    on = run.signals.get("enabled", np.ones(len(run.time)))[rows, None] > 0
    lacks = np.where(free & on, commanded[rows] - needed, np.nan)
    found = []
    for joint, (column, gain) in enumerate(zip(lacks.T, run.controller.gains["kp"], strict=True)):
        # A passive joint has no gain.
        if np.isnan(column).all() or not gain:
            continue
        # The median, because friction adds to the difference with both signs.
        offset = float(np.nanmedian(column)) / gain
        if abs(offset) >= _LEAST_OFFSET_RAD:
            shift = np.where(np.arange(len(run.signals["q"][0])) == joint, offset, 0.0)
            found.append(_Repair("offset", "q", (joint,), -offset, _on(("q",), lambda v, shift=shift: v + shift)))
    return found


def _drift(run: Run, disagreement: Disagreement) -> list[Finding]:
    """Finds a clock that runs fast or slow: velocities and slopes of positions differ by one factor at all joints."""
    moving = _moving(run)
    if "dq" not in run.signals or not moving.any():
        return []
    speed, slope = run.signals["dq"][:, moving], disagreement.motion(run)[1][:, moving]
    # With a fast clock time stamps are too far apart, and slopes of positions too small.
    ratio = (speed * slope).sum(axis=0) / np.maximum((slope**2).sum(axis=0), 1e-12)
    drift = float(np.median(ratio) - 1.0)
    apart = [relative_difference(speed, slope * factor).mean() for factor in (1.0, np.median(ratio))]
    if abs(drift) < _LEAST_DRIFT or np.ptp(ratio) > 0.5 * abs(drift) or apart[1] > 0.6 * apart[0]:
        return []
    pace = "fast" if drift > 0 else "slow"
    text = f"the clock drifts: it is {abs(drift):.1%} too {pace}, by velocities against positions"
    return [Finding("clock drift", "t", (), drift, text)]


def _coarse(run: Run, joints: tuple[str, ...]) -> list[Finding]:
    """Finds positions that were rounded more coarsely than the motion allows."""
    quantum = quantum_of(run.signals["q"]).max()
    if not _is_coarse(run):
        return []
    text = f"quantisation: positions come in steps of {quantum:.3g} rad; smaller motion cannot be seen"
    return [Finding("quantised", "q", joints, quantum, text)]


def _is_coarse(run: Run) -> bool:
    span = np.ptp(run.signals["q"], axis=0)
    # Joints that hardly move say nothing of the motion.
    moves = span > _MOVES * span.max()
    return not moves.any() or quantum_of(run.signals["q"])[moves].max() > _COARSE * float(np.median(span[moves]))


def _moving(run: Run) -> np.ndarray:
    """Tells which joints move far enough to be compared, [joints]."""
    least, quanta = _LEAST_MOTION
    return np.ptp(run.signals["q"], axis=0) > np.maximum(least, quanta * quantum_of(run.signals["q"]))


_SENTENCES: Mapping[str, str] = {
    "swapped joints": "{signal}: {joints} are swapped; map their `columns` in meta.yaml",
    "flipped sign": "{signal}: {joints} has a flipped sign; set its `sign` in meta.yaml, or negate the column",
    "degrees": "{signal}: degrees for radians; set `units: {{angle: deg}}` in meta.yaml",
    "degrees of one": "{signal}: {joints} alone is in degrees; multiply its columns by pi / 180",
    "radians twice": "{signal}: angles are 57 times too small; they were converted to radians twice",
    "millimetres": "{signal}: {joints} in mm, expected m; divide the columns by 1000",
    "millinewtonmetres": "{signal}: torques are in mNm; set `units: {{torque: mNm}}` in meta.yaml",
    "late": "{signal}: an apparent delay of {size:.0f} ms",
    "offset": "{signal}: {joints} has a constant offset of {size:+.3f} rad",
}


def _as_finding(repair: _Repair, joints: tuple[str, ...]) -> Finding:
    names = tuple(joints[joint] for joint in repair.joints)
    size = 1e3 * repair.size if repair.kind == "late" else repair.size
    kind = "degrees of one" if repair.kind == "degrees" and names else repair.kind
    sentence = _SENTENCES[kind].format(signal=repair.signal, joints=" and ".join(names), size=size)
    return Finding(repair.kind, repair.signal, names, size, sentence)
