"""What many small changes of a model would cost, once the free coordinates have answered each, without a simulation.

Near a fit the residuals r are linear in the coordinates that are free, with slopes J. A library of simulated changes,
the rows of D, says what effects of some sizes make of them. For a sum D'w of such changes, the step u of the free
coordinates that answers it is

    u = argmin C(r + D'w + J u),

with the cost C of `least_squares`, prior included. For the sizes of effects that the model has, a Gaussian stands for
the prior (`Free.deviations`), so costs are compared within one profile only. How far each segment counts is known
roughly: those that are far off under the best model so far have little say in u, as few segments should not move a
parameter. With that settled, u needs no more than the products of r, J and D with each other, which are summed once.
The cost at u is computed from the residuals there, so that a change which explains the segments that are far off gets
the credit for that.
"""

from dataclasses import dataclass, replace

import numpy as np

from jaxtune.discovery.fit import Fit
from jaxtune.discovery.least_squares import Counts

_TOGETHER = 8  # components whose rows are in memory at once
_REWEIGHTED = 4  # times; the cost changes by less than chance after


@dataclass(frozen=True)
class Changes:
    """Sums of changes of a library: `weights` [n, some] of those with numbers `which` [some]."""

    which: np.ndarray
    weights: np.ndarray

    def of(self, library: np.ndarray) -> np.ndarray:
        """Sums the changes of a library [library, features]; returns [n, features]."""
        return self.weights @ library[self.which]


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A model near a fit, as sums over the rows of every component; see `profile_of`."""

    counts: Counts
    residual: np.ndarray
    """[features] r"""
    jacobian: np.ndarray
    """[features, coordinates] J"""
    library: np.ndarray
    """[library, features] D"""
    rows: int
    """Residuals of every component."""
    square: np.ndarray
    """[components] r'r; in this sum and in those that follow every segment counts by its share."""
    pull: np.ndarray
    """[components, coordinates] J'r"""
    normal: np.ndarray
    """[components, coordinates, coordinates] J'J"""
    of_residual: np.ndarray
    """[components, library] D r"""
    of_slopes: np.ndarray
    """[components, coordinates, library] J'D'"""
    gram: np.ndarray
    """[components, library, library] D D'"""
    offset: np.ndarray
    """[coordinates] where the fit stands."""
    precision: np.ndarray
    """[coordinates] of the prior."""
    bounds: np.ndarray
    """[coordinates, 2]"""

    def moved(self, change: Changes) -> "Profile":
        """Makes the profile of the model with one change (`weights` [1, some]) in it."""
        which, (weights,) = change.which, change.weights
        return replace(
            self,
            residual=self.residual + change.of(self.library)[0],
            square=self.square
            + 2 * self.of_residual[:, which] @ weights
            + np.einsum("s,pst,t->p", weights, self.gram[:, which[:, None], which], weights),
            pull=self.pull + self.of_slopes[:, :, which] @ weights,
            of_residual=self.of_residual + np.einsum("s,psl->pl", weights, self.gram[:, which]),
        )

    def with_directions(self, changes: Changes) -> "Profile":
        """Makes the profile of the model in which some changes may have any size, without a prior, in both senses."""
        which, weights = changes.which, changes.weights
        mixed = np.einsum("ns,pis->pin", weights, self.of_slopes[:, :, which])
        own = np.einsum("ns,pst,mt->pnm", weights, self.gram[:, which[:, None], which], weights)
        of_library = np.einsum("ns,psl->pnl", weights, self.gram[:, which])
        none = np.zeros(len(weights))
        return replace(
            self,
            jacobian=np.concatenate([self.jacobian, changes.of(self.library).T], axis=1),
            pull=np.concatenate([self.pull, self.of_residual[:, which] @ weights.T], axis=1),
            normal=np.block([[self.normal, mixed], [np.swapaxes(mixed, 1, 2), own]]),
            of_slopes=np.concatenate([self.of_slopes, of_library], axis=1),
            offset=np.concatenate([self.offset, none]),
            precision=np.concatenate([self.precision, none]),
            bounds=np.concatenate([self.bounds, np.tile([-np.inf, np.inf], (len(none), 1))]),
        )

    def costs(self, changes: Changes, reweighted: int = _REWEIGHTED) -> tuple[np.ndarray, np.ndarray]:
        """Answers changes of the residuals.

        Bounds are kept by clipping, so that a cost is never too low; a fit finds the bounded optimum later.

        Args:
          changes: n of them.
          reweighted: how often the weights of the components are computed anew.

        Returns:
          Costs [n], and the coordinates [n, coordinates] that answer.
        """
        which, weights = changes.which, changes.weights
        # Sums over rows: [n, components] and [n, components, coordinates].
        of_changes = np.einsum("ns,pst,nt->np", weights, self.gram[:, which[:, None], which], weights, optimize=True)
        square = self.square + 2 * weights @ self.of_residual[:, which].T + of_changes
        pull = self.pull + np.einsum("ns,pis->npi", weights, self.of_slopes[:, :, which], optimize=True)
        parts, count = self.pull.shape
        least = square
        for _ in range(reweighted):
            mean = np.maximum(least, 0.0) / self.rows
            weight = self.counts.independent / np.maximum(mean, 1.0)
            normal = (weight @ self.normal.reshape(parts, -1)).reshape(-1, count, count) + np.diag(self.precision)
            diagonal = np.einsum("nii->ni", normal)
            normal = normal + np.eye(count) * (1e-6 * np.maximum(diagonal, 1e-9))[:, None]
            wanted = -np.einsum("np,npi->ni", weight, pull) - self.precision * self.offset
            step = np.linalg.solve(normal, wanted[..., None])[..., 0]
            step = np.clip(self.offset + step, *self.bounds.T) - self.offset
            bent = np.einsum("npi,ni->np", (step @ self.normal.reshape(parts, count, count)).swapaxes(0, 1), step)
            least = np.maximum(square + 2 * np.einsum("npi,ni->np", pull, step) + bent, 0.0)
        at = self.offset + step
        left = self.residual + changes.of(self.library) + step @ self.jacobian.T
        costs = self.counts.cost(self.counts.mean_squares(left)).sum(axis=-1)
        return costs + (self.precision * at**2).sum(axis=1), at


def profile_of(fit: Fit, library: np.ndarray, shares: np.ndarray) -> Profile:
    """Sums over the rows of a fit.

    Args:
      fit: the model, whose coordinates answer.
      library: [library, features] changes of the residuals.
      shares: [segments, components] how far each segment counts, about one for a usual one.
    """
    parts, count = fit.counts.components, len(fit.coordinates)
    root = np.repeat(np.sqrt(shares), fit.counts.bins, axis=0)
    columns = [fit.residual, *fit.jacobian.T, *library]
    total = np.empty((parts, len(columns), len(columns)))
    slopes, changes = slice(1, 1 + count), slice(1 + count, None)
    for begin in range(0, parts, _TOGETHER):
        some = slice(begin, min(begin + _TOGETHER, parts))
        # The rows of a part one behind the other, column by column, since all at once would not fit into a cache.
        of_part = np.empty((some.stop - begin, len(columns), len(root)))
        for number, column in enumerate(columns):
            of_part[:, number] = (root[:, some] * column.reshape(root.shape)[:, some]).T
        for rows, products in zip(of_part, total[some], strict=True):
            np.matmul(rows, rows.T, out=products)
    return Profile(
        counts=fit.counts,
        residual=fit.residual,
        jacobian=fit.jacobian,
        library=library,
        rows=len(fit.residual) // parts,
        square=total[:, 0, 0],
        pull=total[:, slopes, 0],
        normal=np.ascontiguousarray(total[:, slopes, slopes]),
        of_residual=total[:, changes, 0],
        of_slopes=total[:, slopes, changes],
        gram=total[:, changes, changes],
        offset=fit.coordinates,
        precision=fit.free.deviations(fit.coordinates) ** -2.0,
        bounds=fit.free.bounds,
    )
