"""Lists the hypotheses of discovery: every effect at every place alone, and at sets of places that are alike."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from envs.axes import Axis
from jaxtune.discovery.problem import Hypothesis
from jaxtune.types import Effect, Form, Parameter

_LARGE = 0.7  # of the bounds: the largest size that is screened
_TRAVEL_RAD, _MOST_TRAVELS = 0.002, 5.0  # over which dry friction sets in, and how many of these at most
_TORQUE_SHARE, _MOST_SHARES = 0.2, 3.0  # by which recorded torques are off, and how many of these at most
_HOLDING = 0.5  # standard deviation of the share of the engine's creep that a robot's dry friction lacks
_LONGEST_SIMULATED_S = 0.005  # step of a simulator from which a log may be
_OFFSET = 0.2  # typical offset of a torque sensor, as a share of the rms torque
_BENT, _STRAIGHT = 7, 3  # sizes of an effect without a slope at zero, and of one with


def hypotheses(
    axes: Sequence[Axis],
    places: Mapping[str, Sequence[str]],
    rows: Mapping[str, Effect],
    slides: Collection[str] = (),
) -> tuple[Hypothesis, ...]:
    """Lists the hypotheses about a robot, in the order of the library.

    An effect at several places has the same physical size at each of them. So a hypothesis has one direction in the
    rig's coordinates for each parameter, and this direction passes through all its places. What joints often have in
    sizes of their own (`Effect.differs`) is tried so at all of them as well.

    Args:
      axes: coordinates of the rig (the simulator with all effects built in).
      places: names of all joints, bodies and so on, by the kind of place that an effect may be on.
      rows: effects that are tried, by name.
      slides: joints that slide. A size in their units is no size of a hinge: 5 N s/m are not 5 Nm s/rad.
    """
    index = {(axis.effect, axis.parameter, axis.place): number for number, axis in enumerate(axes)}
    found = []
    for row in rows.values():
        sets = place_sets(places[row.on])
        in_units = row.on == "joint" and row.parameters[0].scale != "one"
        alike = _apart(sets, slides) if in_units else sets
        found += [_hypothesis(axes, index, row, chosen) for chosen in alike]
        if row.differs and len(places[row.on]) > 1:
            found.append(_each(axes, index, row, max(sets, key=len)))
    return tuple(found)


def forms(axes: Sequence[Axis], rows: Mapping[str, Effect], every: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Lists the forms that hypotheses may have.

    Args:
      axes: coordinates of the rig.
      rows: all rows of the rig, by name, those among them that only shape others.
      every: the hypotheses.
    """
    index = {(axis.effect, axis.parameter, axis.place): number for number, axis in enumerate(axes)}
    return tuple(
        _as_form(_hypothesis(axes, index, rows[form.effect], one.places, form.parameters), one, form)
        for one in every
        # They are those of the same effect with one size.
        if not one.each
        for form in rows[one.name].forms
    )


def _as_form(shape: Hypothesis, effect: Hypothesis, form: Form) -> Hypothesis:
    said = {name: getattr(form, name) for name in ("screened", "alone", "beside", "like", "far")}
    return replace(shape, form=form.name, name=effect.name, family=effect.family, **said)


_RIGHT = {"left": "right", "l": "r", "fl": "fr", "rl": "rr", "hl": "hr", "bl": "br"}
_RIGHT |= {"lf": "rf", "lr": "rr", "lh": "rh", "lb": "rb"}
_SIDES = {*_RIGHT, *_RIGHT.values(), "front", "rear", "hind", "back"}
_WORDS = re.compile(r"left|right|[a-z0-9]+?(?=left|right|[^a-z0-9]|$)", re.IGNORECASE)


def place_sets(places: Sequence[str]) -> list[tuple[str, ...]]:
    """Lists the sets of places at which an effect is tried.

    They are each place alone, pairs of left and right, all of one kind on several legs (such as four calves), and all
    places. Such sets are common in robots (the same motor in both knees), and one size for all of them is easier to
    confirm than a size for each. Sides are words of a name: `left`, `L`, `FL` (front left), `LH` (left hind), `rear`.
    """
    pairs = [(one, _mirrored(one)) for one in places if _mirrored(one) in places]
    kinds: dict[str, list[str]] = {}
    for place in places:
        kinds.setdefault(_kind(place), []).append(place)
    several = [tuple(kind) for kind in kinds.values() if len(kind) > 1]
    sets = [(place,) for place in places] + pairs + several + [tuple(places)]
    return _distinct(sets)


def _apart(sets: Sequence[tuple[str, ...]], slides: Collection[str]) -> list[tuple[str, ...]]:
    """Divides sets of joints into those of hinges and those of slides, each of them once."""
    parts = [tuple(one for one in chosen if (one in slides) == slide) for chosen in sets for slide in (False, True)]
    return _distinct([part for part in parts if part])


def _distinct(sets: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Takes every set once: the first of several in another order."""
    return list({frozenset(one): one for one in reversed(sets)}.values())[::-1]


def _mirrored(place: str) -> str | None:
    """Returns the name of the same place on the right, or None for a place that is not on the left."""
    for word in _WORDS.finditer(place):
        right = _RIGHT.get(word[0].lower())
        if right is not None:
            right = right.upper() if word[0].isupper() else right.title() if word[0].istitle() else right
            return place[: word.start()] + right + place[word.end() :]
    return None


def _kind(place: str) -> str:
    """Returns a name without its side."""
    return _WORDS.sub(lambda word: "" if word[0].lower() in _SIDES else word[0], place)


def unknown_directions(
    axes: Sequence[Axis],
    control_hz: float,
    signals: Sequence[str] = (),
    follows: bool = False,
    centres: Mapping[str, np.ndarray] = MappingProxyType({}),
    filter_s: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns directions in the rig's coordinates along what neither log nor model says, and their bounds.

    They are a delay of all readings, of all targets, and of velocities beside positions, how far positions lead
    velocities and torques, the share in which targets move on between two rows, how much less than the engine's the
    robot's dry friction lets joints creep, the travel over which the dry friction of the nominal model sets in, and the
    scale of recorded torques, with their offset where they are all that says how the robot was driven.

    A log does not say when within its period the controller read and acted, and no model says what friction does at
    rest or at a reversal. So discovery leaves these free under every hypothesis; otherwise a delay, a friction or a
    weak motor would be named for a robot that has none.

    Args:
      axes: coordinates of the rig.
      control_hz: rate of the controller in Hz.
      signals: that are compared.
      follows: whether the controller is one that follows measured motion (`envs.following`), of which all is known.
        What it asks for was measured, by sensors of unknown scale and offset.
      centres: by how much links' centres of mass may be off (`envs.rig.Rig.loose_centres`).
      filter_s: time constant of the filter that the log says its velocities went through. The controller may have acted
        on them.

    Returns:
      [unknowns, axes] of the size of half a period, of a quarter of a simulator's step, of half of the way between rows
      or to no creep, of a typical travel, or of a typical error of a motor's constant or of a sensor's offset; and
      [unknowns, 2] least and largest coordinate.
    """
    # Nothing acts before it is time, and nothing is later than a whole period.
    common = {"sensor_delay": 0.5 / control_hz, "holding": _HOLDING}
    common |= {} if follows else {"command_delay": 0.5 / control_hz, "target_between_rows": 0.5}
    # Velocities of positions that were read before and now are those of half of the time in between.
    latest = ("dq" in signals) / control_hz + (0.0 if follows else filter_s)
    common |= {"velocity_lag": 0.5 * latest} if latest else {}
    found = [([size * (axis.effect == effect) for axis in axes], (0.0, 2.0)) for effect, size in common.items()]
    # Semi-implicit Euler has positions of half a step after its velocities, and no step is longer than a period.
    lead = 0.25 * min(1.0 / control_hz, _LONGEST_SIMULATED_S)
    leading = {"seconds"} if "dq" in signals else {"seconds", "velocity_seconds"}
    leads = [lead * (axis.effect == "position_lead" and axis.parameter in leading) for axis in axes]
    found.append((leads, (0.0, 2.0)))
    rubbing = {axis.place for axis in axes if axis.effect == "coulomb" and axis.prior_sd > 0}
    recorded = {axis.place for axis in axes if {"tau", "abs_tau"} & set(signals)}
    for effect, size, bounds, places in (
        ("presliding", _TRAVEL_RAD, (0.0, _MOST_TRAVELS), rubbing),
        ("torque_scale" if follows else "torque_reading", _TORQUE_SHARE, (-_MOST_SHARES, _MOST_SHARES), recorded),
        ("constant_push", _OFFSET, (-_MOST_SHARES, _MOST_SHARES), recorded if follows else set()),
    ):
        mine = [number for number, axis in enumerate(axes) if axis.effect == effect and axis.place in places]
        found += [(size * np.eye(len(axes))[number], bounds) for number in mine]
    for body, shifts in centres.items():
        mine = [axis.effect == "com_offset" and axis.place == body for axis in axes]
        scales = [axis.scale for axis, its in zip(axes, mine, strict=True) if its]
        for shift in shifts:
            direction = np.zeros(len(axes))
            direction[mine] = shift / scales
            found.append((direction, (-_MOST_SHARES, _MOST_SHARES)))
    directions, bounds = zip(*found, strict=True)
    return np.array(directions, float), np.array(bounds)


def learned_torque(axes: Sequence[Axis], row: Effect) -> Hypothesis:
    """Makes the hypothesis of a learned torque, in which every parameter at every joint is a coordinate of its own.

    Args:
      axes: coordinates of the rig.
      row: the learned torque.
    """
    mine = [number for number, axis in enumerate(axes) if axis.effect == row.name]
    parameters = {parameter.name: parameter for parameter in row.parameters}
    each = [parameters[axes[number].parameter] for number in mine]
    return Hypothesis(
        name=row.name,
        family=row.family,
        places=tuple(dict.fromkeys(axes[number].place for number in mine)),
        directions=np.eye(len(axes))[mine],
        probes=row.sizes[0] * np.eye(len(mine)),
        bounds=np.array([parameter.bounds for parameter in each], float),
        prior=np.array([parameter.prior for parameter in each], float),
        joints=(),
    )


def _hypothesis(
    axes: Sequence[Axis], index: Mapping, row: Effect, places: tuple[str, ...], names: Sequence[str] = ()
) -> Hypothesis:
    """Makes the hypothesis of an effect in its first form, or of some of its parameters alone."""
    later = {name for form in row.forms if form.effect == row.name for name in form.parameters}
    parameters = [one for one in row.parameters if (one.name in names if names else one.name not in later)]
    directions = np.zeros((len(parameters), len(axes)))
    bounds = np.array([one.bounds for one in parameters], float)
    for number, one in enumerate(parameters):
        mine = [index[row.name, one.name, place] for place in places]
        for axis in mine:
            # In single precision, as the physics has it.
            ratio = np.float32(axes[mine[0]].scale) / np.float32(axes[axis].scale)
            factor = 1.0 / ratio if one.form == "reciprocal" else ratio
            directions[number, axis] = 1.0 if one.form == "ratio" else factor
        # Coordinates are in the first place's unit, and no place may lose more than it has.
        bounds[number, 0] = max(axes[axis].least / directions[number, axis] for axis in mine)
    first = [index[row.name, parameters[0].name, place] for place in places]
    return Hypothesis(
        name=row.name,
        family=row.family,
        places=places,
        directions=directions,
        probes=_probes(row.sizes, parameters, bounds[0, 0], 1.0 / directions[0].max()),
        bounds=bounds,
        spent=axes[first[0]].takes,
        prior=np.array([one.prior for one in parameters]),
        joints=tuple(sorted({joint for axis in first for joint in axes[axis].joints[:1]})),
    )


def _each(axes: Sequence[Axis], index: Mapping, row: Effect, places: tuple[str, ...]) -> Hypothesis:
    """Makes the hypothesis of an effect with one parameter that has a size of its own at each place."""
    (parameter,) = row.parameters
    alone = [_hypothesis(axes, index, row, (place,)) for place in places]
    return replace(
        alone[0],
        places=places,
        directions=np.concatenate([one.directions for one in alone]),
        probes=row.sizes[0] * np.eye(len(places)),
        bounds=np.concatenate([one.bounds for one in alone]),
        prior=np.full(len(places), parameter.prior),
        joints=tuple(joint for one in alone for joint in one.joints),
        each=True,
    )


def _probes(sizes: Sequence[float], parameters: Sequence[Parameter], least: float, finest: float) -> np.ndarray:
    """Returns the coordinates [probes, parameters] at which the screen simulates an effect.

    Shape parameters, such as the speed scale of Stribeck friction, stay zero, since they mean nothing without a size.
    If an effect has several parameters (x, y, z), each is tried alone at its sizes. Else sizes grow by a constant
    factor, to where the effect is large; more of them where it has no slope at zero. What can be subtracted is tried
    with both signs.

    Args:
      sizes: of the effect, the smallest of interest first; several where it has no slope at zero.
      parameters: that are free.
      least: smallest coordinate.
      finest: what is of the same interest at the place where the effect acts most, as a share of that at the first
        place: what moves a finger is little for an arm.
    """
    sizes = [finest * sizes[0], *sizes[1:]]
    free = [number for number, parameter in enumerate(parameters) if not parameter.shape]
    if len(free) > 1:
        return np.concatenate([size * np.eye(len(parameters))[free] for size in sizes])
    most, bends = parameters[free[0]].bounds[1], len(sizes) > 1
    largest = max(_LARGE * most, sizes[-1])
    count = (_BENT if bends else _STRAIGHT) + int(np.ceil(np.log10(1.0 / finest)))
    sizes = np.unique(np.geomspace(sizes[0], largest, count))
    below = [-size for size in sizes if -size >= _LARGE * least - 1e-9]
    # Armature and damping can be lowered by less than their smallest size of interest.
    below = below or ([0.5 * least] if least < 0 else [])
    values = np.array([*below, *sizes])
    probes = np.zeros((len(values), len(parameters)))
    probes[:, free[0]] = values
    return probes
