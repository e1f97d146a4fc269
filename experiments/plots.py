"""Every picture the experiments draw."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from envs.biteno.constants import DUTY, POLICY_DT_S
from envs.logs import Run

_COLOURS = {"ours": "tab:blue", "spm": "tab:orange", "dr": "tab:green", "oracle": "tab:gray"}
_MARKS = {"accept": "o", "widen": "^", "unexplained": "X", "radius_exhausted": "s", "not_finite": "x"}


def training(path: Path, curve: Sequence[dict]) -> None:
    """Reward, Table I return and falls over the steps of a training run."""
    steps = np.array([line["steps"] for line in curve]) / 1e6
    panels = {
        "per second": {"trained reward": "reward", "Table I": "score"},
        "share": {
            "linear tracking": "linear_tracking",
            "angular tracking": "angular_tracking",
            "feet against the clock (of 2)": "clock_contact",
        },
        "episode ends per 20 s": {"ends": "done"},
    }
    scales = {"per second": 100.0, "share": 1.0, "episode ends per 20 s": 2000.0}
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained")
    for axis, (label, series) in zip(axes, panels.items(), strict=True):
        for name, key in series.items():
            axis.plot(steps, scales[label] * np.array([line[key] for line in curve]), label=name)
        axis.set(xlabel="million steps", ylabel=label)
        axis.grid(alpha=0.3)
        axis.legend()
    axes[2].set_yscale("log")
    _save(figure, path)


def sim2sim(out: Path, results: dict[str, list[dict]], off: Sequence[str], epochs: int) -> None:
    """After the paper's Figs. 3 and 4: return, parameter error, and the gate over the tunings."""
    _returns(out / "return.png", results, epochs)
    _errors(out / "param_error.png", results, off or list(next(iter(results.values()))[0]["lines"][0]["param_error"]))
    _each_error(out / "param_error_each.png", results)
    if any(line.get("verdicts") for runs in results.values() for run in runs for line in run["lines"]):
        _gate(out / "gate.png", results)


def sweep(path: Path, grid: np.ndarray, rows: Sequence[str], columns: Sequence[str], titles: Sequence[str]) -> None:
    """One heat map for each panel of `grid` [panels, rows, columns]; `titles` holds row, column and panel names."""
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
    _save(figure, path)


def gaps(path: Path, rows: Sequence[dict], shown: dict[str, str], nominal: dict[str, float]) -> None:
    """One column of panels for every sweep, one row for every quantity of `shown`; a line where nothing is off."""
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
    _save(figure, path)


def gait(path: Path, force: np.ndarray, phase: np.ndarray) -> None:
    """Contacts of one episode over time, above what the clock asks for.

    Args:
      path: a PNG.
      force: [time, 2] N, normal, left and right foot.
      phase: [time, 2] cycles.
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
    _save(figure, path)


def suspicions(path: Path, run: Run, joints: Sequence[str], titles: Sequence[str]) -> None:
    """A run as it was recorded: the clock, and every joint's position and target with what is suspected above."""
    figure, axes = plt.subplots(1 + len(joints), 1, figsize=(10, 1.6 * (2 + len(joints))), layout="constrained")
    steps = 1e3 * np.diff(run.time)
    axes[0].plot(run.time[1:], steps, lw=0.8)
    # Rounding is no news.
    axes[0].set(ylabel="row to row, ms", yscale="log", ylim=(0.3 * steps.min(), 3.0 * steps.max()))
    for index, (axis, joint) in enumerate(zip(axes[1:], joints, strict=True)):
        if "target" in run.signals:
            axis.plot(run.time, run.signals["target"][:, index], lw=0.8, color="tab:orange", label="target")
        axis.plot(run.time, run.signals["q"][:, index], lw=0.8, color="tab:blue", label="q")
        axis.set(ylabel=f"{joint}, rad", xlim=(run.time[0], run.time[-1]))
    axes[1].legend(loc="upper right")
    axes[-1].set(xlabel="s")
    figure.suptitle("\n".join(textwrap.fill(title, 120) for title in titles) or "nothing is suspected", fontsize=9)
    _save(figure, path)


def _beside(axis):
    """Across in shares of the axes, up in data."""
    return axis.get_yaxis_transform()


def _returns(path: Path, results: dict[str, list[dict]], epochs: int) -> None:
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, runs in results.items():
        values = np.array([[line["return"] for line in run["lines"]] for run in runs])
        _spread(axis, np.arange(values.shape[1]) * epochs, values, name)
    axis.set(xlabel="PPO epochs (dots: tunings)", ylabel="return in the target, Table I weights (at most 70)")
    axis.legend()
    _save(figure, path)


def _errors(path: Path, results: dict[str, list[dict]], off: Sequence[str]) -> None:
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, runs in results.items():
        values = np.array([[np.mean([line["param_error"][p] for p in off]) for line in run["lines"]] for run in runs])
        _spread(axis, np.arange(values.shape[1]), values, name)
    axis.set(xlabel="tunings", ylabel="mean of |estimate / truth - 1|", ylim=(0, None))
    axis.set_title(textwrap.fill(f"over {', '.join(off)}", 100), fontsize=7)
    axis.legend()
    _save(figure, path)


def _each_error(path: Path, results: dict[str, list[dict]]) -> None:
    names = list(next(iter(results.values()))[0]["lines"][0]["param_error"])
    figure, axes = plt.subplots(
        1, len(names), figsize=(2.2 * len(names) + 1, 3), layout="constrained", sharey=True, squeeze=False
    )
    for axis, parameter in zip(axes[0], names, strict=True):
        for name, runs in results.items():
            values = np.array([[line["param_error"][parameter] for line in run["lines"]] for run in runs])
            _spread(axis, np.arange(values.shape[1]), values, name)
        axis.set_title(parameter, fontsize=9)
        axis.set_xlabel("tunings")
    axes[0, 0].set(ylabel="|estimate / truth - 1|", ylim=(0, None))
    axes[0, -1].legend(fontsize=8)
    _save(figure, path)


def _gate(path: Path, results: dict[str, list[dict]]) -> None:
    figure, (above, below) = plt.subplots(2, 1, figsize=(8, 5.5), layout="constrained", sharex=True)
    used = set()
    for name, runs in results.items():
        if any(line.get("verdicts") for run in runs for line in run["lines"]):
            above.plot([], [], color=_COLOURS[name], label=name)
        for run in runs:
            calls = [
                (line["tuning"] + place / (len(line["verdicts"]) + 1), line, place)
                for line in run["lines"]
                for place in range(len(line.get("verdicts", ())))
            ]
            when = [call[0] for call in calls]
            above.plot(when, [line["radius"][i] for _, line, i in calls], color=_COLOURS[name], alpha=0.6)
            gated = [(t, line, i) for t, line, i in calls if line["p_value"][i] is not None]
            below.plot(
                [t for t, *_ in gated], [line["novelty"][i] for _, line, i in gated], color=_COLOURS[name], alpha=0.6
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
                above.plot(moment, line["radius"][place], _MARKS[verdict], color=_COLOURS[name], label=label)
                if line["p_value"][place] is not None:
                    below.plot(moment, line["novelty"][place], _MARKS[verdict], color=_COLOURS[name])
    below.plot([], [], color="tab:red", lw=0.8, label="threshold")
    above.set(ylabel="largest radius, log space", ylim=(0, None))
    above.legend(fontsize=8)
    below.set(xlabel="tunings (fractions: gate calls within one)", ylabel="novelty, mean rank", ylim=(0, 1.05))
    below.legend(fontsize=8)
    for axis in (above, below):
        axis.grid(alpha=0.3)
    _save(figure, path)


def _spread(axis, x: np.ndarray, values: np.ndarray, name: str) -> None:
    """Mean over seeds as a line, least to largest as a band."""
    axis.plot(x, values.mean(axis=0), "o-", ms=3, color=_COLOURS[name], label=name)
    axis.fill_between(x, values.min(axis=0), values.max(axis=0), color=_COLOURS[name], alpha=0.15)
    axis.grid(alpha=0.3)


def _save(figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def heat_map(cells: Sequence[dict]) -> plt.Figure:
    """Excess over the floor by joint and regime, one panel a signal."""
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


def traces(runs: Sequence[dict], joints: Sequence[str], most: int = 6) -> plt.Figure:
    """Measured and simulated positions of whole runs, sealed ones first and framed in red; the worst joint of each."""
    shown = sorted(runs, key=lambda run: run["split"] != "sealed")[:most]
    columns = 2 if len(shown) > 1 else 1
    rows = -(-len(shown) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(12, 2.6 * rows), layout="constrained", squeeze=False)
    for axis in axes.flat[len(shown) :]:
        axis.axis("off")
    for axis, run in zip(axes.flat, shown, strict=False):
        joint = int(np.abs(run["null"] - run["measured"]).mean(axis=0).argmax())
        axis.plot(run["time"], run["measured"][:, joint], color="black", lw=1.5, label="measured")
        axis.plot(run["time"], run["null"][:, joint], color="tab:orange", lw=1.0, label="parameters fitted again")
        axis.plot(run["time"], run["after"][:, joint], color="tab:blue", lw=1.0, label="corrected model")
        error = run["error_rad"]
        axis.set_title(
            f"{run['run']} ({run['split']}): {joints[joint]}, {error['null']:.3f} -> {error['after']:.3f} rad",
            fontsize=9,
        )
        axis.set(xlabel="s", ylabel="rad")
        axis.grid(alpha=0.3)
        if run["split"] == "sealed":
            for spine in axis.spines.values():
                spine.set(color="tab:red", linewidth=1.8)
    axes[0, 0].legend(fontsize=8)
    return figure


def ladder(rungs: Sequence) -> plt.Figure:
    """Gain of every accepted effect beside what healthy logs gain by chance."""
    figure, axis = plt.subplots(figsize=(8, 1.5 + 0.5 * len(rungs)), layout="constrained")
    place = np.arange(len(rungs))
    axis.barh(place, [rung.evidence.gain for rung in rungs], color="tab:blue", height=0.5, label="gain")
    axis.plot([rung.thresholds.gain for rung in rungs], place, "|", color="black", ms=22, mew=2, label="threshold")
    axis.set(yticks=place, xscale="log", xlabel="fall of the loss on train")
    axis.set_yticklabels([rung.hypothesis.key for rung in rungs])
    axis.invert_yaxis()
    axis.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return figure


def write_png(figure: plt.Figure, file) -> None:
    """Writes a figure into a file and is done with it."""
    figure.savefig(file, format="png", dpi=110)
    plt.close(figure)


def confusion(path: Path, rows: Sequence[dict]) -> None:
    """What was hidden against what was named, a panel for every severity."""
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
    _save(figure, path)
