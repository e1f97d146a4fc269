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
