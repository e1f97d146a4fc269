"""Short pieces of episodes, simulated again from measured states, and a fit of coordinates to those of each set.

The pieces of a set begin in measured states, with the measured actions (multiple shooting; Bock 1981). What a piece
ends off is nearly linear in the coordinates, so Gauss-Newton finds them. `jaxtune.replay` says what is minimised, and
makes estimates and intervals of it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from jaxtune import devices
from jaxtune import dist as dists
from jaxtune.types import Coords, ParamDist, Trajectory

_FREEDOM = 4.0  # n, degrees of freedom of the t distributions
_EXACT = 1e-3  # least error of a feature, as a share of what the distribution's coordinates change it by
# Radii: of the first secants, and of the shortest. Whether a foot slips or sticks changes in steps, across which a
# short secant is steep and wrong.
_SECANT, _SHORTEST = 0.5, 0.03
_FURTHEST = 1.0  # radii that one step may move
_SHORTER = 0.3  # share of a step that is tried after one that did not lower the cost
_BROKEN = 1e3  # whitened error of a piece whose simulation is not finite
_SETS = {"cpu": 1, "other": 20}  # fitted side by side on a device


@dataclass(frozen=True)
class Replay:
    """Simulates a piece of an episode from a measured state; `jaxtune.mjx.replay` makes one of an MJX robot.

    Both functions are of one robot, and are vmapped. A state is one step of `Trajectory.state`.
    """

    play: Callable[[Any, Float[Array, "steps act"], Coords], Float[Array, " features"]]
    """`(state, actions, coords: scalars by name) -> features` of the state after these control steps."""
    read: Callable[[Any], Float[Array, " features"]]
    """`state -> features` of a measured state, such as its positions and velocities."""
    needs: tuple[str, ...] = ()
    """Names that a measured state must have; others may be left out."""


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """Sizes of a replay; `TunerConfig` holds one."""

    window: int = 2
    """Control steps of a piece. Short ones are more linear; noisy states need longer ones."""
    stride: int = 10
    """Control steps from the start of one piece to the next."""
    iterations: int = 6
    """Gauss-Newton steps."""
    sets: int = 19
    """Simulated sets that are fitted beside the measured one; a level of 0.95 needs 19. If it fits worse than all of
    them, all other held-out sets are fitted too. The last ones, as many, say how features err: these fit a little
    better than a measured set can."""


@chex.dataclass(frozen=True)
class Pieces:
    """Pieces of the episodes of a set, behind each other."""

    start: Any  # measured states, [pieces, ...]
    action: jax.Array  # [pieces, steps, act]
    end: jax.Array  # measured features, [pieces, features]
    valid: jax.Array  # [pieces] True where the robot stood from start to end


@chex.dataclass(frozen=True)
class _Whitening:
    size: jax.Array  # [features] by which errors are divided first
    inverse: jax.Array  # L^-1 of what is left, [features, features]


@chex.dataclass(frozen=True)
class Fit:
    """Where the fit of one set stands."""

    best: jax.Array  # [coords]
    energy: jax.Array  # [pieces] |z|^2 / k there; infinite before the first step
    step: jax.Array  # [coords] that is tried from there
    normal: jax.Array  # [coords, coords] there, of Gauss-Newton


def cut(config: ReplayConfig, replay: Replay, episodes: Trajectory) -> Pieces:
    """Cuts a set [episodes, time] into pieces, those of all episodes behind each other."""
    steps = episodes.alive.shape[1]
    starts = jnp.arange(0, max(steps - config.window, 1), config.stride)
    within = starts[:, None] + jnp.arange(config.window)
    states = lambda where: jax.tree.map(lambda leaf: devices.merged(leaf[:, where]), episodes.state)  # noqa: E731
    # The state after a fall may be anything, so the step of the end must be alive too.
    alive = devices.merged(episodes.alive[:, within].all(axis=-1) & episodes.alive[:, starts + config.window])
    start, action, end = states(starts), devices.merged(episodes.action[:, within]), states(starts + config.window)
    end = jax.vmap(replay.read)(end)
    # A camera may lose a robot that stands.
    rows = [leaf.reshape(len(alive), -1) for leaf in (*jax.tree.leaves(start), action, end)]
    valid = alive & jnp.stack([jnp.isfinite(row).all(axis=-1) for row in rows]).all(axis=0)
    # What is simulated in the place of others does not matter, but a simulator may not bear what it never was.
    instead = jnp.where(valid, jnp.arange(len(valid)), jnp.argmax(valid))
    return Pieces(
        start=jax.tree.map(lambda leaf: leaf[instead], start), action=action[instead], end=end[instead], valid=valid
    )


def fit(config: ReplayConfig, replay: Replay, pieces: Pieces, others: Pieces, truth: jax.Array, dist: ParamDist) -> Fit:
    """Fits the pieces of all sets, each set by itself and all side by side.

    Args:
      config: sizes.
      replay: simulates pieces.
      pieces: of the simulated sets and, last, of the measured one, [sets + 1, pieces, ...].
      others: of the sets that say how features err, and one that is not read.
      truth: [sets, coords] of these, in radii.
      dist: whose radii and bounds are meant.
    """
    names, (count, coords) = dists.names(dist), truth.shape
    low, high = (dists.normalise(dist, end) for end in (dist.lower, dist.upper))

    def misses(centre, radius, pieces: Pieces, points: Float[Array, "points coords"]) -> jax.Array:
        def piece(point, start, action, end):
            return replay.play(start, action, dists.unravel(names, centre + radius * point)) - end

        many = jax.vmap(piece, (None, 0, 0, 0))
        # In turn: pieces are as many as suit a cache.
        found = jax.lax.map(lambda point: many(point, pieces.start, pieces.action, pieces.end), points)
        return jnp.where(pieces.valid[:, None], found, 0.0)

    def improve(carry, number):
        # The first round learns how features err. It is one of these rounds, so that simulation is compiled once.
        whitening, fits = carry
        tried = jax.vmap(lambda fit: jnp.clip(fit.best + fit.step, low, high))(fits)
        secants = jax.vmap(lambda fit, trial: _secants(fit, trial, low, high))(fits, tried)
        around = tried[:, None] + jnp.concatenate([jnp.zeros((1, coords)), jnp.eye(coords)]) * secants[:, None]
        points, mine = optax.tree.where(number == 0, (probes, others), (around, pieces))
        left = devices.in_chunks(
            misses, (mine, points), _SETS, shared=(dists.ravel(dist.centre), dists.ravel(dist.radius))
        )
        learn = lambda: _whitening(left[:-1, 0], left[:-1, 1], others.valid[:-1])  # noqa: E731
        whitening = jax.lax.cond(number == 0, learn, lambda: whitening)
        white = left / whitening.size @ whitening.inverse.T
        white = jnp.where(jnp.isfinite(white).all(axis=-1, keepdims=True), white, _BROKEN)
        better = jax.vmap(_improved)(fits, tried, secants, white, pieces.valid)
        return (whitening, optax.tree.where(number == 0, fits, better)), None

    probes = jnp.zeros((count + 1, coords + 1, coords)).at[:-1, 1].set(truth)
    fits = Fit(
        best=jnp.zeros((count + 1, coords)),
        energy=jnp.full(pieces.valid.shape, jnp.inf),
        step=jnp.zeros((count + 1, coords)),
        normal=jnp.broadcast_to(jnp.eye(coords), (count + 1, coords, coords)),
    )
    size = pieces.end.shape[-1]
    start = _Whitening(size=jnp.ones(size), inverse=jnp.eye(size)), fits
    (_, fits), _ = jax.lax.scan(improve, start, jnp.arange(config.iterations + 2))
    return fits


def _whitening(centre: jax.Array, truth: jax.Array, valid: jax.Array) -> _Whitening:
    """Learns how features err [sets, pieces, features], and how they err together, at true coordinates.

    Args:
      centre: errors where the coordinates are those of the centre.
      truth: errors at the true ones.
      valid: [sets, pieces]
    """
    finite = jnp.isfinite(centre).all(axis=-1) & jnp.isfinite(truth).all(axis=-1)
    weight = (valid & finite)[..., None]
    moved, left = (jnp.where(weight, values, 0.0).reshape(-1, values.shape[-1]) for values in (centre, truth))
    weight = weight.reshape(-1, 1).astype(left.dtype)
    count = jnp.maximum(weight.sum(), 1.0)
    size = jnp.maximum(jnp.sqrt((weight * (moved**2 + left**2)).sum(axis=0) / count), 1e-9)
    left = left / size
    # A few pieces in which a foot touches down earlier or later would widen the errors of all.
    typical = jnp.maximum(jnp.sqrt((weight * left**2).sum(axis=0) / count), _EXACT)
    weight = weight / (1.0 + ((left / typical) ** 2).mean(axis=-1, keepdims=True) / _FREEDOM)
    covariance = left.T @ (weight * left) / jnp.maximum(weight.sum(), 1e-9)
    root = jnp.linalg.cholesky(covariance + _EXACT**2 * jnp.eye(len(size)))
    return _Whitening(size=size, inverse=jax.scipy.linalg.solve_triangular(root, jnp.eye(len(size)), lower=True))


def _secants(fit: Fit, trial: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """How far secants go from a point along each coordinate, [coords]: as far as the last step, and onwards."""
    size = jnp.where(jnp.isfinite(fit.energy).all(), jnp.clip(jnp.abs(fit.step), _SHORTEST, _SECANT), _SECANT)
    size = jnp.where(fit.step < 0, -size, size)
    return jnp.where((trial + size < low) | (trial + size > high), -size, size)


def _improved(fit: Fit, trial: jax.Array, secants: jax.Array, white: jax.Array, valid: jax.Array) -> Fit:
    """Takes a trial if it costs less, and a Gauss-Newton step from there; else a shorter step from where the fit was.

    Args:
      fit: before.
      trial: [coords] that was simulated.
      secants: [coords] how far from it each coordinate was simulated too.
      white: whitened errors [1 + coords, pieces, features], first of the trial, then along each secant.
      valid: [pieces]
    """
    here, there = white[0], white[1:]
    features, now = here.shape[-1], jnp.where(valid, (here**2).mean(axis=-1), 0.0)

    def scale(energy):
        return jnp.maximum(jnp.nanmedian(jnp.where(valid, energy, jnp.nan)), 1.0)

    # Both under the scale of the better one so far; before the first step any is better than none.
    unit = jnp.where(jnp.isfinite(fit.energy).all(), scale(fit.energy), scale(now))

    def cost(energy, point):
        return (_FREEDOM + features) * jnp.log1p(features * energy / (_FREEDOM * unit)).sum() + point @ point

    better = ~(cost(now, trial) >= cost(fit.energy, fit.best))
    slopes = jnp.moveaxis(there - here, 0, -1) / secants
    weight = valid * (_FREEDOM + features) / (_FREEDOM + features * now / scale(now)) / scale(now)
    normal = jnp.einsum("p,pfi,pfj->ij", weight, slopes, slopes) + jnp.eye(len(trial))
    pull = jnp.einsum("p,pfi,pf->i", weight, slopes, here) + trial
    newton = jnp.clip(-jnp.linalg.solve(normal, pull), -_FURTHEST, _FURTHEST)
    found = Fit(best=trial, energy=now, step=newton, normal=normal)
    return optax.tree.where(better, found, fit.replace(step=_SHORTER * fit.step))
