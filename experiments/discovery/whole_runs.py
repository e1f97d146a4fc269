"""Simulates whole runs from their first state to their end, without a correction by measured states in between."""

from collections.abc import Sequence
from functools import partial

import jax
import numpy as np

from envs import segments
from envs.effects.memory import LONGEST_S
from envs.logs import Run
from experiments.discovery.question import Question
from jaxtune import devices

_WIDTH = 16  # simulations side by side


def simulate_runs(
    question: Question, runs: Sequence[Run], vectors: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Simulates runs under several vectors.

    Programs are compiled for a few lengths and take the robot's numbers as an argument, so most robots find theirs
    in the cache.

    Args:
      question: the problem whose simulator is used.
      runs: of its robot.
      vectors: [vectors, axes] coordinates.

    Returns:
      By run: its rows that are simulated [rows], and there `Question.of_whole_runs`, [vectors, rows, joints].
    """
    rig, problem = question.rig, question.problem
    cut = segments.whole(runs, rig.dt)
    before = cut.segments.measured.shape[1] - 1 - round(LONGEST_S / rig.dt)
    steps, inputs = cut.segments.sample.shape[1] - before, _padded(cut.segments, before)
    values = np.asarray(rig.inner(vectors), np.float32)
    which, piece = (grid.ravel() for grid in np.indices((len(vectors), len(runs))))
    found = []
    for start in range(0, len(which), _WIDTH):
        # The last call is filled up: another width would be another program.
        mine = np.resize(np.arange(start, min(start + _WIDTH, len(which))), _WIDTH)
        some = jax.tree.map(lambda leaf, mine=mine: leaf[piece[mine]], inputs)
        signal = question.of_whole_runs
        found.append(_play(problem.simulate, signal, problem.system, values[which[mine]], some, steps))
    every = np.concatenate(found)[: len(which)].reshape(len(vectors), len(runs), *found[0].shape[1:])
    rows = [np.unique(row) for row in cut.row]
    return rows, [
        _at_rows(every[:, number], step[: len(own)], share[: len(own)], steps)
        for number, (own, step, share) in enumerate(
            zip(rows, cut.segments.row_step, cut.segments.row_share, strict=True)
        )
    ]


def mean_errors(question: Question, vectors: np.ndarray) -> np.ndarray:
    """Computes by how much vectors [vectors, axes] miss whole runs of train and select, [vectors] in the signal's unit.

    It is the mean of the runs' mean absolute errors.
    """
    used = {name for split in ("train", "select") for name in question.splits[split]}
    runs = [run for run in question.log.runs if run.name in used]
    rows, simulated = simulate_runs(question, runs, vectors)
    measured = [run.signals[question.of_whole_runs][own] for run, own in zip(runs, rows, strict=True)]
    errors = [np.abs(one - real).mean(axis=(1, 2)) for one, real in zip(simulated, measured, strict=True)]
    return np.mean(errors, axis=0)


@devices.on_all
@partial(jax.jit, static_argnums=(0, 1))
def _play(simulate, signal, system, values, inputs, steps):
    def some(system, steps, values, inputs):
        return jax.vmap(lambda value, one: simulate(system, value, one, steps)[signal])(values, inputs)

    return devices.spread(some, (values, inputs), shared=(system, steps))


def _padded(cut: segments.Segment, before: int) -> segments.Segment:
    """Repeats the last step until their number after the start is a power of two, and reads at every step."""
    length = cut.sample.shape[1]
    wanted = before + 2 ** int(np.ceil(np.log2(length - before)))

    def longer(leaf: np.ndarray) -> np.ndarray:
        return np.pad(leaf, [(0, 0), (0, wanted - length), *[(0, 0)] * (leaf.ndim - 2)], mode="edge")

    every = np.tile(np.arange(wanted - before, dtype=np.int32), (len(cut.sample), 1))
    return cut.replace(
        **{name: longer(getattr(cut, name)) for name in segments.INPUTS},
        row_step=every,
        row_share=np.zeros(every.shape, np.float32),
    )


def _at_rows(read: np.ndarray, step: np.ndarray, share: np.ndarray, steps: int) -> np.ndarray:
    """Interpolates readings at all steps [..., steps, joints] at the rows' steps and shares, [rows] each."""
    following = np.minimum(step + 1, steps - 1)
    return read[:, step] + share[:, None] * (read[:, following] - read[:, step])
