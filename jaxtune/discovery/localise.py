"""Where simulation and measurement disagree (step 4)."""

from collections.abc import Sequence

import numpy as np

from jaxtune.discovery.resample import blocks


def cells(
    residual: np.ndarray,
    regimes: np.ndarray,
    regime_names: Sequence[str],
    components: Sequence[tuple[str, str]],
    run: np.ndarray,
) -> list[dict]:
    """Energy above the floor by component and regime, largest first, with bootstrap intervals over segments.

    Args:
      residual: [segments, bins, components] in floor units.
      regimes: [segments, bins, joints] index of each joint's regime.
      components: (signal, joint) of every component.
      run: [segments] index of each segment's run.
    """
    draws = blocks(run, 200)
    joints = [joint for signal, joint in components if signal == "q"]
    found = []
    for index, (signal, joint) in enumerate(components):
        column = regimes[..., joints.index(joint) if joint in joints else 0]
        for number, name in enumerate(regime_names):
            there = (column == number).astype(float)
            count = there.sum(axis=1)
            if (count > 0).sum() < 3:
                continue
            energy = (residual[..., index] ** 2 * there).sum(axis=1)
            resampled = energy[draws].sum(axis=1) / np.maximum(count[draws].sum(axis=1), 1.0)
            low, high = (excess(bound) for bound in np.quantile(resampled, (0.025, 0.975)))
            found.append(
                {
                    "joint": joint,
                    "signal": signal,
                    "regime": name,
                    "excess_floor_units": excess(energy.sum() / count.sum()),
                    "low": low,
                    "high": high,
                    "bins": int(count.sum()),
                }
            )
    return sorted(found, key=lambda cell: -cell["excess_floor_units"])


def excess(energy: float) -> float:
    """Floor units above the floor, of a mean square."""
    return float(np.sqrt(max(energy - 1.0, 0.0)))


def free_torque(residual: np.ndarray, slopes: np.ndarray, penalty: float) -> np.ndarray:
    """What every joint needs if each may have a torque of its own in every segment: [joints], zero where none.

    A group lasso over joints: min sum over segments |r_s + S_s a_s|^2 / 2 + penalty sum over joints |a_.j|, in units in
    which a joint's slopes have length one.

    Args:
      residual: [segments, features] in floor units.
      slopes: [segments, features, joints] of a constant torque at each joint.
      penalty: as large as the largest need in healthy logs.
    """
    size = np.sqrt((slopes**2).sum(axis=(0, 1)))
    slopes = slopes / np.where(size > 0, size, 1.0)
    torque = np.zeros((len(residual), slopes.shape[-1]))
    rate = 1.0 / max(np.linalg.eigvalsh(np.einsum("sfi,sfj->sij", slopes, slopes)).max(), 1e-12)
    for _ in range(300):
        left = residual + np.einsum("sfj,sj->sf", slopes, torque)
        torque = torque - rate * np.einsum("sfj,sf->sj", slopes, left)
        norm = np.sqrt((torque**2).sum(axis=0))
        torque *= np.maximum(1.0 - rate * penalty / np.maximum(norm, 1e-12), 0.0)
    return np.sqrt((torque**2).sum(axis=0))


def least_penalty(residual: np.ndarray, slopes: np.ndarray) -> float:
    """The smallest penalty under which no joint needs a torque."""
    size = np.sqrt((slopes**2).sum(axis=(0, 1)))
    slopes = slopes / np.where(size > 0, size, 1.0)
    pull = np.einsum("sfj,sf->sj", slopes, residual)
    return float(np.sqrt((pull**2).sum(axis=0)).max())
