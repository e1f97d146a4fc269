"""Plots of logs, of the gap between simulation and measurement, and of how often discovery is right."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

from envs.logs import Run
from experiments.common.plots.base import save


def suspicions(path: Path, run: Run, joints: Sequence[str], titles: Sequence[str]) -> None:
    """Draws a run as it was recorded: the time between rows, and every joint's position and target.

    A person can check against it what the log doctor suspects.

    Args:
      path: of the PNG.
      run: the run.
      joints: names in the log's order.
      titles: sentences of the log doctor, written above the plot.
    """
    figure, axes = plt.subplots(1 + len(joints), 1, figsize=(10, 1.6 * (2 + len(joints))), layout="constrained")
    steps = 1e3 * np.diff(run.time)
    axes[0].plot(run.time[1:], steps, lw=0.8)
    # A logarithmic axis, because on a linear one the mere rounding of time stamps would look like a faulty clock.
    axes[0].set(ylabel="row to row, ms", yscale="log", ylim=(0.3 * steps.min(), 3.0 * steps.max()))
    for index, (axis, joint) in enumerate(zip(axes[1:], joints, strict=True)):
        if "target" in run.signals:
            axis.plot(run.time, run.signals["target"][:, index], lw=0.8, color="tab:orange", label="target")
        axis.plot(run.time, run.signals["q"][:, index], lw=0.8, color="tab:blue", label="q")
        axis.set(ylabel=f"{joint}, rad", xlim=(run.time[0], run.time[-1]))
    axes[1].legend(loc="upper right")
    axes[-1].set(xlabel="s")
    figure.suptitle("\n".join(textwrap.fill(title, 120) for title in titles) or "nothing is suspected", fontsize=9)
    save(figure, path)


def heat_map(cells: Sequence[dict]) -> plt.Figure:
    """Draws where simulation and measurement disagree: the excess over the noise floor by joint and motion regime.

    Args:
      cells: rows of `Result.where`: joint, signal, regime and excess in floor units.

    Returns:
      A figure with a heat map for every signal.
    """
    signals = list(dict.fromkeys(cell["signal"] for cell in cells))
    regimes = sorted({cell["regime"] for cell in cells})
    joints = sorted({cell["joint"] for cell in cells})
    figure, axes = plt.subplots(
        1,
        len(signals),
        figsize=(1.5 + 4.2 * len(signals), 2.4 + 0.45 * len(joints)),
        layout="constrained",
        squeeze=False,
        sharey=True,
    )
    top = max(cell["excess_floor_units"] for cell in cells)
    for axis, signal in zip(axes[0], signals, strict=True):
        grid = np.full((len(joints), len(regimes)), np.nan)
        for cell in cells:
            if cell["signal"] == signal:
                grid[joints.index(cell["joint"]), regimes.index(cell["regime"])] = cell["excess_floor_units"]
        image = axis.imshow(grid, cmap="magma_r", vmin=0.0, vmax=max(top, 1.0), aspect="auto")
        for (row, column), value in np.ndenumerate(grid):
            if np.isfinite(value):
                colour = "white" if value > 0.6 * max(top, 1.0) else "black"
                axis.text(column, row, f"{value:.1f}", ha="center", va="center", color=colour, fontsize=8)
        axis.set(title=signal, xticks=range(len(regimes)), yticks=range(len(joints)))
        axis.set_xticklabels(regimes, rotation=30, ha="right")
        axis.set_yticklabels(joints)
    figure.colorbar(image, ax=axes, label="floor units above the floor", shrink=0.8)
    return figure


def traces(runs: Sequence[dict], joints: Sequence[str], unit: str = "rad", most: int = 6) -> plt.Figure:
    """Draws what was measured and simulated in whole runs, in each run for the joint with the largest error.

    Args:
      runs: rows of `experiments.discovery.summary.free_runs`. Sealed runs (the held-out test) come first and have a red
        frame.
      joints: names in the log's order.
      unit: of the signal.
      most: largest number of runs that are drawn.
    """
    shown = sorted(runs, key=lambda run: run["split"] != "sealed")[:most]
    columns = 2 if len(shown) > 1 else 1
    rows = -(-len(shown) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(12, 2.6 * rows), layout="constrained", squeeze=False)
    for axis in axes.flat[len(shown) :]:
        axis.axis("off")
    for axis, run in zip(axes.flat, shown, strict=False):
        joint = int(np.abs(run["null"] - run["measured"]).mean(axis=0).argmax())
        axis.plot(run["time"], run["measured"][:, joint], color="black", lw=1.5, label="measured")
        axis.plot(run["time"], run["null"][:, joint], color="tab:orange", lw=1.0, label="nominal parameters fitted")
        axis.plot(run["time"], run["after"][:, joint], color="tab:blue", lw=1.0, label="corrected model")
        error = run["error"]
        axis.set_title(
            f"{run['run']} ({run['split']}): {joints[joint]}, {error['null']:.3f} -> {error['after']:.3f} {unit}",
            fontsize=9,
        )
        axis.set(xlabel="s", ylabel=unit)
        axis.grid(alpha=0.3)
        if run["split"] == "sealed":
            for spine in axis.spines.values():
                spine.set(color="tab:red", linewidth=1.8)
    axes[0, 0].legend(fontsize=8)
    return figure


def accepted_terms(terms: Sequence, labels: Sequence[str]) -> plt.Figure:
    """Draws how much every accepted effect lowered the cost, beside the threshold that simulated null logs set.

    Args:
      terms: `jaxtune.discovery.result.AcceptedTerm`, the one that explains most first.
      labels: what to call them.
    """
    figure, axis = plt.subplots(figsize=(8, 1.5 + 0.5 * len(terms)), layout="constrained")
    place = np.arange(len(terms))
    gains, thresholds = ([getattr(term, of).gain for term in terms] for of in ("evidence", "thresholds"))
    axis.barh(place, gains, color="tab:blue", height=0.5, label="gain")
    axis.plot(thresholds, place, "|", color="black", ms=22, mew=2, label="threshold")
    axis.set(yticks=place, xscale="log", xlabel="fall of the cost on train and select")
    # Whole decades, so that there is more than one labelled tick; labels between them would overlap.
    ends = np.log10([value for value in gains + thresholds if value > 0])
    axis.set_xlim(10.0 ** np.floor(ends.min()), 10.0 ** np.ceil(ends.max()))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_yticklabels(labels)
    axis.invert_yaxis()
    axis.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, markerscale=0.4)
    return figure


def confusion(path: Path, rows: Sequence[dict]) -> None:
    """Draws the confusion matrix of the blind benchmark: hidden effect by named effect, as counts.

    There is a panel for every severity at which effects were hidden. Where nothing was named, the verdict stands in the
    place of the name.

    Args:
      path: of the PNG.
      rows: of `experiments.discovery.scores.score`.
    """
    severities = sorted({row["asked"] for row in rows})
    said = lambda row: row["named"] or row["verdict"].replace("_", " ")  # noqa: E731
    hidden = sorted({row["effect"] or "nothing" for row in rows})
    named = sorted({said(row) for row in rows})
    figure, axes = plt.subplots(
        1,
        len(severities),
        figsize=(2 + (1.2 + 0.28 * len(named)) * len(severities), 2 + 0.26 * len(hidden)),
        layout="constrained",
        squeeze=False,
        sharey=True,
    )
    for axis, severity in zip(axes[0], severities, strict=True):
        grid = np.zeros((len(hidden), len(named)))
        for row in rows:
            if row["asked"] == severity:
                grid[hidden.index(row["effect"] or "nothing"), named.index(said(row))] += 1
        axis.imshow(grid, cmap="Blues", aspect="auto")
        for (line, column), count in np.ndenumerate(grid):
            if count:
                colour = "white" if count > 0.6 * grid.max() else "black"
                axis.text(column, line, int(count), ha="center", va="center", fontsize=7, color=colour)
        title = f"{severity:g} floor units" if severity else "nothing hidden"
        axis.set(title=title, xticks=range(len(named)), yticks=range(len(hidden)), xlabel="named")
        axis.set_xticklabels(named, rotation=90, fontsize=7)
        axis.set_yticklabels(hidden, fontsize=7)
    axes[0, 0].set_ylabel("hidden")
    save(figure, path)
