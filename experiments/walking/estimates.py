"""How exact estimates of a simulated robot's coordinates are, method by method; `experiments.bench` prints it."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from experiments.common.config import Preset
from experiments.walking import one_step
from experiments.walking.costs import Track, compiled
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from experiments.walking.robots import BITENO
from jaxtune import devices, readings, regression, spm
from jaxtune import dist as dists
from jaxtune.mjx import parameters
from jaxtune.settings import TunerConfig
from jaxtune.types import ParamDist

_MODELS = 5  # search-parameter models whose mean is compared with one


def compare(sizes: Preset, policy: str, radius: float, seeds: Sequence[int], track: Track = iter) -> dict[str, dict]:
    """Compares estimates of the coordinates of simulated robots, on the same episodes.

    Args:
      sizes: of a tuning; the number of robots is that of held-out sets.
      policy: what walks.
      radius: of the distribution.
      seeds: every seed has episodes and models of its own.
      track: shows which seed it is.

    Returns:
      By method: mean and 0.9-quantile of |estimate - truth| in radii, over all robots, coordinates and seeds, and the
      mean by coordinate; the mean error of the robot's mass, as a share of it; seconds to fit.
    """
    learner = Learner(sizes, BITENO.chosen("legs6"))
    machine, config = learner.tuner(), sizes.tuner
    dist = learner.dist(parameters.nominal(learner.entries), radius)
    start, methods = starting_policy(policy, learner), _estimators(config, dist)
    collect = compiled(lambda key: machine.collect(key, start, dist))
    found, truths = {name: ([], []) for name in methods}, []
    for seed in track(seeds):
        key_collect, key_fit = jax.random.split(jax.random.PRNGKey(seed))
        data = collect(key_collect)
        truths.append(np.asarray(dists.normalise(dist, data.held_out_coords)))
        for name, (train, answer) in methods.items():
            model, seconds = _timed(train, (key_fit, data))
            every = compiled(
                lambda model, sets, answer=answer: devices.in_chunks(answer, (sets,), readings.SETS, shared=(model,))
            )
            answers, times = found[name]
            answers.append(np.asarray(every(model, data.held_out)))
            times.append(seconds)
    truth, rows = np.concatenate(truths), {}
    mass = _mass(learner, dist, truth)
    for name, (answers, times) in found.items():
        answers = np.concatenate(answers)
        errors = np.abs(answers - truth)
        rows[name] = {
            "error": errors.mean(),
            "error_90": np.quantile(errors, 0.9),
            "fit_s": min(times),
            **dict(zip(dists.names(dist), errors.mean(axis=0).tolist(), strict=True)),
            "mass": np.abs(_mass(learner, dist, answers) / mass - 1.0).mean(),
        }
    return rows


def _estimators(config: TunerConfig, dist: ParamDist) -> dict[str, tuple[Callable, Callable]]:
    """What is compared: by name `(key, data) -> model` and `(model, set) -> coordinates in radii`."""

    def fit(settings, key, data):
        return spm.train(key, settings, data.trajectory, data.sampled_coords, dist)[0]

    def fit_several(key, data):
        return jax.lax.map(lambda key: fit(config.spm, key, data), jax.random.split(key, _MODELS))

    def mean_estimate(models, measured):
        return jax.vmap(partial(spm.estimate, config.spm), (0, None))(models, measured).mean(axis=0)

    def regress(key, data):
        return regression.train(config.regression, data.trajectory, data.sampled_coords, dist)

    raw, step_sizes = dataclasses.replace(config.spm, reads="steps"), one_step.OneStepConfig()
    return {
        "search-parameter model": (partial(fit, config.spm), partial(spm.estimate, config.spm)),
        "search-parameter model of raw steps": (partial(fit, raw), partial(spm.estimate, raw)),
        f"{_MODELS} search-parameter models, mean": (fit_several, mean_estimate),
        "one-step model": (
            lambda key, data: one_step.train(key, step_sizes, data.trajectory, data.sampled_coords, dist),
            partial(one_step.estimate, step_sizes),
        ),
        "regression": (regress, partial(regression.estimate, config.regression)),
    }


def _mass(learner: Learner, dist: ParamDist, radii: np.ndarray) -> np.ndarray:
    """Mass of BITeno [robots] in kg, of coordinates [robots, coords] in radii."""
    model = learner.robot.mj_model
    ratio = np.exp(np.asarray(dists.ravel(dist.centre)) + np.asarray(dists.ravel(dist.radius)) * radii)
    added = [
        model.body_mass[[model.body(link).id for link in entry.targets]].sum() * (ratio[:, number] - 1.0)
        for number, entry in enumerate(learner.entries[name] for name in dists.names(dist))
        if "body_mass" in entry.fields
    ]
    return model.body_mass.sum() + np.sum(added, axis=0)


def _timed(program: Callable, inputs: tuple) -> tuple[Any, float]:
    """What a program returns, and the seconds that it takes when it is compiled."""
    run = compiled(program)
    jax.block_until_ready(run(*inputs))
    begin = time.monotonic()
    found = jax.block_until_ready(run(*inputs))
    return found, time.monotonic() - begin
