"""Reports a round to a person: an HTML page with its plot, and two tables on the console. Verdict and advice first."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.common import plots, report
from experiments.common.files import as_json
from experiments.robot.fall_risk import surprise
from experiments.robot.records import Round
from experiments.robot.rounds import Terms
from jaxtune import conformal
from jaxtune.settings import UNEXPLAINED

VERDICTS = {
    "accept": "The simulator covers what was measured.",
    "unexplained": "No parameters of the simulator explain what was measured, tested at 1 %: physics is missing in "
    "the model.",
    "radius_exhausted": "The simulator does not cover what was measured, and its distribution cannot grow any wider.",
    "not_finite": "Nothing could be compared: a value is not finite.",
    "not_comparable": "There is too little to compare: walks, measured or simulated, were shorter than a window of 50 "
    "steps, the robot did not move or showed no parameter, two of its walks are copies, something that never changes "
    "in simulation has another value, or too few simulated sets are usable: a level of 0.95 needs 19.",
    None: "This method does not check whether the simulator covers what was measured.",
}
"""What each verdict of the gate means; None stands for a method without a gate."""

ADVICE = {
    "accept": "Continue with the next round, if the expected falls allow it.",
    "doubtful": "The log fits badly all the same, in the distribution that was read last: estimates may make up for "
    "physics that the model lacks. Look where it does not fit before the robot walks again, and measure again with the "
    "same policy if you can.",
    "together": "No log is rejected by itself, but the logs of all rounds together are: each misfits a little. Physics "
    "is missing in the model, and estimates make up for it. Suspend the robot, play the targets that "
    "experiments.excite writes, and run experiments.discover on the log.",
    "unexplained": "Suspend the robot, play the targets that experiments.excite writes, and run experiments.discover "
    "on the log: it names what is missing.",
    "radius_exhausted": "Check the bounds of the parameters and the log. If both are right, suspend the robot and run "
    "experiments.discover.",
    "not_finite": "Look for the value that is not finite: experiments.doctor names its signal.",
    "not_comparable": "Look at the log: does the robot walk in each of its walks, and is none there twice? If it falls "
    "at once, start from a policy that stands longer: one that was trained in a wider distribution (--method dr), or "
    "with the robot held by a rope.",
    None: "Use --method ours if you want to know.",
}
"""What to do next, by verdict; `doubtful` stands for an accepted log that fits badly, `together` for several."""

_TEMPLATE = Path(__file__).with_suffix(".html")
_QUANTITIES = {"return": "return", "fall_rate": "share of walks that end in a fall", "power_w": "mechanical power, W"}


def write(path: Path, history: Sequence[Round], terms: Terms, robot: str = "biteno") -> None:
    """Writes the page of the last round; text that comes from the log is escaped.

    Args:
      path: of the HTML file; its plot is embedded.
      history: all rounds so far.
      terms: conditions of the walks, for the largest fall rate and the length of a walk.
      robot: its name. Only BITeno can be tuned in a model that discovery corrected.
    """
    last = history[-1]
    page = report.render(
        _TEMPLATE,
        line=as_json(last),
        verdict=last.tuning.verdict,
        meaning=VERDICTS[last.tuning.verdict],
        advice=_advice(history),
        quantities=_QUANTITIES,
        unidentified=last.tuning.unidentified,
        earlier=_earlier(last),
        together=last.tuning.together if last.tuning.verdict == "accept" else (),
        surprise=surprise(last.measured, last.tuning.explained),
        safe=last.expected_falls <= terms.max_fall_rate,
        terms=terms,
        biteno=robot == "biteno",
        episodes=sum(one.measured.episodes for one in history),
        falls=sum(round(one.measured.episodes * one.measured.fall_rate) for one in history),
        misfits=plots.embedded(plots.misfits(as_json(last.tuning.misfits))) if last.tuning.misfits else "",
        picture=plots.embedded(plots.rounds(as_json(list(history)))),
    )
    path.write_text(page)


def _advice(history: Sequence[Round]) -> str:
    last = history[-1].tuning
    together = float(conformal.together(np.array([one.tuning.misfit_p_value for one in history], float)))
    if len(history) > 1 and last.verdict == "accept" and together <= UNEXPLAINED:
        return f"{ADVICE['together']} (p {together:.1g})"
    if last.doubtful:
        return f"{ADVICE['doubtful']} (p {last.fit_p_value:.2f})"
    return ADVICE[last.verdict]


def _earlier(last: Round) -> str:
    """Says whether the logs of earlier rounds count; nothing where they said nothing."""
    if last.tuning.verdict != "accept" or last.tuning.past_p_value is None:
        return ""
    found = f"p {last.tuning.past_p_value:.2f}"
    if last.tuning.pooled:
        return f"Estimates are joined with those of earlier rounds, which this log does not contradict ({found})."
    return (
        f"This log contradicts earlier rounds ({found}), which count no longer: they misled, or the robot has changed."
    )


def show(console: Console, history: Sequence[Round]) -> None:
    """Prints a round: verdict and advice, prediction and measurement, what moved, and the expected falls.

    Args:
      console: where it is printed.
      history: all rounds so far.
    """
    last = history[-1]
    verdict = last.tuning.verdict
    console.print(f"[bold]round {last.index}: {verdict or 'no gate'}[/bold]: {VERDICTS[verdict]}")
    console.print(_advice(history))
    table = Table("", "predicted", "measured", "same policy, tuned simulator", "predicted for the next round")
    columns = [as_json(one) for one in (last.predicted, last.measured, last.tuning.explained, last.next_predicted)]
    for name, label in _QUANTITIES.items():
        table.add_row(label, *("-" if column[name] is None else f"{column[name]:.2f}" for column in columns))
    console.print(table)
    table = Table("parameter", "before", "after", "90 % interval")
    for name, ends in last.tuning.moved.items():
        interval = "-" if ends.low is None else f"{ends.low:.3f} to {ends.high:.3f}"
        note = " (not identifiable from this log)" if name in last.tuning.unidentified else ""
        note = note or (" (weakly identified)" if name in last.tuning.weak else "")
        table.add_row(name + note, f"{ends.before:.3f}", f"{ends.after:.3f}", interval)
    console.print(table)
    if earlier := _earlier(last):
        console.print(earlier, highlight=False)
    for one in last.measured.suspected:
        console.print(f"doctor: {one.sentence} ({', '.join(one.runs)})", highlight=False, markup=False)
    console.print(f"{last.expected_falls:.0%} of the next walks are expected to end in a fall")
