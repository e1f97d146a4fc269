import jax
import jax.numpy as jnp

from experiments.walking import work


def test_a_product_counts_its_operations_and_its_matrices():
    found = work.work(lambda one, other: one @ other, jnp.ones((3, 5)), jnp.ones((5, 7)))
    assert found == work.Work(2 * 3 * 5 * 7, 4 * (15 + 35 + 21))


def test_a_loop_counts_every_step_and_what_it_carries():
    def program(start, still):
        def step(carry, _):
            one, other = carry
            return (jnp.sin(one) + other, other), one.sum()

        return jax.lax.scan(step, (start, still), length=10)

    found = work.work(program, jnp.ones(8), jnp.ones(8))
    # A sine, a sum of two, and the sum of all, in each of ten steps.
    assert found.flops == 10 * 3 * 8
    # Of what is carried only one half changes.
    ends = 4 * (16 + 16 + 10)
    assert found.moved == 10 * (2 * 4 * 8 + 4) + ends


def test_calls_inside_count_and_the_largest_branch():
    def program(x):
        return jax.lax.cond(x[0] > 0, lambda: jax.jit(jnp.sin)(jnp.sin(x)), lambda: x)

    assert work.work(jax.vmap(jax.jit(jnp.sin)), jnp.ones((4, 5))).flops == 20
    assert work.work(program, jnp.ones(6)).flops == 12 + 1  # and the comparison


def test_moving_numbers_computes_nothing():
    assert work.work(lambda x: x.T.reshape(-1)[::2], jnp.ones((4, 6))).flops == 0


def test_numbers_that_are_added_in_places_count():
    assert work.work(lambda x: jnp.zeros(3).at[:2].add(x), jnp.ones(2)).flops >= 2
    rows = jnp.arange(1000) % 7
    assert 1000 <= work.work(lambda x: jnp.zeros(7).at[rows].add(x), jnp.ones(1000)).flops < 20_000


def test_the_peaks_of_this_machine_are_positive(monkeypatch):
    monkeypatch.setattr(work, "_SIDE", 64)
    monkeypatch.setattr(work, "_COPIED", 1024)
    assert min(work.peaks()) > 0
