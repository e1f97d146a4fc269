"""The log doctor: finds errors of a log itself, before discovery or the tuner learn from it.

`columns` looks at names, `structure` at time stamps and rows, `stuck` at signals that do not move with the others,
`contacts` at the model's geometry. `physics` tries repairs: two joints swapped back, a sign flipped, degrees converted
to radians, an offset or a delay removed. A repair is believed if the log then agrees much better with itself and with
the model. Disagreement is the sum over joints of up to five parts, in units of the signals' own size. Each goes from 0
(agreement) to 2, that of the targets to 1:

- measured velocities against the slopes of measured positions;
- the controller's torque against the model's inverse dynamics of the measured motion (on a fixed base only);
- the measured torque against the controller's;
- positions against their targets;
- positions against the joints' ranges.

Repairs are searched greedily in three rounds at most. A round makes the best repair, or a unit and one other repair
together, because nothing agrees in wrong units.
"""

from collections.abc import Mapping, Sequence

import mujoco

from envs import models
from envs.diagnosis.clipping import clipped, clipped_alike
from envs.diagnosis.columns import misspelt
from envs.diagnosis.contacts import contacts
from envs.diagnosis.finding import Finding
from envs.diagnosis.physics import physics
from envs.diagnosis.structure import structure
from envs.diagnosis.stuck import stuck, wrapped
from envs.logs import Log, Run
from envs.models import hinges, suspended

__all__ = ["Finding", "diagnose", "diagnose_log", "shared_findings"]

_LEAST_ROWS = 100  # consecutive rows, below which only the structure is checked


def diagnose_log(log: Log, spec: mujoco.MjSpec | None = None) -> dict[str, list[Finding]]:
    """Diagnoses every run of a log separately; `python -m experiments.doctor` reports the result.

    Args:
      log: as it was read.
      spec: its robot's model; None loads it by the name or path in the log.

    Returns:
      What is suspected, by the name of the run, in the log's order; an empty list where nothing is.
    """
    spec = models.spec(log.robot) if spec is None else spec
    # On a free base the model's dynamics are not compared, so the base may stay.
    model = suspended(spec, log.joints) if log.base == "fixed" else spec.compile()
    found = {run.name: diagnose(run, log.joints, model, log.base) for run in log.runs}
    for name, alike in clipped_alike(log.runs, log.joints).items():
        found[name] += alike
    if log.base == "fixed":
        touching = spec.compile()
        for run in log.runs:
            # Positions of the wrong joints or units touch anything.
            if not any(one.wrong for one in found[run.name]):
                found[run.name] += contacts(run, log.joints, touching)
    return found


def shared_findings(found: Mapping[str, Sequence[Finding]]) -> list[tuple[Finding, list[str]]]:
    """Groups equal findings of several runs, so that a report says each of them once.

    Findings are equal where kind, signal and joints are; their sizes may differ.

    Args:
      found: findings by the name of the run, as `diagnose_log` returns them.

    Returns:
      The first finding of every group and the names of its runs, the most common group first. A name is followed by a
      count where its run has the finding more than once.
    """
    shared: dict[tuple, tuple[Finding, dict[str, int]]] = {}
    for name, findings in found.items():
        for finding in findings:
            _, times = shared.setdefault((finding.kind, finding.signal, finding.joints), (finding, {}))
            times[name] = times.get(name, 0) + 1
    most_common = sorted(shared.values(), key=lambda group: -len(group[1]))
    return [(finding, [_with_count(name, count) for name, count in times.items()]) for finding, times in most_common]


def _with_count(name: str, count: int) -> str:
    return name if count == 1 else f"{name} ({count} times)"


def diagnose(run: Run, joints: tuple[str, ...], model: mujoco.MjModel, base: str = "fixed") -> list[Finding]:
    """Finds everything that is suspected of one run.

    Args:
      run: as it was read.
      joints: names of the joints, in the log's order.
      model: of the robot, suspended (`envs.models.suspended`) where the base is fixed.
      base: `fixed` or `free`. On a free base torques are not compared with the model's, because they depend on ground
        forces that were not measured.

    Returns:
      Findings of names and structure first, then of physics and of clipping; an empty list where nothing is suspected.
    """
    turned, run = wrapped(run, joints, hinges(model, joints))
    found, clean = structure(run)
    found = misspelt(run, joints) + found + turned + stuck(run, joints)
    cut_off = clipped(run, joints)
    if len(clean.time) < _LEAST_ROWS:
        text = (
            f"only {len(clean.time)} consecutive rows are in order, expected {_LEAST_ROWS} or more: "
            "joints, signs, units and delays were not checked"
        )
        return [*found, Finding("in pieces", "t", (), float(len(clean.time)), text), *cut_off]
    return [*found, *physics(clean, joints, model, base == "fixed"), *cut_off]
