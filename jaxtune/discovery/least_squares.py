"""Least squares with Gaussian priors, on residuals in floor units.

Around a point, residuals are r(u) = r + J u for a step u, and the loss is

    L(u) = w |r + J u|^2 + |(c + u) / s|^2

with the share of independent features w, the point's coordinates c, seen from the prior's centre, and the prior's
standard deviations s. Up to a constant it is twice the negative logarithm of the posterior.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear


@dataclass(frozen=True)
class Linear:
    """Residuals near a point, to first order, with the prior of the coordinates: what a Gauss-Newton step needs."""

    residual: np.ndarray
    """[features]"""
    jacobian: np.ndarray
    """[features, coordinates]"""
    offset: np.ndarray
    """[coordinates]: where the point is, seen from the prior's centre."""
    sd: np.ndarray
    """[coordinates]: standard deviation of the prior."""
    weight: float
    """Share of the features that count as independent."""

    @property
    def loss(self) -> float:
        """The loss at the point, L(0). Where residuals are noise alone, chance moves it by about one."""
        return float(self.weight * self.residual @ self.residual + ((self.offset / self.sd) ** 2).sum())

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Stacks what the loss squares, so that it reads |value + slope u|^2.

        Returns:
          Value [features + coordinates] and slope [features + coordinates, coordinates]; the prior's rows are last.
        """
        root = np.sqrt(self.weight)
        value = np.concatenate([root * self.residual, self.offset / self.sd])
        slope = np.concatenate([root * self.jacobian, np.diag(1.0 / self.sd)])
        return value, slope

    def step(self, damping: float = 0.0, bounds: np.ndarray | None = None) -> np.ndarray:
        """Finds the step u [coordinates] to the least loss: (S'S + D) u = -S'v, of `rows` v and S, with damping D.

        Within bounds it solves the bounded problem (BVLS; Stark and Parker, 1995). To clip the free solution would not
        do: where one coordinate meets its bound the others have to make up for it.

        Args:
          damping: share of the diagonal that is added to it (Marquardt).
          bounds: [coordinates, 2] of the point that the step leads to.
        """
        value, slope = self.rows()
        normal, pull = slope.T @ slope, slope.T @ value
        diagonal = np.diag(normal).copy()
        diagonal[diagonal <= 0] = 1.0
        # A coordinate on which nothing depends stays where it is, instead of making the system singular.
        normal = normal + np.diag(damping * diagonal + 1e-9 * diagonal)
        if bounds is None:
            return np.linalg.solve(normal, -pull)
        # Scaled to a unit diagonal: a coordinate in seconds and one in Nm differ by orders of magnitude.
        scale = np.sqrt(np.diag(normal))
        root = np.linalg.cholesky(normal / np.outer(scale, scale)).T
        low, high = ((bounds - self.offset[:, None]) * scale[:, None]).T
        wanted = np.linalg.solve(root.T, -pull / scale)
        return lsq_linear(root, wanted, bounds=(low, high), method="bvls").x / scale


def complement(slope: np.ndarray, ridge: float = 1e-9) -> Callable[[np.ndarray], np.ndarray]:
    """Makes the projection onto what columns [n, k] cannot explain: v - Q Q'v, with Q R = columns.

    The score test takes out with it what the free coordinates explain. Columns that depend on others, by less than
    `ridge` of their length, are left out. Returns a function of [n] or [n, ...].
    """
    if not slope.shape[1]:
        return lambda values: values
    scale = np.sqrt((slope**2).sum(axis=0))
    basis, triangle = np.linalg.qr(slope / np.where(scale > 0, scale, 1.0))
    basis = basis[:, np.abs(np.diag(triangle)) > ridge]
    return lambda values: values - basis @ (basis.T @ values)
