"""The driver: floor, null, localise, screen, fit, decide, accept and look again, abstain, prove.

    floor -> null -> [ localise -> screen -> fit (alone, then in pairs) -> decide -> accept ] up to four times -> prove

A round ends the ladder where nothing passes. Sealed segments are simulated by `prove` alone, once.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from jaxtune.discovery import decide, localise
from jaxtune.discovery.accept import accept, drop
from jaxtune.discovery.fit import ROUNDS_MORE, Fit, Free, anew, begin, polish, refine
from jaxtune.discovery.measure import Gauge, fitted, gauge, jacobian, nominal, residuals, slopes
from jaxtune.discovery.problem import Hypothesis, Problem, Residuals, apart, together
from jaxtune.discovery.prove import judge, prove, worst
from jaxtune.discovery.result import DEFAULTS, Calibration, Result, Settings
from jaxtune.discovery.saved import resume
from jaxtune.discovery.saved import state as state_of
from jaxtune.discovery.screen import Screen, probes, shortlist


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
        settings: Settings = DEFAULTS,
        push: Mapping[str, int] | None = None,
        calibration: Calibration | None = None,
        say: Callable[[str], None] = lambda text: None,
    ):
        self.problem, self.settings, self.say = problem, settings, say
        self._push = dict(push or {})
        self.measure = Residuals(problem)
        self.main = problem.horizons[len(problem.horizons) // 2]
        self.gauges: dict[float, Gauge] = {}
        self.fits: dict[float, Fit] = {}
        """The model as it stands, by horizon; other horizons than the main one from when they are first asked for."""
        self._settled: set[float] = set()
        self._slopes: dict[float, np.ndarray] = {}
        self.result = Result()
        self._calibration, self.looked = calibration, False
        self._screen: Screen | None = None
        self.promise: dict[str, float] = {}
        self.least_gain = calibration.gain if calibration else 0.0
        self.penalty = calibration.penalty if calibration else 0.0

    # --- what is there before the first question

    def prepare(self) -> None:
        """Floor, null, and what healthy logs would gain by chance."""
        for horizon in self.problem.horizons:
            self.say(f"floor at {horizon:g} s")
            known = self._calibration.floors[horizon] if self._calibration else None
            self.gauges[horizon] = gauge(self.problem, self.measure, horizon, known)
        self.say("null")
        main = self.main
        null = fitted(self.problem, self.residual(main, "train"), self.slopes(main), self.gauges[main].weight)
        if not np.isfinite(null.residual).all():
            raise ValueError(f"model: the nominal one breaks within {main:g} s of these logs")
        self.fits[main] = self.result.null = null

    def slopes(self, horizon: float) -> np.ndarray:
        """Of what is free from the start, at the nominal model: [segments, bins, components, directions]."""
        if horizon not in self._slopes:
            found = slopes(self.problem, self.measure, horizon)
            self._slopes[horizon] = found / self.gauges[horizon].floor["train"][..., None]
        return self._slopes[horizon]

    def stand(self, fits: dict[float, Fit]) -> None:
        """Goes on from another model."""
        self.fits, self._screen = fits, None
        self._settled.clear()

    def settle(self, horizon: float) -> Fit:
        """The model as it stands, fitted once a round with fresh slopes.

        Or the screen would not see what the nominal parameters have taken over; and with as many rounds as the
        hypotheses get, so that what they gain is theirs.
        """
        if horizon not in self._settled:
            fit = self.fits.get(horizon) or self.fits[self.main]
            fresh = self.anew(fit.free, fit.coordinates, horizon)
            fit = refine([fresh], self.residual(horizon, "train"), 2 * self.settings.rounds)[0]
            if not np.isfinite(fit.residual).all():
                raise ValueError(f"model: it breaks within {horizon:g} s of these logs")
            self.fits[horizon] = fit
            self._settled.add(horizon)
        return self.fits[horizon]

    def residual(self, horizon: float, split: str):
        """Residuals [n, features] of vectors [n, axes]."""
        return residuals(self.measure, self.problem.data[split][horizon], self.gauges[horizon].floor[split])

    def runs(self, split: str) -> np.ndarray:
        """Index of the run of every segment of the main horizon, [segments]."""
        return self.problem.data[split][self.main].run

    def shaped(self, residual: np.ndarray, horizon: float) -> np.ndarray:
        """[segments, bins, components, ...] again."""
        return residual.reshape(-1, *self.gauges[horizon].floor["train"].shape, *residual.shape[1:])

    # --- one round

    def localise(self) -> list[str]:
        """Fills in where the gap is; returns the joints that need a torque."""
        problem, gauge_, fit = self.problem, self.gauges[self.main], self.fits[self.main]
        residual = self.shaped(fit.residual, self.main)
        segments = problem.data["train"][self.main]
        regimes = segments.regimes[:, :: problem.bin_rows][:, : residual.shape[1]]
        if not self.result.where:
            self.result.where = localise.cells(residual, regimes, problem.regimes, problem.cells, segments.run)
        if not self._push:
            return []
        unit = np.zeros((len(self._push), problem.axes))
        unit[np.arange(len(unit)), list(self._push.values())] = 0.05
        slopes = jacobian(self.measure, fit.vector, unit, segments) / gauge_.floor["train"][..., None]
        flat = slopes.reshape(len(residual), -1, len(unit))
        if not self.penalty:
            self.penalty = max(
                localise.least_penalty(log.residual.reshape(len(residual), -1), flat) for log in gauge_.healthy
            )
        need = localise.free_torque(residual.reshape(len(residual), -1), flat, self.penalty)
        self.result.needs_torque = dict(zip(self._push, need.tolist(), strict=True))
        return [joint for joint, value in self.result.needs_torque.items() if value > 0]

    def screen(self, hypotheses: Sequence[Hypothesis], fit: Fit) -> Screen:
        """Secants of all hypotheses from where the model stands."""
        asked = probes(hypotheses)
        steps = np.zeros((len(asked), self.problem.axes))
        for row, (axis, size) in enumerate(asked):
            steps[row, axis] = size
        evaluate = self.residual(self.main, "train")
        columns = {}
        for start in range(0, len(asked), 32):
            self.say(f"screen {start}/{len(asked)}")
            found = evaluate(fit.vector + steps[start : start + 32])
            for key, residual in zip(asked[start : start + 32], found, strict=True):
                columns[key] = np.nan_to_num((residual - fit.residual) / key[1], posinf=0.0, neginf=0.0)
        return Screen(fit, columns)

    def fit(
        self,
        hypotheses: Sequence[Hypothesis],
        tried: Mapping[str, Sequence[np.ndarray]],
        horizon: float,
        rounds: int,
        absolute: bool = False,
        like: Sequence[Fit] | None = None,
    ) -> list[Fit]:
        """Fits hypotheses with everything that is free already, each from the best of the points that are tried."""
        evaluate = self.residual(horizon, "train")
        fits = begin(self.settle(horizon), hypotheses, [tried[h.key] for h in hypotheses], evaluate, absolute, like)
        return refine(fits, evaluate, rounds)

    def healthy_gain(self, screen: Screen, hypotheses: Sequence[Hypothesis]) -> float:
        """What the best hypothesis gains where nothing is missing, 95th percentile over healthy logs."""
        gauge_ = self.gauges[self.main]
        best = []
        for log in gauge_.healthy:
            scores = screen.scores(hypotheses, log)
            best.append(max(score.gain for score in scores.values()))
        return float(np.quantile(best, 1.0 - self.settings.level, method="higher"))

    def round(self) -> bool:
        """Looks for one more effect; whether one was accepted."""
        problem, settings = self.problem, self.settings
        self._settled.clear()
        base = self.settle(self.main)
        if not self.result.rungs:
            self.result.null = base
        if self.looked and worst(self, base.vector) <= settings.at_floor:
            return False
        taken = {rung.hypothesis.key for rung in self.result.rungs} | set(self.result.dropped)
        hypotheses = [h for h in problem.hypotheses if h.key not in taken]
        joints = self.localise()
        screen = self._screen = self.screen(hypotheses, base)
        scores = screen.scores(hypotheses)
        if not self.looked:
            self.looked = True
            self.promise = {key: score.gain for key, score in scores.items()}
            names = dict.fromkeys(h.name for h in hypotheses)
            shown = {h.name for h in hypotheses if scores[h.key].testable}
            self.result.not_testable = [name for name in names if name not in shown]
            self.say(f"these logs cannot show: {', '.join(self.result.not_testable) or 'nothing is beyond them'}")
            self.least_gain = self.least_gain or self.healthy_gain(screen, hypotheses)
        index = {joint: number for number, joint in enumerate(self._push)}
        needing = {index[joint] for joint in joints}
        near = [h for h in hypotheses if not needing or not h.joints or needing & set(h.joints)]
        # What is larger than the smallest size of interest may show where that would not.
        near = [h for h in near if scores[h.key].testable or scores[h.key].gain > self.least_gain]
        # A fit finds more than its first step does, but not many times as much.
        near = [h for h in near if scores[h.key].gain > settings.promising * self.least_gain]
        short = shortlist(scores, near, settings.shortlist)
        self.say(f"fit {len(short)}")
        if not short:
            return False
        tried = {h.key: _starts(h, scores[h.key].coordinates) for h in short}
        short, everywhere = self._compete(short, tried)
        return bool(short) and (accept(self, short, everywhere) or self._pair(short, everywhere[self.main]))

    def _compete(
        self, hypotheses: Sequence[Hypothesis], tried: Mapping[str, Sequence[np.ndarray]], absolute: bool = False
    ):
        """Fits hypotheses; the finalists, best first, and their fits by horizon and hypothesis."""
        settings, evaluate = self.settings, self.residual(self.main, "train")
        fits = self.fit(hypotheses, tried, self.main, settings.rounds, absolute)
        found = {h.key: fit for h, fit in zip(hypotheses, fits, strict=True) if fit.finite}
        self.result.not_finite += [h.key for h in hypotheses if h.key not in found]
        loss = lambda h: found[h.key].linear.loss  # noqa: E731
        short = sorted((h for h in hypotheses if h.key in found), key=loss)[: settings.finalists]
        if not short:
            return [], {}
        polished = polish([found[h.key] for h in short], evaluate, settings.rounds)
        found |= {h.key: fit for h, fit in zip(short, polished, strict=True)}
        short.sort(key=loss)
        everywhere = {self.main: {h.key: found[h.key] for h in short}}
        starts, like = {h.key: [found[h.key].own(h)] for h in short}, [found[h.key] for h in short]
        for horizon in self.problem.horizons:
            if horizon != self.main:
                there = self.fit(short, starts, horizon, ROUNDS_MORE, absolute=True, like=like)
                everywhere[horizon] = dict(zip([h.key for h in short], there, strict=True))
        return short, everywhere

    def _pair(self, short: Sequence[Hypothesis], fits: Mapping[str, Fit]) -> bool:
        """Tries the best two by two where something is missing and none pays alone; whether two were accepted."""
        if self.result.rungs or worst(self, self.fits[self.main].vector) <= self.settings.at_floor:
            return False
        couples = [(one, two) for one, two in combinations(short[: self.settings.paired], 2) if apart(one, two)]
        self.say(f"fit {len(couples)} pairs")
        pairs = [together(one, two) for one, two in couples]
        tried = {
            pair.key: [np.concatenate([fits[one.key].own(one), fits[two.key].own(two)])]
            for pair, (one, two) in zip(pairs, couples, strict=True)
        }
        if not pairs:
            return False
        pairs, everywhere = self._compete(pairs, tried, absolute=True)
        return bool(pairs) and accept(self, pairs, everywhere)

    def errors(self, fit: Fit) -> np.ndarray:
        """Standard errors of a fit's coordinates."""
        features = self.gauges[self.main].floor["train"].size  # of a segment
        jacobian_ = fit.jacobian.reshape(-1, features, fit.jacobian.shape[-1])
        return decide.sandwich(
            fit.residual.reshape(-1, features), jacobian_, fit.weight, fit.free.sd, self.runs("train")
        )

    def ablated(self, horizon: float, hypothesis: Hypothesis) -> Fit:
        """The fit without an accepted effect, everything else fitted again."""
        fit = self.fits[horizon]
        own = fit.along(hypothesis)
        evaluate = self.residual(horizon, "train")
        # What the hypothesis had taken over is a nominal parameter again.
        first, seen = nominal(self.problem), self.slopes(horizon).reshape(len(fit.residual), -1)
        kept = fit.free.directions[fit.free.nominal & ~own]
        back = np.array([not any((row == mine).all() for mine in kept) for row in first.directions])
        free = Free(*(part[~own] for part in fit.free.parts()))
        start = replace(
            fit,
            free=free.and_then(Free(*(part[back] for part in first.parts()))),
            coordinates=np.concatenate([fit.coordinates[~own], np.zeros(back.sum())]),
            jacobian=np.concatenate([fit.jacobian[:, ~own], seen[:, back]], axis=1),
        )
        start = replace(start, residual=evaluate(start.vector[None])[0])
        return refine([start], evaluate, 3)[0]

    # --- all of it

    def run(self, state: Mapping[str, Any] | None = None, save: Callable[[dict], None] = lambda state: None) -> Result:
        """Takes every step.

        Args:
          state: what an interrupted run saved last.
          save: told after every acceptance; numbers, texts, lists and dictionaries of them.
        """
        self.prepare()
        if state:
            resume(self, state)
        while len(self.result.rungs) < self.settings.most and self.round():
            drop(self)
            save(state_of(self))
        judge(self)
        named = {rung.hypothesis.name for rung in self.result.rungs}
        self.result.not_testable = [name for name in self.result.not_testable if name not in named]
        prove(self)
        return self.result

    def anew(self, free: Free, coordinates: np.ndarray, horizon: float) -> Fit:
        """A fit of which no more is known than where it stands."""
        return anew(free, coordinates, self.gauges[horizon].weight, self.residual(horizon, "train"))

    def mistaken_for(self, axis: int) -> tuple[str, ...]:
        """Names of the effects that look like the change of a nominal parameter."""
        fit = self.fits[self.main]
        self._screen = self._screen or self.screen(self.problem.hypotheses, fit)
        return self._screen.like(axis, fit.vector[axis], self.problem.hypotheses, self.settings.same)

    def calibrate(self) -> None:
        """Finds what healthy logs gain and need, without asking anything of the measured ones."""
        self.localise()
        self.least_gain = self.healthy_gain(
            self.screen(self.problem.hypotheses, self.fits[self.main]), self.problem.hypotheses
        )

    @property
    def calibration(self) -> Calibration:
        """What another log of the same robot and motion may be judged by."""
        floors = {horizon: (gauge_.floor, gauge_.weight) for horizon, gauge_ in self.gauges.items()}
        return Calibration(floors, self.least_gain, self.penalty)


def _starts(hypothesis: Hypothesis, found: np.ndarray) -> list[np.ndarray]:
    """Points to try: what the screen found, less and more of it; the sizes that were looked at, where these matter."""
    others = list(hypothesis.probes) if len(hypothesis.probes) > 1 and hypothesis.bounds[0, 0] >= 0 else []
    return [found, 0.4 * found, 2.5 * found, *others]
