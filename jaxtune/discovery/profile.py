"""What many small changes of a model would cost, once the free coordinates have answered each, without a simulation.

Near a fit the residuals are linear in the coordinates that are free. So for a change d of the residuals, such as an
effect of some size makes, the step u of the free coordinates that answers it follows from sums over the rows:

    u = argmin C(r + d + J u),

with the cost C of `least_squares`, prior included. Thousands of changes are answered in one batch.
"""

import numpy as np

from jaxtune.discovery.fit import Fit

_REWEIGHTED = 4  # times; the cost changes by less than chance after


class Profile:
    """A fit with the sums that answer a change of its residuals.

    Args:
      fit: the model, whose coordinates answer.
      columns: [features, k] further directions that may answer, without a prior, in both senses.
    """

    def __init__(self, fit: Fit, columns: np.ndarray | None = None):
        self._counts, parts = fit.counts, fit.counts.components
        extra = np.zeros((len(fit.residual), 0)) if columns is None else columns
        slopes = np.concatenate([fit.jacobian, extra], axis=1).astype(np.float32)
        none = np.zeros(extra.shape[1])
        self._slopes = np.moveaxis(slopes.reshape(-1, parts, slopes.shape[1]), 1, 0)
        self._residual = np.moveaxis(fit.residual.reshape(-1, parts), 1, 0).astype(np.float32)
        self._normal = (np.swapaxes(self._slopes, 1, 2) @ self._slopes).astype(float)
        self._offset = np.concatenate([fit.coordinates, none])
        self._precision = np.concatenate([fit.free.sd**-2.0, none])
        self._low, self._high = np.concatenate([fit.free.bounds, np.tile([-np.inf, np.inf], (len(none), 1))]).T

    def costs(self, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Answers changes of the residuals.

        Bounds are kept by clipping, so that a cost is never too low; a fit finds the bounded optimum later.

        Args:
          changes: [n, features]

        Returns:
          Costs [n], and the coordinates [n, coordinates and columns] that answer.
        """
        parts = len(self._residual)
        values = np.moveaxis(changes.reshape(len(changes), -1, parts), 2, 0) + self._residual[:, None]
        # Sums over rows: [components, n] and [components, n, coordinates].
        square = np.einsum("pnf,pnf->pn", values, values).astype(float)
        pull = (values @ self._slopes).astype(float)
        rows = values.shape[2]
        least = square
        for _ in range(_REWEIGHTED):
            mean = least / rows
            weight = np.where(mean > 1.0, self._counts.systematic / np.maximum(mean, 1.0), self._counts.independent)
            normal = np.einsum("pn,pij->nij", weight, self._normal) + np.diag(self._precision)
            diagonal = np.einsum("nii->ni", normal)
            normal = normal + np.eye(normal.shape[1]) * (1e-6 * np.maximum(diagonal, 1e-9))[:, None]
            wanted = -np.einsum("pn,pni->ni", weight, pull) - self._precision * self._offset
            step = np.linalg.solve(normal, wanted[..., None])[..., 0]
            step = np.clip(self._offset + step, self._low, self._high) - self._offset
            least = square + 2 * np.einsum("pni,ni->pn", pull, step)
            least = np.maximum(least + np.einsum("ni,pij,nj->pn", step, self._normal, step, optimize=True), 0.0)
        at = self._offset + step
        return self._counts.cost(least.T / rows, rows) + (self._precision * at**2).sum(axis=1), at
