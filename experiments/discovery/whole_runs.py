"""Simulates whole runs from their first state to their end, without a correction by measured states in between."""

from collections.abc import Sequence
from dataclasses import fields
from functools import partial

import jax
import numpy as np

from envs import segments
from envs.effects.memory import LONGEST_S
from envs.logs import Run
from experiments.discovery.setup import Question

_WIDTH = 16  # simulations side by side
_ROOM = 1.3  # factor between the lengths that programs are compiled for


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
      By run: its rows that are simulated [rows], and their positions in rad, [vectors, rows, joints].
    """
    rig, problem = question.rig, question.problem
    cut = segments.whole(runs, rig.dt)
    rows = [np.unique(row) for row in cut.row]
    before = cut.segments.measured.shape[1] - 1 - round(LONGEST_S / rig.dt)
    steps, inputs = cut.segments.sample.shape[1] - before, _padded(cut.segments)
    values = np.asarray(rig.inner(vectors), np.float32)
    which, piece = (grid.ravel() for grid in np.indices((len(vectors), len(runs))))
    found = []
    for start in range(0, len(which), _WIDTH):
        # The last call is filled up: another width would be another program.
        mine = np.resize(np.arange(start, min(start + _WIDTH, len(which))), _WIDTH)
        some = jax.tree.map(lambda leaf, mine=mine: leaf[piece[mine]], inputs)
        found.append(_play(problem.simulate, problem.system, values[which[mine]], some, steps))
    every = np.concatenate(found)[: len(which)].reshape(len(vectors), len(runs), *found[0].shape[1:])
    return rows, [every[:, number, : len(own)] for number, own in enumerate(rows)]


@partial(jax.jit, static_argnums=0)
def _play(simulate, system, values, inputs, steps):
    return jax.vmap(lambda value, one: simulate(system, value, one, steps)["q"])(values, inputs)


def _padded(cut: segments.Segment) -> segments.Segment:
    """Repeats the last step and the last row until their numbers are some that programs are compiled for."""

    def longer(leaf: np.ndarray) -> np.ndarray:
        length = leaf.shape[1]
        wanted = int(np.ceil(_ROOM ** np.ceil(np.log(length) / np.log(_ROOM))))
        return np.pad(leaf, [(0, 0), (0, wanted - length), *[(0, 0)] * (leaf.ndim - 2)], mode="edge")

    # The measured history has the same length in all runs.
    names = [one.name for one in fields(cut) if one.name != "measured"]
    return cut.replace(**{name: longer(getattr(cut, name)) for name in names})
