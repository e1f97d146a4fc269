"""Least squares with priors, on residuals in floor units, whose variance may exceed the floor's.

Even the right effect, in another functional form than the library's, leaves more than the noise floor, and in a few
segments much more than in the others: where a joint sticks or a state was estimated across a jump. So the residuals of
every component (such as the position of a joint) have an unknown variance v, at least that of the floor, and a segment
of them has a t distribution. With the mean square m of a component over a segment, which is worth n independent
numbers, and f degrees of freedom, the cost of a model is twice the negative logarithm of its posterior, with v at its
maximum:

    C = sum over components and segments of n log v + (n + f) log(1 + n m / (f v)) + sum of P(c / s),   v >= 1,

with coordinates c, seen from the prior's centre, and prior deviations s. A component that nothing explains yet is thus
weighed by its own misfit, and a segment that nothing explains counts by the logarithm of its own: neither can drown
what the others and the prior say.

The nominal parameters have a Gaussian prior, P(z) = z^2. How large an effect is, if it is there, nobody knows: up to
its deviation all sizes are about as likely, and beyond it all orders of magnitude, P(z) = log(1 + z^2) (`of_size`). An
encoder that is off by a tooth of its horn is ten deviations off; a Gaussian prior would let another effect have it.
What only shapes an effect, such as a share, has the same prior within its bounds.

Around a point the cost is least squares with weights w and deviations s',

    L(u) = w |r + J u|^2 + |(c + u) / s'|^2,   w = (n + f) / (f v + n m) a,   s'^2 = s^2 (1 + z^2),

with the share a of rows that count as independent (`Counts`), and s' = s for a Gaussian prior. Both are computed anew
after every step (iteratively reweighted least squares).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

_FREEDOM = 4.0  # degrees of freedom of the t distribution
_RARE = 50  # one segment of so many, in every component, may be off for a reason that no model has
_ROUNDS, _SETTLED = 60, 1e-3  # rounds of expectation and maximisation at most; change of a variance that ends them


def of_size(z: np.ndarray) -> np.ndarray:
    """What the prior says against sizes `z` of effects, in deviations: log(1 + z^2)."""
    return np.log1p(z**2)


@dataclass(frozen=True, kw_only=True)
class Counts:
    """How much independent evidence residuals hold, [features] = [segments, bins, components]."""

    components: int
    bins: int
    """Rows of every component in a segment."""
    independent: float
    """Share of the rows that count as independent."""

    def mean_squares(self, residual: np.ndarray) -> np.ndarray:
        """Computes the mean squares [..., segments, components] of residuals [..., features]."""
        return (residual.reshape(*residual.shape[:-1], -1, self.bins, self.components) ** 2).mean(axis=-2)

    @staticmethod
    def usual(mean_squares: np.ndarray) -> np.ndarray:
        """Averages mean squares [segments, components] over all segments but the worst fiftieth, [components].

        A leg that lacked nothing had one segment that was 18 floor units off, where the median was 0.8. A segment
        that is not finite is never left out.
        """
        kept = len(mean_squares) - round(len(mean_squares) / _RARE)
        found = np.sort(mean_squares, axis=0)[:kept].mean(axis=0)
        return np.where(np.isfinite(mean_squares).all(axis=0), found, np.nan)

    def cost(self, mean_squares: np.ndarray) -> np.ndarray:
        """Computes C without the prior from mean squares [..., segments, components]; returns what each segment adds,
        [..., segments]."""
        count, variance = self.bins * self.independent, self.variances(mean_squares)[..., None, :]
        beyond = (count + _FREEDOM) * np.log1p(count * mean_squares / (_FREEDOM * variance))
        return (count * np.log(variance) + beyond).sum(axis=-1)

    def weights(self, residual: np.ndarray) -> np.ndarray:
        """Computes w for every feature, [features]."""
        mean_squares = self.mean_squares(residual)
        variance = self.variances(mean_squares)
        weight = self.independent * self._shares(mean_squares, variance) / variance
        return np.repeat(weight, self.bins, axis=0).ravel()

    def shares(self, residual: np.ndarray) -> np.ndarray:
        """Computes how far each segment of residuals [features] counts, [segments, components]: w v / a."""
        mean_squares = self.mean_squares(residual)
        return self._shares(mean_squares, self.variances(mean_squares))

    def variances(self, mean_squares: np.ndarray) -> np.ndarray:
        """Computes the v at which C is least, [..., components], from mean squares [..., segments, components].

        A few segments hardly move it. Source: Lange, Little and Taylor (1989).
        """
        variance = np.maximum(mean_squares.mean(axis=-2), 1.0)
        for _ in range(_ROUNDS):
            before, weighed = variance, self._shares(mean_squares, variance[..., None, :]) * mean_squares
            variance = np.maximum(weighed.mean(axis=-2), 1.0)
            if (np.abs(variance - before) < _SETTLED * before).all():
                break
        return variance

    def _shares(self, mean_squares: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """How far a segment counts, [segments, components]; about one where it is as far off as the others."""
        count = self.bins * self.independent
        return (count + _FREEDOM) / (_FREEDOM + count * mean_squares / variance)


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
    """[coordinates]: standard deviation of the prior, or of the Gaussian that stands for it here."""
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

    def without(self, outs: Sequence[np.ndarray], free: np.ndarray) -> list[float]:
        """Says how much the loss grows where some coordinates are taken back to zero, and others answer.

        Args:
          outs: [coordinates] masks of what is taken back, one after the other.
          free: [coordinates] True for what may answer.
        """
        value, slope = (part.astype(float) for part in self.rows())
        normal, pull, grown = slope.T @ slope, slope.T @ value, []
        for out in outs:
            move, answer = np.where(out, -self.offset, 0.0), free & ~out
            move[answer] = solve(normal[np.ix_(answer, answer)], (pull + normal @ move)[answer], self.offset[answer])
            grown.append(float(2.0 * pull @ move + move @ normal @ move))
        return grown


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
