"""The driver: floor, null, localise, screen, fit, decide, accept and look again, abstain, prove.

    floor -> null -> [ localise -> screen -> fit -> decide -> accept ] up to four times -> prove

A round ends the ladder where nothing passes. Sealed segments are simulated by `prove` alone, once.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxtune.discovery import decide, localise
from jaxtune.discovery.fit import Fit, Free, refine
from jaxtune.discovery.measure import Gauge, gauge, jacobian, nominal_directions
from jaxtune.discovery.problem import Hypothesis, Problem, Residuals
from jaxtune.discovery.screen import Score, Screen, given_up, probes


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much is tried, and what it takes."""

    shortlist: int = 8
    """Hypotheses that are fitted beside the best of each family."""
    finalists: int = 6
    """Of those, how many are fitted at every horizon."""
    most: int = 4
    """Effects that are accepted at most."""
    level: float = 0.05
    """Of naming something where nothing is missing."""
    share: float = 0.5
    """Of the energy above the floor that the named effects must explain together; else it is `unnamed`."""
    rounds: int = 4
    """Of a fit."""


@dataclass(frozen=True)
class Rung:
    """One accepted effect."""

    hypothesis: Hypothesis
    evidence: decide.Evidence
    thresholds: decide.Thresholds
    alike: tuple[str, ...]
    """Names that could not be told from it."""


@dataclass
class Result:
    """What was found."""

    verdict: str = ""
    rungs: list[Rung] = field(default_factory=list)
    fit: Fit | None = None
    errors: np.ndarray | None = None
    """Standard errors of the fit's coordinates."""
    null: Fit | None = None
    where: list[dict] = field(default_factory=list)
    """Cells above the floor before anything was accepted."""
    needs_torque: dict[str, float] = field(default_factory=dict)
    not_testable: list[str] = field(default_factory=list)
    not_finite: list[str] = field(default_factory=list)
    rejected: dict[str, dict] = field(default_factory=dict)
    """Tests of the best that was not accepted."""
    sealed: dict[str, Any] = field(default_factory=dict)


class Discovery:
    """One question, asked step by step.

    Args:
      problem: what is asked.
      settings: how.
      push: axes of a constant torque at every joint, by joint name; for localising.
      say: told what is being done.
    """

    def __init__(
        self,
        problem: Problem,
        settings: Settings = Settings(),  # noqa: B008  (frozen)
        push: Mapping[str, int] | None = None,
        say: Callable[[str], None] = lambda text: None,
    ):
        self.problem, self.settings, self.say = problem, settings, say
        self._push = dict(push or {})
        self.measure = Residuals(problem)
        self.main = problem.horizons[len(problem.horizons) // 2]
        self.gauges: dict[float, Gauge] = {}
        self.result = Result()

    # --- what is there before the first question

    def prepare(self) -> None:
        """Floor, null, and what healthy logs would gain by chance."""
        for horizon in self.problem.horizons:
            self.say(f"floor at {horizon:g} s")
            self.gauges[horizon] = gauge(self.problem, self.measure, horizon)
        self.say("null")
        zero = np.zeros(self.problem.axes)
        self.fits = {}
        for horizon in self.problem.horizons:
            free = self._nominal()
            start = Fit(
                free=free,
                coordinates=np.zeros(len(free.sd)),
                residual=self._residual(horizon, "train")(zero[None])[0],
                jacobian=self.gauges[horizon].jacobian["train"].reshape(-1, len(free.sd)),
                weight=self.gauges[horizon].weight,
            )
            self.fits[horizon] = refine([start], self._residual(horizon, "train"), 3)[0]
        self.result.null = self.fits[self.main]

    def _nominal(self) -> Free:
        directions = nominal_directions(self.problem)
        count = len(directions)
        return Free(directions, np.ones(count), np.tile([-5.0, 5.0], (count, 1)))

    def _residual(self, horizon: float, split: str):
        """Residuals [n, features] of vectors [n, axes]."""
        floor, segments = self.gauges[horizon].floor, self.problem.data[split][horizon]
        return lambda vectors: (self.measure(vectors, segments) / floor).reshape(len(vectors), -1)

    def _shaped(self, residual: np.ndarray, horizon: float) -> np.ndarray:
        """[segments, bins, components, ...] again."""
        return residual.reshape(-1, *self.gauges[horizon].floor.shape, *residual.shape[1:])

    # --- one round

    def localise(self) -> list[str]:
        """Fills in where the gap is; returns the joints that need a torque."""
        problem, gauge_, fit = self.problem, self.gauges[self.main], self.fits[self.main]
        residual = self._shaped(fit.residual, self.main)
        segments = problem.data["train"][self.main]
        regimes = segments.regimes[:, :: problem.bin_rows][:, : residual.shape[1]]
        names = [(signal, part) for signal in sorted(segments.signals) for part in problem.components[signal]]
        if not self.result.where:
            self.result.where = localise.cells(residual, regimes, problem.regimes, names, 0)
        if not self._push:
            return []
        unit = np.zeros((len(self._push), problem.axes))
        unit[np.arange(len(unit)), list(self._push.values())] = 0.05
        slopes = jacobian(self.measure, fit.vector, unit, segments) / gauge_.floor[..., None]
        flat = slopes.reshape(len(residual), -1, len(unit))
        calm = [log["train"] for log in gauge_.healthy]
        slope = gauge_.jacobian["train"]
        penalty = max(
            localise.least_penalty(_refit(values, slope, gauge_.weight).reshape(len(residual), -1), flat)
            for values in calm
        )
        need = localise.free_torque(residual.reshape(len(residual), -1), flat, penalty)
        self.result.needs_torque = dict(zip(self._push, need.tolist(), strict=True))
        return [joint for joint, value in self.result.needs_torque.items() if value > 0]

    def screen(self, hypotheses: Sequence[Hypothesis], fit: Fit) -> Screen:
        """Secants of all hypotheses from where the model stands."""
        asked = probes(hypotheses)
        steps = np.zeros((len(asked), self.problem.axes))
        for row, (axis, size) in enumerate(asked):
            steps[row, axis] = size
        evaluate = self._residual(self.main, "train")
        columns = {}
        for start in range(0, len(asked), 32):
            self.say(f"screen {start}/{len(asked)}")
            found = evaluate(fit.vector + steps[start : start + 32])
            for key, residual in zip(asked[start : start + 32], found, strict=True):
                columns[key] = np.nan_to_num((residual - fit.residual) / key[1], posinf=0.0, neginf=0.0)
        return Screen(fit, columns)

    def shortlist(self, scores: Mapping[str, Score], hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The best, and the best of each family."""
        ranked = sorted(hypotheses, key=lambda h: -scores[h.key].gain)
        ranked = [h for h in ranked if scores[h.key].gain > 4.0]
        chosen, seen, names = [], set(), {}
        for hypothesis in ranked:
            first = hypothesis.family not in seen
            # Three places of one name tell where; more would crowd out other names.
            if names.get(hypothesis.name, 0) >= 3:
                continue
            if first or len(chosen) < self.settings.shortlist:
                chosen.append(hypothesis)
                seen.add(hypothesis.family)
                names[hypothesis.name] = names.get(hypothesis.name, 0) + 1
        return chosen

    def fit(self, hypotheses: Sequence[Hypothesis], scores: Mapping[str, Score], horizon: float, starts=None) -> list[Fit]:
        """Fits hypotheses with everything that is free already."""
        evaluate = self._residual(horizon, "train")
        kept = {h.key: _without(self.fits[horizon], h) for h in hypotheses}
        tried = []
        for hypothesis in hypotheses:
            stood, low, high = kept[hypothesis.key][1], *hypothesis.bounds.T
            if starts is not None:
                tried.append([starts[hypothesis.key]])
                continue
            found = scores[hypothesis.key].coordinates
            others = list(hypothesis.probes) if len(hypothesis.probes) > 1 and low[0] >= 0 else []
            tried.append([np.clip(stood + move, low, high) for move in (found, 0.4 * found, 2.5 * found, *others)])
        at = lambda hypothesis, point: kept[hypothesis.key][0].vector + point @ hypothesis.directions
        residuals = _dealt(evaluate, [[at(h, point) for point in group] for h, group in zip(hypotheses, tried, strict=True)])
        begun = []
        for hypothesis, points, found in zip(hypotheses, tried, residuals, strict=True):
            # The best once the nominal parameters have answered.
            fit = kept[hypothesis.key][0]
            answers = [replace(fit, residual=residual).linear for residual in found]
            losses = [
                linear.weight * np.sum((linear.residual + linear.jacobian @ linear.step(1e-3)) ** 2)
                for linear in answers
            ]
            best = int(np.nanargmin(np.where(np.isfinite(losses), losses, np.inf)))
            begun.append((points[best], found[best]))
        steps = [
            np.where(point + size > hypothesis.bounds[:, 1], -size, size)
            for hypothesis, (point, _) in zip(hypotheses, begun, strict=True)
            for size in [0.2 * np.abs(point) + 0.2 * hypothesis.probes.max(axis=0) + 0.02 * (hypothesis.probes == 0).all(axis=0)]
        ]
        moved = _dealt(
            evaluate,
            [
                [at(h, point + step) for step in np.diag(size)]
                for h, (point, _), size in zip(hypotheses, begun, steps, strict=True)
            ],
        )
        fits = []
        for hypothesis, (point, residual), size, found in zip(hypotheses, begun, steps, moved, strict=True):
            fit = kept[hypothesis.key][0]
            columns = ((found - residual) / size[:, None]).T
            # What means nothing without a size is held by a prior.
            sd = np.where((hypothesis.probes == 0).all(axis=0), 1.0, np.inf)
            fits.append(
                replace(
                    fit,
                    free=fit.free.and_then(Free(hypothesis.directions, sd, hypothesis.bounds)),
                    coordinates=np.concatenate([fit.coordinates, point]),
                    residual=residual,
                    jacobian=np.concatenate([fit.jacobian, np.nan_to_num(columns)], axis=1),
                    finite=bool(np.isfinite(residual).all()),
                )
            )
        rounds = self.settings.rounds if starts is None else 2
        return refine(fits, evaluate, rounds)

    def healthy_gain(self, screen: Screen, hypotheses: Sequence[Hypothesis]) -> float:
        """What the best hypothesis gains where nothing is missing, 95th percentile over healthy logs."""
        gauge_ = self.gauges[self.main]
        best = []
        for log in gauge_.healthy:
            scores = screen.scores(hypotheses, log["train"].ravel())
            best.append(max(score.gain for score in scores.values()))
        return float(np.quantile(best, 1.0 - self.settings.level, method="higher"))

    def round(self) -> bool:
        """Looks for one more effect; whether one was accepted."""
        problem, settings, base = self.problem, self.settings, self.fits[self.main]
        taken = {rung.hypothesis.key for rung in self.result.rungs}
        hypotheses = [h for h in problem.hypotheses if h.key not in taken]
        joints = self.localise()
        screen = self.screen(hypotheses, base)
        scores = screen.scores(hypotheses)
        if not taken:
            names = dict.fromkeys(h.name for h in hypotheses)
            shown = {h.name for h in hypotheses if scores[h.key].testable}
            self.result.not_testable = [name for name in names if name not in shown]
            self._healthy_gain = self.healthy_gain(screen, hypotheses)
        index = {joint: number for number, joint in enumerate(self._push)}
        needing = {index[joint] for joint in joints}
        near = [h for h in hypotheses if not needing or not h.joints or needing & set(h.joints)]
        near = [h for h in near if scores[h.key].testable]
        short = self.shortlist(scores, near)
        self.say(f"fit {len(short)}")
        if not short:
            return False
        fits = dict(zip([h.key for h in short], self.fit(short, scores, self.main), strict=True))
        self.result.not_finite += [key for key, fit in fits.items() if not fit.finite]
        short = [h for h in short if fits[h.key].finite]
        short.sort(key=lambda h: fits[h.key].linear.loss)
        short = short[: settings.finalists]
        if not short:
            return False
        everywhere = {self.main: {h.key: fits[h.key] for h in short}}
        for horizon in problem.horizons:
            if horizon != self.main:
                starts = {h.key: fits[h.key].coordinates[-len(h.directions) :] for h in short}
                found = self.fit(short, scores, horizon, starts)
                everywhere[horizon] = dict(zip([h.key for h in short], found, strict=True))
        return self._decide(short, everywhere, base)

    def _decide(self, short, everywhere, base) -> bool:
        settings = self.settings
        losses, gains, best_at = {}, {}, {h.key: 0 for h in short}
        for horizon, fits in everywhere.items():
            residual = self._residual(horizon, "select")
            found = residual(np.stack([self.fits[horizon].vector, *(fits[h.key].vector for h in short)]))
            shaped = [self._shaped(r, horizon) for r in found]
            select = {h.key: (r**2).mean(axis=(1, 2)) for h, r in zip(short, shaped[1:], strict=True)}
            for key in decide.alike(select, 1.0):
                best_at[key] += 1
            if horizon == self.main:
                before = shaped[0]
                after = {h.key: r for h, r in zip(short, shaped[1:], strict=True)}
                gains = {key: decide.paired(before, r) for key, r in after.items()}
                train = {
                    h.key: (self._shaped(fits[h.key].residual, horizon) ** 2).mean(axis=(1, 2)) for h in short
                }
                losses = {key: np.concatenate([train[key], select[key]]) for key in select}
        close = decide.alike(losses, 2.0)
        complexity = {h.key: h.complexity[0] for h in short}
        key = decide.simplest(decide.alike(losses, 1.0), complexity)
        chosen = decide.bagged(losses)
        fit = everywhere[self.main][key]
        hypothesis = next(h for h in short if h.key == key)
        count = len(hypothesis.directions)
        errors = self._errors(fit)
        value, error = fit.coordinates[-count], errors[-count]
        low, high = fit.free.bounds[-count]
        drop = (before**2).mean(axis=(0, 1)) - (after[key] ** 2).mean(axis=(0, 1))
        evidence = decide.Evidence(
            gain=base.linear.loss - fit.linear.loss,
            t=decide.t_statistic(gains[key]),
            floors=float(np.sqrt(max(drop.max(), 0.0))),
            interval=(float(value - 1.96 * error), float(value + 1.96 * error)),
            inside=bool(low < value < high or (low == 0 and 0 < value < high)),
            horizons=best_at[key],
            chosen=sum(chosen[other] for other in close),
        )
        thresholds = decide.Thresholds(t=decide.max_t(gains, settings.level), gain=self._healthy_gain)
        tests = decide.passes(evidence, thresholds)
        self.say(f"{key} {evidence} {thresholds} {tests} alike {close}")
        if not all(tests.values()):
            self.result.rejected = {"hypothesis": key, "tests": tests, "evidence": evidence}
            return False
        names = tuple(dict.fromkeys(k.partition("@")[0] for k in close if k.partition("@")[0] != hypothesis.name))
        self.result.rungs.append(Rung(hypothesis, evidence, thresholds, names))
        self.fits = {horizon: fits[key] for horizon, fits in everywhere.items()}
        return True

    def _errors(self, fit: Fit) -> np.ndarray:
        """Standard errors of a fit's coordinates."""
        return decide.sandwich(
            self._shaped(fit.residual, self.main).reshape(-1, fit_features(self.gauges[self.main])),
            self._shaped(fit.jacobian, self.main).reshape(
                -1, fit_features(self.gauges[self.main]), fit.jacobian.shape[-1]
            ),
            fit.weight,
            fit.free.sd,
        )

    def run(self) -> Result:
        """All of it."""
        self.prepare()
        while len(self.result.rungs) < self.settings.most and self.round():
            pass
        self.result.fit = self.fits[self.main]
        self.result.errors = self._errors(self.result.fit)
        return self.result


def fit_features(gauge_: Gauge) -> int:
    """Features of a segment."""
    return gauge_.floor.size


def _without(fit: Fit, hypothesis: Hypothesis) -> tuple[Fit, np.ndarray]:
    """A fit without what a hypothesis takes over, and where that stood, [parameters] of the hypothesis."""
    own = given_up(fit.free, hypothesis)
    stood = np.zeros(len(hypothesis.directions))
    if own.any():
        vector = fit.coordinates[own] @ fit.free.directions[own]
        stood[0] = vector[hypothesis.directions[0] != 0].mean()
    free = Free(*(part[~own] for part in fit.free.parts()))
    return replace(fit, free=free, coordinates=fit.coordinates[~own], jacobian=fit.jacobian[:, ~own]), stood


def _dealt(evaluate, groups: Sequence[Sequence[np.ndarray]]) -> list[np.ndarray]:
    """Evaluates all vectors of all groups at once; what was found, by group."""
    found = evaluate(np.stack([vector for group in groups for vector in group]))
    return np.split(found, np.cumsum([len(group) for group in groups])[:-1])


def _refit(residual: np.ndarray, slope: np.ndarray, weight: float) -> np.ndarray:
    from jaxtune.discovery.measure import _refitted

    return _refitted(residual, slope, weight)
