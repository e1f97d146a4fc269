"""What regression and response surface say of all sets of episodes: gate and update read the same.

A `Tuner` reads an accepted set once (`examine`), and hands the reading to both with the episodes (`Collected.reading`).
"""

from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxtune import devices, regression, surface
from jaxtune.settings import TunerConfig
from jaxtune.types import ParamDist, Trajectory

# Least distance of median and 0.9-quantile of each statistic, where all simulated sets are alike.
_LEAST_SPREAD = {"cover": 0.02, "lost": 0.1, "misfit": 0.05, "beyond": 0.1}
LEAST_ERROR = 1e-4
"""Radii; without noise a regression may be exact."""

SETS = {"cpu": 1, "other": 64}
"""Held-out sets that are scored side by side on a device (`devices.in_chunks`)."""


@chex.dataclass(frozen=True)
class Collected:
    """Simulated episodes drawn from one distribution: what `verify` and `update` learn from and are calibrated on.

    The paper's D_q trains both models. The held-out sets imitate a measured set: one draw of the coordinates per set,
    repeated in `set_episodes` episodes. No network is trained on them.
    """

    trajectory: Trajectory  # D_q, [episodes, time]
    sampled_coords: dict  # true coordinates of the episodes of D_q, [episodes] by name
    held_out: Trajectory  # [sets, set_episodes, time]
    held_out_coords: dict  # true coordinates of the held-out sets, [sets] by name
    dist: ParamDist  # what all coordinates were drawn from
    # What `examine` reads of these and the measured set; gate and update read it themselves where it is None.
    reading: Any = None
    # What earlier sets of the measured robot said (`pooling.Past`), which the update counts in; None if nothing.
    past: Any = None


@chex.dataclass(frozen=True)
class Reading:
    """What regression and response surface say of all held-out sets and, last, of the measured one."""

    model: regression.Regression
    answers: jax.Array  # [sets + 1, coords] estimates in radii, which may lie beyond the box
    misfit: jax.Array  # [sets + 1] of the four statistics of `calibrated_gate`; nan for a set without a valid window
    beyond: jax.Array  # [sets + 1] likewise


def cut_alike(collected: Collected, measured: Trajectory) -> Collected:
    """Hides of simulated episodes what is not known of measured ones, so that all sets are treated alike.

    An episode that was cut short without a fall, as by a hole in a log, says nothing of the rest of its time. Motion
    differs from the start of an episode to its end, so simulated episodes may not have that rest either. Episode i of
    each set goes without what measured episode i lacks, and so does every `set_episodes`-th episode of D_q.

    Args:
      collected: whole simulated episodes.
      measured: the measured set, [set_episodes, time].
    """
    # A set that is read from a log holds arrays of NumPy, which traced indices do not index.
    known = jnp.asarray(measured.alive | (measured.fell | measured.not_finite)[:, None])

    def cut(episodes, known):
        # What ends an episode in a hidden step is hidden as well.
        within = ~(episodes.alive & ~known).any(axis=-1)
        return episodes.replace(
            alive=episodes.alive & known, fell=episodes.fell & within, not_finite=episodes.not_finite & within
        )

    like = jnp.arange(len(collected.trajectory.alive)) % len(known)
    return collected.replace(trajectory=cut(collected.trajectory, known[like]), held_out=cut(collected.held_out, known))


def examine(config: TunerConfig, collected: Collected, measured: Trajectory) -> Reading:
    """Estimates all sets by regression, and computes how well they fit."""
    model, ways = fit(config, collected)
    scale = jnp.maximum(model.error, LEAST_ERROR)

    def one(model, ways, scale, episodes):
        answer, moments, count = regression.answers(config.regression, model, episodes)
        off = surface.misfit(ways, moments, jnp.clip(answer, model.low, model.high))
        beyond = (jnp.maximum(model.low - answer, answer - model.high) / scale).max()
        known = count > 0
        return answer, jnp.where(known, jnp.log(jnp.maximum(off, 1e-9)), jnp.nan), jnp.where(known, beyond, jnp.nan)

    answers, misfit, beyond = of_all_sets(one, (model, ways, scale), collected, measured)
    return Reading(model=model, answers=answers, misfit=misfit, beyond=beyond)


def fit(config: TunerConfig, collected: Collected) -> tuple[regression.Regression, surface.Surface]:
    """Fits the regression to D_q, and the way back."""
    model = regression.train(config.regression, collected.trajectory, collected.sampled_coords, collected.dist)
    return model, surface.train(model)


def reading_of(config: TunerConfig, collected: Collected, measured: Trajectory) -> Reading:
    """Returns the reading that the episodes come with, or makes it."""
    return examine(config, collected, measured) if collected.reading is None else collected.reading


def misses(reading: Reading) -> dict[str, jax.Array]:
    """Returns the statistics of a reading that the gate uses, [sets + 1] by name."""
    return {"misfit": reading.misfit, "beyond": reading.beyond}


def excess(name: str, values: jax.Array) -> jax.Array:
    """A statistic [sets] in units of what simulated sets scatter; nan for a set that has none."""
    median, high = jnp.nanquantile(values, 0.5), jnp.nanquantile(values, 0.9)
    return (values - median) / jnp.maximum(high - median, _LEAST_SPREAD[name])


def of_all_sets(function: Callable, shared: tuple, collected: Collected, measured: Trajectory):
    """What a function `(*shared, set)` returns for every held-out set and, last, for the measured one.

    Under `vmap` over measured sets alone, held-out sets are scored once for all. The function closes over constants
    only (`devices.spread`), and cannot be differentiated backwards.
    """
    held_out, measured = (episodes.replace(state=None) for episodes in (collected.held_out, measured))
    of = lambda shared, sets: devices.in_chunks(function, (sets,), SETS, shared=shared)  # noqa: E731

    def every(shared, held_out, measured):
        # Put together first, so that the function is compiled once.
        return of(shared, jax.tree.map(lambda sets, one: jnp.concatenate([sets, one[None]]), held_out, measured))

    @jax.custom_batching.custom_vmap
    def scored(shared, held_out, measured):
        return every(shared, held_out, measured)

    @scored.def_vmap
    def of_many(size, batched, shared, held_out, measured):
        if any(jax.tree.leaves(batched[:2])):
            # Lanes of a sweep have sets of their own.
            axes = jax.tree.map(lambda own: 0 if own else None, tuple(batched))
            found = jax.vmap(every, in_axes=axes, axis_size=size)(shared, held_out, measured)
        else:
            wide = lambda leaf, own: leaf if own else jnp.broadcast_to(leaf, (size, *leaf.shape))  # noqa: E731
            once, each = of(shared, held_out), of(shared, jax.tree.map(wide, measured, batched[2]))
            row = lambda sets, one: jnp.concatenate([sets, one[None]])  # noqa: E731
            found = jax.tree.map(lambda sets, ones: jax.vmap(row, (None, 0))(sets, ones), once, each)
        return found, jax.tree.map(lambda _: True, found)

    return scored(shared, held_out, measured)
