"""Plots of how a robot walks: the cost of wrong parameters, and foot contacts against the gait clock."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from envs.biteno.constants import DUTY, POLICY_DT_S
from experiments.common.plots.base import save


def gaps(path: Path, rows: Sequence[dict], shown: dict[str, str], nominal: dict[str, float]) -> None:
    """Draws how an untuned policy walks if one parameter of the target differs from the simulator's.

    There is a column of panels for every varied parameter and a row for every quantity.

    Args:
      path: of the PNG.
      rows: one for every point: `sweep`, `value`, and the quantities.
      shown: labels of the quantities by name.
      nominal: the simulator's value, by sweep; drawn as a dashed line.
    """
    figure, axes = plt.subplots(
        len(shown), len(nominal), figsize=(9, 8), layout="constrained", sharex="col", sharey="row", squeeze=False
    )
    labels = {"friction": "friction of the feet", "mass": "mass, of nominal", "motor": "torque, of nominal"}
    for column, (sweep, value) in zip(axes.T, nominal.items(), strict=True):
        own = [row for row in rows if row["sweep"] == sweep]
        for axis, (name, label) in zip(column, shown.items(), strict=True):
            axis.plot([row["value"] for row in own], [row[name] for row in own], "o-", ms=3)
            axis.axvline(value, color="tab:gray", lw=0.8, ls="--")
            axis.grid(alpha=0.3)
            if axis in axes[:, 0]:
                axis.set_ylabel(label, fontsize=8)
        column[-1].set_xlabel(labels[sweep])
    save(figure, path)


def gait(path: Path, force: np.ndarray, phase: np.ndarray) -> None:
    """Draws the foot contacts of one episode over time, each above the contact that the gait clock prescribes.

    Args:
      path: of the PNG.
      force: [time, 2] N, normal force of left and right foot.
      phase: [time, 2] cycles, clock of left and right foot; the foot should be down below `constants.DUTY`.
    """
    time = np.arange(len(force)) * POLICY_DT_S
    figure, axis = plt.subplots(figsize=(9, 2.4), layout="constrained")
    for foot, (name, colour) in enumerate((("left", "tab:blue"), ("right", "tab:orange"))):
        for row, (on, shade) in enumerate(((phase[:, foot] < DUTY, 0.3), (force[:, foot] > 1.0, 1.0))):
            low = 2.4 * foot + row
            axis.fill_between(time, low, low + 0.9 * on, step="post", color=colour, alpha=shade, lw=0)
        axis.text(-0.01, 2.4 * foot + 0.45, f"{name}, clock", ha="right", va="center", transform=_beside(axis))
        axis.text(-0.01, 2.4 * foot + 1.45, f"{name}, floor", ha="right", va="center", transform=_beside(axis))
    axis.set(xlabel="s", yticks=[], xlim=(0, time[-1]))
    axis.spines[["left", "right", "top"]].set_visible(False)
    save(figure, path)


def _beside(axis):
    """Returns the transform for labels beside the plot: horizontal shares of the axes, vertical data units."""
    return axis.get_yaxis_transform()
