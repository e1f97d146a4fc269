"""The driver: floor, null, localise, screen, fit, decide, accept and look again, abstain, prove.

    floor -> null -> [ localise -> screen -> fit -> decide -> accept ] up to four times -> prove

A round ends the ladder where nothing passes. Sealed segments are simulated by `prove` alone, once.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from jaxtune.discovery import decide, localise
from jaxtune.discovery.fit import Fit, Free, refine
from jaxtune.discovery.measure import Gauge, gauge, jacobian, nominal_directions, refitted
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
    at_floor: float = 1.5
    """Floor units up to which a gap is none."""
    changed: float = 3.0
    """Prior standard deviations beyond which a nominal parameter is another one."""
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
    rejected: dict[str, Any] = field(default_factory=dict)
    """The best that was not accepted, and its tests."""
    changed: dict[int, float] = field(default_factory=dict)
    """Nominal axes that moved too far to be the same parameter, with their standard deviations from the prior."""
    residual: Fit | None = None
    """With a free torque at one joint, where something has no name."""
    gap: dict[str, float] = field(default_factory=dict)
    proof: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Calibration:
    """What healthy logs say, which depends on the robot, its motion and its noise alone."""

    floors: dict[float, tuple[np.ndarray, float]]
    """Floor [bins, components] and independent share by horizon."""
    gain: float
    """What the best hypothesis gains on them."""
    penalty: float
    """Under which no joint of them needs a torque."""


class Discovery:
    """One question, asked step by step.

    Args:
      problem: what is asked.
      settings: how.
      push: axes of a constant torque at every joint, by joint name; for localising.
      calibration: what another log of the same robot and the same motion has found of healthy logs.
      say: told what is being done.
    """

    def __init__(
        self,
        problem: Problem,
        settings: Settings = Settings(),
        push: Mapping[str, int] | None = None,
        calibration: "Calibration | None" = None,
        say: Callable[[str], None] = lambda text: None,
    ):
        self.problem, self.settings, self.say = problem, settings, say
        self._push = dict(push or {})
        self.measure = Residuals(problem)
        self.main = problem.horizons[len(problem.horizons) // 2]
        self.gauges: dict[float, Gauge] = {}
        self.fits: dict[float, Fit] = {}
        self.result = Result()
        self._calibration, self._looked = calibration, False
        self._healthy_gain = calibration.gain if calibration else 0.0
        self._penalty = calibration.penalty if calibration else 0.0

    # --- what is there before the first question

    def prepare(self) -> None:
        """Floor, null, and what healthy logs would gain by chance."""
        for horizon in self.problem.horizons:
            self.say(f"floor at {horizon:g} s")
            known = self._calibration.floors[horizon] if self._calibration else None
            self.gauges[horizon] = gauge(self.problem, self.measure, horizon, known)
        self.say("null")
        zero = np.zeros(self.problem.axes)
        for horizon in self.problem.horizons:
            free = self._nominal()
            start = Fit(
                free=free,
                coordinates=np.zeros(len(free.sd)),
                residual=self._residual(horizon, "train")(zero[None])[0],
                jacobian=self.gauges[horizon].jacobian.reshape(-1, len(free.sd)),
                weight=self.gauges[horizon].weight,
            )
            self.fits[horizon] = refine([start], self._residual(horizon, "train"), 3)[0]
        self.result.null = self.fits[self.main]

    def _nominal(self) -> Free:
        directions = nominal_directions(self.problem)
        count = len(directions)
        bounds = np.tile([-5.0, 5.0], (count, 1))
        # Nobody looks before it is time.
        bounds[count - len(self.problem.timing) :, 0] = 0.0
        return Free(directions, np.ones(count), bounds)

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
        if not self._penalty:
            slope = gauge_.jacobian
            self._penalty = max(
                localise.least_penalty(refitted(values, slope, gauge_.weight).reshape(len(residual), -1), flat)
                for values in gauge_.healthy
            )
        need = localise.free_torque(residual.reshape(len(residual), -1), flat, self._penalty)
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

    def fit(
        self, hypotheses: Sequence[Hypothesis], scores: Mapping[str, Score], horizon: float, starts=None
    ) -> list[Fit]:
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

        def at(hypothesis, point):
            return kept[hypothesis.key][0].vector + point @ hypothesis.directions

        residuals = _dealt(
            evaluate, [[at(h, point) for point in group] for h, group in zip(hypotheses, tried, strict=True)]
        )
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
            for size in [
                0.2 * np.abs(point) + 0.2 * hypothesis.probes.max(axis=0) + 0.02 * (hypothesis.probes == 0).all(axis=0)
            ]
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
            scores = screen.scores(hypotheses, log.ravel())
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
        if not self._looked:
            self._looked = True
            names = dict.fromkeys(h.name for h in hypotheses)
            shown = {h.name for h in hypotheses if scores[h.key].testable}
            self.result.not_testable = [name for name in names if name not in shown]
            self.say(f"these logs cannot show: {', '.join(self.result.not_testable) or 'nothing is beyond them'}")
            self._healthy_gain = self._healthy_gain or self.healthy_gain(screen, hypotheses)
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
            select = {h.key: decide.losses(r) for h, r in zip(short, shaped[1:], strict=True)}
            for key in decide.alike(select, 1.0):
                best_at[key] += 1
            if horizon == self.main:
                before = shaped[0]
                after = {h.key: r for h, r in zip(short, shaped[1:], strict=True)}
                gains = {key: decide.paired(before, r) for key, r in after.items()}
                train = {h.key: decide.losses(self._shaped(fits[h.key].residual, horizon)) for h in short}
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

    def drop(self) -> None:
        """Takes out earlier effects that no longer pay beside the last one."""
        for rung in self.result.rungs[:-1]:
            without = {horizon: self._ablated(horizon, rung.hypothesis) for horizon in self.fits}
            residual = self._residual(self.main, "select")
            found = residual(np.stack([without[self.main].vector, self.fits[self.main].vector]))
            gains = decide.paired(*(self._shaped(one, self.main) for one in found))
            if decide.t_statistic(gains) < 1.0:
                self.say(f"drop {rung.hypothesis.key}")
                self.result.rungs.remove(rung)
                self.fits = without

    def _ablated(self, horizon: float, hypothesis: Hypothesis) -> Fit:
        """The fit without an accepted effect, everything else fitted again."""
        fit = self.fits[horizon]
        own = np.array([any((d == mine).all() for mine in hypothesis.directions) for d in fit.free.directions])
        free = Free(*(part[~own] for part in fit.free.parts()))
        evaluate = self._residual(horizon, "train")
        start = replace(fit, free=free, coordinates=fit.coordinates[~own], jacobian=fit.jacobian[:, ~own])
        start = replace(start, residual=evaluate(start.vector[None])[0])
        return refine([start], evaluate, 3)[0]

    # --- after the last round

    def judge(self) -> None:
        """The verdict, from what `select` says."""
        result, settings = self.result, self.settings
        fit = result.fit = self.fits[self.main]
        result.errors = self._errors(fit)
        nominal = self.problem.prior > 0
        deviations = np.divide(fit.vector, self.problem.prior, out=np.zeros_like(fit.vector), where=nominal)
        error = np.sqrt((result.errors[:, None] ** 2 * fit.free.directions**2).sum(axis=0))
        moved = (np.abs(deviations) > settings.changed) & (np.abs(fit.vector) > 1.96 * error)
        result.changed = {int(axis): float(deviations[axis]) for axis in np.flatnonzero(moved)}
        null, after = (self.gap(one.vector, "select") for one in (result.null, fit))
        unexplained = after > settings.at_floor
        if result.rungs and null > 1.0:
            unexplained &= (null**2 - after**2) / (null**2 - 1.0) < settings.share
        if unexplained:
            result.verdict = "unnamed"
            # Parameters of a model that does not explain the logs mean nothing.
            result.changed = {}
            result.residual = self._free_residual()
        elif any(not self.is_nominal(rung.hypothesis) for rung in result.rungs):
            result.verdict = "named"
        else:
            result.verdict = "parameter_change" if result.changed else "no_missing_effect"

    def is_nominal(self, hypothesis: Hypothesis) -> bool:
        """Whether it is about parameters that every model has."""
        return bool((self.problem.prior[(hypothesis.directions != 0).any(axis=0)] > 0).all())

    def gap(self, vector: np.ndarray, split: str) -> float:
        """Root mean square of the worst component of the positions, in floor units, at the main horizon."""
        residual = self._shaped(self._residual(self.main, split)(vector[None])[0], self.main)
        return float(np.sqrt((residual**2).mean(axis=(0, 1)))[self._positions()].max())

    def _positions(self) -> np.ndarray:
        """Components that are positions."""
        signals = sorted(self.problem.data["train"][self.main].signals)
        return np.concatenate([[signal == "q"] * len(self.problem.components[signal]) for signal in signals])

    def _free_residual(self) -> Fit | None:
        """A bounded torque without a name at the joint that needs it most."""
        if not self.problem.residual:
            return None
        need = self.result.needs_torque
        joint = max(need, key=need.get) if any(need.values()) else self.result.where[0]["joint"]
        hypothesis = self.problem.residual[joint]
        scores = {hypothesis.key: Score(0.0, np.zeros(len(hypothesis.directions)), 0.0)}
        return self.fit([hypothesis], scores, self.main)[0]

    def prove(self) -> None:
        """Looks at the sealed segments, once."""
        result = self.result
        final = result.residual or result.fit
        zero = np.zeros(self.problem.axes)
        self.say("sealed")
        named = {"before": zero, "null": result.null.vector, "after": final.vector}
        others = {f"without {r.hypothesis.key}": self._ablated(self.main, r.hypothesis).vector for r in result.rungs}
        others |= self._placebos()
        residual = self._residual(self.main, "sealed")
        found = [self._shaped(one, self.main) for one in residual(np.stack([*named.values(), *others.values()]))]
        rms = {name: np.sqrt((r**2).mean(axis=(0, 1))) for name, r in zip([*named, *others], found, strict=True)}
        result.gap = {name: float(rms[name][self._positions()].max()) for name in named}
        signals = sorted(self.problem.data["train"][self.main].signals)
        cells = [(signal, part) for signal in signals for part in self.problem.components[signal]]
        result.proof = {
            "cells": [
                {
                    "signal": signal,
                    "joint": part,
                    "before": rms["before"][i],
                    "null": rms["null"][i],
                    "after": rms["after"][i],
                }
                for i, (signal, part) in enumerate(cells)
            ],
            "no_cell_worse": bool((rms["after"] <= rms["null"] + 1.0).all()),
            "others": {name: float(rms[name][self._positions()].max()) for name in others},
        }

    def _placebos(self) -> dict[str, np.ndarray]:
        """The first effect at a wrong joint, and a wrong effect at its place, with the same budget."""
        if not self.result.rungs:
            return {}
        truth = self.result.rungs[0].hypothesis
        same = [h for h in self.problem.hypotheses if h.name == truth.name and len(h.places) == len(truth.places)]
        elsewhere = [h for h in same if not set(h.places) & set(truth.places)]
        beside = [h for h in self.problem.hypotheses if h.places == truth.places and h.family != truth.family]
        kept, self.fits = self.fits, {self.main: self.result.null}
        found = {}
        for label, options in {"wrong place": elsewhere, "wrong effect": beside}.items():
            if options:
                fit = self.fit(options[:1], {options[0].key: Score(0.0, options[0].probes[0], 0.0)}, self.main)[0]
                found[f"{label}: {options[0].key}"] = fit.vector
        self.fits = kept
        return found

    # --- all of it

    def run(self, state: Mapping[str, Any] | None = None, save: Callable[[dict], None] = lambda state: None) -> Result:
        """Takes every step.

        Args:
          state: what an interrupted run saved last.
          save: told after every acceptance; numbers, texts, lists and dictionaries of them.
        """
        self.prepare()
        if state:
            self.resume(state)
        while len(self.result.rungs) < self.settings.most and self.round():
            self.drop()
            save(self.state())
        self.judge()
        self.prove()
        return self.result

    def calibrate(self) -> None:
        """Finds what healthy logs gain and need, without asking anything of the measured ones."""
        self.localise()
        self._healthy_gain = self.healthy_gain(
            self.screen(self.problem.hypotheses, self.fits[self.main]), self.problem.hypotheses
        )

    @property
    def calibration(self) -> Calibration:
        """What another log of the same robot and motion may be judged by."""
        floors = {horizon: (gauge_.floor, gauge_.weight) for horizon, gauge_ in self.gauges.items()}
        return Calibration(floors, self._healthy_gain, self._penalty)

    def state(self) -> dict:
        """What a run that goes on needs to know."""
        result = self.result
        own = lambda fit, hypothesis: [  # noqa: E731
            float(c)
            for c, direction in zip(fit.coordinates, fit.free.directions, strict=True)
            if any((direction == mine).all() for mine in hypothesis.directions)
        ]
        return {
            "rungs": [
                {
                    "key": rung.hypothesis.key,
                    "evidence": asdict(rung.evidence),
                    "thresholds": asdict(rung.thresholds),
                    "alike": list(rung.alike),
                    "coordinates": [own(self.fits[horizon], rung.hypothesis) for horizon in self.problem.horizons],
                }
                for rung in result.rungs
            ],
            "where": result.where,
            "not_testable": result.not_testable,
            "not_finite": result.not_finite,
            "healthy_gain": self._healthy_gain,
        }

    def resume(self, state: Mapping[str, Any]) -> None:
        """Stands where another run stood when it said this."""
        by_key = {hypothesis.key: hypothesis for hypothesis in self.problem.hypotheses}
        for saved in state["rungs"]:
            hypothesis = by_key[saved["key"]]
            for horizon, coordinates in zip(self.problem.horizons, saved["coordinates"], strict=True):
                starts = {hypothesis.key: np.array(coordinates)}
                self.fits[horizon] = self.fit([hypothesis], {}, horizon, starts)[0]
            evidence = {**saved["evidence"], "interval": tuple(saved["evidence"]["interval"])}
            self.result.rungs.append(
                Rung(
                    hypothesis,
                    decide.Evidence(**evidence),
                    decide.Thresholds(**saved["thresholds"]),
                    tuple(saved["alike"]),
                )
            )
        self.result.where, self.result.not_testable = state["where"], state["not_testable"]
        self.result.not_finite, self._healthy_gain = state["not_finite"], state["healthy_gain"]
        self._looked = True


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
