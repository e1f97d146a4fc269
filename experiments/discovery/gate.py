"""Decides before any computing whether discovery can answer from a log: what makes it impossible, and what misleads.

A log from which nothing can be learnt is refused. One that the log doctor suspects of an error that would make the
answer wrong (`envs.diagnosis.finding.MISLEADING`) is refused unless the user trusts it. Everything else is a note.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from envs import segments
from envs.diagnosis import diagnose_log, shared_findings
from envs.diagnosis.finding import Finding
from envs.logs import Log, Run, splits
from envs.readings import quantum_of
from envs.smoothing import smoothed
from experiments.discovery.cutting import fitting_horizons
from experiments.discovery.measured import check_simulatable, without_sealed

_LEAST_SEGMENTS = 3  # of the longest horizon in every split
_REST = 2e-3  # rad or m, and in quanta: what a joint at rest may wander, averaged over a tenth of a second
_REST_QUANTA = 3.0
_SATURATED = 0.95  # of the rows in which motors are on
_OF_RUNS = 1.0 / 3.0  # that show a wrong order, sign or unit


def check(log: Log, spec: mujoco.MjSpec, horizons: Sequence[float] | None = None, trust: bool = False) -> list[str]:
    """Checks that a log can answer, without its sealed runs, whose time stamps alone are looked at.

    Args:
      log: of all runs, its base fixed.
      spec: the nominal model, its flags as they will be simulated.
      horizons: lengths of the segments in s; None takes those that fit the rows.
      trust: whether what the doctor suspects is a note too.

    Returns:
      Notes: sentences of the log doctor, and of what torques are taken for, with the runs that they are true of.

    Raises:
      ValueError: nothing can be learnt from the log, or it is misleading and not trusted.
    """
    fitting = fitting_horizons(log, horizons)
    check_simulatable(log, spec, fitting)
    _check_length(log, max(fitting))
    log = without_sealed(log)
    _check_driven(log)
    _check_motion(log)
    said = [
        (_misleads(finding, len(runs) / len(log.runs)) and not trust, f"{finding.sentence} ({_some(runs)})")
        for finding, runs in shared_findings(diagnose_log(log, spec))
    ]
    if refused := [sentence for misleading, sentence in said if misleading]:
        raise ValueError(f"{'; '.join(refused)}: correct the log, or use --trust-log where it is right")
    # After the doctor, because everything is at its limit in wrong units.
    _check_saturation(log)
    taken, unknown = [], log.runs[0].controller.kind == "unknown"
    sent = [run.name for run in log.runs if "target" not in run.signals]
    if unknown:
        taken.append("the controller is unknown, so torques that were measured are compared, along the measured motion")
    elif sent:
        taken.append(
            f"no targets, so torques are taken as sent to the motors ({_some(sent)}); if they were measured, write "
            "controller: {type: unknown} into meta.yaml"
        )
    return [sentence for _, sentence in said] + taken


def _misleads(finding: Finding, share: float) -> bool:
    """Whether a finding in a share of the runs makes the answer wrong.

    A log has one order, sign and unit of its joints. In a few runs alone something else looks like another one, such as
    a load that turns the torque of a light joint around.
    """
    return finding.misleading and (not finding.wrong or share >= _OF_RUNS)


def _some(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _check_length(log: Log, longest_s: float) -> None:
    for split, runs in splits(log).items():
        lasts = [run.time[-1] - run.time[0] - segments.HISTORY_S for run in runs]
        count = sum(max(0, int(last / longest_s)) for last in lasts)
        if count < _LEAST_SEGMENTS:
            raise ValueError(
                f"runs: '{split}' has room for {count} segment(s) of {longest_s:g} s, expected {_LEAST_SEGMENTS} or "
                "more: record longer runs or more of them, or choose shorter horizons"
            )


def _check_driven(log: Log) -> None:
    """Refuses joints whose torque nobody knows: targets without gains."""
    if log.runs[0].controller.kind == "unknown" and not any(
        np.ptp(run.signals["tau"], axis=0).any() for run in log.runs
    ):
        raise ValueError("tau: got constant torques, expected measured ones: nothing else says what the motors did")
    silent = np.ones(len(log.joints), bool)
    goes = np.zeros(len(log.joints), bool)
    for run in log.runs:
        if run.controller.kind != "pd" or "target" not in run.signals:
            return
        silent &= run.controller.gains["kp"] == 0
        goes |= np.ptp(run.signals["target"], axis=0) > 0
    # The target of a passive joint stays where it is.
    missing = [name for name, bad in zip(log.joints, silent & (goes | silent.all()), strict=True) if bad]
    if missing:
        remedy = (
            "or no target.* columns, so that tau.* is what drives the robot"
            if all("tau" in run.signals for run in log.runs)
            else "or the torques that were sent, in tau.* in the place of target.*"
        )
        raise ValueError(f"controller.kp: got 0 for {', '.join(missing)}, expected the controller's gains, {remedy}")


def _check_motion(log: Log) -> None:
    wander = {}
    for run in log.runs:
        for name, column in zip(log.joints, run.signals["q"].T, strict=True):
            rows = min(len(column), max(1, round(0.1 / np.median(np.diff(run.time)))))
            mean = np.convolve(column, np.full(rows, 1.0 / rows), "valid")
            least = max(_REST, _REST_QUANTA * quantum_of(column))
            wander[run.name, name] = np.ptp(mean) / least
    (where, joint), most = max(wander.items(), key=lambda each: each[1])
    if most <= 1.0:
        raise ValueError(
            f"q: got a robot at rest in all runs (most moves {joint} in {where}, no more than noise), expected motion; "
            "`python -m experiments.excite` writes targets"
        )


def _check_saturation(log: Log) -> None:
    """Refuses a log in which every motor is at its limit nearly always: then position errors have no effect."""
    shares = np.stack([share for run in log.runs if (share := _saturated(run)) is not None] or [np.zeros((2, 1))])
    on, at_limit = shares.sum(axis=0)
    if (on > 0).any() and (at_limit > _SATURATED * on)[on > 0].all():
        raise ValueError(
            f"tau: got controllers at their limit in {at_limit.sum() / on.sum():.0%} of the rows, at every joint, "
            "expected motion below the limit: check kp and torque_limit_nm, or record smaller motion"
        )


def _supplied(run: Run) -> bool:
    return run.controller.kind != "servo" or "volts" in run.signals or "volts" in run.controller.gains


def _saturated(run: Run) -> np.ndarray | None:
    """Counts rows with motors on, and those of them at the controller's limit, [2, joints]."""
    if "target" not in run.signals or not _supplied(run):
        return None
    law, speed = run.impedance(), smoothed(run)[:, 1]
    on = law.limit > 0
    torque = np.abs(law.torque(run.signals["target"], run.signals["q"], speed))
    return np.stack([on.sum(axis=0), (on & (torque >= 0.999 * law.limit)).sum(axis=0)])
