"""Estimates from measured states: which coordinates carry the robot from each measured state to the next?

Where a measured set holds the robot's whole state (`Trajectory.state`), short pieces of it can be simulated again from
their measured first states under their measured actions (multiple shooting; Bock 1981). What a piece ends off is nearly
linear in the coordinates, so Gauss-Newton finds them, far more exactly than moments of observations can. The tuner does
it once an accepted set was read (`Tuner.replay`).

A piece ends at features f (positions and velocities) that miss the measured ones by d. With noise these errors depend
on each other: a wrong first velocity shows in the last position. So d is whitened by its covariance over simulated sets
at their true coordinates, z = L^-1 d. With k features and coordinates c in radii, seen from the centre, a fit minimises

    sum over pieces of (n + k) log(1 + |z|^2 / (n s^2))  +  |c|^2,      n = 4

Pieces have t distributions, since contacts make some jump, and s^2 is the typical |z|^2 / k, one at least. The prior
has a standard deviation of one radius.

Simulated sets of known coordinates are fitted in the same way. They tell how far estimates err, and how large the
misfit is where nothing is missing, both conformal as in `jaxtune.rules`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtune import devices
from jaxtune import dist as dists
from jaxtune.types import Coords, ParamDist, Trajectory

_FREEDOM = 4.0  # n, degrees of freedom of the t distributions
_EXACT = 1e-3  # least error of a feature, as a share of what the distribution's coordinates change it by
# Radii: of the first secants, and of the shortest. Whether a foot slips or sticks changes in steps, across which a
# short secant is steep and wrong.
_SECANT, _SHORTEST = 0.5, 0.03
_CLOSEST = 0.01  # radii: least standard error; where nothing is noisy a fit ends before it is exact
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
    """Simulated sets that are fitted beside the measured one. A level of 0.95 needs 19."""


@chex.dataclass(frozen=True)
class Replayed:
    """What the fits of a measured set and of simulated ones found, in radii of the distribution."""

    estimate: jax.Array  # [coords]
    interval: jax.Array  # [coords] half widths, in which all true coordinates lie together
    errors: jax.Array  # [coords, coords] mean product of the errors of simulated sets
    p_value: jax.Array  # (1 + #{simulated sets that misfit at least as much}) / (sets + 1)


@chex.dataclass(frozen=True)
class _Pieces:
    start: Any  # measured states, [pieces, ...]
    action: jax.Array  # [pieces, steps, act]
    end: jax.Array  # measured features, [pieces, features]
    valid: jax.Array  # [pieces] True where the robot stood from start to end


@chex.dataclass(frozen=True)
class _Whitening:
    size: jax.Array  # [features] by which errors are divided first
    inverse: jax.Array  # L^-1 of what is left, [features, features]


def estimate(
    config: ReplayConfig,
    replay: Replay,
    simulated: Trajectory,
    truth: Coords,
    measured: Trajectory,
    dist: ParamDist,
    coverage: float,
) -> Replayed:
    """Estimates the coordinates of a measured set, and how far the estimate may be off.

    Each set is fitted by itself, from the centre of the distribution. With Q the conformal quantile over simulated
    sets and e the standard errors of a fit,

        interval = e(measured) Q(max over coordinates of |estimate - truth| / e).

    Args:
      config: sizes.
      replay: simulates pieces.
      simulated: sets with states, measured as the robot's are, [sets, episodes, time].
      truth: their coordinates, [sets] by name, drawn from `dist`.
      measured: the set with states, [episodes, time].
      dist: a distribution near the truth; estimates may leave it, but not its bounds.
      coverage: share of sets of which all true coordinates shall lie in their intervals.
    """
    # What the measured states lack, the simulated ones must do without.
    lean = simulated.replace(state={name: simulated.state[name] for name in measured.state})
    every = jax.tree.map(lambda sets, one: jnp.concatenate([sets, one[None]]), lean, measured)
    truth = dists.normalise(dist, truth)
    names, low, high = dists.names(dist), *(dists.normalise(dist, end) for end in (dist.lower, dist.upper))
    centre, radius = dists.ravel(dist.centre), dists.ravel(dist.radius)

    def misses(centre, radius, pieces: _Pieces, points: Float[Array, "points coords"]) -> jax.Array:
        def piece(point, start, action, end):
            return replay.play(start, action, dists.unravel(names, centre + radius * point)) - end

        many = jax.vmap(piece, (None, 0, 0, 0))
        # In turn: pieces are as many as suit a cache, and one more is as fast as two halves elsewhere.
        found = jax.lax.map(lambda point: many(point, pieces.start, pieces.action, pieces.end), points)
        return jnp.where(pieces.valid[:, None], found, 0.0)

    def first(centre, radius, episodes, truth):
        pieces = _cut(config, replay, episodes)
        return misses(centre, radius, pieces, jnp.stack([jnp.zeros_like(truth), truth])), pieces.valid

    at, valid = devices.in_chunks(first, (lean, truth), _SETS, shared=(centre, radius))
    whitening = _whitening(at[:, 0], at[:, 1], valid)

    def fit(centre, radius, low, high, whitening, episodes):
        pieces = _cut(config, replay, episodes)

        def whitened(points):
            left = misses(centre, radius, pieces, points) / whitening.size @ whitening.inverse.T
            broken = ~jnp.isfinite(left).all(axis=-1, keepdims=True)
            return jnp.where(broken, _BROKEN, left)

        return _fit(config, whitened, pieces.valid, low, high)

    points, deviations, misfit = devices.in_chunks(fit, (every,), _SETS, shared=(centre, radius, low, high, whitening))
    error = points[:-1] - truth
    scaled = (jnp.abs(error) / deviations[:-1]).max(axis=-1)
    rank = jnp.ceil((len(scaled) + 1) * coverage).astype(int) - 1
    return Replayed(
        estimate=points[-1],
        interval=deviations[-1] * jnp.sort(scaled)[jnp.minimum(rank, len(scaled) - 1)],
        errors=error.T @ error / len(error),
        p_value=(1 + jnp.sum(misfit[:-1] >= misfit[-1])) / len(misfit),
    )


def _cut(config: ReplayConfig, replay: Replay, episodes: Trajectory) -> _Pieces:
    """Cuts a set [episodes, time] into pieces, those of all episodes behind each other."""
    steps = episodes.alive.shape[1]
    starts = jnp.arange(0, max(steps - config.window, 1), config.stride)
    within = starts[:, None] + jnp.arange(config.window)
    flat = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])  # noqa: E731
    states = lambda where: jax.tree.map(lambda leaf: flat(leaf[:, where]), episodes.state)  # noqa: E731
    # The state after a fall may be anything, so the step of the end must be alive too.
    alive = episodes.alive[:, within].all(axis=-1) & episodes.alive[:, starts + config.window]
    return _Pieces(
        start=states(starts),
        action=flat(episodes.action[:, within]),
        end=jax.vmap(replay.read)(states(starts + config.window)),
        valid=flat(alive),
    )


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


def _fit(
    config: ReplayConfig,
    whitened: Callable[[jax.Array], jax.Array],
    valid: jax.Array,
    low: jax.Array,
    high: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Fits one set by Gauss-Newton, with the slopes by secants.

    Args:
      config: sizes.
      whitened: errors [points, pieces, features] at points [points, coords].
      valid: [pieces]
      low: [coords] bounds.
      high: [coords]

    Returns:
      The estimate [coords], its standard errors [coords], and the misfit, mean log(1 + |z|^2 / k) of its pieces.
    """
    count = len(low)
    pieces = jnp.maximum(valid.sum(), 1)

    def energies(errors):
        return jnp.where(valid, (errors**2).mean(axis=-1), 0.0)

    def scale(energy):
        return jnp.maximum(jnp.nanmedian(jnp.where(valid, energy, jnp.nan)), 1.0)

    def improve(carry, _):
        best, energy, step, normal, trial = carry
        # As long as the last step, and towards where it led.
        secants = jnp.where(step < 0, -1.0, 1.0) * jnp.clip(jnp.abs(step), _SHORTEST, _SECANT)
        secants = jnp.where((trial + secants < low) | (trial + secants > high), -secants, secants)
        here, *there = whitened(jnp.concatenate([trial[None], trial + jnp.diag(secants)]))
        features, now = here.shape[-1], energies(here)
        # Both under the scale of the better one so far; before the first step any is better than none.
        unit = jnp.where(jnp.isfinite(energy).all(), scale(energy), scale(now))
        cost = lambda energy, point: (  # noqa: E731
            (_FREEDOM + features) * jnp.log1p(features * energy / (_FREEDOM * unit)).sum() + point @ point
        )
        better = ~(cost(now, trial) >= cost(energy, best))
        slopes = jnp.stack([one - here for one in there], axis=-1) / secants
        weight = valid * (_FREEDOM + features) / (_FREEDOM + features * now / scale(now)) / scale(now)
        hessian = jnp.einsum("p,pfi,pfj->ij", weight, slopes, slopes) + jnp.eye(count)
        pull = jnp.einsum("p,pfi,pf->i", weight, slopes, here) + trial
        newton = jnp.clip(-jnp.linalg.solve(hessian, pull), -_FURTHEST, _FURTHEST)
        best, energy = jnp.where(better, trial, best), jnp.where(better, now, energy)
        step, normal = jnp.where(better, newton, _SHORTER * step), jnp.where(better, hessian, normal)
        return (best, energy, step, normal, jnp.clip(best + step, low, high)), None

    start, nothing = jnp.clip(jnp.zeros(count), low, high), jnp.full(valid.shape, jnp.inf)
    carry = (start, nothing, jnp.full(count, _SECANT), jnp.eye(count), start)
    (best, energy, _, normal, _), _ = jax.lax.scan(improve, carry, length=config.iterations + 1)
    deviations = jnp.sqrt(jnp.diag(jnp.linalg.inv(normal)))
    return best, jnp.maximum(deviations, _CLOSEST), jnp.where(valid, jnp.log1p(energy), 0.0).sum() / pieces
