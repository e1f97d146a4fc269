"""The experiment that would decide between the two models that are most believed: both play every motion."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from envs import segments
from envs.logs import Log, Run
from envs.models import BUILT_IN
from experiments.discovery.excitation import controller_of, deciding, passive, unlimited_slides
from experiments.discovery.question import Question
from experiments.discovery.rehearsal import rehearsal
from experiments.discovery.target_runs import TargetRun, scaled
from experiments.discovery.whole_runs import simulate_runs
from jaxtune.discovery.result import Result

_RUNS, _SECONDS, _RATE_HZ = 4, 3.0, 200.0


def deciding_experiment(question: Question, log: Log, folder: Path, result: Result) -> str | None:
    """Says which motion of `excite` would decide between the two models that are most believed, and by how much.

    Args:
      question: the problem that discovery worked on.
      log: what was measured; its controller plays the motions.
      folder: of the log.
      result: with the two models.

    Returns:
      A sentence with the command that writes the targets; None where there are no two models with an effect, where no
      motion can be simulated with both, where a slide joint has no range, or where no joint follows its target.
    """
    controller = controller_of(log)
    if controller.kind == "unknown" or len(result.rivals) < 2 or unlimited_slides(question.rig.mj_model, log.joints):
        return None
    (one, other), vectors = (key for key, _ in result.rivals), np.stack([vector for _, vector in result.rivals])

    def score(motion: Sequence[TargetRun]) -> float:
        _, simulated = simulate_runs(question, [_as_run(log, run) for run in motion], vectors)
        # Of the joint in which they differ most.
        return float(np.sqrt(np.mean([(a - b) ** 2 for a, b in simulated], axis=(0, 1)).max()))

    still = passive(controller)
    if still.all():
        return None
    sizes = {"runs": _RUNS, "seconds": _SECONDS, "rate_hz": _RATE_HZ, "seed": 0}
    follow = rehearsal(question.spec, log.joints, controller, _SECONDS)
    found = deciding(question.spec, log.joints, score, **sizes, still=still, follow=follow)
    if found is None:
        return None
    return (
        f"python -m experiments.excite --like {shlex.quote(str(folder))}{_robot_of(log, folder)} "
        f"--motion {found.name} --runs {_RUNS} --seconds {_SECONDS:g} "
        f"--rate-hz {_RATE_HZ:g} --out NEW: there {one} and {other} differ by "
        f"{1e3 * found.scores[found.name]:.2g} mrad (rms)"
    )


def _robot_of(log: Log, folder: Path) -> str:
    """The option that names a model that is not the log's own."""
    own = log.robot in BUILT_IN or Path(log.robot).resolve().is_relative_to(folder.resolve())
    return "" if own else f" --robot {shlex.quote(log.robot)}"


def _as_run(log: Log, motion: TargetRun) -> Run:
    """The motion as a run that begins at rest in its first target, long enough before it moves to have a history."""
    first = log.runs[0]
    rows = round(segments.HISTORY_S * _RATE_HZ) + 2
    still = np.repeat(motion.target[:1], rows, axis=0)
    target = np.concatenate([still, motion.target])
    # A servo's gains depend on its supply.
    supply = {"volts": np.full(len(target), np.median(first.signals["volts"]))} if "volts" in first.signals else {}
    return Run(
        name=motion.name,
        condition=motion.condition,
        split=motion.split,
        controller=scaled(controller_of(log), motion.gain),
        time=np.arange(len(target)) / _RATE_HZ,
        signals={
            "q": np.broadcast_to(motion.target[0], target.shape),
            "target": target,
            "enabled": np.concatenate([np.ones(rows), motion.enabled]),
            **supply,
        },
    )
