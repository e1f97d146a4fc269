import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtune import conformal


@pytest.mark.parametrize("sets", [19, 39, 99, 199])
def test_every_level_rejects_as_many_ranks_as_it_should(sets):
    p_values = jnp.arange(1, sets + 2) / jnp.float32(sets + 1)
    for per_cent in range(50, 100):
        found = int(conformal.rejects(p_values, jnp.float32(per_cent / 100)).sum())
        assert found == (sets + 1) * (100 - per_cent) // 100, per_cent
    assert not conformal.rejects(jnp.nan, 0.5)


def test_a_quantile_is_exceeded_as_rarely_as_it_says():
    values = np.random.default_rng(0).permutation(19)
    assert conformal.quantile(jnp.asarray(values), 0.95) == 18
    assert conformal.quantile(jnp.asarray(values), 0.5) == 9
    # Too few for the level: the largest.
    assert conformal.quantile(jnp.asarray(values), 0.99) == 18
    # What is not known is no draw.
    some = jnp.append(jnp.asarray(values, jnp.float32), jnp.full(5, jnp.nan))
    assert conformal.quantile(some, 0.5) == 9
    both = conformal.quantile(jnp.stack([some, jnp.full(24, jnp.nan)], axis=1), 0.95)
    assert both[0] == 18 and jnp.isnan(both[1])


@pytest.mark.parametrize("sets", [19, 39, 99, 199])
def test_no_level_costs_a_rank_by_rounding(sets):
    for per_cent in range(1, 100):
        rank = -((sets + 1) * -per_cent // 100) - 1
        got = conformal.quantile(jnp.arange(sets), jnp.float32(per_cent / 100))
        assert got == min(max(rank, 0), sets - 1), per_cent


def test_a_p_value_counts_what_is_at_least_as_large():
    assert conformal.p_value(jnp.array([3.0, 1.0, 2.0, 2.0])) == 0.75
    assert np.isnan(conformal.p_value(jnp.array([3.0, jnp.nan])))
    assert conformal.p_value(jnp.array([3.0, jnp.nan, 1.0, jnp.nan, 2.0])) == 2 / 3


def test_p_values_together_are_as_rare_as_they_say():
    # That of two halves, and one of its own for a single one.
    assert float(conformal.together(jnp.array([0.5, jnp.nan, 0.5]))) == pytest.approx(0.25 * (1 + np.log(4)), rel=1e-5)
    assert float(conformal.together(jnp.array([0.03]))) == pytest.approx(0.03, rel=1e-5)
    assert np.isnan(conformal.together(jnp.array([jnp.nan])))
    # Of conformal p-values with 99 held-out sets, as a tuning has.
    found = np.random.default_rng(0).integers(1, 101, (20_000, 5)) / 100
    together = np.asarray(jax.vmap(conformal.together)(found))
    # Steps of 0.01 make it rarer.
    assert 0.003 <= (together <= 0.01).mean() <= 0.01
    # Five sets that a level of 0.95 lets pass.
    assert float(conformal.together(jnp.full(5, 0.06))) < 0.01
