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
    fitted, runs = everywhere[discovery.main], {split: discovery.runs(split) for split in ("train", "select")}
    residuals = {horizon: _on_select(discovery, horizon, short, fits) for horizon, fits in everywhere.items()}
    before, after = residuals[discovery.main]
    train = {key: decide.losses(discovery.shaped(fit.residual, discovery.main)) for key, fit in fitted.items()}
    lost = {key: np.concatenate([train[key], decide.losses(residual)]) for key, residual in after.items()}
    both = np.concatenate([runs["train"], runs["select"]])
    base = discovery.fits[discovery.main]
    linear = {key: fit.linear for key, fit in fitted.items()}
    gained = {key: base.linear.loss - one.loss for key, one in linear.items()}
    close = decide.alike(lost, both, 2.0)
    nearly = [key for key in gained if key not in close and gained[key] > settings.same * max(gained.values())]
    best = {h.key: h for h in short if h.key in decide.alike(lost, both, 1.0)}
    hypothesis = min(best.values(), key=lambda h: (len(h.directions), linear[h.key].loss))
    parts = hypothesis.parts or (hypothesis,)
    gains = {key: decide.paired(before, residual) for key, residual in after.items()}
    evidence = decide.Evidence(
        gain=gained[hypothesis.key],
        t=decide.t_statistic(gains[hypothesis.key], runs["select"]),
        confirmed=decide.confirmed(before, after[hypothesis.key], runs["select"], base.weight),
        floors=_floors(before, after[hypothesis.key]),
        **_estimate(discovery, fitted[hypothesis.key], hypothesis, parts),
        horizons=sum(_wins(discovery, horizon, hypothesis.key, found) for horizon, (_, found) in residuals.items()),
        chosen=_chosen(decide.bagged(linear, runs["train"]), short, close, hypothesis),
    )
    least = decide.Thresholds(
        t=decide.max_t(gains, runs["select"], settings.level), gain=len(parts) * discovery.least_gain
    )
    tests = decide.passes(evidence, least)
    discovery.say(f"{hypothesis.key} {evidence} {least} {tests} alike {close} nearly {nearly}")
    if not all(tests.values()):
        result.rejected = {"hypothesis": hypothesis.key, "tests": tests, "evidence": evidence}
        return False
    mine = {part.name for part in parts}
    others = [part.name for h in short if h.key in (*close, *nearly) for part in h.parts or (h,)]
    alike = tuple(dict.fromkeys(name for name in others if name not in mine))
    result.rungs += [Rung(part, evidence, least, alike) for part in parts]
    discovery.stand({horizon: fits[hypothesis.key] for horizon, fits in everywhere.items()})
    return True


def _on_select(discovery, horizon: float, short: Sequence[Hypothesis], fits: Mapping[str, Fit]):
    """Residuals [segments, bins, components] on `select` of the model as it stands, and of every hypothesis by key."""
    vectors = [discovery.fits[horizon].vector, *(fits[h.key].vector for h in short)]
    before, *after = (discovery.shaped(r, horizon) for r in discovery.residual(horizon, "select")(np.stack(vectors)))
    return before, {h.key: residual for h, residual in zip(short, after, strict=True)}


def _wins(discovery, horizon: float, key: str, found: Mapping[str, np.ndarray]) -> bool:
    """Whether a hypothesis is best at a horizon, or within a standard error of it."""
    lost = {other: decide.losses(residual) for other, residual in found.items()}
    return key in decide.alike(lost, discovery.problem.data["select"][horizon].run, 1.0)


def _floors(before: np.ndarray, after: np.ndarray) -> float:
    """Root of the largest fall of a component's mean square, in floor units."""
    fall = (before**2).mean(axis=(0, 1)) - (after**2).mean(axis=(0, 1))
    return float(np.sqrt(max(fall.max(), 0.0)))


def _chosen(share: Mapping[str, float], short: Sequence[Hypothesis], close: Sequence[str], mine: Hypothesis) -> float:
    """How often a hypothesis, or what cannot be told from it, was best; its name at some of its places is the same."""
    same = [h for h in short if h.key in close or (h.name == mine.name and set(h.places) & set(mine.places))]
    return sum(share[h.key] for h in same)


def _estimate(discovery, fit: Fit, hypothesis: Hypothesis, parts: Sequence[Hypothesis]) -> dict:
    """What the fit says of the hypothesis' own coordinates: an interval, and whether they are inside their bounds."""
    values = fit.own(hypothesis)
    errors = discovery.errors(fit)[-len(values) :]
    low, high = hypothesis.bounds.T
    return {
        "interval": _interval(parts, values, errors),
        "inside": bool(((low < values) & (values < high)).all()),
    }


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
    """Takes out earlier effects that no longer pay beside what was accepted last."""
    newest = discovery.result.rungs[-1].evidence
    for rung in [rung for rung in discovery.result.rungs if rung.evidence is not newest]:
        without = {horizon: discovery.ablated(horizon, rung.hypothesis) for horizon in discovery.fits}
        residual = discovery.residual(discovery.main, "select")
        found = residual(np.stack([without[discovery.main].vector, discovery.fits[discovery.main].vector]))
        pair, run = [discovery.shaped(one, discovery.main) for one in found], discovery.runs("select")
        still = decide.confirmed(*pair, run, discovery.gauges[discovery.main].weight) > discovery.least_gain
        if decide.t_statistic(decide.paired(*pair), run) < 1.0 and not still:
            discovery.say(f"drop {rung.hypothesis.key}")
            discovery.result.rungs.remove(rung)
            discovery.result.dropped.append(rung.hypothesis.key)
            discovery.stand(without)
