"""Least squares with priors, on residuals in floor units.

Coordinates `u` are those that may move from a point: r(u) = r + J u, and the loss is
weight |r|^2 + |(offset + u) / sd|^2.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear


@dataclass(frozen=True)
class Linear:
    """Residuals near a point."""

    residual: np.ndarray
    """[features]"""
    jacobian: np.ndarray
    """[features, coordinates]"""
    offset: np.ndarray
    """[coordinates] where the point is, seen from the prior's centre."""
    sd: np.ndarray
    """[coordinates] the prior's standard deviation."""
    weight: float
    """Share of the features that count as independent."""

    @property
    def loss(self) -> float:
        """Loss at the point."""
        return float(self.weight * self.residual @ self.residual + ((self.offset / self.sd) ** 2).sum())

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Value [n] and slope [n, coordinates] of what is squared, the prior's rows last."""
        root = np.sqrt(self.weight)
        value = np.concatenate([root * self.residual, self.offset / self.sd])
        slope = np.concatenate([root * self.jacobian, np.diag(1.0 / self.sd)])
        return value, slope

    def step(self, damping: float = 0.0, bounds: np.ndarray | None = None) -> np.ndarray:
        """The step [coordinates] to the least loss; within bounds [coordinates, 2] of the point, if given.

        A step that is only cut short at its bounds leads nowhere: the others were to go along with it.
        """
        value, slope = self.rows()
        normal, pull = slope.T @ slope, slope.T @ value
        diagonal = np.diag(normal).copy()
        diagonal[diagonal <= 0] = 1.0
        # What nothing depends on stays where it is.
        normal = normal + np.diag(damping * diagonal + 1e-9 * diagonal)
        if bounds is None:
            return np.linalg.solve(normal, -pull)
        # Of unit diagonal, so that all coordinates count alike.
        scale = np.sqrt(np.diag(normal))
        root = np.linalg.cholesky(normal / np.outer(scale, scale)).T
        low, high = ((bounds - self.offset[:, None]) * scale[:, None]).T
        wanted = np.linalg.solve(root.T, -pull / scale)
        return lsq_linear(root, wanted, bounds=(low, high), method="bvls").x / scale


def complement(slope: np.ndarray, ridge: float = 1e-9):
    """The projection [n] -> [n] onto what these columns [n, k] cannot explain, as a function of [n, ...]."""
    if not slope.shape[1]:
        return lambda values: values
    scale = np.sqrt((slope**2).sum(axis=0))
    basis, triangle = np.linalg.qr(slope / np.where(scale > 0, scale, 1.0))
    basis = basis[:, np.abs(np.diag(triangle)) > ridge]
    return lambda values: values - basis @ (basis.T @ values)
