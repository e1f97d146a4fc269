"""Scores a benchmark of discovery: what was right in each case, rates with intervals over all cases, and a page."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from experiments.common.rates import wilson
from jaxtune.discovery.evaluate import is_worse

SEVERITIES = (2.0, 5.0, 15.0)
"""Severities at which effects are hidden in the sizes `arm` and `standard`, in floor units."""

EMPTY = ("empty", "linear", "wandering")
"""Kinds of cases in which nothing is hidden."""

_REACHED = 0.7  # least share of the wanted severity: an effect that could not be made so severe is not counted
_STRONG = 15.0
_SHOWN = 5.0  # floor units of the null on sealed, where one run in four has to show what was hidden in all


def score(truth: dict, answer: dict) -> dict:
    """Compares the answer of one case with its truth.

    With `unnamed`, nothing was named; so it is with a model that was withdrawn, and with a case that failed.

    Args:
      truth: `kind` of the case (`field.cases.FieldCase`) and its `effects`, each with `name`, `family`, `places`,
        `value` of the first parameter (None where the generator's formula has no such number), and its `asked` and
        reached `severity`.
      answer: content of `summary.json`, or the verdict `failed` with its `message`.

    Returns:
      What was hidden and named; whether name, family, place and reported set are right; gaps in floor units.
    """
    named = [*answer.get("effects", ()), *answer.get("parameter_changes", ())]
    first = named[0] if named else None
    effects = truth["effects"]
    main = _main(effects, first)
    reported = sorted({first["name"], *first["confusable_with"]}) if first else []
    gap = {name: _number(answer.get("gap", {}).get(name)) for name in ("before", "null", "after")}
    right = bool(first) and bool(main) and first["name"] == main["name"]
    place = bool(first) and bool(main) and set(first["places"]) == set(main["places"])
    where = answer.get("where") or [{"joint": None}]
    return {
        "kind": truth["kind"],
        "effect": main["name"] if main else None,
        "effects": [effect["name"] for effect in effects],
        "places": main["places"] if main else [],
        "severity": main["severity"] if main else 0.0,
        "asked": main["asked"] if main else 0.0,
        "reached": all(effect["severity"] > _REACHED * effect["asked"] for effect in effects),
        "verdict": answer["verdict"],
        "message": answer.get("message"),
        "named": first["name"] if first else None,
        "named_places": first["places"] if first else [],
        "others": [other["name"] for other in named[1:]],
        "set": reported,
        "name": right,
        "family": bool(first) and bool(main) and first["family"] == main["family"],
        "in_set": bool(main) and main["name"] in reported,
        "place": place,
        "all_named": all(_true(effect, named) for effect in effects),
        "extra": any(not _true(one, effects) for one in (named[1:] if len(effects) == 1 else named)),
        "covered": _covered(main, first) if right and place else None,
        "where": where[0]["joint"],
        "nominal": gap["before"],
        "null": gap["null"],
        "after": gap["after"],
        "harm": is_worse(gap),
        "withdrawn": bool(answer.get("withdrawn", False)),
        "seconds": answer["seconds"],
    }


def _main(effects: Sequence[Mapping], first: Mapping | None) -> Mapping | None:
    """Returns the hidden effect that a case is scored by: of several the one that was named first, else the largest."""
    same = [effect for effect in effects if first and effect["name"] == first["name"]]
    return max(same or effects, key=lambda effect: effect["severity"], default=None)


def _number(value) -> float:
    return float("nan") if value is None else float(value)


def _true(named: Mapping, effects: Sequence[Mapping]) -> bool:
    """Whether a named effect is hidden, at one of the places that it was named at; or a hidden one is named."""
    return any(effect["name"] == named["name"] and set(effect["places"]) & set(named["places"]) for effect in effects)


def _covered(effect: Mapping, named: Mapping) -> bool | None:
    """Whether the 95 % interval of the first parameter holds the truth; None where there is no single true number."""
    if effect.get("value") is None or not named.get("parameters"):
        return None
    interval = next(iter(named["parameters"].values()))
    return bool(interval["low"] <= effect["value"] <= interval["high"])


def tally(rows: Sequence[dict]) -> list[dict]:
    """Computes the table of rates and means over scored cases, each with its interval and the value to reach.

    Args:
      rows: of `score`.

    Returns:
      Rows with `measure`, `value`, the ends `low` and `high` of the interval, `count` of cases and `goal`.
    """
    kinds = {
        kind: [row for row in rows if row["kind"] == kind and row["reached"]]
        for kind in ("single", "weak", "pair", "triple", "outside")
    }
    singles, outside = kinds["single"], kinds["outside"]
    empty = [row for row in rows if row["kind"] in EMPTY]
    right = [row for row in singles if row["name"]]
    strong = [row for row in singles if row["severity"] >= _STRONG]
    answered = [row for row in rows if row["verdict"] != "failed"]
    unnamed = [row for row in outside if row["verdict"] == "unnamed"]

    def each(group: Sequence[dict], key: str) -> list:
        return [row[key] for row in group if row[key] is not None]

    def closing(group: Sequence[dict]) -> list[float]:
        return [row["null"] / row["after"] for row in group if row["after"] > 0]

    lines = [
        _rate("top-1 name, 5 floor units and more", each(singles, "name"), ">= 0.85"),
        _rate("top-1 name, 15 floor units and more", each(strong, "name"), ""),
        _rate("top-1 name, 2 floor units", each(kinds["weak"], "name"), ""),
        _rate("top-1 family, 5 floor units and more", each(singles, "family"), ">= 0.93"),
        _rate("place right, 5 and more", each(singles, "place"), ">= 0.93"),
        _rate("truth in the reported set, 5 and more", each(singles, "in_set"), ">= 0.95"),
        _mean("mean size of the reported set", [len(row["set"]) for row in singles if row["set"]], "<= 2.5"),
        _rate("extra wrong names, 5 and more", each(singles, "extra"), "<= 0.10"),
        _rate("pairs: both named", each(kinds["pair"], "all_named"), ">= 0.65"),
        _rate("pairs: a name that is not there", each(kinds["pair"], "extra"), ""),
        _rate("triples: all three named", each(kinds["triple"], "all_named"), ""),
        _rate("triples: a name that is not there", each(kinds["triple"], "extra"), ""),
        _rate(
            "names something where nothing is hidden",
            [row["named"] is not None or row["verdict"] == "failed" for row in empty],
            "<= 0.05",
        ),
        _rate(
            "`no_missing_effect` where nothing is hidden",
            [row["verdict"] == "no_missing_effect" for row in empty],
            ">= 0.90",
        ),
        _rate("`unnamed` outside the library", [row["verdict"] == "unnamed" for row in outside], ">= 0.80"),
        _rate("joint of the largest gap right where `unnamed`", [row["where"] in row["places"] for row in unnamed], ""),
        _rate("95 % interval holds the truth", each(right, "covered"), "0.88 to 0.98"),
        _mean("final gap, floor units, name right (median)", each(right, "after"), "<= 1.2", np.median),
        _mean("final gap, floor units, name right (mean)", each(right, "after"), "<= 1.6"),
        _mean("null over after at 15 floor units (median)", closing(strong), ">= 8", np.median),
        _mean(
            "null over after where sealed runs show 5 floor units (median)",
            closing([row for row in singles if row["null"] >= _SHOWN]),
            "",
            np.median,
        ),
        _rate("worse than the better of nominal and null", each(answered, "harm"), ""),
        _rate("withdrawn after the look at sealed", each(answered, "withdrawn"), "<= 0.02"),
        _rate("failed with an error", [row["verdict"] == "failed" for row in rows], ""),
        _mean("seconds a case", each(rows, "seconds"), ""),
    ]
    return [line for line in lines if line["count"]]


def _rate(label: str, hits: Sequence[bool], goal: str) -> dict:
    low, high = wilson(sum(hits), len(hits))
    rate = sum(hits) / len(hits) if hits else None
    return {"measure": label, "value": rate, "low": low, "high": high, "count": len(hits), "goal": goal}


def _mean(label: str, values: Sequence[float], goal: str, middle: Callable = np.mean) -> dict:
    finite = [value for value in values if np.isfinite(value)]
    value = float(middle(finite)) if finite else None
    return {"measure": label, "value": value, "low": None, "high": None, "count": len(finite), "goal": goal}


def wrong(row: dict) -> str | None:
    """Says what is wrong with a scored case, for the list of failures; None where it is right.

    Args:
      row: of `score`.
    """
    if row["verdict"] == "failed":
        return f"failed: {row['message']}"
    if row["kind"] in EMPTY:
        return "something is named" if row["named"] else None if row["verdict"] == "no_missing_effect" else "unsure"
    if row["kind"] == "outside":
        return None if row["verdict"] == "unnamed" else "not `unnamed`"
    several = row["kind"] in ("pair", "triple")
    checks = {
        "harms": row["harm"],
        "withdrawn": row["withdrawn"],
        "not all named": several and not row["all_named"],
        "wrong name": not several and not row["name"],
        "wrong place": not several and row["name"] and not row["place"],
        "extra name": row["extra"],
    }
    return ", ".join(label for label, there in checks.items() if there) or None


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


def page(identity: Mapping[str, object], count: int, rows: Sequence[dict], lines: Sequence[dict]) -> str:
    """Writes the results as a Markdown page.

    Args:
      identity: options of the benchmark.
      count: number of cases in all.
      rows: of `score`, with the name of the `case`.
      lines: table of `tally`.
    """
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in shown(lines))
    options = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in identity.items())
    failures = "\n".join(_failure(row) for row in rows if wrong(row))
    return f"""# Blind benchmark of discovery, size `{identity["size"]}`

`python -m experiments.discovery_bench {options}`, {len(rows)} of {count} robots.
Intervals are Wilson's. `scores.json` holds, for every robot, what was hidden and what discovery answered.

| measure | value | 95 % interval | cases | to reach |
|---|---|---|---|---|
{table}

![hidden effects against named effects](confusion.png)

## Failures

| case | hidden | severity | answered | gap: nominal, null, after | what is wrong |
|---|---|---|---|---|---|
{failures}
"""


def _failure(row: dict) -> str:
    hidden = " + ".join(row["effects"]) or "nothing"
    said = " + ".join([row["named"], *row["others"]]) if row["named"] else row["verdict"]
    gaps = ", ".join(f"{row[name]:.1f}" for name in ("nominal", "null", "after"))
    places = ", ".join(row["places"])
    cells = (row["case"], f"{hidden} ({places})" if places else hidden, f"{row['severity']:.1f}", said, gaps)
    return f"| {' | '.join(cells)} | {wrong(row)} |"
