"""Reports a discovery to a person: an HTML page with its plots, and tables on the console. Verdict and advice first."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from envs.logs import Log
from experiments.common import plots, report
from experiments.discovery.question import Question
from jaxtune.discovery.result import Result

VERDICTS = {
    "named": "Something is missing in the model, and it has a name.",
    "parameter_change": "Nothing is missing in the model, but a parameter has another value.",
    "no_missing_effect": "Nothing is missing: the model explains these logs down to the noise floor.",
    "unnamed": "Something is missing that no effect of the library explains.",
}
"""What each verdict means, in one sentence."""

ADVICE = {
    "named": "Train and tune in the corrected model (--model OUT/model). If an effect is not distinguishable from "
    "others and the difference matters to you, first record the experiment in its row.",
    "parameter_change": "Use the corrected model (--model OUT/model), and check the parameter on the robot.",
    "no_missing_effect": "Keep the model. If a policy still fails on the robot, look at what these logs cannot show: "
    "contact, the free base, commands and delays on the way to the controller.",
    "unnamed": "Look at the suspects, and at the joint and regime where the gap is largest. The saved model is the "
    "best one on validation runs; it may have a learned torque, which names nothing.",
}
"""What to do next, by verdict."""

FAILED = {
    "beyond_chance": "it gains no more than chance does",
    "confirmed": "validation runs speak against it",
    "matters": "it closes too little of the gap",
    "inside_bounds": "its fit went to the end of its range",
    "clear_of_zero": "its size may be zero",
    "horizons": "it helps at too few lengths of segments",
    "of_interest": "it is far smaller than any size of interest",
}
"""Why an effect was taken out of the model again, by the test of `jaxtune.discovery.evidence.passes` that it failed."""

PARTS = {
    "position": "position",
    "speed": "speed",
    "torque": "torque",
    "past": "last 30 ms",
    "joint before": "joint before it, in torque or position",
    "joint after": "joint after it, in torque or position",
}
"""What parts of a learned torque depend on (`envs.effects.learned.PARTS`)."""

_UNITS = {"q": ("rad", "m"), "tau": ("Nm", "N")}  # of hinges and slides
_SHOWN = 4  # suspects on the console
_MUCH = 5.0  # floor units; of 16 answers that left as much in the benchmarks, 7 were wrong or lacked an effect
_HARDLY = 0.2  # share of the gap
_SUSPECT = 0.01  # least probability of one there
_TEMPLATE = Path(__file__).with_suffix(".html")


def write(path: Path, log: Log, question: Question, result: Result, summary: dict, free: dict) -> None:
    """Writes the page; text that comes from the log is escaped.

    Args:
      path: of the HTML file; its plots are embedded.
      log: what was measured.
      question: the problem that discovery worked on; its rig has the sentences that describe effects.
      result: what was found.
      summary: of `experiments.discovery.summary.summarise`.
      free: of `experiments.discovery.summary.free_runs`.
    """
    traces = plots.traces(free["runs"], log.joints, _UNITS[free["signal"]][0])
    pictures = {"where": plots.heat_map(result.where), "traces": traces}
    brief = partial(brief_keys, question)
    if result.terms:
        pictures["terms"] = plots.accepted_terms(result.terms, [brief(term.hypothesis.key) for term in result.terms])
    page = report.render(
        _TEMPLATE,
        robot=log.robot,
        runs=len(log.runs),
        meaning=VERDICTS[summary["verdict"]] + _doubt(summary),
        clues=_clues(summary),
        sensors=_sensors(summary),
        advice=ADVICE[summary["verdict"]],
        summary=summary,
        brief=brief,
        place=partial(place_in_words, question),
        effects=_presented(summary, question),
        notes=question.notes,
        not_testable=[(name, _what_would_show(question, name)) for name in summary["not_testable"]],
        proof=result.proof,
        terms=result.terms,
        failed=partial(_failed, summary),
        reasons=_reasons,
        named=_named,
        whole_runs=_whole_runs(free),
        free=free,
        pictures={name: plots.embedded(figure) for name, figure in pictures.items()},
    )
    path.write_text(page)


def _what_would_show(question: Question, name: str) -> str:
    """What it takes to see an effect that the logs do not show."""
    if name not in question.rig.effects:
        return "a free base"
    asked = any(hypothesis.name == name for hypothesis in question.problem.hypotheses)
    return question.rig.effects[name].excited_by if asked else "a controller that is known"


def show(console: Console, question: Question, summary: dict, free: dict) -> None:
    """Prints the verdict, what to do next, every effect with its interval, and the gap before and after.

    Args:
      console: where it is printed.
      question: the problem that discovery worked on.
      summary: of `experiments.discovery.summary.summarise`.
      free: of `experiments.discovery.summary.free_runs`.
    """
    # Names of joints and links are printed as they are.
    say = partial(console.print, markup=False, highlight=False)
    doubt = escape(_doubt(summary))
    console.print(f"[bold]{summary['verdict']}[/bold]: {VERDICTS[summary['verdict']]}{doubt}", highlight=False)
    say(ADVICE[summary["verdict"]])
    table = Table("effect", "place", "size (95 % interval)", "not distinguishable from", "experiment to decide")
    table.caption = "sizes come on top of what the model has"
    for effect in _presented(summary, question):
        values = ", ".join(
            f"{name} {value['value']:.4g} ({value['low']:.4g} to {value['high']:.4g})"
            for name, value in effect["parameters"].items()
        )
        others = ", ".join(effect["confusable_with"]) or "-"
        table.add_row(_named(effect), escape(effect["place"]), values, others, escape(effect["experiment"]))
    if table.row_count:
        console.print(table)
    for effect in summary["not_named"]:
        name, why = f"{effect['name']} at {place_in_words(question, effect)}", "explains only a part"
        if effect["refines"] is not None:
            why = f"may only make up for the form of {brief_keys(question, effect['refines'])}"
        say(f"accepted, not named: {name}, which {why}")
    table = Table("error on held-out runs", "nominal model", "parameters fitted", "corrected model")
    gap, error = summary["gap"], free["error"]["sealed"]
    table.add_row("short segments, floor units", *(f"{gap[name]:.2f}" for name in ("before", "null", "after")))
    table.add_row(_whole_runs(free), *(f"{error[name]:.4f}" for name in ("before", "null", "after")))
    console.print(table)
    if summary["effects"] or summary["not_named"]:
        say(f"explained: {summary['explained_share']:.0%} of what can be explained")
    for one in summary["dropped"]:
        why = _reasons(one["failed"])
        say(f"taken out again: {_named(one)} at {place_in_words(question, one)}, since {why}")
    suspects = [
        f"{one['name']} at {place_in_words(question, one)} {one['probability']:.2f}"
        f"{' (taken out again)' if _failed(summary, one) else ''}"
        for one in summary["suspects"]
        if one["probability"] >= _SUSPECT
    ]
    if suspects:
        say(f"suspects: {'; '.join(suspects[:_SHOWN])}")
    if summary["next_experiment"]:
        experiment = brief_keys(question, summary["next_experiment"])
        say(f"to decide between them: {experiment}")
    if summary["verdict"] == "unnamed" and summary["explainable_share"] < _HARDLY:
        say(
            f"A learned torque at all joints explains {summary['explainable_share']:.0%} of what is left: the rest may "
            "differ from run to run. Record a motion several times, as one condition, to see whether it does."
        )
    if clues := _clues(summary):
        say(clues)
    if summary["withdrawn"]:
        say("the corrected model was withdrawn: on held-out runs it was worse than the one that is saved")
    if sensors := _sensors(summary):
        say(sensors)
    if summary["not_testable"]:
        say(f"effects that these logs could not show: {', '.join(summary['not_testable'])}")


def _sensors(summary: dict) -> str:
    """How sensors read torques; empty where none are compared."""
    said = [
        f"{joint} {', '.join(f'{name} {value:.3g}' for name, value in one.items())}"
        for joint, one in summary["torque_sensors"].items()
    ]
    offsets = any("offset_nm" in one for one in summary["torque_sensors"].values())
    # It has no other name there.
    constant = ". A constant torque, such as that of a tilted base, would be in these offsets too" if offsets else ""
    return f"torque sensors read, of the robot's torques: {'; '.join(said)}{constant}." if said else ""


def _whole_runs(free: dict) -> str:
    return f"whole runs, mean absolute error in {' or '.join(_UNITS[free['signal']])}"


def _clues(summary: dict) -> str:
    """What the learned torque depends on most, where it is what is saved; empty elsewhere."""
    parts = summary["learned_parts"][:_SHOWN] if summary["model_is"] == "learned" else []
    if not parts:
        return ""
    said = "; ".join(f"at {one['place']} the {PARTS[one['part']]} ({one['lost_without']:.0%})" for one in parts)
    return f"What the learned torque depends on, with the share of what it explains that is lost without: {said}."


def _doubt(summary: dict) -> str:
    """Says where a model that lacks nothing is far off all the same, or by how much one with a name still is."""
    if cell := summary["far_off"]:
        where = f"{cell['joint']} is {cell['excess_floor_units']:.1f} floor units above it in a few segments"
        return f" Yet {where} (regime: {cell['regime']}): record more motions of that kind."
    left = summary["gap"]["after"]
    if summary["verdict"] not in ("named", "parameter_change") or left < _MUCH:
        return ""
    return (
        f" Yet {left:.1f} floor units are left on held-out runs: something else may be missing as well, or in place of "
        "what is named."
    )


def _presented(summary: dict, question: Question) -> list[dict]:
    """Returns effects and parameter changes with place in words, experiment there, and a sentence for the effect."""
    found = []
    for effect in [*summary["effects"], *summary["parameter_changes"]]:
        row, place = question.rig.effects[effect["name"]], place_in_words(question, effect)
        added = {"place": place, "experiment": f"{row.excited_by} on {place}", "sentence": row.sentence}
        found.append(effect | added)
    return found


def _failed(summary: dict, suspect: Mapping) -> list[str]:
    """The tests that a suspect failed when it was taken out of the model again; none where it was not."""
    identity = ("name", "places", "each")
    same = [one for one in summary["dropped"] if all(one[key] == suspect[key] for key in identity)]
    return next((one["failed"] for one in same if not one["form"]), [])


def _named(effect: Mapping) -> str:
    """The name of an effect of the summary, with its form where it has another than the first."""
    return f"{effect['name']} ({effect['form'].replace('_', ' ')})" if effect["form"] else effect["name"]


def _reasons(failed: Sequence[str]) -> str:
    return ", and ".join(FAILED[test] for test in failed)


def place_in_words(question: Question, effect: Mapping) -> str:
    """Names the places of an effect, suspect or family of the summary, such as `all joints` for six names.

    Of one that has a size of its own at every place it is `each joint`.
    """
    between = "&" if effect.get("each") else "+"
    words = brief_keys(question, f"@{between.join(effect['places'])}")[1:]
    return f"each of {words.replace('&', ', ')}" if "&" in words else words.replace("+", ", ")


def brief_keys(question: Question, text: str) -> str:
    """Puts `all joints` or `each joint` in the place of all their names, wherever a text has the keys of hypotheses."""
    for kind, plural in (("joint", "joints"), ("body", "bodies")):
        every = question.rig.places[kind]
        if len(every) > 1:
            text = text.replace(f"@{'+'.join(every)}", f"@all {plural}")
            text = text.replace(f"@{'&'.join(every)}", f"@each {kind}")
    return text
