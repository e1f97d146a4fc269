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
misfit is where nothing is missing, both conformal as in `jaxtune.update`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from jaxtune import conformal, devices
from jaxtune import dist as dists
from jaxtune.types import Coords, ParamDist, Trajectory

_FREEDOM = 4.0  # n, degrees of freedom of the t distributions
_EXACT = 1e-3  # least error of a feature, as a share of what the distribution's coordinates change it by
# Radii: of the first secants, and of the shortest. Whether a foot slips or sticks changes in steps, across which a
# short secant is steep and wrong.
_SECANT, _SHORTEST = 0.5, 0.03
_ROUNDING = 0.01  # |z|^2 / k up to which pieces end where they were measured: misfits are a tenth of the least error
_CLOSEST = 0.002  # radii: least error; where nothing is noisy a fit ends before it is exact
_FURTHEST = 1.0  # radii that one step may move
_SHORTER = 0.3  # share of a step that is tried after one that did not lower the cost
_BROKEN = 1e3  # whitened error of a piece whose simulation is not finite
_SETS = {"cpu": 1, "other": 20}  # fitted side by side on a device

Pool = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
"""`pooling.joined` of one measured robot: `(estimates [sets + 1, coords], truth [sets, coords], valid [sets])`."""


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
class Replayed:
    """What the fits of a measured set and of simulated ones found, in radii of the distribution."""

    estimate: jax.Array  # [coords]
    interval: jax.Array  # [coords] half widths, in which all true coordinates lie together
    wide: jax.Array  # [coords] likewise, a tenth as often not
    identifiable: jax.Array  # [coords] whether simulated sets are estimated better than by what they were drawn from
    errors: jax.Array  # [coords, coords] mean product of the errors of simulated sets
    p_value: jax.Array  # (1 + #{simulated sets that misfit at least as much}) / (sets + 1)
    pooled: jax.Array  # whether earlier sets count in the estimate (`jaxtune.pooling`)
    p_past: jax.Array  # of what contradicts them; nan where they said nothing
    sets: jax.Array  # number of simulated sets that were fitted, and tell the errors


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


@chex.dataclass(frozen=True)
class _Fit:
    """Where the fit of one set stands."""

    best: jax.Array  # [coords]
    energy: jax.Array  # [pieces] |z|^2 / k there; infinite before the first step
    step: jax.Array  # [coords] that is tried from there
    normal: jax.Array  # [coords, coords] there, of Gauss-Newton


def alone(estimates: jax.Array, truth: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Joins estimates with nothing: a `Pool` of a robot that was never measured before."""
    return estimates, jnp.asarray(False), jnp.asarray(jnp.nan)


@devices.precisely
def estimate(
    config: ReplayConfig,
    replay: Replay,
    simulated: Trajectory,
    truth: Coords,
    measured: Trajectory,
    dist: ParamDist,
    coverage: float,
    others: Trajectory,
    true_others: Coords,
    pool: Pool = alone,
) -> Replayed:
    """Estimates the coordinates of a measured set, and how far the estimate may be off.

    Each set is fitted by itself, from the centre of the distribution. With Q the conformal quantile over simulated
    sets and e the standard errors of a fit, joined with the median error of the other simulated sets,

        interval     = e(measured) Q(max over coordinates of |estimate - truth| / e)
        wide         = the same with a quantile of 1 - (1 - coverage) / 10
        identifiable = rms of estimate - truth < 0.9 rms of truth.

    Simulated sets are fitted until one fits as badly as the measured one, `ReplayConfig.sets` or one more at a time.

    Args:
      config: sizes.
      replay: simulates pieces.
      simulated: sets with states, measured as the robot's are, [sets, episodes, time]; `ReplayConfig.sets` or more.
      truth: their coordinates, [sets] by name, drawn from `dist`.
      measured: the set with states, [episodes, time].
      dist: a distribution near the truth; estimates may leave it, but not its bounds.
      coverage: share of sets of which all true coordinates shall lie in their intervals.
      others: `ReplayConfig.sets` simulated sets, which say how features err. Others than the fitted ones: what was
        learnt of a set fits it better than it fits the measured one.
      true_others: their coordinates.
      pool: joins estimates with what earlier sets said.

    Returns:
      What was found; not finite where the measured set has no whole piece, or hardly any simulated one has.
    """

    def cut(sets):
        # What the measured states lack, the simulated ones must do without.
        lean = sets.replace(state={name: sets.state[name] for name in measured.state})
        every = jax.tree.map(lambda sets, one: jnp.concatenate([sets, one[None]]), lean, measured)
        return jax.vmap(lambda episodes: _cut(config, replay, episodes))(every)

    pieces, truth = cut(simulated), dists.normalise(dist, truth)
    others, true_others = cut(others), dists.normalise(dist, true_others)
    best, normal, left = _fit_until_exceeded(config, replay, pieces, others, true_others, dist)
    known = jnp.isfinite(left)
    joined, pooled, p_past = pool(best, truth, known[:-1])
    best = jnp.clip(joined, *(dists.normalise(dist, end) for end in (dist.lower, dist.upper)))
    error = jnp.where(known[:-1, None], best[:-1] - truth, jnp.nan)
    deviations = jax.vmap(lambda normal: jnp.sqrt(jnp.diag(jnp.linalg.inv(normal))))(normal)
    # Slopes that jump make some standard errors far too small.
    deviations = jnp.hypot(deviations, jnp.maximum(_medians(jnp.abs(error)), _CLOSEST))
    scaled = (jnp.abs(error) / deviations[:-1]).max(axis=-1)
    off = jnp.nan_to_num(error)
    interval, wide = (
        deviations[-1] * conformal.quantile(scaled, level)
        for level in (coverage, 1.0 - conformal.EACH * (1.0 - coverage))
    )
    # A coordinate that shows nowhere stays where the fit began, at zero.
    ignorant = jnp.where(known[:-1, None], truth**2, 0.0).sum(axis=0)
    return Replayed(
        estimate=jnp.where(known[-1], best[-1], jnp.nan),
        interval=interval,
        wide=wide,
        identifiable=(off**2).sum(axis=0) < conformal.IDENTIFIABLE**2 * ignorant,
        errors=off.T @ off / known[:-1].sum(),
        p_value=conformal.p_value(left),
        pooled=pooled,
        p_past=p_past,
        sets=known[:-1].sum(),
    )


def _fit_until_exceeded(
    config: ReplayConfig, replay: Replay, pieces: _Pieces, others: _Pieces, truth: jax.Array, dist: ParamDist
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Fits part after part of the simulated sets, until one misfits as badly as the measured one, or all are fitted.

    The arguments are those of `_fit`.

    Returns:
      Of the simulated sets and, last, the measured one: coordinates [sets + 1, coords] in radii, normal matrices of
      Gauss-Newton [sets + 1, coords, coords], and misfits [sets + 1], nan where a set was not fitted.
    """
    count, coords = len(pieces.valid), truth.shape[1]
    parts = _parts(count - 1, len(truth))

    def fit_part(carry):
        number, *found = carry
        rows = parts[number]
        mine = jax.tree.map(lambda leaf: leaf[rows], pieces)
        fits = _fit(config, replay, mine, others, truth, dist)
        logs = jnp.where(mine.valid, jnp.log1p(fits.energy), 0.0).sum(axis=-1) / jnp.maximum(mine.valid.sum(axis=-1), 1)
        # Or rounding would tell which of two exact fits is the worse one.
        logs = jnp.maximum(logs, jnp.log1p(_ROUNDING))
        # A set without a piece says nothing, and counts as one that is fitted badly.
        logs = jnp.where(mine.valid.any(axis=-1), logs, jnp.inf)
        some = fits.best, fits.normal, logs
        return number + 1, *(every.at[rows].set(one) for every, one in zip(found, some, strict=True))

    def goes_on(carry):
        number, _, _, left = carry
        worst = jnp.isfinite(left[-1]) & ~(left[:-1] >= left[-1]).any()
        return (number == 0) | ((number < len(parts)) & worst)

    unknown = jnp.broadcast_to(jnp.eye(coords), (count, coords, coords)), jnp.full(count, jnp.nan)
    start = jnp.zeros((), int), jnp.zeros((count, coords)), *unknown
    return jax.lax.while_loop(goes_on, fit_part, start)[1:]


def _parts(sets: int, first: int) -> jax.Array:
    """Which of all sets and the measured one, the last, are fitted side by side, [parts, first + 1] indices.

    The measured one is beside the first sets. Of the last part some are fitted again, so that all are alike.
    """
    size = first + 1
    rows = [[min(index, sets - 1) for index in range(low, low + size)] for low in range(first, sets, size)]
    return jnp.array([[*range(first), sets], *rows])


def _medians(values: Float[Array, "sets coords"]) -> Float[Array, "sets+1 coords"]:
    """The median over all other sets of each set and, last, over all sets: as if each were the measured one."""
    own = jnp.eye(len(values), dtype=bool)[..., None]
    others = jnp.nanmedian(jnp.where(own, jnp.nan, values), axis=1)
    return jnp.concatenate([others, jnp.nanmedian(values, axis=0)[None]])


def _fit(
    config: ReplayConfig, replay: Replay, pieces: _Pieces, others: _Pieces, truth: jax.Array, dist: ParamDist
) -> _Fit:
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

    def misses(centre, radius, pieces: _Pieces, points: Float[Array, "points coords"]) -> jax.Array:
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
    fits = _Fit(
        best=jnp.zeros((count + 1, coords)),
        energy=jnp.full(pieces.valid.shape, jnp.inf),
        step=jnp.zeros((count + 1, coords)),
        normal=jnp.broadcast_to(jnp.eye(coords), (count + 1, coords, coords)),
    )
    size = pieces.end.shape[-1]
    start = _Whitening(size=jnp.ones(size), inverse=jnp.eye(size)), fits
    (_, fits), _ = jax.lax.scan(improve, start, jnp.arange(config.iterations + 2))
    return fits


def _cut(config: ReplayConfig, replay: Replay, episodes: Trajectory) -> _Pieces:
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
    return _Pieces(
        start=jax.tree.map(lambda leaf: leaf[instead], start), action=action[instead], end=end[instead], valid=valid
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


def _secants(fit: _Fit, trial: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """How far secants go from a point along each coordinate, [coords]: as far as the last step, and onwards."""
    size = jnp.where(jnp.isfinite(fit.energy).all(), jnp.clip(jnp.abs(fit.step), _SHORTEST, _SECANT), _SECANT)
    size = jnp.where(fit.step < 0, -size, size)
    return jnp.where((trial + size < low) | (trial + size > high), -size, size)


def _improved(fit: _Fit, trial: jax.Array, secants: jax.Array, white: jax.Array, valid: jax.Array) -> _Fit:
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
    found = _Fit(best=trial, energy=now, step=newton, normal=normal)
    return optax.tree.where(better, found, fit.replace(step=_SHORTER * fit.step))
