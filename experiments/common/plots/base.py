"""What every picture shares."""

import base64
import io
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLOURS = {"ours": "tab:blue", "spm": "tab:orange", "dr": "tab:green", "oracle": "tab:gray"}


def spread(axis, x: np.ndarray, values: np.ndarray, name: str) -> None:
    """Mean over seeds as a line, least to largest as a band."""
    axis.plot(x, values.mean(axis=0), "o-", ms=3, color=COLOURS[name], label=name)
    axis.fill_between(x, values.min(axis=0), values.max(axis=0), color=COLOURS[name], alpha=0.15)
    axis.grid(alpha=0.3)


def save(figure: plt.Figure, path: Path) -> None:
    """Writes a PNG and is done with the figure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def embedded(figure: plt.Figure) -> str:
    """The figure as the source of an `img`, and is done with it."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    plt.close(figure)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
