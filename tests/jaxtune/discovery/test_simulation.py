"""Moves of different kinematic trees are simulated at a time, and found as if each were simulated alone."""

import jax.numpy as jnp
import numpy as np
from slider import problem

from jaxtune.discovery.problem import Problem, Segments
from jaxtune.discovery.simulation import Evaluate


def simulate(system, vector, segment, steps):
    """Two joints of two trees: axes 0 and 1 move a joint each, axis 2 both; beyond 1 the first breaks everything."""
    del steps
    own = system * segment["x"][:, None] * jnp.stack([vector[0] ** 2, vector[1]]) + vector[2]
    return {"q": own + jnp.where(vector[0] > 1.0, jnp.nan, 0.0)}


def two_trees() -> tuple[Problem, Segments]:
    x = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    none = np.zeros((3, 4, 2))
    segments = Segments(inputs={"x": x}, signals={"q": none}, steps=4, run=np.arange(3), regimes=none.astype(int))
    fields = {name: value for name, value in vars(problem({})).items() if name not in ("data", "components")}
    fields |= {"simulate": simulate, "system": np.float32(1.0), "axes": 3, "bin_rows": 2, "trees": np.array([0, 1])}
    fields |= {"axis_trees": np.array([0, 1, -1]), "components": {"q": ("one", "two")}}
    return Problem(**fields, data={"train": dict.fromkeys((0.1, 0.2, 0.4), segments)}), segments


def evaluation() -> Evaluate:
    asked, segments = two_trees()
    return Evaluate(asked, segments, np.full((2, 2), 0.5), np.zeros((3, 2, 2)))


def test_moves_are_found_as_if_each_were_alone_with_fewer_simulations():
    evaluate, counted = evaluation(), []
    vectors = [np.zeros(3), np.array([0.2, -0.1, 0.3])]
    residuals = list(evaluate(np.stack(vectors)))
    moves = [np.diag([0.5, 0.7, 0.1]), np.array([[0.0, 0.4, 0.0], [0.3, 0.0, 0.0], [0.3, 0.4, 0.0]])]
    found = evaluate.changes(vectors, residuals, moves, lambda done, count: counted.append(count))
    for vector, residual, mine, changes in zip(vectors, residuals, moves, found, strict=True):
        np.testing.assert_allclose(changes, evaluate(vector + mine) - residual, atol=1e-5)
        assert (changes != 0).any(axis=1).all()
    # Of six moves two pairs go together.
    assert counted == [4]


def test_a_move_that_breaks_the_simulation_takes_no_other_with_it():
    evaluate = evaluation()
    residual = evaluate(np.zeros((1, 3)))
    (found,) = evaluate.changes([np.zeros(3)], residual, [np.array([[2.0, 0.0, 0.0], [0.0, 0.7, 0.0]])])
    np.testing.assert_array_equal(found[0], 0.0)
    np.testing.assert_allclose(found[1], evaluate(np.array([[0.0, 0.7, 0.0]]))[0] - residual[0], atol=1e-6)
    assert np.abs(found[1]).max() > 0.1
