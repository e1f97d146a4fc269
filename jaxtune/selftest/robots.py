"""Gates, updates and whole tunings of simulated robots whose parameters are known, counted."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np

from jaxtune import devices, pooling
from jaxtune import dist as dists
from jaxtune.selftest.report import INSIDE, Rate, SelfTest, Tuned
from jaxtune.tuner import Info, Tuner, TunerState
from jaxtune.types import Coords, ParamDist, Verdict

_OFF = 2.0  # radii from the centre: one outside


Keep = Callable[[str, Callable[[], dict]], dict]
"""`(name, compute) -> part`: what `compute` gives, numbers and lists of them by name, or what it gave an earlier call.
A number that is not finite may be None then."""


def run(
    key: jax.Array,
    tuner: Tuner,
    state: TunerState,
    *,
    robots: int = 20,
    gates: int = 1,
    whole: int = 0,
    tunings: int = 1,
    lanes: int = 1,
    others: Mapping[str, Coords] = MappingProxyType({}),
    keep: Keep = lambda name, compute: compute(),
    done: Callable[[int, int], None] = lambda number, total: None,
) -> SelfTest:
    """Runs a self-test. Gate and update are called once for each measured set; nothing is trained but their models.

    Args:
      key: random key.
      tuner: whose `simulate`, gate and update are tested.
      state: whose policy walks, and whose distribution is tested.
      robots: simulated robots of every case and gate.
      gates: calls of the gate, each with new episodes and models. Models differ by chance, so rates need several.
      whole: robots of every case with which whole tunings are run as well, widenings and refinements included.
      tunings: of each such robot, one after another. Each measures a new set and starts from the distribution that the
        one before left; the policy stays as it is.
      lanes: robots of which whole tunings run side by side, in one program. More of them suit a GPU, on which a larger
        batch costs little. All wait for the robot with the most gate calls, so one at a time is best on a CPU. A last
        group that is smaller is compiled by itself.
      others: cases by name, of coordinates that replace those drawn. `tuner.simulate` must know them; a coordinate that
        is not in the distribution is 0, that is nominal, in all other cases.
      keep: given every part of the test, a gate or the whole tunings of robots side by side, so that one that was
        interrupted goes on.
      done: called after every gate, and every tuning of robots side by side, with their number so far and in all.

    Raises:
      ValueError: fewer than two robots, no gate, tuning or lane, or a tuner whose `simulate` JAX cannot trace.
    """
    if not isinstance(tuner, Tuner):
        raise ValueError(f"tuner: got {type(tuner).__name__}, expected a Tuner, whose simulate JAX can trace")
    if robots < 2 or gates < 1 or tunings < 1:
        raise ValueError(f"robots, gates, tunings: got {robots}, {gates} and {tunings}, expected at least 2, 1 and 1")
    if lanes < 1:
        raise ValueError(f"lanes: got {lanes}, expected 1 or more")
    outside = _outside(state.dist)
    others = {name: dict(coords) for name, coords in others.items()}
    extra = sorted({name for coords in others.values() for name in coords} - set(dists.names(state.dist)))
    key_gates, key_whole = jax.random.split(key)
    total = gates + whole * tunings * (1 + len(others))
    cases = [{}, *outside.values(), *others.values()]
    calls = _call(key_gates, tuner, state, cases, extra, robots, gates, keep, lambda number: done(number, total))
    groups = [range(first, min(first + lanes, whole)) for first in range(0, whole, lanes)]
    whole_cases = {INSIDE: {}} | others if whole else {}
    tuned = _tune(
        key_whole, tuner, state, whole_cases, extra, groups, tunings, keep, lambda number: done(gates + number, total)
    )
    return _counted(state, calls, list(outside), list(others), tuned)


def _counted(
    state: TunerState,
    calls: Mapping[str, np.ndarray],
    outside: Sequence[str],
    others: Sequence[str],
    tuned: dict[str, tuple[Tuned, ...]],
) -> SelfTest:
    """Counts what `_call` found of the robots inside, outside in the coordinates named, and of other cases."""
    rejected, noticed = (
        [_told(column) for column in np.moveaxis(calls[name], 1, 0)] for name in ("rejected", "noticed")
    )
    unusable = np.isnan(calls["rejected"]).sum(axis=(0, 2)).tolist()
    ends = len(outside) + 1
    errors, intervals = calls["errors"], calls["intervals"]
    accepted = calls["rejected"][:, 0] == 0.0
    known = calls["identifiable"] & accepted[..., None]
    unit, order = np.asarray(dists.ravel(state.dist.radius)), dists.names(state.dist)
    columns = lambda values: dict(zip(order, np.moveaxis(values, -1, 0), strict=True))  # noqa: E731
    median = lambda values: {  # noqa: E731
        name: float(np.median(column[told])) if (told := columns(known)[name]).any() else float("nan")
        for name, column in columns(values * unit).items()
    }
    return SelfTest(
        level=float(state.knobs.level),
        gates=len(errors),
        alarms=rejected[0],
        outside=dict(zip(outside, rejected[1:ends], strict=True)),
        noticed=dict(zip(outside, noticed[1:ends], strict=True)),
        others=dict(zip(others, rejected[ends:], strict=True)),
        identified={name: _told(np.where(accepted, column, np.nan)) for name, column in columns(known).items()},
        error=median(errors),
        interval=median(intervals),
        covered=_told(np.where(accepted, _covers(errors, intervals, known), np.nan)),
        tuned=tuned,
        unusable={name: count for name, count in zip([INSIDE, *outside, *others], unusable, strict=True) if count},
    )


def _call(
    key: jax.Array,
    tuner: Tuner,
    state: TunerState,
    cases: Sequence[Mapping],
    extra: list[str],
    robots: int,
    gates: int,
    keep: Keep,
    done: Callable[[int], None],
) -> dict[str, np.ndarray]:
    """Calls gate and update for the robots of every case, the first of which is the one inside the distribution.

    Returns:
      `rejected` and `noticed` [gates, cases, robots]: 1, 0, or nan where the set is unusable; of the robots inside,
      `identifiable`, and `errors` and `intervals` in radii, [gates, robots, coords].
    """
    # No gate reads states, which are large.
    seen = replace(tuner, simulate=lambda *args: tuner.simulate(*args).replace(state=None))
    programs = (_scorer(seen, robots), seen.collect, partial(_measured, seen))
    score, collect, measure = (devices.on_all(jax.jit(program)) for program in programs)

    def call(gate: int) -> dict:
        keys = jax.random.split(jax.random.fold_in(key, gate), 4)
        drawn = [
            _draw(jax.random.fold_in(keys[0], number), state.dist, robots, replaced, extra)
            for number, replaced in enumerate(cases)
        ]
        coords = jax.tree.map(lambda *rows: jnp.concatenate(rows), *drawn)
        sets, collected = measure(keys[1], state, coords), collect(keys[2], state.policy, state.dist)
        rejected, usable, update, moved = jax.device_get(score(keys[3], collected, sets, state))
        truth = np.asarray(dists.normalise(state.dist, {name: drawn[0][name] for name in state.dist.centre}))
        return {
            "rejected": np.where(usable, rejected, np.nan).reshape(-1, robots),
            "noticed": np.where(usable, rejected | _inside(moved, coords), np.nan).reshape(-1, robots),
            "identifiable": update.identifiable,
            "errors": np.abs(update.step - truth),
            "intervals": update.interval,
        }

    calls = []
    for gate in range(gates):
        part = keep(f"gate_{gate}", partial(call, gate))
        calls.append({name: np.array(values, float) for name, values in part.items()})
        done(gate + 1)
    found = {name: np.stack([one[name] for one in calls]) for name in calls[0]}
    return found | {"identifiable": found["identifiable"] == 1.0}


def _tune(
    key: jax.Array,
    tuner: Tuner,
    state: TunerState,
    cases: Mapping[str, Mapping],
    extra: list[str],
    groups: Sequence[range],
    tunings: int,
    keep: Keep,
    done: Callable[[int], None],
) -> dict[str, tuple[Tuned, ...]]:
    """Runs whole tunings of robots of every case, those of a group side by side, and counts how they end."""
    measure, tune = (devices.on_all(jax.jit(_by_side(program))) for program in (partial(_measured, tuner), tuner.tune))

    def each(number: int, replaced: Mapping, group: range) -> dict:
        key_draws, *keys = zip(
            *(
                jax.random.split(jax.random.fold_in(jax.random.fold_in(key, number), robot), 1 + 2 * tunings)
                for robot in group
            ),
            strict=True,
        )
        drawn = [_draw(one, state.dist, 1, replaced, extra) for one in key_draws]
        coords = jax.tree.map(lambda *values: jnp.stack(values), *drawn)
        # What is known of the real robot says nothing of these.
        blank = state.replace(past=pooling.nothing(state.dist))
        now, rows = jax.tree.map(lambda leaf: jnp.stack([leaf] * len(group)), blank), []
        for index, (key_measure, key_tune) in enumerate(zip(keys[::2], keys[1::2], strict=True)):
            if index:
                done(group.start * tunings + index * len(group) + number * of_case)
            measured = jax.tree.map(lambda leaf: leaf[:, 0], measure(jnp.stack(key_measure), now, coords))
            # The state stays on its devices: from others the programs would be compiled anew.
            now, info = tune(jnp.stack(key_tune), now, measured)
            ended = jax.device_get((now.dist, info))
            rows.append([_ended(*_lane(ended, lane), one) for lane, one in enumerate(drawn)])
        return {"robots": list(zip(*rows, strict=True))}

    tuned, of_case = {}, groups[-1].stop * tunings if groups else 0
    for number, (name, replaced) in enumerate(cases.items()):
        ended = []
        for group in groups:
            part = f"case_{number}_robots_{group.start}_to_{group.stop - 1}"
            ended += keep(part, partial(each, number, replaced, group))["robots"]
            done(group.stop * tunings + number * of_case)
        tuned[name] = tuple(_tuned(rows, dists.names(state.dist)) for rows in zip(*ended, strict=True))
    return tuned


def _by_side(program: Callable) -> Callable:
    """Makes a program work on several robots, as the first axis of every input.

    One robot gets the program as it is: mapped, it would compute both branches of every `cond`.
    """

    def of_all(*inputs):
        if len(jax.tree.leaves(inputs)[0]) > 1:
            return jax.vmap(program)(*inputs)
        return jax.tree.map(lambda leaf: leaf[None], program(*_lane(inputs, 0)))

    return of_all


def _lane(tree, lane: int):
    return jax.tree.map(lambda leaf: leaf[lane], tree)


def _ended(dist: ParamDist, info: Info, coords: Coords) -> dict:
    """How one tuning of a robot, coordinates [1] by name, ended: with the distribution that it left."""
    truth = np.asarray(dists.ravel({name: coords[name][0] for name in dist.centre}))
    centre, radius = (np.asarray(dists.ravel(value)) for value in (info.dist.centre, info.dist.radius))
    errors = np.abs(centre + radius * info.update.step - truth)
    return {
        "verdict": int(info.verdicts[int(info.calls) - 1]),
        "held": bool(_inside(dist, coords).all()),
        "covered": float(_covers(errors, radius * info.update.interval, info.update.identifiable)),
        "errors": np.abs(np.asarray(dists.ravel(dist.centre)) - truth),
    }


def _tuned(rows: Sequence[Mapping], names: Sequence[str]) -> Tuned:
    """Counts rows of `_ended`, one for each robot."""
    accepted = [row for row in rows if row["verdict"] == Verdict.ACCEPT]
    return Tuned(
        verdicts=dict(Counter(Verdict(row["verdict"]).name.lower() for row in rows)),
        held=Rate(sum(row["held"] for row in accepted), len(accepted)),
        covered=_told(np.array([row["covered"] for row in accepted], float)),
        error=dict(
            zip(names, np.median(np.array([row["errors"] for row in rows], float), axis=0).tolist(), strict=True)
        ),
    )


def _covers(errors: np.ndarray, intervals: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Tells whether all identifiable coordinates [..., coords] lie in their intervals: 1, 0; nan where one has none."""
    inside = ((errors <= intervals) | ~known).all(axis=-1)
    return np.where((known & np.isnan(intervals)).any(axis=-1), np.nan, inside)


def _told(covers: np.ndarray) -> Rate:
    """Counts ones among what is not nan, of robots [robots], or by gate, [gates, robots]."""
    hits, told = np.nansum(covers, axis=-1), np.isfinite(covers).sum(axis=-1)
    by_gate = tuple((int(one), int(of)) for one, of in zip(hits, told, strict=True)) if covers.ndim == 2 else ()
    return Rate(int(hits.sum()), int(told.sum()), by_gate)


def _outside(dist: ParamDist) -> dict[str, dict[str, np.ndarray]]:
    """Cases of robots one radius outside, by coordinate: the values that take turns."""
    cases = {}
    for name in dists.names(dist):
        centre, radius = float(dist.centre[name]), float(dist.radius[name])
        ends = np.array([centre - _OFF * radius, centre + _OFF * radius])
        ends = ends[(ends >= float(dist.lower[name])) & (ends <= float(dist.upper[name]))]
        if ends.size:
            cases[name] = {name: ends}
    return cases


def _inside(dist: ParamDist, coords: Coords) -> np.ndarray:
    """Tells which robots, coordinates [robots] by name, lie in a distribution, or each in one of its own."""
    low, high = (dists.ravel(end) for end in dists.box(dist))
    truth = dists.ravel({name: coords[name] for name in dist.centre})
    return np.asarray(((low <= truth) & (truth <= high)).all(axis=-1))


def _draw(key: jax.Array, dist: ParamDist, count: int, replaced: Mapping, extra: list[str]) -> dict[str, jax.Array]:
    """Coordinates of the robots of a case, [count] by name."""
    coords = dists.sample(key, dist, count) | {name: jnp.zeros(count) for name in extra}
    for name, values in replaced.items():
        coords[name] = jnp.resize(jnp.asarray(values, jnp.float32), count)
    return coords


def _measured(tuner: Tuner, key: jax.Array, state: TunerState, coords: Coords):
    """A measured set of every robot, [robots, set_episodes, time]."""
    each = tuner.config.set_episodes
    episodes = tuner.simulate(key, state.policy, {name: jnp.repeat(value, each) for name, value in coords.items()})
    return jax.tree.map(lambda leaf: leaf.reshape(len(leaf) // each, each, *leaf.shape[1:]), episodes)


def _scorer(tuner: Tuner, robots: int) -> Callable:
    """Makes the function that calls gate and update for many sets; their models are trained once for all."""

    def score(key, collected, sets, state):
        key_verify, key_update = jax.random.split(key)
        gate = jax.vmap(lambda one: tuner.verify(key_verify, tuner.config, collected, one, state.knobs))(sets)
        moved, update = jax.vmap(
            lambda one: tuner.update(key_update, tuner.config, collected, one, state.dist, state.knobs)
        )(sets)
        inside = jax.tree.map(lambda leaf: leaf[:robots], update)
        usable = gate.comparable & jnp.isfinite(gate.novelty) & jnp.isfinite(gate.threshold)
        return gate.novelty > gate.threshold, usable, inside, moved

    return score
