"""Checks a robot's log before anything is learnt from it: what its numbers mean, and which policy has walked."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.diagnosis import Finding
from envs.logs import Log
from jaxtune.types import Trajectory

_STRANGE = 0.25
"""Largest difference between recorded actions and those of the policy, as rms over rms, that is put down to sensor
noise and late targets. Beyond it another policy must have walked."""


def check_runs(place: Path, log: Log, episodes: int) -> None:
    """Checks that a log holds one run for every walk that was requested.

    An additional or a missing run would distort the measured share of falls.

    Args:
      place: folder of the round, with `request.json` and `log`.
      log: as it was read.
      episodes: number of walks that were requested.

    Raises:
      ValueError: the numbers differ; names the log, the number of runs and the request.
    """
    if len(log.runs) != episodes:
        raise ValueError(
            f"{place / 'log'}: got {len(log.runs)} run(s), expected the {episodes} walks that "
            f"{place / 'request.json'} asks for, as one run each"
        )


def check_meaning(
    place: Path,
    log: Log,
    walks: Trajectory,
    policy: Mapping[str, Any],
    act: Callable[[jax.Array], jax.Array],
    suspicions: Sequence[tuple[Finding, list[str]]],
) -> None:
    """Checks that a log's numbers have the meaning that its `meta.yaml` declares, and that the round's policy walked.

    Learning from swapped joints, wrong units or another policy's walks would move the distribution to wrong physics.

    Args:
      place: folder of the log, for messages.
      log: as it was read.
      walks: its episodes, [episodes, time].
      policy: settings of the policy that was exported, such as its reference and scale.
      act: actions [steps, act] of that policy for observations [steps, obs], without noise.
      suspicions: findings of the log doctor, each with the names of the runs that share it.

    Raises:
      ValueError: most runs have a finding that changes what the numbers mean, the log is of a policy with another
        reference or scale, or its actions are not the policy's. Names everything that is wrong.
    """
    wrong = [finding.sentence for finding, runs in suspicions if finding.wrong and 2 * len(runs) > len(log.runs)]
    wrong += _other_policy(log.policy or {}, policy)
    strange = _difference(walks, act)
    if strange > _STRANGE:
        wrong.append(f"actions differ from what this round's policy does by {strange:.0%} of their size")
    if wrong:
        raise ValueError(f"{place}: {'; '.join(wrong)} (to learn from it nevertheless, set trust_log)")


def _other_policy(found: Mapping, expected: Mapping) -> list[str]:
    return [
        f"policy.{name}: got {found[name]}, expected {value}"
        for name, value in expected.items()
        if found.get(name, value) != value
    ]


def _difference(walks: Trajectory, act: Callable[[jax.Array], jax.Array]) -> float:
    """Rms difference between recorded actions and the policy's for the recorded observations, over the actions' rms."""
    alive = np.asarray(walks.alive)
    recorded = np.asarray(walks.action)[alive]
    expected = np.asarray(act(walks.obs.reshape(-1, walks.obs.shape[-1])))[alive.ravel()]
    return float(np.sqrt(((recorded - expected) ** 2).mean() / np.maximum((recorded**2).mean(), 1e-12)))
