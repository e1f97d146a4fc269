"""Least squares with Gaussian priors, on residuals in floor units, whose variance may exceed the floor's.

Even the right effect, in another functional form than the library's, leaves more than the noise floor. So the variance
of every component of the residuals (such as the position of a joint) is unknown, and at least that of the floor. With
its mean square m over n rows, the cost of a model is twice the negative logarithm of its posterior, with the variance
at its maximum:

    C = sum over components of n (a min(m, 1) + b log max(m, 1)) + |c / s|^2,

with coordinates c, seen from the prior's centre, prior deviations s, and the shares a and b of rows that count as
independent (`Counts`). A component that nothing explains yet is thus weighed by its own misfit, and cannot drown what
the others and the prior say. Around a point the cost is least squares with weights w = a or b / m,

    L(u) = w |r + J u|^2 + |(c + u) / s|^2,

which are computed anew after every step (iteratively reweighted least squares).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear


@dataclass(frozen=True, kw_only=True)
class Counts:
    """How much independent evidence residuals [features] hold; the last dimension of a feature is its component."""

    components: int
    independent: float
    """Share of the rows that count as independent where a model is at the noise floor."""
    systematic: float = 1.0
    """The same where it is not; what a wrong model leaves goes together for longer than noise."""

    def mean_squares(self, residual: np.ndarray) -> np.ndarray:
        """Computes the mean square [components] of residuals [features]."""
        return (residual.reshape(-1, self.components) ** 2).mean(axis=0)

    def cost(self, mean_squares: np.ndarray, rows: int) -> np.ndarray:
        """Computes C without the prior from mean squares [..., components] over some rows; returns [...]."""
        near, beyond = np.minimum(mean_squares, 1.0), np.log(np.maximum(mean_squares, 1.0))
        return rows * (self.independent * near + self.systematic * beyond).sum(axis=-1)

    def weights(self, residual: np.ndarray) -> np.ndarray:
        """Computes w for every feature, [features]."""
        mean_squares = self.mean_squares(residual)
        weight = np.where(mean_squares > 1.0, self.systematic / np.maximum(mean_squares, 1.0), self.independent)
        return np.tile(weight, len(residual) // self.components)


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
    weight: np.ndarray
    """[features]"""

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Stacks what the loss squares, so that it reads |value + slope u|^2.

        Returns:
          Value [features + coordinates] and slope [features + coordinates, coordinates]; the prior's rows are last.
        """
        root = np.sqrt(self.weight)
        value = np.concatenate([root * self.residual, self.offset / self.sd])
        slope = np.concatenate([root[:, None] * self.jacobian, np.diag(1.0 / self.sd)])
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
        return solve(slope.T @ slope, slope.T @ value, self.offset, damping, bounds)


def solve(
    normal: np.ndarray, pull: np.ndarray, offset: np.ndarray, damping: float = 0.0, bounds: np.ndarray | None = None
) -> np.ndarray:
    """Solves the normal equations of a step within bounds: (normal + D) u = -pull; see `Linear.step`.

    Args:
      normal: [coordinates, coordinates] S'S.
      pull: [coordinates] S'v.
      offset: [coordinates] where the step begins.
      damping: share of the diagonal that is added to it.
      bounds: [coordinates, 2] of the point that the step leads to.
    """
    diagonal = np.diag(normal).copy()
    diagonal[diagonal <= 0] = 1.0
    # A coordinate on which nothing depends stays where it is, instead of making the system singular.
    normal = normal + np.diag(damping * diagonal + 1e-9 * diagonal)
    step = np.linalg.solve(normal, -pull)
    if bounds is None or ((bounds[:, 0] <= offset + step) & (offset + step <= bounds[:, 1])).all():
        return step
    # Scaled to a unit diagonal: a coordinate in seconds and one in Nm differ by orders of magnitude.
    scale = np.sqrt(np.diag(normal))
    root = np.linalg.cholesky(normal / np.outer(scale, scale)).T
    low, high = ((bounds - offset[:, None]) * scale[:, None]).T
    wanted = np.linalg.solve(root.T, -pull / scale)
    return lsq_linear(root, wanted, bounds=(low, high), method="bvls").x / scale


def complement(slope: np.ndarray, ridge: float = 1e-9) -> Callable[[np.ndarray], np.ndarray]:
    """Makes the projection onto what columns [n, k] cannot explain: v - Q Q'v, with Q R = columns.

    The screen takes out with it what the free coordinates explain. Columns that depend on others, by less than
    `ridge` of their length, are left out. Returns a function of [n] or [n, ...].
    """
    if not slope.shape[1]:
        return lambda values: values
    scale = np.sqrt((slope**2).sum(axis=0))
    basis, triangle = np.linalg.qr(slope / np.where(scale > 0, scale, 1.0))
    basis = basis[:, np.abs(np.diag(triangle)) > ridge]
    return lambda values: values - basis @ (basis.T @ values)
