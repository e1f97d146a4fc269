import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtune import dist as dists


def scalars(**values):
    return {name: jnp.float32(value) for name, value in values.items()}


@pytest.fixture
def two():
    """Centres 0 and 0.75 in bounds of +-1: the second box is cut by its upper bound."""
    return dists.make(scalars(b=0.75, a=0.0), 0.5, scalars(a=-1, b=-1), scalars(a=1, b=1))


def test_vectors_are_sorted_by_name_whatever_the_order_of_the_mapping(two):
    assert dists.names(two) == ("a", "b")
    vector = dists.ravel(scalars(b=2.0, a=1.0))
    np.testing.assert_array_equal(vector, [1.0, 2.0])
    assert dists.unravel(("a", "b"), vector) == {"a": 1.0, "b": 2.0}


def test_ravel_keeps_leading_dimensions():
    named = {"b": jnp.arange(6.0).reshape(2, 3), "a": jnp.zeros((2, 3))}
    vector = dists.ravel(named)
    assert vector.shape == (2, 3, 2)
    np.testing.assert_array_equal(dists.unravel(("a", "b"), vector)["b"], named["b"])


def test_box_is_cut_by_the_bounds(two):
    low, high = dists.box(two)
    assert low == {"a": -0.5, "b": 0.25}
    assert high == {"a": 0.5, "b": 1.0}


def test_normalised_box_is_in_radii_around_the_centre(two):
    low, high = dists.normalised_box(two)
    np.testing.assert_array_equal(low, [-1.0, -1.0])
    np.testing.assert_array_equal(high, [1.0, 0.5])  # (1 - 0.75) / 0.5


def test_normalise_by_hand(two):
    np.testing.assert_allclose(dists.normalise(two, scalars(a=0.25, b=0.5)), [0.5, -0.5])


def test_samples_fill_the_box_evenly(two):
    count = 4000
    draws = dists.sample(jax.random.key(0), two, count)
    for name, (low, high) in {"a": (-0.5, 0.5), "b": (0.25, 1.0)}.items():
        values = np.asarray(draws[name])
        assert values.shape == (count,)
        assert values.min() >= low
        assert values.max() <= high
        tenths = np.histogram(values, bins=10, range=(low, high))[0]
        # 400 expected in each, standard deviation 19.
        assert np.all(np.abs(tenths - count / 10) < 5 * 19)
    # Independent draws correlate by 1 / sqrt(4000) = 0.016.
    assert abs(np.corrcoef(draws["a"], draws["b"])[0, 1]) < 0.08


def test_widen_multiplies_the_radius_up_to_the_width_of_the_bounds(two):
    wider = dists.widen(two, jnp.float32(1.5))
    assert wider.radius == {"a": 0.75, "b": 0.75}
    assert dists.widen(two, jnp.float32(100.0)).radius == {"a": 2.0, "b": 2.0}
    assert wider.centre == two.centre


def test_widen_moves_as_far_as_the_wider_box_still_holds_the_narrower_one(two):
    wider = dists.widen(two, jnp.float32(1.5), jnp.array([0.2, -9.0]))
    np.testing.assert_allclose(dists.ravel(wider.centre) - dists.ravel(two.centre), [0.1, -0.25], rtol=1e-6)
    assert wider.radius == {"a": 0.75, "b": 0.75}
    (low, high), (inner, outer) = dists.box(wider), dists.box(two)
    assert (dists.ravel(low) <= dists.ravel(inner)).all()
    assert (dists.ravel(high) >= dists.ravel(outer)).all()


def test_at_bounds_only_when_every_parameter_is(two):
    assert not dists.at_bounds(two)
    # Radius 1 fills a (-1 to 1), but b from 0.75 - 1 = -0.25 only.
    assert not dists.at_bounds(dists.widen(two, jnp.float32(2.0)))
    # Radius 1.75 fills both.
    assert dists.at_bounds(dists.widen(two, jnp.float32(3.5)))


def test_a_radius_at_its_cap_is_at_the_bounds_from_any_centre():
    # upper - (upper - lower) is not lower in float32 for these; widening must still end.
    for lower, upper in ((-1.2732527, 0.6121195), (-0.7, 0.3), (-1.1, 0.9)):
        for centre in (lower, upper, (lower + upper) / 3):
            bounds = scalars(a=lower), scalars(a=upper)
            dist = dists.make(scalars(a=np.clip(np.float32(centre), *np.float32([lower, upper]))), 0.1, *bounds)
            assert dists.at_bounds(dists.widen(dist, jnp.float32(1e6))), (lower, upper, centre)


def test_move_is_in_radii_and_stops_at_the_bounds(two):
    moved = dists.move(two, jnp.array([0.5, 0.9]))
    assert moved.centre == {"a": 0.25, "b": 1.0}  # 0.75 + 0.9 * 0.5 = 1.2
    assert moved.radius == two.radius


def test_narrow_goes_to_the_interval_but_not_below_the_least(two):
    # Radii of 0.5: to 0.3 of them, to the least, and not at all where nothing is known or the interval is wider.
    found = dists.narrow(two, jnp.array([0.6, 0.1]), 0.1).radius
    assert found == pytest.approx({"a": 0.3, "b": 0.1})
    assert dists.narrow(two, jnp.array([jnp.nan, 3.0]), 0.1).radius == pytest.approx({"a": 0.5, "b": 0.5})
    assert dists.narrow(two, jnp.array([0.1, 0.1]), 2.0).radius == pytest.approx({"a": 0.5, "b": 0.5})


def test_make_needs_room_between_the_bounds():
    with pytest.raises(
        ValueError, match=r"lower\['a'\]: got 0.0, expected less than 0.0; leave out what is not searched"
    ):
        dists.make({"a": 0.0, "b": 0.0}, 0.2, {"a": 0.0, "b": -1.0}, {"a": 0.0, "b": 1.0})


def test_make_needs_a_coordinate():
    with pytest.raises(ValueError, match="centre: got no coordinates"):
        dists.make({}, 0.2, {}, {})


def test_make_needs_a_positive_radius():
    for radius in (0.0, -0.5, float("nan")):
        with pytest.raises(ValueError, match=f"radius: got {radius}"):
            dists.make(scalars(a=0), radius, scalars(a=-1), scalars(a=1))


def test_make_takes_radii_by_name():
    made = dists.make(scalars(a=0, b=0), {"a": 0.2, "b": 5.0}, scalars(a=-1, b=-1), scalars(a=1, b=1))
    # No wider than the bounds.
    assert {name: float(value) for name, value in made.radius.items()} == pytest.approx({"a": 0.2, "b": 2.0})
    with pytest.raises(ValueError, match=r"radius: got \['a'\], expected \['a', 'b'\]"):
        dists.make(scalars(a=0, b=0), {"a": 0.2}, scalars(a=-1, b=-1), scalars(a=1, b=1))
    with pytest.raises(ValueError, match=r"radius\['a'\]: got -0.1, expected a positive number"):
        dists.make(scalars(a=0), {"a": -0.1}, scalars(a=-1), scalars(a=1))


@pytest.mark.parametrize("field", ["lower", "upper"])
def test_make_needs_the_same_names_everywhere(field):
    bounds = {"lower": scalars(a=-1), "upper": scalars(a=1)} | {field: scalars(wrong=1)}
    with pytest.raises(ValueError, match=rf"{field}: got \['wrong'\], expected \['a'\]"):
        dists.make(scalars(a=0), 0.1, **bounds)


def test_make_needs_the_centre_within_the_bounds():
    with pytest.raises(ValueError, match=r"centre\['a'\]: got 2.0, expected -1.0 to 1.0"):
        dists.make(scalars(a=2), 0.1, scalars(a=-1), scalars(a=1))
    with pytest.raises(ValueError, match=r"centre\['b'\]: got nan"):
        dists.make(scalars(a=0, b=jnp.nan), 0.1, scalars(a=-1, b=-1), scalars(a=1, b=1))


def test_operations_batch_over_distributions(two):
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), two, dists.widen(two, jnp.float32(3.5)))
    np.testing.assert_array_equal(jax.vmap(dists.at_bounds)(stacked), [False, True])


def test_a_distribution_has_narrowed_by_a_tenth_and_half_the_least_radius(two):
    # A radius of 0.5 that becomes 0.4: a fifth of it, and 0.1.
    after = dists.narrow(two, jnp.array([1.0, 0.8]), 0.01)
    assert dists.narrowed(two, after, 0.19)
    assert not dists.narrowed(two, after, 0.21)
    assert not dists.narrowed(two, dists.narrow(two, jnp.array([0.91, 1.0]), 0.01), 0.01)
    assert not dists.narrowed(two, dists.widen(two, jnp.float32(2.0)), 0.01)
