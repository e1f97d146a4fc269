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

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtune import conformal, devices
from jaxtune import dist as dists
from jaxtune.shooting import Pieces, Replay, ReplayConfig, cut, fit
from jaxtune.types import Coords, ParamDist, Trajectory

_ROUNDING = 0.01  # |z|^2 / k up to which pieces end where they were measured: misfits are a tenth of the least error
_CLOSEST = 0.002  # radii: least error; where nothing is noisy a fit ends before it is exact

Pool = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
"""`pooling.joined` of one measured robot: `(estimates [sets + 1, coords], truth [sets, coords], valid [sets])`."""


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

    def pieces_of(sets):
        # What the measured states lack, the simulated ones must do without.
        lean = sets.replace(state={name: sets.state[name] for name in measured.state})
        every = jax.tree.map(lambda sets, one: jnp.concatenate([sets, one[None]]), lean, measured)
        return jax.vmap(lambda episodes: cut(config, replay, episodes))(every)

    pieces, truth = pieces_of(simulated), dists.normalise(dist, truth)
    others, true_others = pieces_of(others), dists.normalise(dist, true_others)
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
    config: ReplayConfig, replay: Replay, pieces: Pieces, others: Pieces, truth: jax.Array, dist: ParamDist
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Fits part after part of the simulated sets, until one misfits as badly as the measured one, or all are fitted.

    The arguments are those of `fit`.

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
        fits = fit(config, replay, mine, others, truth, dist)
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
