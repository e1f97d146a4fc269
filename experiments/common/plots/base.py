"""What all plots share: colours of the methods, bands over seeds, and how a figure is written or embedded."""

import base64
import io
from pathlib import Path

import matplotlib
import numpy as np

from experiments.common import hosts

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLOURS = {"ours": "tab:blue", "spm": "tab:orange", "dr": "tab:green", "oracle": "tab:gray"}
"""Colour of every method, the same in all plots."""


def spread(axis, x: np.ndarray, values: np.ndarray, name: str) -> None:
    """Draws the mean over seeds as a line and their range as a band.

    Args:
      axis: matplotlib axes to draw on.
      x: [points] horizontal positions.
      values: [seeds, points] what is averaged.
      name: of the method; it chooses the colour and is the label.
    """
    axis.plot(x, values.mean(axis=0), "o-", ms=3, color=COLOURS[name], label=name)
    axis.fill_between(x, values.min(axis=0), values.max(axis=0), color=COLOURS[name], alpha=0.15)
    axis.grid(alpha=0.3)


def save(figure: plt.Figure, path: Path) -> None:
    """Writes a figure as PNG, making the folder where it is missing, and closes it so that its memory is freed."""
    hosts.from_first(lambda: _write(figure, path))
    plt.close(figure)


def _write(figure: plt.Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def embedded(figure: plt.Figure) -> str:
    """Returns a figure as the `src` of an HTML `img`, so that a page is one file, and closes the figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    plt.close(figure)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
