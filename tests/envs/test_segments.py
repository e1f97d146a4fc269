"""What is measured of a log, and how it is cut."""

from dataclasses import replace

import numpy as np
import pytest

from envs import clock, readings, segments
from envs.effects.memory import LONGEST_S
from envs.logs import Controller, Run

DT = 0.001
PD = {"kp": np.array([20.0, 10.0]), "kd": np.array([0.5, 0.2]), "torque_limit_nm": np.array([5.0, 3.0])}
SERVO = {"gain": np.array([2.0, 3.0]), "kt": np.array([0.4, 0.5]), "resistance_ohm": np.array([2.0, 4.0])}


def times(seconds=1.0, rate_hz=200.0):
    return np.arange(round(seconds * rate_hz) + 1) / rate_hz


def run(time, name="run_000", kind="pd", gains=PD, known=None, **signals):
    """A run of two joints, still at zero where nothing else is said."""
    still = {"q": np.zeros((len(time), 2)), "target": np.zeros((len(time), 2))}
    signals = {name: values for name, values in (still | signals).items() if values is not None}
    return Run(
        name=name,
        condition=name,
        split=None,
        controller=Controller(kind=kind, rate_hz=200.0, gains=gains),
        time=time,
        signals=signals,
        known=known or {},
    )


def parabola(time):
    """Positions and velocities [rows, joints] under constant accelerations."""
    time = time[:, None]
    acceleration, speed = np.array([4.0, -6.0]), np.array([-1.0, 2.0])
    return 0.3 + speed * time + 0.5 * acceleration * time**2, speed + acceleration * time


# Smoothing.


@pytest.mark.parametrize("with_velocity", [True, False])
@pytest.mark.parametrize("even", [True, False])
def test_a_parabola_is_recovered_to_its_ends(with_velocity, even):
    time = times()
    if not even:
        time = time + 0.002 * np.random.default_rng(0).uniform(size=len(time))
    position, velocity = parabola(time)
    got = segments.smoothed(run(time, q=position, dq=velocity if with_velocity else None))
    assert got.shape == (201, 2, 2)
    np.testing.assert_allclose(got[:, 0], position, atol=1e-5)
    np.testing.assert_allclose(got[:, 1], velocity, atol=1e-3)


def test_smoothing_takes_noise_out():
    rng = np.random.default_rng(1)
    time = times(4.0)
    position, velocity = parabola(time)
    noisy = position + 0.01 * rng.standard_normal(position.shape)
    got = segments.smoothed(run(time, q=noisy))[10:-10]
    # Two rows on each side: a parabola through five points leaves 17 / 35 of the variance of the middle one, 0.697 of
    # its deviation; and a slope's is 0.01 / (5 ms sqrt(10)).
    np.testing.assert_allclose((got[:, 0] - position[10:-10]).std(), 0.697 * 0.01, rtol=0.06)
    np.testing.assert_allclose((got[:, 1] - velocity[10:-10]).std(), 0.01 / (0.005 * 10**0.5), rtol=0.06)


def test_slopes_have_less_noise_than_states_and_follow_the_motion():
    rng = np.random.default_rng(1)
    time = times(4.0)
    angle = 2.0 * np.pi * 2.0 * time[:, None] * [1.0, -0.5]
    position, acceleration = 0.3 * np.sin(angle), -0.3 * (2.0 * np.pi * np.array([2.0, 1.0])) ** 2 * np.sin(angle)
    inner = slice(10, -10)
    exact = segments.slopes(run(time, q=position))[:, 1]
    # A cubic over 20 ms on both sides bends 0.5 % less at 2 Hz.
    np.testing.assert_allclose(exact[inner], acceleration[inner], atol=0.006 * np.abs(acceleration).max())
    noisy = run(time, q=position + 3e-4 * rng.standard_normal(position.shape))
    got = segments.slopes(noisy)[inner]
    velocity, own = np.gradient(position, time, axis=0)[inner], segments.smoothed(noisy)[:, 1]
    assert (got[:, 0] - velocity).std() < 0.6 * (own[inner] - velocity).std()
    slopes = np.gradient(own, time, axis=0)[inner] - acceleration[inner]
    assert (got[:, 1] - acceleration[inner]).std() < 0.3 * slopes.std()


def test_a_good_velocity_counts_for_more_than_positions():
    rng = np.random.default_rng(2)
    time = times(4.0)
    position, velocity = parabola(time)
    noisy = position + 0.01 * rng.standard_normal(position.shape)
    measured = velocity + 0.01 * rng.standard_normal(velocity.shape)
    got = segments.smoothed(run(time, q=noisy, dq=measured))[10:-10]
    # Positions would know it to 0.63 rad/s, see above; five velocities to 0.01 / sqrt(5).
    np.testing.assert_allclose((got[:, 1] - velocity[10:-10]).std(), 0.01 / 5**0.5, rtol=0.1)


@pytest.mark.parametrize("counts", [0.5, 1.0, np.inf])
def test_a_joint_at_rest_has_little_speed(counts):
    # Of 13 readings with a slope: noise / sqrt(sum of squared times). Windows that are narrower by chance have up to
    # four times as much, so they must be few.
    rng, time = np.random.default_rng(8), times(10.0, 500.0)
    exact = 1e-3 * rng.uniform(size=20)
    read = exact + 5e-4 * rng.standard_normal((len(time), 20))
    if np.isfinite(counts):
        read = np.round(read / (5e-4 / counts)) * (5e-4 / counts)
    rest = segments.smoothed(run(time, q=read))[10:-10, 1]
    assert rest.std() < 1.2 * (read - exact).std() / (0.002 * 182**0.5)


@pytest.mark.parametrize("rate_hz", [50.0, 100.0])
def test_slow_rows_are_smoothed_without_a_bias_larger_than_the_noise(rate_hz):
    rng = np.random.default_rng(5)
    time, pace, quantum = times(10.0, rate_hz), 2 * np.pi * 2.0, 2 * np.pi / 4096
    phase = pace * time[:, None] + [0.0, 1.0]
    exact = np.stack([0.3 * np.sin(phase), 0.3 * pace * np.cos(phase)], axis=1)
    errors = []
    for _ in range(2):
        rounded = np.round((exact[:, 0] + 0.3 * quantum * rng.standard_normal((len(time), 2))) / quantum) * quantum
        errors.append((segments.smoothed(run(time, q=rounded)) - exact)[5:-5])
    # What is the same in both is bias, what differs is noise.
    noise = (errors[0] - errors[1]).std(axis=0) / 2**0.5
    bias = np.sqrt(np.maximum((errors[0] * errors[1]).mean(axis=0), 0.0))
    assert (bias < noise).all()


# Noise and rounding.


def test_noise_is_what_changes_from_row_to_row():
    rng = np.random.default_rng(3)
    time = times(20.0)
    position, _ = parabola(time)
    # 8000 draws; a median of theirs is good to a few percent.
    np.testing.assert_allclose(segments.noise(position + 0.02 * rng.standard_normal(position.shape)), 0.02, rtol=0.05)


def test_noise_of_a_smooth_signal_is_none_and_not_zero():
    # Not a parabola: at even times its values are multiples of one number, as if they were rounded.
    position = np.sin(times()[:, None] * [3.0, 4.0])
    assert ((segments.noise(position) > 0) & (segments.noise(position) < 1e-5)).all()
    assert (segments.noise(np.zeros((50, 2))) > 0).all()


@pytest.mark.parametrize("quantum", [2 * np.pi / 2**14, 2 * np.pi / 4096, 0.005, 0.25])
def test_a_quantum_is_found(quantum):
    position, _ = parabola(times(2.0))
    rounded = np.round(position / quantum) * quantum
    np.testing.assert_allclose(segments.quantum_of(rounded), quantum, rtol=1e-5)
    # At least the noise of rounding, a uniform distribution's.
    assert (segments.noise(rounded) >= quantum / 12**0.5 * (1 - 1e-5)).all()


@pytest.mark.parametrize("share", [0.2, 0.3, 0.5, 0.7, 1.0])
def test_noise_is_found_where_rounding_is_as_coarse(share):
    # Noise of a share of a 12-bit encoder's count. Third differences are few counts then, and half of them one or none.
    rng, quantum, time = np.random.default_rng(7), 2 * np.pi / 4096, times(3.0, 500.0)
    exact = 0.3 * np.sin(8.0 * time[:, None] + np.arange(20))
    rounded = np.round(exact / quantum + share * rng.standard_normal(exact.shape)) * quantum
    np.testing.assert_allclose(segments.noise(rounded).mean(), quantum * np.hypot(share, 12**-0.5), rtol=0.05)


def test_what_was_not_rounded_has_no_quantum():
    rng = np.random.default_rng(4)
    for values in (rng.standard_normal((500, 2)), np.sin(times()[:, None] * [3.0, 4.0]), np.ones((500, 2))):
        np.testing.assert_array_equal(segments.quantum_of(values), [0.0, 0.0])


@pytest.mark.parametrize("late_s", [[0.0, 0.0], [0.007, 0.0], [0.0, 0.02], [-0.006, 0.02]])
def test_late_and_early_velocities_are_found_joint_by_joint(late_s):
    time = times(4.0)
    pace = 2 * np.pi * np.array([1.0, 2.5])
    position = 0.3 * np.sin(pace * time[:, None])
    velocity = 0.3 * pace * np.cos(pace * (time[:, None] - late_s))
    # Each joint moves in a run of its own, and rests in the other.
    rests = run(time, q=np.zeros_like(position), dq=np.zeros_like(velocity))
    alone = [run(time, q=position * mine, dq=velocity * mine) for mine in np.eye(2)]
    for runs in ([run(time, q=position, dq=velocity)], alone, [rests, *alone, rests]):
        np.testing.assert_allclose(segments.lateness(runs), late_s, atol=3e-4)


@pytest.mark.parametrize("pace_hz", [0.0, 0.3])
@pytest.mark.parametrize(("rate_hz", "quantum"), [(50.0, 0.0015), (200.0, 0.0015), (200.0, 1e-9), (500.0, 2e-4)])
@pytest.mark.parametrize("seed", range(5))
def test_noise_of_joints_that_rest_or_move_slowly_is_not_taken_for_a_lag(pace_hz, rate_hz, quantum, seed):
    time, rng, pace = times(3.0, rate_hz), np.random.default_rng(seed), 2 * np.pi * pace_hz
    runs = []
    for _ in range(2):
        position = 0.2 * np.sin(pace * time[:, None] + [0.0, 1.0]) + 1e-4 * rng.standard_normal((len(time), 2))
        velocity = 0.2 * pace * np.cos(pace * time[:, None] + [0.0, 1.0])
        noisy = velocity + 0.02 * rng.standard_normal(velocity.shape)
        runs.append(run(time, q=np.round(position / quantum) * quantum, dq=noisy))
    assert (np.abs(segments.lateness(runs)) <= 1e-3).all()


def test_stamps_in_bursts_and_short_runs_tell_nothing_rather_than_break():
    time = times(4.0, 250.0)
    pace = 2 * np.pi * np.array([1.0, 2.5])
    position, velocity = 0.3 * np.sin(pace * time[:, None]), 0.3 * pace * np.cos(pace * (time[:, None] - 0.016))
    bursts = 0.016 * (np.arange(len(time)) // 4) + 1e-4 * (np.arange(len(time)) % 4)
    assert np.isfinite(segments.lateness([run(bursts, q=position, dq=velocity)])).all()
    for count in (1, 2, 10):
        few = [run(time[:count], q=position[:count], dq=velocity[:count])]
        assert (segments.lateness(few) == 0.0).all()


def slow_bus(every=3, rate_hz=200.0):
    """Rounded sines of which the bus hands every third row's over; the second joint stands still half of the time."""
    time, quantum = times(4.0, rate_hz), 2 * np.pi / 4096
    phase = 2 * np.pi * time[:, None]
    exact = 0.5 * np.sin(phase)
    exact = np.concatenate([exact, np.where(phase < 4 * np.pi, exact, 0.0)], axis=1)
    held = np.arange(len(time)) // every * every
    return time, exact, (np.round(exact / quantum) * quantum)[held]


def test_repeated_readings_are_stale_where_the_joint_moves():
    time, exact, read = slow_bus()
    stale = readings.stale(run(time, q=read), "q")
    fast = np.abs(np.gradient(exact, time, axis=0)) > 1.0
    repeats = np.arange(len(time)) % 3 > 0
    assert stale[repeats][fast[repeats]].mean() > 0.95
    assert not stale[~repeats].any()
    # From 2 s on the second joint stands still.
    assert not stale[405:, 1].any()
    # Without a slow bus there are none, although slow joints repeat themselves.
    own = run(time, q=slow_bus(every=1)[2])
    assert not readings.stale(own, "q").any()


@pytest.mark.parametrize("rows", [2, 3, 5, 10])
def test_a_joint_that_stops_and_goes_on_is_not_stale(rows):
    # At 50 Hz, 0.1 rad from row to row, then some rows at rest, and so on.
    moves = np.tile(np.append(np.full(6, 0.1), np.zeros(rows - 1)), 10)
    position = np.cumsum(moves)[:, None] * [1.0, -1.0]
    mine = run(times(10.0, 50.0)[: len(moves)], q=position, known={"q": {"quantum": np.array([0.0015, 0.0015])}})
    assert not readings.stale(mine, "q").any()


def test_a_joint_that_sticks_and_then_jumps_is_not_stale():
    # It creeps by a step of rounding every six rows, sticks for 23 rows, and goes off by four steps and more.
    creep, goes_on = np.tile([1, 0, 0, 0, 0, 0], 12), np.tile([1, 0, 2], 20)
    steps = np.concatenate([creep, np.zeros(18), 4 * np.arange(1, 12), goes_on])
    position = 0.0004 * np.cumsum(steps)[:, None]
    mine = run(times(10.0, 250.0)[: len(steps)], q=position, known={"q": {"quantum": np.array([0.0004])}})
    assert not readings.stale(mine, "q").any()
    np.testing.assert_array_equal(readings.aligned(mine, "q"), position)


def test_stale_readings_bias_nothing():
    time, exact, read = slow_bus()
    mine = run(time, q=read)
    assert np.abs(read - exact).max() > 0.02
    np.testing.assert_allclose(readings.aligned(mine, "q")[6:395], exact[6:395], atol=0.004)
    np.testing.assert_allclose(segments.smoothed(mine)[6:395, 0], exact[6:395], atol=0.004)
    # Their jumps do not pass for noise.
    assert (readings.noise_of(mine, "q") < 0.002).all()
    assert (segments.noise(read)[0] > 0.005).all()


def test_a_value_that_is_held_is_stale_though_noise_flips_its_last_bit():
    time, exact, read = slow_bus()
    quantum = 2 * np.pi / 4096
    flipped = read + quantum * np.random.default_rng(3).integers(0, 2, read.shape)
    mine = run(time, q=flipped)
    fast = np.abs(np.gradient(exact, time, axis=0)) > 1.0
    repeats = np.arange(len(time)) % 3 > 0
    assert readings.stale(mine, "q")[repeats][fast[repeats]].mean() > 0.95
    assert (readings.noise_of(mine, "q") < 0.002).all()
    # Readings that are never held have none, whatever their noise.
    own = slow_bus(every=1)[2] + quantum * np.random.default_rng(4).integers(0, 2, read.shape)
    assert readings.stale(run(time, q=own), "q").mean() < 0.01
    # At rest, then off at once, and to rest again.
    jumps = np.repeat(0.3 * np.cos(np.arange(9) * np.pi), 89)[: len(time), None] * [1.0, -1.0]
    jumps = np.apply_along_axis(lambda column: np.convolve(column, np.ones(8) / 8, "same"), 0, jumps)
    jumps = np.round(jumps / quantum) * quantum + quantum * np.random.default_rng(5).integers(0, 2, jumps.shape)
    assert not readings.stale(run(time[: len(jumps)], q=jumps), "q").any()


def test_known_noise_counts_and_what_is_not_known_is_estimated_over_all_runs():
    time = times(4.0)
    moving = 0.3 * np.sin(5.0 * time)[:, None] * [1.0, 1.0] + 0.01 * np.random.default_rng(6).standard_normal((801, 2))
    known = {"q": {"noise_sd": np.array([np.nan, 0.07])}}
    runs = [run(time, q=np.round(moving / 0.005) * 0.005, known=known), run(time, "run_001", known=known)]
    estimate = readings.noise(runs[0].signals["q"])
    np.testing.assert_allclose(estimate, 0.0101, rtol=0.1)
    for one in readings.with_noise(runs, runs):
        np.testing.assert_allclose(readings.noise_of(one, "q"), [estimate[0], 0.07], rtol=1e-6)
        np.testing.assert_allclose(readings.rounding_of(one, "q"), 0.005, rtol=1e-6)


@pytest.mark.parametrize("offset_s", [0.004, -0.006])
def test_readings_of_another_time_are_brought_to_their_rows(offset_s):
    time = times(2.0, 50.0)
    late = np.array([offset_s, 0.0])
    exact = 0.3 * np.sin(8.0 * time[:, None])
    read = 0.3 * np.sin(8.0 * (time[:, None] + late))
    mine = run(time, q=read, dq=None, known={"q": {"offset_s": np.array([offset_s, np.nan])}})
    np.testing.assert_allclose(readings.aligned(mine, "q")[2:-2], exact[2:-2] + 0 * late, atol=1e-3)
    np.testing.assert_allclose(segments.smoothed(mine)[3:-3, 0], exact[3:-3] + 0 * late, atol=1e-3)
    # The column that was on time is as it was recorded.
    np.testing.assert_array_equal(readings.aligned(mine, "q")[:, 1], read[:, 1])
    cut = segments.cut([mine], 0.4, DT)
    np.testing.assert_allclose(cut.signals["q"], readings.aligned(mine, "q")[cut.row], rtol=1e-6)


def test_a_filters_delay_is_taken_from_its_readings():
    time = times(2.0)
    corner = 2 * np.pi * 20.0
    slow = 2 * np.pi * 1.0
    exact, lag = np.sin(slow * time)[:, None] * [1.0, 1.0], np.arctan(slow / corner) / slow
    filtered = np.sin(slow * (time - lag))[:, None] * [1.0, 1.0]
    mine = run(time, q=filtered, known={"q": {"filter_hz": np.array([20.0, 20.0])}})
    np.testing.assert_allclose(readings.aligned(mine, "q")[4:-4], exact[4:-4], atol=2e-3)


# Cutting.


@pytest.fixture(scope="module")
def moving():
    """A parabola under targets that name their row: 1, 2, ... for one joint, -1, -2, ... for the other."""
    time = times(1.0)
    position, velocity = parabola(time)
    number = np.arange(len(time), dtype=float)[:, None]
    return run(time, q=position, dq=velocity, target=number * [1.0, -1.0])


# 0.12 s before, 0.1 s ahead, of 1 ms each.
BEFORE, AHEAD = 120, 100


def test_pieces_follow_on_each_other_and_have_a_history(moving):
    cut = segments.cut([moving], 0.15, DT)
    # 0.15 s are 30 rows; the first with 0.12 s before it is row 24: from 24, 54, ... up to row 200.
    np.testing.assert_array_equal(cut.row[:, 0], [25, 55, 85, 115, 145])
    np.testing.assert_array_equal(cut.row, cut.row[:, :1] + np.arange(30))
    np.testing.assert_array_equal(cut.run, 0)
    assert round(LONGEST_S / DT) == AHEAD
    assert round(segments.HISTORY_S / DT) == BEFORE
    one = cut.segments
    # 0.15 s and one step for the end, or two where times are no multiples to the last bit.
    _, steps = one.sample.shape
    assert BEFORE + 151 <= steps <= BEFORE + 152
    assert one.measured.shape == (5, BEFORE + 1 + AHEAD, 4, 2)
    for name in ("target", "between", "feed", "stiffness", "damping", "limit", "emf"):
        assert getattr(one, name).shape == (5, steps, 2), name
    assert one.row_step.shape == one.row_share.shape == (5, 30)


def test_what_was_measured_at_the_rows_is_what_was_measured(moving):
    cut = segments.cut([moving], 0.15, DT)
    assert set(cut.signals) == {"q", "dq"}
    for name, values in cut.signals.items():
        np.testing.assert_allclose(values, moving.signals[name][cut.row], rtol=1e-6)


def test_rows_are_read_at_their_times(moving):
    cut = segments.cut([moving], 0.15, DT)
    at = DT * (cut.segments.row_step + cut.segments.row_share)
    np.testing.assert_allclose(at, moving.time[cut.row] - moving.time[cut.row[:, :1] - 1], atol=1e-6)


def test_rows_between_steps_are_read_between_steps():
    # 1 / 60 s apart: 16.67 steps.
    time = times(1.0, rate_hz=60.0)
    cut = segments.cut([run(time)], 0.1, DT)
    np.testing.assert_array_equal(cut.segments.row_step[0, :3], [16, 33, 50])
    np.testing.assert_allclose(cut.segments.row_share[0, :3], [2 / 3, 1 / 3, 0.0], atol=1e-3)


def test_a_segment_starts_where_the_robot_was(moving):
    cut = segments.cut([moving], 0.15, DT)
    start = moving.time[cut.row[:, 0] - 1]
    grid = start[:, None] + DT * np.arange(-BEFORE, AHEAD + 1)
    position, velocity = parabola(grid.ravel())
    # Past the last row it stays what it was.
    there = grid <= moving.time[-1]
    measured = np.asarray(cut.segments.measured)
    np.testing.assert_allclose(measured[:, :, 0][there], position.reshape(*grid.shape, 2)[there], atol=1e-5)
    np.testing.assert_allclose(measured[:, :, 1][there], velocity.reshape(*grid.shape, 2)[there], atol=1e-3)


def test_a_target_is_held_until_the_next_row(moving):
    cut = segments.cut([moving], 0.15, DT)
    target = np.asarray(cut.segments.target)
    first = cut.row[:, 0] - 1
    steps = np.arange(target.shape[1]) - BEFORE
    # A row's target acts for the five steps from its time on.
    expected = np.minimum(first[:, None] + steps // 5, len(moving.time) - 1)
    np.testing.assert_array_equal(target[..., 0], expected)
    np.testing.assert_array_equal(target[..., 1], -expected)


def between(moving, rows):
    own = replace(moving, controller=replace(moving.controller, between_rows=rows))
    one = segments.cut([own], 0.15, DT).segments
    return np.asarray(one.target), np.asarray(one.between)


def test_targets_between_rows_are_held_or_lines_or_unknown(moving):
    held, none = between(moving, "hold")
    line, nothing = between(moving, "linear")
    either, apart = between(moving, "unknown")
    np.testing.assert_array_equal(none, 0.0)
    np.testing.assert_array_equal(nothing, 0.0)
    np.testing.assert_array_equal(either, held)
    np.testing.assert_allclose(either + apart, line, atol=1e-4)
    # Targets are the number of the row, and a row is five steps.
    first = np.arange(line.shape[1]) / 5.0
    np.testing.assert_allclose(line[0, :150, 0] - line[0, 0, 0], first[:150], atol=1e-3)


def test_targets_of_twelve_seconds_lead_to_a_segment():
    time = times(20.0)
    number = np.arange(len(time), dtype=float)[:, None] * [1.0, -1.0]
    cut = segments.cut([run(time, target=number)], 0.15, DT)
    past, first = np.asarray(cut.segments.past_target), np.asarray(cut.segments.target)[:, 0]
    assert past.shape[1:] == (2001, 2)
    np.testing.assert_array_equal(past[:, -1], first)
    # A row holds for 5 ms, and the first one counts from long ago. Steps are of 10 ms, and of 2 ms in the last 2 s.
    seconds = np.concatenate([2.0 + 0.01 * np.arange(1000, 0, -1), 0.002 * np.arange(1000, -1, -1)])
    rows = np.floor(first[:, None, 0] - 200.0 * seconds + 1e-6)
    np.testing.assert_array_equal(past[..., 0], np.maximum(rows, 0.0))
    np.testing.assert_array_equal(cut.segments.past_told[:, 0], np.maximum(first[:, 0] - 400.0, 0.0))


def test_a_segment_knows_the_torque_that_was_sent_where_its_past_begins():
    time = times(4.0)
    sent = np.arange(len(time), dtype=float)[:, None] * [1.0, -1.0]
    cut = segments.cut([run(time, target=None, tau=sent)], 0.15, DT)
    # 2 s are 400 rows; before the first row it counts from long ago.
    began = np.maximum(np.asarray(cut.segments.feed)[:, 0, 0] - 400.0, 0.0)
    np.testing.assert_allclose(cut.segments.past_feed, began[:, None] * [1.0, -1.0], atol=1.0)
    assert began.max() > 100.0


def test_torques_between_rows_are_lines_where_the_log_says_so(moving):
    number = np.arange(len(moving.time), dtype=float)[:, None] * [1.0, -1.0]
    fed = run(moving.time, q=moving.signals["q"], target=None, tau=number)
    fed = replace(fed, controller=replace(fed.controller, between_rows="linear"))
    feed = np.asarray(segments.cut([fed], 0.15, DT).segments.feed)
    np.testing.assert_allclose(feed[0, :150, 0] - feed[0, 0, 0], np.arange(150) / 5.0, atol=1e-3)


def test_a_controller_looks_at_its_rate(moving):
    cut = segments.cut([moving], 0.15, DT)
    # 200 Hz at a millisecond: every fifth step, the start among them; the first step of all has nothing to hold.
    sample = np.asarray(cut.segments.sample)[:, 1:]
    steps = np.arange(sample.shape[1]) + 1 - BEFORE
    np.testing.assert_array_equal(sample, np.broadcast_to(steps % 5 == 0, sample.shape))


def test_the_controllers_numbers_are_the_logs(moving):
    cut = segments.cut([moving], 0.15, DT)
    for name, gain in (("stiffness", "kp"), ("damping", "kd"), ("limit", "torque_limit_nm")):
        values = getattr(cut.segments, name)
        np.testing.assert_allclose(values, np.broadcast_to(PD[gain], values.shape), rtol=1e-6)
    np.testing.assert_array_equal(cut.segments.emf, 0.0)
    np.testing.assert_array_equal(cut.segments.feed, 0.0)


def test_a_motor_that_is_off_has_no_stiffness_and_no_torque(moving):
    enabled = (np.arange(len(moving.time)) < 32).astype(float)
    off = replace(moving, signals={**moving.signals, "enabled": enabled})
    cut = segments.cut([off], 0.15, DT)
    # The first piece begins at row 24, so eight rows of five steps are left.
    for name in ("stiffness", "damping", "limit"):
        values = np.asarray(getattr(cut.segments, name))
        assert np.all(values[0, : BEFORE + 40] > 0), name
        np.testing.assert_array_equal(values[0, BEFORE + 40 :], 0.0, err_msg=name)
        np.testing.assert_array_equal(values[1:, BEFORE:], 0.0, err_msg=name)


def test_a_servo_is_a_stiffness_a_limit_and_a_brake(moving):
    volts = np.full(len(moving.time), 8.0)
    servo = replace(moving, controller=replace(moving.controller, kind="servo", gains=SERVO))
    servo = replace(servo, signals={**moving.signals, "volts": volts})
    one = segments.cut([servo], 0.15, DT).segments
    # At 8 V it stalls at 8 x 0.4 / 2 = 1.6 and 8 x 0.5 / 4 = 1.0 Nm; its windings brake by kt^2 / R.
    np.testing.assert_allclose(one.limit[0, 0], [1.6, 1.0], rtol=1e-6)
    np.testing.assert_allclose(one.stiffness[0, 0], [3.2, 3.0], rtol=1e-6)
    np.testing.assert_allclose(one.emf[0, 0], [0.08, 0.0625], rtol=1e-6)
    np.testing.assert_array_equal(one.damping, 0.0)


def test_torques_that_were_sent_are_fed(moving):
    number = np.arange(len(moving.time), dtype=float)[:, None] * [1.0, -1.0]
    fed = run(moving.time, q=moving.signals["q"], target=None, tau=number)
    cut = segments.cut([fed], 0.15, DT)
    np.testing.assert_array_equal(cut.segments.feed, segments.cut([moving], 0.15, DT).segments.target)
    np.testing.assert_array_equal(cut.segments.stiffness, 0.0)
    # What was sent is no measurement.
    assert set(cut.signals) == {"q"}


def test_runs_are_cut_alike_and_know_whose_they_are(moving):
    short = run(times(0.46), name="run_001")
    cut = segments.cut([moving, short], 0.15, DT)
    # 0.46 s are 92 rows: from 24 and from 54.
    np.testing.assert_array_equal(cut.run, [0] * 5 + [1] * 2)
    np.testing.assert_array_equal(cut.row[5:, 0], [25, 55])
    np.testing.assert_array_equal(cut.signals["q"][5:], 0.0)
    # Only one of them has velocities.
    assert set(cut.signals) == {"q"}


def test_a_segment_has_whole_bins():
    # At 1 kHz ten rows make a bin of 10 ms; 0.0463 s are 4.6 bins.
    cut = segments.cut([run(times(0.5, rate_hz=1000.0))], 0.0463, DT)
    assert segments.rows_together(0.001, 0.01) == 10
    assert cut.row.shape[1] == 50


def test_runs_that_are_too_short_are_named():
    with pytest.raises(ValueError, match=r"runs: the longest has 0\.2 s, expected more than 0\.27 s"):
        segments.cut([run(times(0.2))], 0.15, DT)


# Whole runs.


def test_a_whole_run_is_one_piece(moving):
    cut = segments.whole([moving], DT)
    np.testing.assert_array_equal(cut.row, [np.arange(25, 201)])
    np.testing.assert_allclose(cut.signals["q"][0], moving.signals["q"][25:], rtol=1e-6)
    at = DT * (cut.segments.row_step + cut.segments.row_share)
    np.testing.assert_allclose(at[0], moving.time[25:] - moving.time[24], atol=1e-6)
    # The last row can be read, and no more is simulated than it takes.
    assert cut.segments.target.shape == (1, BEFORE + 881, 2)


def test_whole_runs_are_of_equal_shape(moving):
    short = run(times(0.4), name="run_001", q=np.ones((81, 2)))
    cut = segments.whole([moving, short], DT)
    np.testing.assert_array_equal(cut.run, [0, 1])
    np.testing.assert_array_equal(cut.row[1], [*range(25, 81), *[80] * 120])
    np.testing.assert_allclose(cut.segments.row_step[1, 56:], 280)
    assert len(np.unique(cut.row[1])) == 56


def test_velocities_between_rows_are_as_good_as_those_at_rows():
    # Where they are worse, a delay of whole rows is the likeliest of all delays.
    time = times(6.0)
    speed = 0.3 * 8.0 * np.cos(8.0 * time)
    noisy = 0.3 * np.sin(8.0 * time) + 1e-3 * np.random.default_rng(7).standard_normal(len(time))
    cut = segments.cut([run(time, q=noisy[:, None] * [1.0, -1.0])], 0.1, DT)
    start = time[cut.row[:, 0] - 1]
    grid = start[:, None] + DT * np.arange(-BEFORE, AHEAD + 1)
    there = grid <= time[-1] - 0.02
    error = np.where(there, cut.segments.measured[:, :, 1, 0] - np.interp(grid, time, speed), 0.0)
    by_phase = np.sqrt((error**2).mean(axis=0).reshape(-1)[: BEFORE + AHEAD].reshape(-1, 5).mean(axis=0))
    assert by_phase.max() < 1.1 * by_phase[0]


def late(time, most, seed=9):
    """Stamps of a logger that is early or late by at most so much, in s."""
    return time + most * np.random.default_rng(seed).uniform(-1.0, 1.0, len(time))


# As seconds since 1970 are, and as of a logger that takes its time.
@pytest.mark.parametrize(
    "stamped", [lambda time: (1.7e9 + time) - 1.7e9, lambda time: late(time, 1e-3)], ids=["rounded", "jittering"]
)
def test_inexact_time_stamps_move_no_tick_and_no_target(stamped):
    time = times(2.0)
    motion = {"q": parabola(time)[0], "target": np.random.default_rng(6).normal(size=(len(time), 2))}
    cut = segments.cut([run(stamped(time), **motion)], 0.2, DT)
    after = np.arange(cut.segments.target.shape[1]) - BEFORE
    ticks = np.broadcast_to(after % 5 == 0, cut.segments.sample.shape)
    np.testing.assert_array_equal(cut.segments.sample[:, 1:], ticks[:, 1:])
    acting = np.clip(cut.row[:, :1] - 1 + after // 5, 0, len(time) - 1)
    np.testing.assert_array_equal(cut.segments.target, motion["target"][acting].astype(np.float32))


@pytest.mark.parametrize(("rows_hz", "control_hz"), [(2000.0, 1000.0), (400.0, 500.0), (200.0, 60.0)])
def test_no_tick_has_a_target_that_comes_later(rows_hz, control_hz):
    time = times(2.0, rows_hz)
    mine = run(time, target=np.arange(len(time))[:, None] * np.ones(2))
    mine = replace(mine, controller=replace(mine.controller, rate_hz=control_hz, between_rows="hold"))
    cut = segments.cut([mine], 0.2, DT)
    steps = time[cut.row[:, :1] - 1] + DT * (np.arange(cut.segments.target.shape[1]) - BEFORE)
    newest = np.clip(np.floor(steps * rows_hz + 1e-3), 0, len(time) - 1)
    np.testing.assert_array_equal(cut.segments.target[..., 0], newest)


@pytest.mark.parametrize("rows_hz", [200.0, 130.0])
def test_targets_in_lines_are_where_they_were_sent(rows_hz):
    time = times(2.0, rows_hz)
    mine = run(late(time, 3e-4), target=time[:, None] * np.ones(2))
    mine = replace(mine, controller=replace(mine.controller, between_rows="linear"))
    cut = segments.cut([mine], 0.2, DT)
    steps = time[cut.row[:, :1] - 1] + DT * (np.arange(cut.segments.target.shape[1]) - BEFORE)
    inside = steps < time[-1] - 0.01
    # Where rows do not go with the ticks, stamps are believed.
    most = 1e-5 if rows_hz == 200.0 else 7e-4
    assert np.abs(cut.segments.target[..., 0] - steps)[inside].max() < most


def test_stamps_that_jitter_where_positions_do_not_are_put_on_a_line():
    time, position = times(2.0), lambda time: 0.3 * np.sin(8.0 * time)[:, None] * [1.0, -1.0]
    noise = 1e-5 * np.random.default_rng(1).standard_normal((len(time), 2))
    stamps = late(time, 3e-4)
    moves, rests, short = (run(stamps, q=position(time) + noise), run(stamps, q=noise), run(time[:9], q=noise[:9]))
    *even, same = clock.evened([moves, rests, short], [moves, rests, short])
    # The run at rest does not show it, but the same program stamped it.
    for one in even:
        np.testing.assert_allclose(np.diff(one.time), 0.005, rtol=1e-3)
    assert same is short
    # Sealed runs do not decide.
    assert clock.evened([moves, rests], [rests]) == (moves, rests)
    # Rows that were read when they say so, and stamps without jitter.
    for one in (run(stamps, q=position(stamps) + noise), run(time, q=position(time) + noise)):
        assert clock.evened([one, rests], [one, rests]) == (one, rests)
    assert clock.evened([short], [short]) == (short,)


def polled(motion, grid=True):
    """Rows that were asked for, and read up to 1 ms before: new states come every ms, or whenever one looks."""
    rng = np.random.default_rng(4)
    asked = np.cumsum(rng.uniform(0.0007, 0.0012, 3000))
    read = np.floor(asked * 1000.0) / 1000.0 if grid else asked - rng.uniform(0.0, 0.0006, 3000)
    values = motion(read)
    return run(asked, q=values + 3e-6 * rng.standard_normal(values.shape)), read


def sines(time):
    return np.stack([0.5 * np.sin(3.0 * time), 0.3 * np.cos(5.0 * time), 0.0 * time, 0.0 * time], axis=1)


@pytest.mark.parametrize("grid", [True, False])
def test_rows_are_where_all_joints_say_that_they_were_read(grid):
    # Two more joints and another run at rest say nothing.
    mine, read = polled(sines, grid)
    rests = run(mine.time, q=3e-6 * np.random.default_rng(6).standard_normal((len(read), 4)))
    found, _ = clock.retimed([mine, rests], [mine, rests])
    new = np.append(True, np.diff(read) > 0)
    # From row to row; what wanders slowly does not show in positions.
    off = lambda time: (np.diff(time[new]) - np.diff(read[new])).std()  # noqa: E731
    assert off(found.time) < 0.15 * off(mine.time)
    assert (np.diff(found.time) > clock.SAME_S).all()
    # Null logs get the noise of readings, not that of stamps.
    jitter = off(mine.time) / 2**0.5 * np.array([1.5, 1.5]) / 2**0.5
    noise = found.fact("q", "noise_sd")
    assert (noise[:2] < 0.2 * jitter).all()
    np.testing.assert_allclose(noise[2:], 3e-6, rtol=0.2)
    assert (clock.retimed([mine], [rests])[0] is mine) and clock.retimed([rests], [mine])[0] is not rests


@pytest.mark.parametrize("case", ["stamped as read", "one profile", "slow", "one joint", "at rest", "short"])
def test_stamps_that_joints_do_not_speak_against_are_kept(case):
    time = polled(sines)[0].time
    both = np.array([0.5, -0.3])
    positions = {
        "stamped as read": sines(time),
        # Steps of speed that all joints do at once look like a clock that goes wrong, but only there.
        "one profile": np.abs((0.8 * time) % 2.0 - 1.0)[:, None] * both,
        "one joint": polled(lambda time: np.stack([0.5 * np.sin(3.0 * time), 0.0 * time], axis=1))[0].signals["q"],
    }
    if case == "slow":
        # At 100 rows a second a common ripple cannot be told from late rows.
        time = times(20.0, 100.0)
        positions[case] = (0.5 * np.sin(np.pi * time) + 0.005 * np.sin(40.0 * np.pi * time))[:, None] * both
    q = positions.get(case, np.zeros((len(time), 2)))
    q = q + 3e-6 * np.random.default_rng(5).standard_normal(q.shape)
    rows = slice(20 if case == "short" else None)
    mine = run(time[rows], q=q[rows])
    assert clock.retimed([mine], [mine]) == (mine,)


def test_a_kink_of_all_joints_is_no_late_row():
    kinked = lambda time: np.abs((0.8 * time) % 2.0 - 1.0)[:, None] * [0.5, -0.3, 0.2, 0.1]  # noqa: E731
    (sine, _), (mine, read) = polled(sines), polled(kinked)
    found = clock.retimed([sine, mine], [sine, mine])[1]
    near = (np.abs((0.8 * read + 0.5) % 1.0 - 0.5) < 0.8 * 0.012) & (read > 0.1)
    off = lambda time, rows: (np.diff(time) - np.diff(read))[rows].std()  # noqa: E731
    assert near.sum() > 30 and off(found.time, near[1:]) < 1.05 * off(mine.time, near[1:])
    assert off(found.time, ~near[1:]) < 0.3 * off(mine.time, ~near[1:])


@pytest.mark.parametrize("mean", [2e-5, 2e-4])
def test_rows_that_are_stamped_very_late_or_are_missing_miss_no_tick(mean):
    time = times(10.0)
    late_s = np.random.default_rng(3).exponential(mean, len(time))
    # By more than half of the 5 ms between rows.
    late_s[[1000, 1500]] = 3.5e-3
    for missing in ([], [1003], [900, 1985, 1986, 1987]):
        there = np.delete(np.arange(len(time)), missing)
        found = clock.clock_of(run((time + late_s)[there], target=np.ones((len(there), 2))), DT)
        assert np.abs(np.diff(found.rows) - 0.005 * np.diff(there)).max() < 1e-6
        assert np.abs(found.rows - time[there]).max() < 2 * mean


def test_a_clock_that_wanders_slowly_is_believed():
    time = times(20.0)
    wanders = time + 1e-3 * np.sin(time)
    stamps, noise = late(wanders, 2e-4), 1e-5 * np.random.default_rng(1).standard_normal((len(time), 2))
    mine = run(stamps, q=0.3 * np.sin(8.0 * wanders)[:, None] * [1.0, -1.0] + noise)
    assert clock.evened([mine], [mine]) == (mine,)


def test_stamps_off_an_even_clock_are_believed():
    # A logger's clock that goes wrong by a tick, and right again.
    time = times(2.0)
    moved = time + 0.005 * np.sin(np.pi * time)
    found = clock.clock_of(run(moved), DT)
    np.testing.assert_array_equal(found.rows, moved)
    assert found.rate_hz == 200.0


def test_torque_that_was_sent_drives_nothing_while_motors_are_off():
    time = times(2.0)
    enabled = (time < 1.0).astype(float)
    mine = run(time, target=None, tau=np.full((len(time), 2), 0.3), enabled=enabled)
    sent = mine.sent_torque()
    np.testing.assert_array_equal(sent, 0.3 * np.repeat(enabled[:, None], 2, axis=1))
    cut = segments.cut([mine], 0.2, DT)
    begins = time[cut.row[:, 0]]
    after = np.asarray(cut.segments.feed)[:, -100:]
    np.testing.assert_allclose(after[begins > 1.0], 0.0)
    np.testing.assert_allclose(after[begins < 0.7], 0.3, rtol=1e-6)
    assert not run(time, tau=np.ones((len(time), 2))).sent_torque().any()
