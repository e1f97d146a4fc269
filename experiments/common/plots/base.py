"""What every picture shares: colours of the methods, bands over seeds, and where a figure goes."""

import base64
import io
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLOURS = {"ours": "tab:blue", "spm": "tab:orange", "dr": "tab:green", "oracle": "tab:gray"}


def spread(axis, x: np.ndarray, values: np.ndarray, name: str) -> None:
    """Draws the mean over seeds as a line and their range as a band.

    Args:
      axis: where to draw.
      x: [points]
      values: [seeds, points]
      name: of the method, which gives colour and label.
    """
    axis.plot(x, values.mean(axis=0), "o-", ms=3, color=COLOURS[name], label=name)
    axis.fill_between(x, values.min(axis=0), values.max(axis=0), color=COLOURS[name], alpha=0.15)
    axis.grid(alpha=0.3)


def save(figure: plt.Figure, path: Path) -> None:
    """Writes a figure as PNG, making the folder where it is missing, and closes it so that its memory is freed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def embedded(figure: plt.Figure) -> str:
    """Returns a figure as the `src` of an HTML `img`, so that a page is one file, and closes the figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    plt.close(figure)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
