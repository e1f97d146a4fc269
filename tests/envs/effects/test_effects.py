"""Every effect against physics: a closed form, or what MuJoCo C makes of the same."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigs

from envs import effects, models, sensing
from envs.chain import Now, Wrench
from envs.effects import EVERY, LEARNED, LIBRARY, NOMINAL
from envs.effects.memory import LONGEST_S, PAST_TARGET_S, delay_line, delayed
from envs.rig import Rig

DT = 0.001
ROWS = tuple(EVERY.values())
PARAMETERS = [
    pytest.param(parameter, id=f"{row.name}.{parameter.name}") for row in ROWS for parameter in row.parameters
]
ACTING = [row for row in ROWS if row.enters != "model"]
JOINTS = 2


def now(speed=0.0, **fields):
    joints = np.ones(JOINTS, np.float32)
    standard = {
        "dt": DT,
        "position": joints * 0.0,
        "load": joints * 0.0,
        "limit": 5.0 * joints,
        "stiffness": 20.0 * joints,
        "damping": 0.0 * joints,
        "rotor": 0.0 * joints,
        "link": joints,
        "mobility": 0.0 * joints,
        "alone": 0.0 * joints,
        "stopped": 0.0 * joints,
        "rigid": joints,
        "body_velocity": np.zeros((JOINTS, 3), np.float32),
        "between": joints * 0.0,
        "unit": joints,
        "before": np.array([JOINTS, 0]),
        "after": np.array([1, JOINTS]),
    }
    return Now(**(standard | {"speed": speed * joints} | fields))


def signal_of(row, rng):
    """Some signal of the stage that a row enters."""
    shapes = {"sensor": (2, JOINTS), "bristle": (2, JOINTS), "transmission": (5, JOINTS), "gravity": (3,)}
    shape = shapes.get(row.enters, (JOINTS,))
    if row.enters == "wrench":
        return Wrench(torque=draw(rng, (JOINTS,)), force=draw(rng, (JOINTS, 3)))
    return draw(rng, shape)


def draw(rng, shape):
    return jnp.asarray(rng.uniform(-3.0, 3.0, shape), jnp.float32)


def values_of(row, **physical):
    """What `act` is given for physical values, each for all places or one per place."""
    values = {}
    for parameter in row.parameters:
        # What only a form has is absent where nothing is said of it.
        absent = {"added": 0.0, "ratio": 1.0, "reciprocal": np.inf}[parameter.form]
        each = np.broadcast_to(physical.get(parameter.name, absent), JOINTS)
        inner = [parameter.inner(parameter.coordinate(float(value), 1.0), 1.0) for value in each]
        values[parameter.name] = jnp.asarray(inner, jnp.float32)
    return values


def act(name, signal, memory=None, at=None, **physical):
    """One step of one effect."""
    row = EVERY[name]
    return row.act(values_of(row, **physical), jnp.asarray(signal, jnp.float32), at or now(), memory)[0]


def series(name, signals, at=None, start=None, **physical):
    """What becomes of signals [time, ...] one after the other, of one that has always been `start`, or the first."""
    row, at = EVERY[name], at or now()
    values, signals = values_of(row, **physical), jnp.asarray(signals, jnp.float32)

    def step(memory, signal):
        signal, memory = row.act(values, signal, at, memory)
        return memory, signal

    start = signals[0] if start is None else jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), start)
    return np.asarray(jax.lax.scan(step, row.start(values, start, DT), signals)[1])


# The library.


def test_no_two_rows_have_one_name():
    families = (getattr(effects, name) for name in {row.family for row in ROWS})
    assert sum(len(family.ROWS) for family in families) == len(LIBRARY)
    assert LEARNED.name not in LIBRARY
    assert len({row.sentence for row in ROWS}) == len(ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_sizes_of_interest_are_positive_and_within_the_bounds(row):
    assert row.sizes[0] > 0
    assert list(row.sizes) == sorted(row.sizes)
    for parameter in row.parameters:
        low, high = parameter.bounds
        assert low <= 0 < high
        # A form of its own effect is tried from the smallest one on.
        alone = any(form.effect == row.name and parameter.name in form.parameters for form in row.forms)
        assert all(size < high for size in row.sizes[: 1 if alone else None]) or parameter.shape


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_acts_or_names_fields(row):
    assert row.act is not None or row.enters == "model"
    for parameter in row.parameters:
        assert bool(parameter.fields) == (row.act is None)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_form_names_parameters_that_its_row_has(row):
    for form in row.forms:
        assert isinstance(form.parameters, tuple)
        assert {*form.parameters} <= {parameter.name for parameter in EVERY[form.effect].parameters}


@pytest.mark.parametrize("parameter", PARAMETERS)
@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_a_coordinate_is_the_inverse_of_a_value(parameter, scale):
    low, high = parameter.bounds
    for coordinate in np.linspace(low, high, 5)[1:]:
        if coordinate:
            value = float(parameter.value(coordinate, scale))
            np.testing.assert_allclose(parameter.coordinate(value, scale), coordinate, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("parameter", PARAMETERS)
def test_a_coordinate_of_zero_is_no_effect(parameter):
    inner = parameter.inner(0.0, 0.3)
    # What only shapes an effect may have a value all the same: its scale.
    np.testing.assert_allclose(inner, 0.3 if parameter.shape and parameter.form == "ratio" else 0.0, rtol=1e-6)


@pytest.mark.parametrize("row", ACTING, ids=lambda row: row.name)
def test_what_is_not_there_changes_nothing(row):
    rng = np.random.default_rng(0)
    values = {p.name: jnp.asarray(p.inner(np.zeros(JOINTS, np.float32), 0.3)) for p in row.parameters}
    at = now(
        speed=rng.uniform(-9, 9, JOINTS),
        load=rng.uniform(0, 9, JOINTS),
        damping=rng.uniform(0, 1, JOINTS),
        rotor=np.full(JOINTS, 0.01, np.float32),
        alone=rng.uniform(-100, 100, JOINTS),
        limit=np.full(JOINTS, 0.1),  # less than the torque, which a controller without a limit of its own may have
        body_velocity=rng.uniform(-9, 9, (JOINTS, 3)),
    )
    first = signal_of(row, rng)
    before = (first[0], first) if row.enters == "bristle" else first[:1] if row.enters == "transmission" else first
    memory = None if row.start is None else row.start(values, before, DT)
    for _ in range(3):
        signal = signal_of(row, rng)
        got, following = row.act(values, signal, at, memory)
        jax.tree.map(lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-6), got, signal)
        if row.start is not None:
            # Of one shape for ever, or no loop could carry it.
            assert jax.tree.map(jnp.shape, following) == jax.tree.map(jnp.shape, memory)
            memory = following


@pytest.mark.parametrize("row", [row for row in ACTING if row.undo], ids=lambda row: row.name)
def test_undoing_what_is_not_there_changes_nothing(row):
    readings = draw(np.random.default_rng(1), (20, 4, JOINTS))
    values = {parameter.name: jnp.zeros(JOINTS) for parameter in row.parameters}
    np.testing.assert_allclose(row.undo(values, readings, DT), readings, rtol=1e-6, atol=1e-6)


# Joint friction.


@pytest.fixture(scope="module")
def pendulum():
    return rigs.Player(Rig(models.spec("pendulum"), ("hinge",), rigs.CONTROL_HZ))


# 0.49 kg at 0.1 m: 0.0049. The sphere itself, 2/5 0.49 0.02^2: 0.0000784. The arm, 0.001 kg and 0.1 m long: 0.0000033.
# The motor: 0.0019. Together in kg m^2:
PENDULUM_INERTIA = 0.0068817
OWN_FRICTION_NM = 0.019


def test_a_joint_sticks_within_its_friction(pendulum):
    # Hanging down, pushed by 0.05 of 0.019 + 0.04 Nm. MuJoCo's stick creeps: its friction is 1 / 0.9 - 1 = 0.111 soft
    # and brakes by 2 / (0.9 x 0.02 s) = 111 /s, so that it is 0.05 / 0.0069 x 0.111 / 111 = 0.0073 rad/s fast.
    segment = rigs.segment(pendulum.rig, 0.0, 0.0, feed=0.05)
    read = pendulum.play(segment, coulomb={"hinge": {"torque_nm": 0.04}})
    assert np.abs(read["dq"]).max() < 0.008
    assert np.abs(pendulum.play(segment)["dq"]).max() > 0.3


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_friction_that_holds_lets_a_joint_creep_less(pendulum, share):
    # As above, and the creep is a tenth at half of the way, a hundredth at its end.
    segment = rigs.segment(pendulum.rig, 0.0, 0.0, feed=0.05)
    slow, held = (
        pendulum.play(segment, coulomb={"hinge": {"torque_nm": 0.04}}, holding={"hinge": {"share": one}})["dq"][-1, 0]
        for one in (0.0, share)
    )
    assert held == pytest.approx(0.01**share * slow, rel=0.1)


def test_a_joint_slides_with_what_is_more_than_its_friction(pendulum):
    segment = rigs.segment(pendulum.rig, 0.0, 0.0, feed=0.2)
    read = pendulum.play(segment, coulomb={"hinge": {"torque_nm": 0.04}})
    # After 5 ms gravity still is 0.5 x 20.5 x 0.005^2 x 0.481 = 0.0001 Nm.
    expected = (0.2 - OWN_FRICTION_NM - 0.04) / PENDULUM_INERTIA * 0.005
    np.testing.assert_allclose(read["dq"][5, 0], expected, rtol=2e-3)


def test_coulomb_friction_is_what_is_added_to_the_bound():
    np.testing.assert_allclose(act("coulomb", [0.1, 0.2], torque_nm=[0.3, 0.0]), [0.4, 0.2], rtol=1e-6)


def test_stribeck_friction_decays_with_speed_whichever_way():
    def extra(speed, **form):
        return act("stribeck", [0.1, 0.1], at=now(speed), torque_nm=0.3, speed_rad_s=0.5, **form)

    # At rest all of it, at the speed of its name 1 / e, at five times that 0.007.
    np.testing.assert_allclose(extra(0.0), 0.4, rtol=1e-6)
    np.testing.assert_allclose(extra(0.5), 0.1 + 0.3 * 0.367879, rtol=1e-5)
    np.testing.assert_allclose(extra(-0.5), extra(0.5), rtol=1e-6)
    np.testing.assert_allclose(extra(2.5), 0.1 + 0.3 * 0.0067379, rtol=1e-5)
    # With a square in the exponent it is as much at rest and at that speed, and less at twice of it, 1 / e^4.
    for speed, share in ((0.0, 1.0), (-0.5, 0.367879), (1.0, 0.0183156)):
        np.testing.assert_allclose(extra(speed, gaussian=[1.0, 1.0]), 0.1 + 0.3 * share, rtol=1e-5)


def test_friction_of_the_load_is_a_share_of_it():
    at = now(load=np.array([2.0, 0.0], np.float32))
    np.testing.assert_allclose(act("load_friction", [0.1, 0.1], at=at, ratio=0.25), [0.6, 0.1], rtol=1e-6)


# Actuator.


def test_a_late_signal_is_the_one_of_so_many_steps_ago():
    targets = np.random.default_rng(2).normal(size=(160, JOINTS)).astype(np.float32)
    got = series("command_delay", targets, seconds=[0.003, LONGEST_S])
    np.testing.assert_allclose(got[3:, 0], targets[:-3, 0], atol=1e-4)
    np.testing.assert_allclose(got[100:, 1], targets[:-100, 1], atol=1e-4)
    # Before that, what has always been.
    np.testing.assert_allclose(got[:3, 0], targets[0, 0], atol=1e-5)


def test_between_samples_a_late_signal_is_both_in_proportion():
    targets = np.random.default_rng(3).normal(size=(30, JOINTS)).astype(np.float32)
    got = series("command_delay", targets, seconds=[0.0025, 0.0002])
    np.testing.assert_allclose(got[3:, 0], 0.5 * targets[1:-2, 0] + 0.5 * targets[:-3, 0], atol=1e-4)
    np.testing.assert_allclose(got[1:, 1], 0.8 * targets[1:, 1] + 0.2 * targets[:-1, 1], atol=1e-4)


def test_a_line_is_no_longer_than_it_is():
    line = delay_line({}, jnp.arange(2.0), DT)
    assert line.shape == (101, 2)
    got, line = delayed(line, jnp.ones(2), jnp.array([1.0, 0.0]), DT)
    np.testing.assert_array_equal(got, [0.0, 1.0])
    np.testing.assert_array_equal(line[0], 1.0)


def test_a_slow_controller_follows_its_target_at_its_speed():
    # 0.1 rad at 2 rad/s takes 50 steps of a millisecond; back again at half the speed, 100.
    targets = np.concatenate([np.zeros(1), np.full(60, 0.1)])[:, None] * [1.0, -1.0]
    got = series("target_slew", targets, rad_per_s=[2.0, 1.0])
    steps = np.arange(61)
    np.testing.assert_allclose(got[:, 0], np.minimum(0.002 * steps, 0.1), atol=1e-6)
    np.testing.assert_allclose(got[:, 1], -0.001 * steps, atol=1e-6)


def test_a_slow_controller_is_behind_what_it_was_told_seconds_ago():
    # Told to move by 1 rad 0.3 s ago, at 2 rad/s it has come 0.6 rad; told 5 s ago, at 0.1 rad/s, 0.5 rad. The step
    # that leads to the first of these targets, of 2 ms and 10 ms, counts as well.
    past = np.stack([PAST_TARGET_S > -0.301, -1.0 * (PAST_TARGET_S > -5.005)], axis=1)
    got = EVERY["target_slew"].start(values_of(EVERY["target_slew"], rad_per_s=[2.0, 0.1]), jnp.asarray(past), DT)
    np.testing.assert_allclose(got[0], [0.604, -0.501], atol=1e-5)
    np.testing.assert_allclose(got[1], [2.0, -0.1], rtol=1e-5)


def test_a_drive_speeds_up_and_slows_down():
    # A drive of 2 rad/s and 10 rad/s^2 moves by 1 rad in 0.2 s + 0.3 s + 0.2 s, one without a ramp in 0.5 s. Back by
    # 0.1 rad it does not reach its speed: 0.1 s up, and 0.1 s down.
    targets = np.where(np.arange(1200) < 900, 1.0, 0.9)[:, None] * np.ones(JOINTS)
    got = series("target_slew", targets, start=np.zeros(JOINTS), rad_per_s=2.0, ramp_s=[0.2, 0.0])
    up = DT * np.arange(1, 201)[:, None]
    np.testing.assert_allclose(got[:200, :1], 5.0 * up**2, atol=0.002)
    np.testing.assert_allclose(got[200:400, :1], 0.2 + 2.0 * up, atol=0.002)
    np.testing.assert_allclose(got[499:699, :1], 1.0 - 5.0 * (0.2 - up) ** 2, atol=0.003)
    np.testing.assert_allclose(got[700:900, 0], 1.0, atol=1e-4)
    assert got.max() < 1.0 + 1e-5
    np.testing.assert_allclose(got[900:1000, 0], 1.0 - 5.0 * up[:100, 0] ** 2, atol=0.002)
    np.testing.assert_allclose(got[1110:, 0], 0.9, atol=1e-4)
    np.testing.assert_allclose(got[:500, 1], 0.002 * np.arange(1, 501), atol=1e-5)


def test_a_drive_is_where_its_profile_has_brought_it():
    # Told to move by 1 rad 0.3 s ago, it has come 0.2 rad while it sped up, in 100 steps of 2 ms of which each counts
    # with the speed at its end (2 mrad more), and 0.2 rad and a step of 4 mrad at its speed.
    past = np.tile((PAST_TARGET_S > -0.301)[:, None], (1, JOINTS))
    row = EVERY["target_slew"]
    got = row.start(values_of(row, rad_per_s=2.0, ramp_s=[0.2, 0.0]), jnp.asarray(past, jnp.float32), DT)
    np.testing.assert_allclose(got, [[0.406, 0.604], [2.0, 2.0]], atol=1e-4)


def test_a_deadband_swallows_half_its_width_on_each_side():
    errors = [[0.005, -0.005], [0.03, -0.03], [0.01, 0.0]]
    expected = [[0.0, 0.0], [0.02, -0.02], [0.0, 0.0]]
    for error, after in zip(errors, expected, strict=True):
        np.testing.assert_allclose(act("deadband", error, rad=0.02), after, atol=1e-8)


@pytest.mark.parametrize("name", ["gain_error", "torque_scale"])
def test_a_ratio_multiplies(name):
    np.testing.assert_allclose(act(name, [2.0, -3.0], ratio=[0.8, 1.5]), [1.6, -4.5], rtol=1e-6)


def test_a_gain_may_be_off_at_small_errors_alone():
    def after(error):
        return act("gain_error", [error, error], ratio=0.4, within_rad=[0.1, np.inf])

    # At 0.1 rad half of the 0.6 is missing, at 10 rad a hundredth of it; elsewhere all of it.
    np.testing.assert_allclose(after(0.1), [0.07, 0.04], rtol=1e-6)
    np.testing.assert_allclose(after(-0.1), [-0.07, -0.04], rtol=1e-6)
    np.testing.assert_allclose(after(10.0), [10.0 - 6.0 / 101.0, 4.0], rtol=1e-6)
    np.testing.assert_allclose(after(1e-6), [0.4e-6, 0.4e-6], rtol=1e-4)


def test_a_torque_is_limited_both_ways():
    np.testing.assert_allclose(act("torque_limit", [2.0, -3.0], torque_nm=[1.5, 2.5]), [1.5, -2.5], rtol=1e-6)
    np.testing.assert_allclose(act("torque_limit", [2.0, -3.0], torque_nm=4.0), [2.0, -3.0], rtol=1e-6)


@pytest.mark.parametrize("softness", [0.02, 0.1, 0.25, 0.5, 1.0])
def test_a_soft_limit_is_the_usual_one_of_some_power(softness):
    torque, power = np.array([1.0, -3.0]), 1.0 / softness
    expected = torque / (1.0 + np.abs(torque / 2.0) ** power) ** softness
    np.testing.assert_allclose(act("torque_limit", torque, torque_nm=2.0, softness=softness), expected, rtol=1e-4)


def test_bristles_of_a_slide_may_be_shorter_than_those_of_a_hinge():
    # 20 um are much for a slide. Of a hinge in rad they are a fifth of the least travel: bristles of that travel have
    # a fifth of the friction, and the engine the rest.
    friction = np.tile([[0.4], [0.1]], JOINTS)
    for speed, wound in ((0.0, (0.0, 0.0)), (0.01, (0.1, 0.5))):
        at = now(speed=speed, unit=np.array([1.0, 0.05], np.float32))
        got = act("presliding", friction, memory=np.zeros(JOINTS), at=at, travel_rad=20e-6)
        torque = 0.1 - 0.4 * np.array([0.2, 1.0]) * wound
        np.testing.assert_allclose(got, [[0.32, 0.0], torque], atol=1e-6)


def test_a_travel_that_shrinks_to_nothing_changes_nothing_at_once():
    friction = np.tile([[0.4], [0.1]], JOINTS)
    after = lambda travel: act(  # noqa: E731
        "presliding", friction, memory=np.full(JOINTS, 0.5), at=now(speed=0.01), travel_rad=travel
    )
    travels = np.linspace(0.0, 3e-4, 301)
    jumps = np.abs(np.diff([after(travel) for travel in travels], axis=0)).max()
    assert jumps < 0.01 * 0.4 + 1e-6
    np.testing.assert_allclose(after(0.0), friction, atol=1e-7)


def test_bristles_give_way_and_then_slide():
    # 0.1 rad/s for 20 ms is 2 mrad: bristles of 1 mrad slide after half of that; without travel nothing changes.
    friction = np.tile([[[0.4, 0.4], [0.1, 0.1]]], (21, 1, 1))
    still = np.zeros((2, JOINTS))
    upright = np.zeros(JOINTS)
    got = series("presliding", friction, at=now(speed=0.1), start=(upright, still), travel_rad=[0.001, 0.0])
    wound = np.minimum(0.1 * DT * np.arange(1, 22) / 0.001, 1.0)
    np.testing.assert_allclose(got[:, 0, 0], 0.0)
    np.testing.assert_allclose(got[:, 1, 0], 0.1 - 0.4 * wound, atol=1e-6)
    np.testing.assert_allclose(got[:, :, 1], friction[:, :, 1], atol=1e-7)
    # Having come 3 mrad from below and gone back by 0.3, they are wound by 1 - 0.3 at first.
    past = np.array([[0.0], [0.001], [0.003], [0.0027]]) * np.ones(JOINTS)
    (got,) = series("presliding", friction[:1], at=now(speed=0.0), start=(upright, past), travel_rad=[0.001, 0.0])
    np.testing.assert_allclose(got[1], [0.1 - 0.4 * 0.7, 0.1], atol=1e-6)
    # What they carried before is kept, as far as the motion leaves it.
    (got,) = series("presliding", friction[:1], at=now(speed=0.0), start=(upright - 0.6, still), travel_rad=0.001)
    np.testing.assert_allclose(got[1], 0.1 + 0.4 * 0.6, atol=1e-6)


def test_a_motor_gives_less_the_faster_it_turns():
    def most(torque, speed):
        return act("torque_speed", [torque, torque], at=now(speed), nm_s_per_rad=[0.2, 0.0])

    # A limit of 5 Nm, less 0.2 x 10: 3 Nm in the direction of its speed. In the other the back-EMF helps.
    np.testing.assert_allclose(most(4.0, 10.0), [3.0, 4.0], rtol=1e-6)
    np.testing.assert_allclose(most(-4.0, -10.0), [-3.0, -4.0], rtol=1e-6)
    np.testing.assert_allclose(most(-4.0, 10.0), -4.0, rtol=1e-6)
    np.testing.assert_allclose(most(2.9, 10.0), 2.9, rtol=1e-6)
    np.testing.assert_allclose(most(4.0, 0.0), 4.0, rtol=1e-6)
    # From 25 rad/s on nothing is left, and it does not turn round.
    np.testing.assert_allclose([most(4.0, 40.0), most(-4.0, -40.0)], [[0.0, 4.0], [0.0, -4.0]], atol=1e-6)


def test_a_motor_at_a_low_voltage_stalls_below_its_controllers_limit():
    def most(torque, speed):
        return act("torque_speed", torque, at=now(speed), nm_s_per_rad=0.2, stall_loss=[0.4, 0.0])

    # 0.6 of 5 Nm, less 0.2 x 5.
    np.testing.assert_allclose(most(4.9, 5.0), [2.0, 4.0], rtol=1e-6)
    np.testing.assert_allclose(most(-4.9, 0.0), [-3.0, -4.9], rtol=1e-6)
    np.testing.assert_allclose(most(2.9, 0.0), 2.9, rtol=1e-6)


def test_a_motor_that_could_give_more_than_its_controller_allows_falls_off_from_a_speed_on():
    def most(torque, speed):
        return act("torque_speed", torque, at=now(speed), nm_s_per_rad=0.5, stall_loss=-0.6)

    # The line is 1.6 x 5 less 0.5 per rad/s, and meets the limit of 5 Nm at 6 rad/s.
    np.testing.assert_allclose(most(5.0, 6.0), 5.0, rtol=1e-6)
    np.testing.assert_allclose(most(5.0, 10.0), 3.0, rtol=1e-6)
    np.testing.assert_allclose(most(-5.0, -10.0), -3.0, rtol=1e-6)
    np.testing.assert_allclose(most(-5.0, 10.0), -5.0, rtol=1e-6)


def test_a_motor_without_a_limit_has_no_speed_line():
    at = now(10.0, limit=np.full(JOINTS, np.inf, np.float32))
    np.testing.assert_array_equal(act("torque_speed", [9.0, -9.0], at=at, nm_s_per_rad=0.2), [9.0, -9.0])


def test_a_motor_that_is_off_gives_no_torque_at_any_speed():
    at = now(10.0, limit=np.zeros(JOINTS, np.float32))
    np.testing.assert_array_equal(act("torque_speed", [0.0, 0.0], at=at, nm_s_per_rad=0.2), 0.0)


def test_a_lagging_torque_rises_as_an_exponential():
    # What it gives over a step is the mean of 1 - exp(-t / T) over it, t from the jump on.
    torque = np.concatenate([np.zeros(1), np.ones(50)])[:, None] * [2.0, -1.0]
    got = series("torque_lag", torque, seconds=[0.01, 0.004])
    np.testing.assert_array_equal(got[0], 0.0)
    constant, within = np.array([0.01, 0.004]), DT * np.linspace(0.0, 1.0, 1001)[:, None]
    means = [np.trapezoid(1 - np.exp(-(DT * n + within) / constant), within, axis=0) / DT for n in range(50)]
    np.testing.assert_allclose(got[1:], [2.0, -1.0] * np.array(means), atol=1e-5)


def test_a_torque_may_lag_behind_in_two_stages():
    # A step answer of 1 - (T1 exp(-t / T1) - T2 exp(-t / T2)) / (T1 - T2), whose means over a step are those at its
    # middle, to the square of the step.
    got = series("torque_lag", np.ones((80, JOINTS)), start=np.zeros(JOINTS), seconds=0.02, second_stage=[0.0, 0.6])
    time, (long, short) = DT * (np.arange(80) + 0.5), (0.014, 0.006)
    once = 1.0 - np.exp(-time / 0.02)
    twice = 1.0 - (long * np.exp(-time / long) - short * np.exp(-time / short)) / (long - short)
    np.testing.assert_allclose(got, np.stack([once, twice], axis=1), atol=2e-3)
    assert np.abs(once - twice).max() > 0.05


# Transmission: a joint that is held, so that what the motor does is all there is.


def wound(name, targets, damping=0.0, stiffness=20.0, rotor=0.0, feed=0.0, rubs=(0.0, 0.0), **physical):
    """Torque on the held joint and how far the motor is ahead of it, [time] each, as a controller turns the motor.

    `rubs` are bound and damping of the joint's friction.
    """
    row = LIBRARY[name]
    values = values_of(row, **physical)
    at = now(stiffness=jnp.full(JOINTS, stiffness), damping=jnp.full(JOINTS, damping), rotor=jnp.full(JOINTS, rotor))

    def step(memory, target):
        torque = stiffness * (target - memory[0]) + feed
        signal = jnp.stack([torque, *(one * jnp.ones(JOINTS) for one in (*rubs, 0.0, 0.0))])
        signal, memory = row.act(values, signal, at, memory)
        return memory, (signal[0], memory[0])

    _, (torque, offset) = jax.lax.scan(
        step, row.start(values, jnp.zeros((1, JOINTS)), DT), jnp.asarray(targets, jnp.float32)
    )
    return np.asarray(torque)[:, 0], np.asarray(offset)[:, 0]


def test_in_the_gap_a_joint_feels_nothing():
    torque, offset = wound("backlash", np.full(5, 0.009), rad=0.02)
    np.testing.assert_allclose(torque, 0.0, atol=1e-6)
    np.testing.assert_allclose(offset, 0.009, rtol=1e-5)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_beyond_the_gap_the_motor_is_half_of_it_ahead(way):
    torque, offset = wound("backlash", np.full(5, 0.05 * way), rad=0.02)
    # 20 Nm/rad x (0.05 - 0.01) rad
    np.testing.assert_allclose(offset, 0.01 * way, rtol=1e-5)
    np.testing.assert_allclose(torque, 0.8 * way, rtol=1e-5)


def test_torque_comes_back_once_the_motor_has_crossed_the_gap():
    # Half a rad and back, by a controller that brakes: 1.2 Nm s/rad and 20 Nm/rad close in on the target with a time
    # constant of 60 ms, so from 0.2 to -0.2 it takes 60 ms x ln((0.5 + 0.2) / (0.5 - 0.2)) = 50.8 ms.
    targets = np.repeat([0.5, -0.5], [1000, 200])
    torque, offset = wound("backlash", targets, damping=1.2, rad=0.4)
    np.testing.assert_allclose(offset[999], 0.2, rtol=1e-5)
    np.testing.assert_allclose(torque[999], 20.0 * 0.3, rtol=1e-4)
    back = torque[1000:]
    crossing = DT * np.flatnonzero(np.abs(back) > 1e-3)[0]
    np.testing.assert_allclose(crossing, 0.0508, atol=0.002)
    np.testing.assert_allclose(back[-1], -20.0 * 0.3, rtol=1e-4)
    np.testing.assert_allclose(offset[-1], -0.2, rtol=1e-5)


def test_in_the_gap_a_motor_gathers_speed_and_gives_it_to_the_joint_at_its_end():
    # 0.01 kg m^2 under 0.5 Nm gain 0.05 rad/s a step of 1 ms, so after n steps they are 2.5e-5 rad x n (n + 1) ahead.
    torque, offset = wound("backlash", np.zeros(60), stiffness=0.0, rotor=0.01, feed=0.5, rad=0.02)
    steps = np.arange(1, 20)
    np.testing.assert_allclose(offset[:19], 2.5e-5 * steps * (steps + 1), rtol=1e-4)
    np.testing.assert_allclose(torque[:19], 0.0, atol=1e-4)
    # The end of the gap, 0.01 rad away, is reached in step 20; all that the motor was given the joint gets by then.
    np.testing.assert_allclose(torque[:40].sum(), 0.5 * 40, rtol=1e-3)
    np.testing.assert_allclose(torque[40:], 0.5, rtol=1e-4)


def test_a_motor_on_a_spring_swings_at_its_own_pace():
    # 0.01 kg m^2 on 20 + 60 Nm/rad: 89 rad/s, half a period is 35 ms; the swing goes to twice where it would rest, less
    # what steps that are taken by their end lose.
    _, offset = wound("compliance", np.full(70, 0.1), rotor=0.01, nm_per_rad=60.0)
    np.testing.assert_allclose(np.argmax(offset), 34, atol=1)
    assert 0.025 * 1.8 < offset.max() < 0.025 * 2.0


def test_a_joint_that_goes_on_without_its_motor_has_no_rotor():
    # MJX has the rotor in the joint's inertia: what it takes to carry it is given back in the gap, where the motor,
    # which nobody drives, stays behind.
    row = LIBRARY["backlash"]
    values = values_of(row, rad=0.4)
    at = now(stiffness=jnp.zeros(JOINTS), rotor=jnp.full(JOINTS, 0.01), alone=jnp.full(JOINTS, 30.0))
    (torque, *_), memory = row.act(values, jnp.zeros((5, JOINTS)), at, jnp.zeros((2, JOINTS)))
    np.testing.assert_allclose(torque, 0.3, rtol=1e-5)
    np.testing.assert_allclose(memory[1], -0.3 / 0.01 * DT, rtol=1e-5)


@pytest.mark.parametrize(("bound", "rate"), [(1.0, 0.0), (0.4, -10.0), (0.0, -30.0), (-0.1, -30.0)])
def test_a_motor_stays_beside_a_link_that_friction_holds(bound, rate):
    # Gravity would accelerate the link of 0.02 kg m^2 by 30 rad/s^2. It creeps under that load, without acceleration.
    row = LIBRARY["backlash"]
    free = jnp.full(JOINTS, 30.0)
    at = now(
        speed=0.05,
        stiffness=jnp.zeros(JOINTS),
        rotor=jnp.full(JOINTS, 0.01),
        alone=free,
        mobility=jnp.full(JOINTS, 50.0),
    )
    signal = jnp.zeros((5, JOINTS)).at[1].set(bound)
    _, memory = row.act(values_of(row, rad=0.4), signal, at, jnp.zeros((2, JOINTS)))
    np.testing.assert_allclose(memory[1], rate * DT, atol=1e-6)


def test_a_spring_winds_up_by_torque_over_stiffness():
    # Two springs in a row: 20 Nm/rad of the controller, 60 of the gears; a quarter of 0.1 rad is in the gears.
    torque, offset = wound("compliance", np.full(5, 0.1), nm_per_rad=60.0)
    np.testing.assert_allclose(offset, 0.025, rtol=1e-5)
    np.testing.assert_allclose(torque, 1.5, rtol=1e-5)
    np.testing.assert_allclose(torque / offset, 60.0, rtol=1e-5)


@pytest.mark.parametrize("hardening", [0.5, 40.0, 2e5])
def test_a_hardening_spring_balances_its_controller(hardening):
    torque, offset = wound("compliance", np.full(5, 0.5), nm_per_rad=10.0, hardening_per_rad2=hardening)
    np.testing.assert_allclose(torque, 20.0 * (0.5 - offset), rtol=1e-5)
    np.testing.assert_allclose(torque, 10.0 * offset * (1.0 + hardening * offset**2), rtol=1e-4)


def test_a_spring_winds_up_as_slowly_as_its_controller_lets_it():
    # 0.8 Nm s/rad against 20 + 60 Nm/rad: a time constant of 10 ms. Steps are taken by their end, so a step of 1 ms
    # leaves 1 / 1.1.
    _, offset = wound("compliance", np.full(40, 0.1), damping=0.8, nm_per_rad=60.0)
    np.testing.assert_allclose(offset, 0.025 * (1 - 1.1 ** -np.arange(1.0, 41.0)), rtol=1e-4)


@pytest.mark.parametrize(("name", "physical"), [("backlash", {"rad": 0.2}), ("compliance", {"nm_per_rad": 60.0})])
def test_a_motor_that_rubs_stays_behind_what_turns_it(name, physical):
    # 0.4 Nm of dry friction take 0.02 rad of the controller's 20 Nm/rad, and nothing moves before.
    torque, offset = wound(name, np.r_[np.full(5, 0.019), np.full(5, 0.09)], rubs=(0.4, 0.0), at_motor=1.0, **physical)
    np.testing.assert_allclose(offset[:5], 0.0, atol=1e-6)
    stiffness = physical.get("nm_per_rad", 0.0)
    np.testing.assert_allclose(offset[5:], 20.0 * 0.07 / (20.0 + stiffness), rtol=1e-4)
    np.testing.assert_allclose(torque, stiffness * offset, atol=1e-5)


def test_damping_at_the_motor_slows_it_within_its_play():
    # 5 Nm on 0.1 Nm s/rad and 0.001 kg m^2 end at 50 rad/s, with a time constant of 10 ms. Half of the damping makes
    # both twice as large. Steps are taken by their end.
    for share in (1.0, 0.5):
        _, offset = wound(
            "backlash", np.zeros(60), stiffness=0.0, rotor=0.001, feed=5.0, rubs=(0.0, 0.1), at_motor=share, rad=20.0
        )
        speed = 50.0 / share * (1 - (1 + 0.1 * share) ** -np.arange(1.0, 61.0))
        np.testing.assert_allclose(np.diff(offset, prepend=0.0) / DT, speed, rtol=1e-3)


@pytest.mark.parametrize(("name", "physical"), [("backlash", {"rad": 0.02}), ("compliance", {"nm_per_rad": 60.0})])
def test_what_rubs_at_the_motor_does_not_rub_at_the_joint(name, physical):
    row, rubs = LIBRARY[name], jnp.array([[0.0], [0.1], [0.2], [0.0], [0.0]]) * jnp.ones(JOINTS)
    values = values_of(row, at_motor=0.25, **physical)
    signal, _ = row.act(values, rubs, now(speed=0.1), jnp.zeros((2, JOINTS)))
    np.testing.assert_allclose(signal[1:, 0], [0.075, 0.15, 0.0, 0.0], rtol=1e-5)
    # At the ends of the play motor and joint are one, and what comes next may use what is the motor's.
    signal, _ = row.act(values, rubs.at[0].set(10.0), now(), jnp.zeros((2, JOINTS)))
    left = [0.025, 0.05] if name == "backlash" else [0.0, 0.0]
    np.testing.assert_allclose(signal[1:, 0], [0.075, 0.15, *left], rtol=1e-5)


@pytest.mark.parametrize(("name", "physical"), [("backlash", {"rad": 0.02}), ("compliance", {"nm_per_rad": 60.0})])
def test_a_motor_takes_nothing_of_less_friction_than_none(name, physical):
    row, rubs = LIBRARY[name], jnp.array([[10.0], [-0.1], [0.2], [0.0], [0.0]]) * jnp.ones(JOINTS)
    signal, _ = row.act(values_of(row, at_motor=1.0, **physical), rubs, now(), jnp.zeros((2, JOINTS)))
    np.testing.assert_allclose([signal[1], signal[3]], [[-0.1] * JOINTS, [0.0] * JOINTS], rtol=1e-5)


@pytest.mark.parametrize(("name", "physical"), [("backlash", {"rad": 0.0}), ("compliance", {"nm_per_rad": np.inf})])
def test_without_gears_nothing_is_before_them(name, physical):
    row, signal = LIBRARY[name], draw(np.random.default_rng(0), (5, JOINTS))
    got, _ = row.act(values_of(row, at_motor=1.0, **physical), signal, now(speed=0.1), jnp.zeros((2, JOINTS)))
    np.testing.assert_array_equal(got, signal)


# Sensing.


def motion(count=600):
    """Smooth positions and velocities [time, 2, joints]."""
    time = DT * np.arange(count)[:, None]
    pace = 2 * np.pi * np.array([2.0, 3.0])
    return np.stack([0.4 * np.sin(pace * time), 0.4 * pace * np.cos(pace * time)], axis=1).astype(np.float32)


def test_a_biased_encoder_reads_positions_off_and_velocities_right():
    got = act("encoder_bias", [[0.1, 0.2], [1.0, 2.0]], rad=[0.03, -0.05])
    np.testing.assert_allclose(got, [[0.13, 0.15], [1.0, 2.0]], rtol=1e-6)


def test_a_late_sensor_reads_positions_and_velocities_late():
    readings = motion(100)
    got = series("sensor_delay", readings, seconds=[0.005, 0.012])
    np.testing.assert_allclose(got[12:, :, 0], readings[7:-5, :, 0], atol=1e-5)
    np.testing.assert_allclose(got[12:, :, 1], readings[:-12, :, 1], atol=1e-5)


@pytest.mark.parametrize("second_stage", [0.0, 0.6, 1.0])
def test_a_lagging_sensor_is_behind_a_ramp_by_its_time_constant(second_stage):
    # 2 rad/s x 0.01 s, from the start on, since it came with that speed.
    time = DT * np.arange(300)
    ramp = np.stack([2.0 * time, np.full(300, 2.0)], axis=1)[:, :, None] * np.ones(JOINTS)
    got = series("sensor_lag", ramp, seconds=0.01, second_stage=second_stage)
    np.testing.assert_allclose(ramp[:, 0] - got[:, 0], 0.02, rtol=1e-4)
    np.testing.assert_allclose(got[:, 1], 2.0, rtol=1e-6)


def test_a_filter_of_two_stages_is_one_behind_the_other():
    once = series("sensor_lag", motion(), seconds=0.005)
    twice = series("sensor_lag", once, seconds=0.005)
    got = series("sensor_lag", motion(), seconds=0.01, second_stage=1.0)
    # Until their starts are forgotten.
    np.testing.assert_allclose(got[100:], twice[100:], atol=2e-5)


def test_a_filter_of_positions_alone_or_of_velocities_alone():
    truth, both = motion(), series("sensor_lag", motion(), seconds=0.01)
    for name, filtered, physical in (("sensor_lag", 0, {"velocity_faster": 1.0}), ("velocity_lag", 1, {})):
        got = series(name, truth, seconds=0.01, **physical)
        np.testing.assert_allclose(got[:, filtered], both[:, filtered], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(got[:, 1 - filtered], truth[:, 1 - filtered], rtol=1e-6)
        assert np.abs(got[100:, filtered] - truth[100:, filtered]).max() > 0.01
    # Between them velocities have a part of the positions' time constant.
    got = series("sensor_lag", truth, seconds=0.01, velocity_faster=0.4)
    np.testing.assert_allclose(got[:, 1], series("sensor_lag", truth, seconds=0.006)[:, 1], rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "physical"),
    [
        ("encoder_bias", {"rad": [0.03, -0.05]}),
        ("sensor_delay", {"seconds": [0.0124, 0.031]}),
        ("sensor_lag", {"seconds": [0.008, 0.02]}),
        ("sensor_lag", {"seconds": [0.008, 0.02], "second_stage": 1.0}),
    ],
)
def test_what_a_sensor_did_is_undone(name, physical):
    truth, row = motion(), LIBRARY[name]
    values = values_of(row, **physical)
    if row.start is None:
        readings = np.stack([act(name, reading, **physical) for reading in truth])
    else:
        readings = series(name, truth, **physical)
    slopes = np.concatenate([readings[:, 1:], np.gradient(readings[:, 1:], DT, axis=0)], axis=1)
    got = np.asarray(row.undo(values, jnp.concatenate([readings, slopes], axis=1), DT))
    # Until a lag of 20 ms has forgotten its start, and as long as a delay of 31 ms knows what comes.
    inner = slice(200, 560)
    # A jerk over 20 ms of motion at 3 Hz is 0.6 % too small.
    np.testing.assert_allclose(got[inner, 0], truth[inner, 0], atol=0.006 * 0.02 * 7.6 + 1e-4)
    np.testing.assert_allclose(got[inner, 1], truth[inner, 1], atol=0.006 * 0.02 * 143 + 1e-3)
    # Left alone they are further off.
    assert np.abs(readings[inner, 0] - truth[inner, 0]).max() > 0.02


def test_a_lead_of_positions_and_of_what_was_taken_from_them_is_undone():
    lead = np.array([0.001, 0.002], np.float32)
    values = values_of(NOMINAL["position_lead"], seconds=lead, velocity_seconds=lead)
    time, pace = DT * np.arange(400)[:, None], 20.0
    truth, ahead = (
        np.stack([0.3 * np.sin(pace * at), 0.3 * pace * np.cos(pace * at), -0.3 * pace**2 * np.sin(pace * at)], axis=1)
        for at in (time, time + lead)
    )
    got = np.asarray(NOMINAL["position_lead"].undo(values, jnp.asarray(ahead, jnp.float32), DT))
    # To first order: half the square of a lead's share of the motion is left.
    for kind, most in enumerate((0.3, 0.3 * pace)):
        assert np.abs(got[1:-1, kind] - truth[1:-1, kind]).max() < 0.6 * (pace * lead.max()) ** 2 * most
        assert np.abs(ahead[:, kind] - truth[:, kind]).max() > 0.03 * most


@pytest.mark.parametrize("axis", ["roll", "pitch"])
def test_a_tilted_imu_reads_gravity_in_its_own_frame(axis):
    angle, upright = 0.02, np.array([0.28, -0.6, -0.75], np.float32)
    half = np.array([np.cos(angle / 2), np.sin(angle / 2)])
    quat = [half[0], half[1], 0.0, 0.0] if axis == "roll" else [half[0], 0.0, half[1], 0.0]
    tilt = {"roll_rad": 0.0, "pitch_rad": 0.0} | {f"{axis}_rad": angle}
    expected = sensing.rotate_inverse(jnp.asarray(quat, jnp.float32), jnp.asarray(upright))
    # Small angles: half of 0.02^2 is left out.
    np.testing.assert_allclose(act("imu_tilt", upright, **tilt), expected, atol=2.5e-4)
    assert np.abs(expected - upright).max() > 0.01


# From outside.


def test_the_learned_torque_is_a_sum_of_features_of_the_joint_its_neighbours_and_its_short_history():
    zero = {parameter.name: 0.0 for parameter in LEARNED.parameters}
    wanted = jnp.full(JOINTS, 0.5)

    def torque(position, speed, past=(0.5, 0.0), **terms):
        at = now(speed, position=jnp.full(JOINTS, position))
        memory = jnp.stack([jnp.full(JOINTS, past[0]), jnp.full(JOINTS, past[1])])
        return LEARNED.act(values_of(LEARNED, **(zero | terms)), wanted, at, memory)[0]

    np.testing.assert_allclose(torque(0.3, 2.0, constant_nm=0.2), 0.7, rtol=1e-6)
    np.testing.assert_allclose(torque(np.pi / 2, 2.0, sine_nm=0.2, cosine_nm=9.0), 0.7, rtol=1e-5)
    np.testing.assert_allclose(torque(np.pi, 2.0, cosine_nm=0.2, sine_nm=9.0), 0.3, rtol=1e-5)
    # From 0.1 rad/s on it has its direction.
    np.testing.assert_allclose(torque(0.3, -2.0, direction_nm=0.2), 0.3, rtol=1e-5)
    np.testing.assert_allclose(torque(0.3, -2.0, speed_nm_s_per_rad=0.2), 0.1, rtol=1e-5)
    np.testing.assert_allclose(torque(0.3, -2.0, square_nm_s2_per_rad2=0.1), 0.1, rtol=1e-5)
    np.testing.assert_allclose(torque(0.3, 2.0, share=0.2), 0.6, rtol=1e-5)
    # The first joint has none before it, and the last none after it.
    np.testing.assert_allclose(torque(np.pi / 2, 2.0, sine_before_nm=0.2), [0.5, 0.7], rtol=1e-5)
    np.testing.assert_allclose(torque(np.pi / 2, 2.0, sine_after_nm=0.2), [0.7, 0.5], rtol=1e-5)
    np.testing.assert_allclose(torque(0.3, 2.0, share_before=0.2), [0.5, 0.6], rtol=1e-5)
    np.testing.assert_allclose(torque(0.3, 2.0, share_after=0.2), [0.6, 0.5], rtol=1e-5)
    # A torque that was there all the time is not late; one that has just come is, but for the step that has passed.
    np.testing.assert_allclose(torque(0.3, 2.0, late_share=1.0), 0.5, rtol=1e-5)
    fresh = torque(0.3, 2.0, past=(0.0, 0.0), late_share=1.0) - 0.5
    assert ((fresh > 0.45) & (fresh < 0.5)).all()
    # After 30 ms a torque of one is 1 / e ahead of what is remembered of it.
    memory, values = jnp.zeros((2, JOINTS)), values_of(LEARNED, **(zero | {"late_share": 1.0}))
    for _ in range(30):
        got, memory = LEARNED.act(values, jnp.ones(JOINTS), now(1.0), memory)
    np.testing.assert_allclose(memory, 1.0 - np.exp(-1.0), rtol=1e-5)
    np.testing.assert_allclose(got, 1.0 + np.exp(-1.0), rtol=1e-5)


def test_the_damping_gain_scales_what_the_controller_damps():
    row = NOMINAL["damping_gain"]
    speed, _ = row.act(values_of(row, ratio=1.5), jnp.full(JOINTS, 2.0), None, None)
    np.testing.assert_allclose(speed, 3.0, rtol=1e-6)


def test_a_recorded_torque_may_be_a_multiple_of_the_motors():
    row = NOMINAL["torque_reading"]
    torque, _ = row.act(values_of(row, ratio=0.8), jnp.full(JOINTS, -2.0), None, None)
    np.testing.assert_allclose(torque, -1.6, rtol=1e-6)


# Against MuJoCo C: an arm under its controller, with the effect and without.


def replaced(text, old, new):
    assert text.count(old) == 1
    return text.replace(old, new)


LOWER = 'fromto="0 0 0 0 0 -0.25"'
UPPER = '<geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="1.2"/>'
IN_THE_MODEL = {
    # 0.05 and 0.01 are everybody's.
    "viscous": (
        {"shoulder": {"nm_s_per_rad": 0.35}},
        [('name="shoulder"', 'name="shoulder" damping="0.4"')],
    ),
    "armature": ({"elbow": {"kg_m2": 0.02}}, [('name="elbow"', 'name="elbow" armature="0.03"')]),
    "coulomb": ({"elbow": {"torque_nm": 0.2}}, [('name="elbow"', 'name="elbow" frictionloss="0.2"')]),
    "joint_spring": ({"elbow": {"nm_per_rad": 1.5}}, [('name="elbow"', 'name="elbow" stiffness="1.5"')]),
    # Geometries give a body mass and inertia alike.
    "link_mass": ({"lower": {"ratio": 1.5}}, [('mass="0.6"', 'mass="0.9"')]),
    "com_offset": (
        {"lower": {"x_m": 0.03, "z_m": -0.02}},
        [(LOWER, 'fromto="0.03 0 -0.02 0.03 0 -0.27"')],
    ),
    # At the centre of the upper link, too small to have an inertia of its own.
    "payload": (
        {"upper": {"kg": 0.7}},
        [(UPPER, UPPER + '<geom type="sphere" size="0.0005" pos="0 0 -0.15" mass="0.7"/>')],
    ),
    # A ball at the end of a bracket, 2/5 r^2 its squared radius of gyration.
    "payload(off_centre, bulky)": (
        {"lower": {"kg": 0.7, "x_m": 0.04, "y_m": -0.03, "z_m": -0.1, "gyration_m": 0.4**0.5 * 0.06}},
        [('mass="0.6"/>', 'mass="0.6"/><geom type="sphere" size="0.06" pos="0.04 -0.03 -0.225" mass="0.7"/>')],
    ),
}


@pytest.fixture(scope="module")
def swing(arm):
    """A step of both targets, from a posture with gravity torque."""
    start = np.array([0.5, -0.7])
    return rigs.segment(arm.rig, start, start + np.array([0.3, 0.5]), kp=12.0, kd=0.3, limit=3.0)


@pytest.mark.parametrize("name", IN_THE_MODEL)
def test_effects_of_the_model_move_it_as_if_compiled_with_them(arm, swing, name):
    places, changes = IN_THE_MODEL[name]
    text = rigs.ARM
    for change in changes:
        text = replaced(text, *change)
    expected = rigs.in_mujoco(arm.rig, rigs.compiled(text, arm.rig), swing)
    check(arm, swing, expected, **{name.split("(")[0]: places})


def test_a_push_is_a_torque_that_is_applied(arm, swing):
    def push(data):
        data.qfrc_applied[arm.rig.dof] += [0.0, -0.4]

    expected = rigs.in_mujoco(arm.rig, rigs.compiled(rigs.ARM, arm.rig), swing, outside=push)
    check(arm, swing, expected, constant_push={"elbow": {"nm": -0.4}})


@pytest.mark.parametrize(("linear", "square"), [(2.0, 0.0), (0.5, 1.5)])
def test_drag_is_a_force_against_the_velocity_of_a_links_centre(arm, swing, linear, square):
    model = rigs.compiled(rigs.ARM, arm.rig)
    lower = model.body("lower").id

    def drag(data):
        # Of the last step's kinematics, which both have at hand.
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, lower, velocity, 0)
        data.xfrc_applied[lower, :3] = -(linear + square * np.linalg.norm(velocity[3:])) * velocity[3:]

    expected = rigs.in_mujoco(arm.rig, model, swing, outside=drag)
    check(arm, swing, expected, drag={"lower": {"n_s_per_m": linear, "n_s2_per_m2": square}})


def check(arm, segment, expected, **effect):
    read, without = arm.play(segment, **effect), arm.play(segment)
    # Single precision; what they do is a thousand times as much.
    np.testing.assert_allclose(read["q"], expected[:, 0], atol=5e-6)
    np.testing.assert_allclose(read["dq"], expected[:, 1], atol=1e-4)
    assert np.abs(without["q"] - expected[:, 0]).max() > 5e-3
