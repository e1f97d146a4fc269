"""Scores the blind benchmark: what was right in each case, rates with intervals over all cases, and a page."""

from collections.abc import Mapping, Sequence

import numpy as np

from envs.effects import LIBRARY
from experiments.discovery.blind_robots import OUTSIDE

SEVERITIES = (2.0, 5.0, 15.0)
"""Severities at which effects are hidden, in floor units."""


def score(truth: dict, answer: dict) -> dict:
    """Compares the answer of one case with its truth.

    Args:
      truth: what was hidden, with its intended severity (`asked`) and the severity that was reached.
      answer: the answer of discovery, as in `summary.json`.

    Returns:
      What was hidden and named; whether name, family, place and reported set are right; gaps in floor units.
    """
    named = [*answer["effects"], *answer["parameter_changes"]]
    first = named[0] if named else None
    reported = {first["name"], *first["confusable_with"]} if first else set()
    effect, gap = truth["effect"], answer["gap"]
    family = LIBRARY[effect].family if effect in LIBRARY else None
    return {
        "effect": effect,
        "severity": truth["severity"],
        "asked": truth["asked"],
        "places": truth["truth"]["places"],
        "verdict": answer["verdict"],
        "named": first["name"] if first else None,
        "named_places": first["places"] if first else [],
        "others": [other["name"] for other in named[1:]],
        "set": sorted(reported),
        "name": bool(first) and first["name"] == effect,
        "family": bool(first) and first["family"] == family,
        "in_set": effect in reported,
        "place": bool(first) and set(first["places"]) == set(truth["truth"]["places"]),
        "where": answer["where"][0]["joint"] if answer["where"] else None,
        "before": gap["null"],
        "nominal": gap["before"],
        "after": gap["after"],
        "seconds": answer["seconds"],
    }


def wilson(hits: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """Returns the 95 % score interval of a rate (Wilson, 1927), which stays within [0, 1] and works at 0 and 1.

    Args:
      hits: number of successes.
      count: number of cases; without any the interval is all of [0, 1].
      z: quantile of the normal distribution.
    """
    if not count:
        return 0.0, 1.0
    rate, z2 = hits / count, z * z
    middle = (rate + z2 / (2 * count)) / (1 + z2 / count)
    half = z * np.sqrt(rate * (1 - rate) / count + z2 / (4 * count**2)) / (1 + z2 / count)
    return float(max(middle - half, 0.0)), float(min(middle + half, 1.0))


def tally(rows: Sequence[dict]) -> list[dict]:
    """Computes the table of rates and means over scored cases, each with its interval and the value to reach.

    Args:
      rows: of `score`.

    Returns:
      Rows with `measure`, `value`, the ends `low` and `high` of the interval, `count` of cases and `goal`.
    """
    # Some effects cannot be made as severe as intended; a weak one that is missed must not count as a strong one.
    hidden = [row for row in rows if row["effect"] in LIBRARY and row["severity"] > 0.7 * row["asked"]]
    outside = [row for row in rows if row["effect"] in OUTSIDE]
    empty = [row for row in rows if row["effect"] is None]
    plain = [row for row in hidden if row["asked"] >= 5.0]
    measures = [
        ("top-1 name, 5 floor units and more", plain, "name", ">= 0.90"),
        *(
            (f"top-1 name, {severity:g} floor units", [r for r in hidden if r["asked"] == severity], "name", "")
            for severity in SEVERITIES
        ),
        ("top-1 family, 5 floor units and more", plain, "family", ">= 0.93"),
        ("truth in the reported set, 5 and more", plain, "in_set", ">= 0.95"),
        ("place right, 5 and more", plain, "place", ">= 0.95"),
    ]
    lines = [_rate(label, [row[key] for row in group], goal) for label, group, key, goal in measures]
    lines.append(
        _rate("names something where nothing is hidden", [row["named"] is not None for row in empty], "<= 0.05")
    )
    lines.append(_rate("`unnamed` outside the library", [row["verdict"] == "unnamed" for row in outside], ">= 0.80"))
    blamed = [row["where"] in row["places"] for row in outside if row["verdict"] == "unnamed"]
    lines.append(_rate("joint of the largest gap right where `unnamed`", blamed, ""))
    sizes = [len(row["set"]) for row in plain if row["set"]]
    strong = [row for row in hidden if row["asked"] == 15.0 and row["name"]]
    lines.append(_mean("mean size of the reported set", sizes, "<= 2.5"))
    lines.append(
        _mean("gap shrink at 15 floor units, name right", [row["nominal"] / row["after"] for row in strong], ">= 8")
    )
    lines.append(_mean("final gap, floor units, name right", [row["after"] for row in plain if row["name"]], "<= 1.3"))
    lines.append(_mean("seconds a case", [row["seconds"] for row in rows], "<= 300"))
    return lines


def _rate(label: str, hits: Sequence[bool], goal: str) -> dict:
    low, high = wilson(sum(hits), len(hits))
    rate = sum(hits) / len(hits) if hits else None
    return {"measure": label, "value": rate, "low": low, "high": high, "count": len(hits), "goal": goal}


def _mean(label: str, values: Sequence[float], goal: str) -> dict:
    value = float(np.mean(values)) if values else None
    return {"measure": label, "value": value, "low": None, "high": None, "count": len(values), "goal": goal}


def shown(lines: Sequence[dict]) -> list[tuple[str, ...]]:
    """Formats the table of `tally` as text for console and page: measure, value, interval, number of cases and goal."""
    return [
        (
            line["measure"],
            "-" if line["value"] is None else f"{line['value']:.2f}",
            "" if line["low"] is None else f"{line['low']:.2f} to {line['high']:.2f}",
            str(line["count"]),
            line["goal"],
        )
        for line in lines
    ]


def page(identity: Mapping[str, object], done: int, count: int, lines: Sequence[dict]) -> str:
    """Writes the results as a Markdown page.

    Args:
      identity: options of the benchmark.
      done: number of cases that are answered.
      count: number of cases in all.
      lines: table of `tally`.
    """
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in shown(lines))
    options = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in identity.items())
    return f"""# Blind benchmark of discovery, size `{identity["size"]}`

`python -m experiments.discovery_bench {options}`, {done} of {count} robots.
Intervals are Wilson's. `scores.json` holds, for every robot, what was hidden and what discovery answered.

| measure | value | 95 % interval | cases | to reach |
|---|---|---|---|---|
{table}

![hidden effects against named effects](confusion.png)
"""
