"""Finds swapped joints, flipped signs, wrong units, offsets and delays by trying repairs; then drift and quantisation.

Drift and quantisation are looked for in the repaired run, because an encoder would look coarse in degrees.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import reduce

import mujoco
import numpy as np

from envs.diagnosis.disagreement import Disagreement, relative_difference
from envs.diagnosis.finding import Finding
from envs.diagnosis.repairs import Repair, possible_repairs
from envs.logs import Run
from envs.models import hinges
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
_DRIFT = (0.015, 0.5)  # of a clock; with more, velocities have another unit
_MOVES = 0.02  # of the largest motion, in rad or m, below which a joint counts as still
_COARSE = 0.004  # largest step of an encoder, as a share of the joint's range of motion


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
    turns = hinges(model, joints)
    now = disagreement(run)
    for _ in range(_MOST_REPAIRS):
        repairs = possible_repairs(run, disagreement, turns)
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


def _summed(repairs: list[Repair]) -> list[Repair]:
    """Makes one delay of those of one signal, which are taken back in steps."""
    total: dict[tuple, Repair] = {}
    for number, one in enumerate(repairs):
        key = (one.kind, one.signal) if one.kind == "late" else (number,)
        total[key] = replace(one, size=one.size + (total[key].size if key in total else 0.0))
    return list(total.values())


def _best(chains: list[list[Repair]], run: Run, disagreement: Disagreement) -> tuple[list[Repair], Run, float]:
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
    least, most = _DRIFT
    if not least <= abs(drift) <= most or np.ptp(ratio) > 0.5 * abs(drift) or apart[1] > 0.6 * apart[0]:
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
    "scale": "{signal}: {joints} would agree with the rest of the log if multiplied by {factors}; check the unit, and "
    "whether it was measured before a gear",
    "gains": "controller: kp of {joints} would agree with the motion and the model if multiplied by {factors}",
    "motors off": "enabled: is 0 in all rows, but joints follow their targets; correct the column",
    "late": "{signal}: an apparent delay of {size:.0f} ms",
    "offset": "{signal}: {joints} has a constant offset of {size:+.3f} rad",
}


def _as_finding(repair: Repair, joints: tuple[str, ...]) -> Finding:
    names = tuple(joints[joint] for joint in repair.joints)
    size = 1e3 * repair.size if repair.kind == "late" else repair.size
    kind = "degrees of one" if repair.kind == "degrees" and names else repair.kind
    factors = ", ".join(dict.fromkeys(f"{factor:.2g}" for factor in repair.factors))
    which = "all joints" if repair.factors and len(names) == len(joints) > 2 else " and ".join(names)
    sentence = _SENTENCES[kind].format(signal=repair.signal, joints=which, size=size, factors=factors)
    return Finding(repair.kind, repair.signal, names, size, sentence)
