"""Renders report pages from templates, and describes a tuning in the form that JSON files and pages need."""

from collections.abc import Mapping
from pathlib import Path

import jinja2
import numpy as np

from jaxtune import dist as dists
from jaxtune.explain import combinations, intervals, weak
from jaxtune.mjx import Entry, parameters
from jaxtune.tuner import Info
from jaxtune.types import ParamDist, Verdict


def render(template: Path, **values) -> str:
    """Renders an HTML page from a Jinja template.

    The template may include files from its own folder and from this one. All values are escaped, because names and
    texts come from logs of unknown origin. If the template names a value that the call does not give, that is an error
    and not an empty place on the page.

    Args:
      template: path of the template.
      **values: what the template names.

    Returns:
      The page's HTML.
    """
    folders = jinja2.FileSystemLoader([template.parent, Path(__file__).parent])
    pages = jinja2.Environment(loader=folders, autoescape=True, undefined=jinja2.StrictUndefined)
    return pages.get_template(template.name).render(**values)


def tuning(info: Info) -> dict:
    """Lists what happened in a tuning, for `metrics.jsonl` and `tuning.json`.

    Args:
      info: of `Tuner.tune` or `Tuner.step`.

    Returns:
      `verdicts`, `radius` and the gate's numbers as lists over its calls; the update's `step` and `interval` by
      parameter, in radii, and whether the parameter was `identifiable`; those that are `weak`, and the
      combinations that are known `together`; the p-values of the update's fit; whether the sets of earlier tunings
      were `pooled` with this one, and whether the estimate was `replayed` from measured states; the number of falls and
      of episodes with values that are not finite; and means of the training metrics.
    """
    calls = int(info.calls)
    order = dists.names(info.dist)
    # Compiled arrays have room for the largest number of gate calls; only the first `calls` entries were made.
    gate = {name: np.asarray(value)[:calls] for name, value in info.gate.items() if value is not None}
    update = {
        name: dict(zip(order, np.asarray(info.update[name]).tolist(), strict=True))
        for name in ("step", "interval", "identifiable")
    }
    return {
        "verdicts": [Verdict(int(verdict)).name.lower() for verdict in info.verdicts[:calls]],
        "radius": np.asarray(info.radius)[:calls],
        **gate,
        **update,
        "weak": tuple(np.array(order)[weak(info)].tolist()),
        "together": combinations(info),
        "update_loss": float(info.update.loss),
        "fit_p_value": float(info.update.p_value),
        "misfit_p_value": float(info.update.p_misfit),
        "replay_p_value": float(info.update.p_replay),
        "past_p_value": float(info.update.p_past),
        "pooled": bool(info.update.pooled),
        "replayed": bool(info.update.replayed),
        "measured_falls": int(info.measured_falls),
        "not_finite": int(info.not_finite),
        "training": {name: float(np.mean(value)) for name, value in info.train.items()},
    }


def moved(entries: Mapping[str, Entry], before: ParamDist, after: ParamDist, info: Info) -> dict[str, dict]:
    """Compares every parameter before and after a tuning, in physical values.

    Args:
      entries: the parameter table.
      before: distribution that the tuning began with.
      after: distribution that it ended with.
      info: what happened in between. Its intervals were calibrated on held-out simulated sets.

    Returns:
      `before`, `after`, and the ends `low` and `high` of the interval, by parameter. The ends are nan if no set was
      accepted, or where the interval does not hold (`jaxtune.explain.intervals`).
    """
    half = dists.unravel(dists.names(after), intervals(info))
    ends = {
        "before": before.centre,
        "after": after.centre,
        "low": {name: centre - half[name] for name, centre in after.centre.items()},
        "high": {name: centre + half[name] for name, centre in after.centre.items()},
    }
    found = {end: parameters.from_coords(entries, values) for end, values in ends.items()}
    return {name: {end: float(values[name]) for end, values in found.items()} for name in after.centre}
