"""The repairs that the log doctor tries on a run, and what each would mean."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from envs.diagnosis.disagreement import Disagreement
from envs.diagnosis.finding import MEASURED
from envs.logs import Run

_DELAYS_S = (0.004, 0.008, 0.012, 0.016, 0.024, 0.032, 0.045)
_LONGEST_DELAY = 0.25  # of the rows, so that most of them remain
_LEAST_OFFSET_RAD = 0.025
_FAR = {"dq": 1.5, "tau": 3.0, "controller": 3.0}  # least factor, up or down, that no clock, motor or friction explains
_UNITS = (np.pi / 180.0, 180.0 / np.pi, 1e-3)
_NAMED = {"dq": _UNITS, "tau": (1e-3,), "controller": _UNITS}  # factors that other repairs have
_ROOM = 1.7  # around these
_FASTER = 0.2  # of a joint's rms speed, above which friction has one size
_BETTER = 0.25  # share of the squared error with dry friction that is left with a factor
_ALIKE = 0.9  # least cosine of two signals, one of which is the other in another unit


@dataclass(frozen=True)
class Repair:
    """One repair to be tried: what it would mean, and the function that applies it."""

    kind: str
    signal: str
    joints: tuple[int, ...]
    size: float
    apply: Callable[[Run], Run]
    places: tuple[int, ...] = ()
    """Joints that a change of units changes, also where it is of all hinges and names none."""
    factors: tuple[float, ...] = ()
    """By which a signal of each of the joints is multiplied, where they were found from the run."""


def possible_repairs(run: Run, disagreement: Disagreement, turns: np.ndarray) -> list[Repair]:
    """Lists every repair to be tried.

    Args:
      run: to be repaired.
      disagreement: of that run.
      turns: [joints] True for a hinge, False for a slide.
    """
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
            found.append(Repair("swapped joints", label, pair, 0.0, _on(names, lambda v, order=order: v[:, order])))
        for joint in range(count):
            sign = np.where(np.arange(count) == joint, -1.0, 1.0)
            found.append(Repair("flipped sign", label, (joint,), -1.0, _on(names, lambda v, sign=sign: v * sign)))
        # Torques are not angles, so a group is converted without them.
        angles = tuple(name for name in names if name != "tau")
        found += _positions(label, angles, turns) if angles else []
    if "tau" in run.signals:
        found.append(Repair("millinewtonmetres", "tau", (), 1e-3, _on(("tau",), lambda v: v * 1e-3)))
    found += _sizes(run, disagreement) + _delays(run, measured, disagreement)
    return found + _offsets(run, disagreement)


def _positions(label: str, names: tuple[str, ...], turns: np.ndarray) -> list[Repair]:
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
            found.append(Repair(kind, label, named, factor, _on(names, lambda v, factors=factors: v * factors), joints))
    return found


def _on(names: tuple[str, ...], change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Run], Run]:
    """Returns a function that changes some signals of a run."""
    return lambda run: replace(run, signals={**run.signals, **{name: change(run.signals[name]) for name in names}})


def _sizes(run: Run, disagreement: Disagreement) -> list[Repair]:
    """Repairs of sizes with a factor that is found from the run: velocities in rpm, torques before the gear, gains.

    Motors that are said to be off, while joints follow their targets, are among them.
    """
    found = []
    if "dq" in run.signals:
        found += _sized("dq", run.signals["dq"], disagreement.motion(run)[1])
    commanded = disagreement.commanded(run)
    needed, rows = disagreement.needed(run) if disagreement.dynamics else (None, slice(None))
    if "tau" in run.signals and commanded is not None:
        found += _sized("tau", run.signals["tau"], commanded)
    elif "tau" in run.signals and needed is not None:
        found += _by_the_model("tau", run.signals["tau"][rows], needed, disagreement.motion(run)[1][rows])
    if commanded is not None and needed is not None:
        law, speed = run.impedance()[rows], disagreement.motion(run)[1][rows]
        spring = law.stiffness * (run.signals["target"] - run.signals["q"])[rows]
        found += _by_the_model("controller", spring, needed + law.damping * speed, speed)
    if commanded is not None and "enabled" in run.signals and not (run.signals["enabled"] > 0).any():
        found.append(Repair("motors off", "enabled", (), 1.0, _on(("enabled",), np.ones_like)))
    return found


def _sized(signal: str, has: np.ndarray, should: np.ndarray) -> list[Repair]:
    """The repair of a signal [rows, joints] that is proportional to what it should be, but far smaller or larger."""
    one, other = (np.sqrt((values**2).sum(axis=0)) for values in (has, should))
    alike = np.abs((has * should).sum(axis=0)) > _ALIKE * one * other
    factors = np.divide(other, one, out=np.ones_like(one), where=(one > 0) & (other > 0) & alike)
    return _multiplied(signal, np.where(np.abs(np.log(factors)) > np.log(_FAR[signal]), factors, 1.0))


def _by_the_model(signal: str, has: np.ndarray, should: np.ndarray, speed: np.ndarray) -> list[Repair]:
    """The repair of torques that the model needs in another size, by one factor, and not since dry friction is in them.

    One for all joints, because a load or a weak motor explains it at some.

    Args:
      signal: what would be multiplied.
      has: [rows, joints] Nm.
      should: what the model needs, [rows, joints] Nm.
      speed: [rows, joints] rad/s.
    """
    moves = np.abs(speed) > _FASTER * np.sqrt((speed**2).mean(axis=0))
    has, should, way = (np.where(moves, values, 0.0) for values in (has, should, np.sign(speed)))
    friction = way * ((has - should) * way).sum(axis=0) / np.maximum(moves.sum(axis=0), 1)
    factor = float((has * should).sum() / max((has**2).sum(), 1e-12))
    left = [((model - should) ** 2).sum() for model in (factor * has, has - friction)]
    if factor <= 0 or left[0] > min(_BETTER * left[1], (1.0 - _ALIKE**2) * (should**2).sum()):
        return []
    return _multiplied(signal, np.full(has.shape[1], factor if abs(np.log(factor)) > np.log(_FAR[signal]) else 1.0))


def _multiplied(signal: str, factors: np.ndarray) -> list[Repair]:
    """The repair that multiplies a signal, or kp, by factors [joints]; none where all are one, or a unit's."""
    wrong = np.log(factors)[factors != 1.0]
    if not len(wrong) or any((np.abs(wrong - np.log(one)) < np.log(_ROOM)).all() for one in _NAMED[signal]):
        return []
    places = tuple(int(place) for place in np.flatnonzero(factors != 1.0))
    kind, apply = "scale", _on((signal,), lambda values: values * factors)
    if signal == "controller":
        kind, apply = "gains", partial(_stiffer, factors)
    return [Repair(kind, signal, places, float(np.exp(wrong.mean())), apply, places, tuple(np.exp(wrong)))]


def _stiffer(factors: np.ndarray, run: Run) -> Run:
    """The run as with other gains: kp multiplied by factors [joints]."""
    gains = {**run.controller.gains, "kp": run.controller.gains["kp"] * factors}
    return replace(run, controller=replace(run.controller, gains=gains))


def _delays(run: Run, measured: tuple[str, ...], disagreement: Disagreement) -> list[Repair]:
    """Repairs of a delay: all measured signals taken earlier, or velocities alone."""
    period, found = float(np.median(np.diff(run.time))), []
    # Only the inverse dynamics distinguish a delay from the time that a joint takes to follow its target; behind coarse
    # encoders and without torques they are not compared.
    told_apart = "dynamics" in disagreement.parts(run)
    groups = {"dq": ("dq",)} | ({"measured": measured} if told_apart else {})
    for label, names in groups.items():
        for delay in _DELAYS_S if "target" in run.signals and set(names) <= set(measured) else ():
            rows = round(delay / period)
            if 0 < rows <= _LONGEST_DELAY * len(run.time):
                found.append(Repair("late", label, (), rows * period, partial(_earlier, names, rows)))
    return found


def _earlier(names: tuple[str, ...], rows: int, run: Run) -> Run:
    """Takes some signals of a run some rows earlier."""
    signals = {name: values[rows:] if name in names else values[:-rows] for name, values in run.signals.items()}
    return replace(run, time=run.time[:-rows], signals=signals)


def _offsets(run: Run, disagreement: Disagreement) -> list[Repair]:
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
            found.append(Repair("offset", "q", (joint,), -offset, _on(("q",), lambda v, shift=shift: v + shift)))
    return found
