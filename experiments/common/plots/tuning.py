"""Plots of training, of tuning to another simulator, and of rounds with a robot."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from experiments.common.plots.base import COLOURS, save, spread
from experiments.common.rates import interval
from jaxtune.selftest import SelfTest

_MARKS = {
    "accept": "o",
    "widen": "^",
    "unexplained": "X",
    "radius_exhausted": "s",
    "not_finite": "x",
    "not_comparable": "P",
}


def training(path: Path, curve: Sequence[dict], control_s: float, shown: Mapping[str, Mapping[str, str]]) -> None:
    """Draws a training run over its environment steps: what the robot's own panels show, and how often episodes end.

    Args:
      path: of the PNG.
      curve: lines of metrics, means over control steps (`experiments.walking.policies.walk`).
      control_s: length of a control step in s.
      shown: metrics by label, by axis label; those of the panel "per second" are divided by `control_s`.
    """
    steps = np.array([line["steps"] for line in curve]) / 1e6
    panels = {**shown, "episode ends per 20 s": {"ends": "done"}}
    scales = {"per second": 1.0 / control_s, "episode ends per 20 s": 20.0 / control_s}
    figure, axes = plt.subplots(1, len(panels), figsize=(4 * len(panels), 3.2), layout="constrained")
    for axis, (label, series) in zip(axes, panels.items(), strict=True):
        for name, key in series.items():
            axis.plot(steps, scales.get(label, 1.0) * np.array([line[key] for line in curve]), label=name)
        axis.set(xlabel="million steps", ylabel=label)
        axis.grid(alpha=0.3)
        axis.legend()
    axes[-1].set_yscale("symlog", linthresh=0.1)
    save(figure, path)


def sim2sim(out: Path, results: dict[str, list[dict]], off: Sequence[str], epochs: int) -> None:
    """Draws return, parameter errors and the gate's calls over the tunings, after the paper's Figs. 3 and 4.

    Args:
      out: folder of `return.png`, `param_error.png`, `param_error_each.png` and `gate.png`.
      results: what `experiments.sim2sim.Runner` returned, by method and seed.
      off: tuned parameters whose true value is not nominal. The mean error is over them, or over all if there is none.
      epochs: PPO updates in a tuning.
    """
    _returns(out / "return.png", results, epochs)
    _errors(out / "param_error.png", results, off or list(next(iter(results.values()))[0]["lines"][0]["param_error"]))
    _each_error(out / "param_error_each.png", results)
    if any(line.get("verdicts") for runs in results.values() for run in runs for line in run["lines"]):
        _gate(out / "gate.png", results)


def recovery(path: Path, results: Mapping[str, Sequence[dict]]) -> None:
    """Draws errors of parameters after tuning over those before, a panel for every robot.

    Args:
      path: of the PNG.
      results: what `experiments.robots_bench.tuned` returned, by robot and seed.
    """
    figure, axes = plt.subplots(
        1, len(results), figsize=(0.6 + 3.4 * len(results), 3.6), layout="constrained", squeeze=False, sharey=True
    )
    for axis, (robot, seeds) in zip(axes[0], results.items(), strict=True):
        for column, name in enumerate(seeds[0]["truth"]):
            for inside, marker in ((True, "o"), (False, "x")):
                chosen = [seed for seed in seeds if seed["in_first_box"][name] == inside]
                before = [seed["error_before"][name] for seed in chosen]
                after = [seed["tunings"][-1]["error"][name] for seed in chosen]
                axis.plot(before, after, marker, ms=5, color=f"C{column}", label=name if inside else None)
        axis.axline((0.0, 0.0), slope=1.0, color="grey", lw=0.8, label="no change")
        axis.axline((0.0, 0.0), slope=0.5, color="grey", lw=0.8, ls="--", label="halved")
        axis.set(xlabel="error before, log", title=f"{robot} (x: outside the first box)")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    axes[0, 0].set_ylabel("error after, log")
    save(figure, path)


def power(path: Path, reports: Mapping[int, SelfTest], level: float) -> None:
    """Draws how often the gate rejects in every case of a self-test, with 95 % Wilson intervals.

    Args:
      path: of the PNG.
      reports: by number of measured episodes.
      level: nominal rate of false alarms.
    """
    first = next(iter(reports.values()))
    names = ["inside the distribution", *(f"{name}, one radius outside" for name in first.outside), *first.others]
    figure, axis = plt.subplots(figsize=(8.0, 1.2 + 0.3 * len(names) * len(reports) ** 0.5), layout="constrained")
    for column, (episodes, report) in enumerate(reports.items()):
        rates = [report.alarms, *report.outside.values(), *report.others.values()]
        shares = np.array([rate.share for rate in rates])
        ends = np.array([interval(rate) for rate in rates]).T
        place = np.arange(len(names)) + 0.25 * (column - 0.5 * (len(reports) - 1))
        bars = np.maximum(np.abs(ends - shares), 0.0)
        axis.errorbar(shares, place, xerr=bars, fmt="o", ms=4, color=f"C{column}", label=f"{episodes} episodes")
    axis.axvline(level, color="grey", ls="--", lw=0.8, label=f"false alarms, nominal {level:g}")
    axis.axhline(0.5, color="lightgrey", lw=0.8)
    axis.axhline(len(first.outside) + 0.5, color="lightgrey", lw=0.8)
    axis.set(xlabel="share of robots that the gate rejects", xlim=(-0.02, 1.02))
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.invert_yaxis()
    axis.grid(alpha=0.3, axis="x")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)


def sweep(path: Path, grid: np.ndarray, rows: Sequence[str], columns: Sequence[str], titles: Sequence[str]) -> None:
    """Draws a sweep as heat maps that share one colour scale, so that all settings compare at a glance.

    Args:
      path: of the PNG.
      grid: [panels, rows, columns] mean parameter error at the end.
      rows: labels of the rows.
      columns: labels of the columns.
      titles: name of the rows, name of the columns, then a title for every panel.
    """
    row_label, column_label, *panels = titles
    figure, axes = plt.subplots(
        1, len(panels), figsize=(1.5 + 3.2 * len(panels), 3.4), layout="constrained", squeeze=False, sharey=True
    )
    finite = grid[np.isfinite(grid)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    for axis, values, title in zip(axes[0], grid, panels, strict=True):
        image = axis.imshow(values, cmap="viridis_r", vmin=low, vmax=high, aspect="auto")
        axis.set(xlabel=column_label, title=title)
        axis.set_xticks(range(len(columns)), columns)
        axis.set_yticks(range(len(rows)), rows)
        for (row, column), value in np.ndenumerate(values):
            dark = np.isfinite(value) and value > (low + high) / 2
            axis.text(column, row, f"{value:.2f}", ha="center", va="center", color="white" if dark else "black")
    axes[0, 0].set_ylabel(row_label)
    figure.colorbar(image, ax=axes, label="mean parameter error at the end")
    save(figure, path)


def misfits(found: Mapping[str, dict]) -> plt.Figure:
    """Draws what no parameters explain of each signal in each phase of the motion; bright is much.

    Args:
      found: `times` and `phases` by signal, as `tuning.json` has them.
    """
    values = np.array([one["phases"] for one in found.values()], float)
    figure, axis = plt.subplots(figsize=(6, 1.0 + 0.4 * len(found)), layout="constrained")
    ends = (0.0, 1.0, len(found) - 0.5, -0.5)
    drawn = axis.imshow(values, aspect="auto", extent=ends, vmin=0.0, vmax=max(3.0, np.nanmax(values)), cmap="viridis")
    axis.set(yticks=range(len(found)), yticklabels=list(found), xlabel="phase, cycles")
    figure.colorbar(drawn, label="misfit, 1 is usual")
    return figure


def rounds(history: Sequence[dict]) -> plt.Figure:
    """Draws a robot's rounds: predicted and measured return, falls and power, and every parameter with its interval.

    Predictions extend one round further than measurements, to the walks that come next.

    Args:
      history: rounds as `summary.json` has them.
    """
    when = np.arange(len(history) + 1)
    names = list(history[0]["tuning"]["moved"])
    labels = {"return": "return", "fall_rate": "share of walks that fall", "power_w": "power, W"}
    columns = max(len(labels), len(names))
    figure, axes = plt.subplots(2, columns, figsize=(2.4 * columns, 5), layout="constrained", squeeze=False)
    for axis in axes[0, len(labels) :]:
        axis.axis("off")
    for axis in axes[1, len(names) :]:
        axis.axis("off")
    for axis, (name, label) in zip(axes[0], labels.items(), strict=False):
        predicted = [line["predicted"][name] for line in history] + [history[-1]["next"][name]]
        measured = np.array([line["measured"][name] for line in history], float)  # nan where it is not known
        axis.plot(when, predicted, "o--", color="tab:gray", ms=4, label="predicted")
        axis.plot(when[:-1], measured, "o-", color="tab:blue", ms=4, label="measured")
        axis.set(title=label, xticks=when)
    axes[0, 0].legend(fontsize=8)
    axes[0, 1].set_ylim(-0.05, 1.05)
    for axis, name in zip(axes[1], names, strict=False):
        moved = [line["tuning"]["moved"][name] for line in history]
        axis.plot(when, [moved[0]["before"], *(ends["after"] for ends in moved)], "o-", color="tab:blue", ms=4)
        known = [(place, ends) for place, ends in zip(when[1:], moved, strict=True) if ends["low"] is not None]
        axis.vlines(
            [p for p, _ in known], [e["low"] for _, e in known], [e["high"] for _, e in known], color="tab:blue"
        )
        axis.set(title=name, xlabel="round", xticks=when)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    return figure


def transfer(path: Path, results: dict[str, list[dict]]) -> None:
    """Draws return, falls and power of the robot's walks over the rounds, by method, like the paper's Fig. 6.

    Args:
      path: of the PNG.
      results: runs by method, as `summary.json` has them: `rounds` and the evaluation at the `end`.
    """
    labels = {"return": "return of a walk", "fall_rate": "share of walks that fall", "power_w": "mechanical power, W"}
    figure, axes = plt.subplots(1, len(labels), figsize=(12, 3.6), layout="constrained")
    for axis, (key, label) in zip(axes, labels.items(), strict=True):
        for name, runs in results.items():
            values = np.array([[line["measured"][key] for line in one["rounds"]] for one in runs])
            spread(axis, np.arange(values.shape[1]), values, name)
            ends = np.mean([one["end"][key] for one in runs])
            axis.plot(values.shape[1], ends, "*", ms=10, color=COLOURS[name])
        axis.set(xlabel="round (stars: evaluation at the end)", ylabel=label)
    axes[0].legend()
    save(figure, path)


def _returns(path: Path, results: dict[str, list[dict]], epochs: int) -> None:
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, runs in results.items():
        values = np.array([[line["return"] for line in run["lines"]] for run in runs])
        spread(axis, np.arange(values.shape[1]) * epochs, values, name)
    axis.set(xlabel="PPO epochs (dots: tunings)", ylabel="return in the target")
    axis.legend()
    save(figure, path)


def _errors(path: Path, results: dict[str, list[dict]], off: Sequence[str]) -> None:
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, runs in results.items():
        values = np.array([[np.mean([line["param_error"][p] for p in off]) for line in run["lines"]] for run in runs])
        spread(axis, np.arange(values.shape[1]), values, name)
    axis.set(xlabel="tunings", ylabel="mean relative error of parameters", ylim=(0, None))
    axis.set_title(textwrap.fill(f"over {', '.join(off)}", 100), fontsize=7)
    axis.legend()
    save(figure, path)


def _each_error(path: Path, results: dict[str, list[dict]]) -> None:
    names = list(next(iter(results.values()))[0]["lines"][0]["param_error"])
    figure, axes = plt.subplots(
        1, len(names), figsize=(2.2 * len(names) + 1, 3), layout="constrained", sharey=True, squeeze=False
    )
    for axis, parameter in zip(axes[0], names, strict=True):
        for name, runs in results.items():
            values = np.array([[line["param_error"][parameter] for line in run["lines"]] for run in runs])
            spread(axis, np.arange(values.shape[1]), values, name)
        axis.set_title(parameter, fontsize=9)
        axis.set_xlabel("tunings")
    axes[0, 0].set(ylabel="relative error", ylim=(0, None))
    axes[0, -1].legend(fontsize=8)
    save(figure, path)


def _gate(path: Path, results: dict[str, list[dict]]) -> None:
    figure, (above, below) = plt.subplots(2, 1, figsize=(8, 5.5), layout="constrained", sharex=True)
    used = set()
    for name, runs in results.items():
        if any(line.get("verdicts") for run in runs for line in run["lines"]):
            above.plot([], [], color=COLOURS[name], label=name)
        for run in runs:
            calls = [
                (line["tuning"] + place / (len(line["verdicts"]) + 1), line, place)
                for line in run["lines"]
                for place in range(len(line.get("verdicts", ())))
            ]
            when = [call[0] for call in calls]
            above.plot(when, [line["radius"][i] for _, line, i in calls], color=COLOURS[name], alpha=0.6)
            gated = [(t, line, i) for t, line, i in calls if line["p_value"][i] is not None]
            below.plot(
                [t for t, *_ in gated], [line["novelty"][i] for _, line, i in gated], color=COLOURS[name], alpha=0.6
            )
            below.plot(
                [t for t, *_ in gated],
                [line["threshold"][i] for _, line, i in gated],
                color="tab:red",
                lw=0.8,
                alpha=0.6,
            )
            for moment, line, place in calls:
                verdict = line["verdicts"][place]
                label = None if verdict in used else verdict
                used.add(verdict)
                above.plot(moment, line["radius"][place], _MARKS[verdict], color=COLOURS[name], label=label)
                if line["p_value"][place] is not None:
                    below.plot(moment, line["novelty"][place], _MARKS[verdict], color=COLOURS[name])
    below.plot([], [], color="tab:red", lw=0.8, label="threshold")
    above.set(ylabel="largest radius, log space", ylim=(0, None))
    above.legend(fontsize=8)
    below.set(xlabel="tunings (fractions: gate calls within one)", ylabel="novelty")
    # The median of simulated sets is 0, and a misfit may be a hundred.
    below.set_yscale("symlog", linthresh=2.0)
    below.legend(fontsize=8)
    for axis in (above, below):
        axis.grid(alpha=0.3)
    save(figure, path)
