"""One discovery from a folder of logs to its files: the same for a user's log and for the cases of a benchmark."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from envs import corrected
from envs.logs import Log
from experiments.common import checkpoint
from experiments.common.files import read_json, write_json
from experiments.discovery.measured import read_logs
from experiments.discovery.question import Question, build_question
from experiments.discovery.summary import details, free_runs, summarise
from experiments.discovery.whole_runs import mean_errors
from jaxtune.discovery import workflow
from jaxtune.discovery.noise_floor import Say
from jaxtune.discovery.result import Result


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a discovery said of a log, with what a report needs beside it."""

    log: Log
    question: Question
    result: Result
    summary: dict
    """Content of `summary.json`."""
    free: dict
    """Whole simulated runs, of `summary.free_runs`."""


def investigate(
    logs: Sequence[Path],
    out: Path,
    *,
    horizons: Sequence[float] | None = None,
    null_logs: int = 20,
    seed: int = 0,
    clear_flags: bool = False,
    swap_halves: bool = False,
    robot: Path | None = None,
    say: Say = lambda text: None,
) -> Answer:
    """Reads logs, discovers what their model lacks, and writes summary, details and the corrected model.

    Interrupted, the same call goes on after the last accepted effect.

    Args:
      logs: folders of logs of one robot.
      out: folder of `summary.json`, `details.json`, `state.json` and `model/`.
      horizons: three increasing lengths of segments in s; None takes those that fit the rows.
      null_logs: number of simulated null logs.
      seed: of the null logs.
      clear_flags: whether flags of the model that switch physics off are cleared; else they are refused.
      swap_halves: whether train changes places with select and sealed.
      robot: path of an MJCF in the place of the logs' own models.
      say: receives a line of text about progress.

    Returns:
      The answer, for a report.

    Raises:
      ValueError: a log cannot be used.
    """
    began, saved = time.monotonic(), out / "state.json"
    log, spec = read_logs(logs, clear_flags, swap_halves, robot)
    question = build_question(log, spec, horizons, null_logs, seed)
    out.mkdir(parents=True, exist_ok=True)
    result = workflow.discover(
        replace(question.problem, whole_runs=partial(mean_errors, question)),
        saved=read_json(saved) if saved.exists() else None,
        save=lambda state: write_json(saved, state),
        say=say,
    )
    free = free_runs(question, result)
    stamp = {"seconds": time.monotonic() - began, "versions": checkpoint.versions()}
    summary = summarise(question, log, logs[0], result) | stamp
    # A robot is no weaker for a sensor that reads too little.
    corrected.save(out / "model", spec, question.rig, np.where(question.sensed, 0.0, result.model))
    write_json(out / "details.json", details(question, result, free))
    # Last: a discovery with this file is finished.
    write_json(out / "summary.json", summary)
    return Answer(log=log, question=question, result=result, summary=summary, free=free)
