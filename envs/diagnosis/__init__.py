"""What is wrong with a log itself, before anything is learnt from it.

Structure first: time stamps, rows, steps of rounding, clipping. Then physics, by trying: a repair (two joints
exchanged, a sign turned, degrees made radians, an offset or a delay taken out, a clock set right) is believed where the
log agrees much better with itself and with the model after it. Agreement has up to five parts for every joint, each
between none (0) and all of it (2) of the signal's own size:

- measured velocities are the slopes of measured positions;
- the controller's torque is what the model needs for the measured motion (robots that are suspended or clamped);
- the measured torque is the controller's;
- positions follow their targets, and stay within the joints' ranges.

Repairs are looked for one after the other, the best first.
"""

from collections.abc import Mapping, Sequence

import mujoco

from envs import models
from envs.diagnosis.finding import Finding
from envs.diagnosis.physics import physics
from envs.diagnosis.structure import structure
from envs.logs import Log, Run
from envs.rig import suspended

__all__ = ["Finding", "diagnose", "diagnose_log", "shared_findings"]

_LEAST_ROWS = 100  # in one piece


def diagnose_log(log: Log) -> dict[str, list[Finding]]:
    """Diagnoses every run of a log, each for itself.

    Args:
      log: as it was read; its robot's model is loaded by name or path.

    Returns:
      What is suspected, by the name of the run, in the log's order; an empty list where nothing is.
    """
    spec = models.spec(log.robot)
    model = suspended(spec) if log.base == "fixed" else spec.compile()
    return {run.name: diagnose(run, log.joints, model, log.base) for run in log.runs}


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
    """Everything that is suspected of a run.

    Args:
      run: as it was read.
      joints: of the log.
      model: of the robot, hung (`envs.rig.suspended`) where the base is fixed.
      base: fixed or free; what a robot on the ground needs of its joints depends on forces that nobody measured.
    """
    found, clean = structure(run)
    if len(clean.time) < _LEAST_ROWS:
        text = f"no more than {len(clean.time)} rows follow on each other in order: nothing else can be said"
        return [*found, Finding("in pieces", "t", (), float(len(clean.time)), text)]
    return found + physics(clean, joints, model, base == "fixed")
