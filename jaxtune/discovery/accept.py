"""Acceptance of an effect, and of what was accepted before it (steps 7 and 8)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaxtune.discovery import decide
from jaxtune.discovery.fit import Fit
from jaxtune.discovery.problem import Hypothesis


@dataclass(frozen=True)
class Rung:
    """One accepted effect."""

    hypothesis: Hypothesis
    evidence: decide.Evidence
    thresholds: decide.Thresholds
    alike: tuple[str, ...]
    """Names that could not be told from it."""


def accept(discovery, short: Sequence[Hypothesis], everywhere: Mapping[float, Mapping[str, Fit]]) -> bool:
    """Compares hypotheses on `select`; whether the best of them passed every test and is part of the model now.

    Args:
      discovery: where the ladder stands; `discovery.fits` is the model without them.
      short: what is compared.
      everywhere: their fits by horizon and hypothesis.
    """
    settings, result = discovery.settings, discovery.result
    base = discovery.fits[discovery.main]
    losses, gains, best_at = {}, {}, {h.key: 0 for h in short}
    fitted, runs = everywhere[discovery.main], discovery.runs("train")
    for horizon, fits in everywhere.items():
        residual, run = discovery.residual(horizon, "select"), discovery.problem.data["select"][horizon].run
        found = residual(np.stack([discovery.fits[horizon].vector, *(fits[h.key].vector for h in short)]))
        shaped = [discovery.shaped(r, horizon) for r in found]
        select = {h.key: decide.losses(r) for h, r in zip(short, shaped[1:], strict=True)}
        for key in decide.alike(select, run, 1.0):
            best_at[key] += 1
        if horizon == discovery.main:
            before = shaped[0]
            after = {h.key: r for h, r in zip(short, shaped[1:], strict=True)}
            gains = {key: decide.paired(before, r) for key, r in after.items()}
            train = {key: decide.losses(discovery.shaped(fit.residual, horizon)) for key, fit in fitted.items()}
            losses = {key: np.concatenate([train[key], select[key]]) for key in select}
    both = np.concatenate([runs, discovery.runs("select")])
    gained = {key: base.linear.loss - fit.linear.loss for key, fit in fitted.items()}
    close = decide.alike(losses, both, 2.0)
    close += [key for key in gained if key not in close and gained[key] > settings.same * max(gained.values())]
    complexity = {h.key: len(h.directions) for h in short}
    key = min(decide.alike(losses, both, 1.0), key=lambda key: (complexity[key], fitted[key].linear.loss))
    chosen = decide.bagged({key: fit.linear for key, fit in fitted.items()}, runs)
    fit = everywhere[discovery.main][key]
    hypothesis = next(h for h in short if h.key == key)
    errors = discovery.errors(fit)[-len(hypothesis.directions) :]
    values = fit.coordinates[-len(errors) :]
    low, high = hypothesis.bounds.T
    parts = hypothesis.parts or (hypothesis,)
    drop = (before**2).mean(axis=(0, 1)) - (after[key] ** 2).mean(axis=(0, 1))
    evidence = decide.Evidence(
        gain=gained[key],
        t=decide.t_statistic(gains[key], discovery.runs("select")),
        floors=float(np.sqrt(max(drop.max(), 0.0))),
        interval=_interval(parts, values, errors),
        inside=bool(((low < values) & (values < high)).all()),
        horizons=best_at[key],
        # Its own name at some of its places is the same finding.
        chosen=sum(
            chosen[h.key]
            for h in short
            if h.key in close or (h.name == hypothesis.name and set(h.places) & set(hypothesis.places))
        ),
    )
    thresholds = decide.Thresholds(
        t=decide.max_t(gains, discovery.runs("select"), settings.level),
        gain=len(parts) * discovery.least_gain,
    )
    tests = decide.passes(evidence, thresholds)
    discovery.say(f"{key} {evidence} {thresholds} {tests} alike {close}")
    if not all(tests.values()):
        result.rejected = {"hypothesis": key, "tests": tests, "evidence": evidence}
        return False
    others = [part.name for h in short if h.key in close for part in h.parts or (h,)]
    for part in parts:
        alike = tuple(dict.fromkeys(name for name in others if name not in {one.name for one in parts}))
        result.rungs.append(Rung(part, evidence, thresholds, alike))
    discovery.fits = {horizon: fits[key] for horizon, fits in everywhere.items()}
    return True


def _interval(parts: Sequence[Hypothesis], values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """95 % interval of the coordinate that tells whether all parts are there.

    Of several directions of one part one must be clear of zero; what has no meaning alone cannot be.
    """
    clear, start = [], 0
    for part in parts:
        mine = slice(start, start := start + len(part.directions))
        distance = np.where((part.probes != 0).any(axis=0), np.abs(values[mine]) / errors[mine], 0.0)
        clear.append((distance.max(), mine.start + int(distance.argmax())))
    _, index = min(clear)
    return float(values[index] - 1.96 * errors[index]), float(values[index] + 1.96 * errors[index])


def drop(discovery) -> None:
    """Takes out earlier effects that no longer pay beside the last one."""
    for rung in discovery.result.rungs[:-1]:
        without = {horizon: discovery.ablated(horizon, rung.hypothesis) for horizon in discovery.fits}
        residual = discovery.residual(discovery.main, "select")
        found = residual(np.stack([without[discovery.main].vector, discovery.fits[discovery.main].vector]))
        gains = decide.paired(*(discovery.shaped(one, discovery.main) for one in found))
        if decide.t_statistic(gains, discovery.runs("select")) < 1.0:
            discovery.say(f"drop {rung.hypothesis.key}")
            discovery.result.rungs.remove(rung)
            discovery.result.dropped.append(rung.hypothesis.key)
            discovery.fits = without
