import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from experiments.common.files import as_json
from jaxtune import selftest
from jaxtune.gate import GateInfo
from jaxtune.host import HostTuner
from jaxtune.selftest import INSIDE, Rate, robots
from jaxtune.tuner import Tuner, keep, knobs
from jaxtune.types import Verdict

THREE = {"colour": 0.0, "friction": 0.0, "mass": 0.0}  # colour enters no equation of the slider
ROBOTS = 12  # of every case: as many cases of as many robots share a program
CONFIG = dataclasses.replace(toys.TUNER, episodes=256, dvm=dataclasses.replace(toys.DVM, train_steps=60))


def machine(config=CONFIG):
    tuner = Tuner(config=config, train_policy=keep, simulate=toys.Slider().simulate)
    return tuner, tuner.init(toys.policy(), toys.uniform(THREE, 0.2), knobs())


def covers_all(*args):
    """A gate that lets every set pass."""
    return GateInfo(novelty=jnp.zeros(()), threshold=jnp.ones(()))


def counted(parts, **options):
    """A self-test that keeps its parts, as a command writes and reads them."""
    tuner, state = machine()

    def keep(name, compute):
        if name not in parts:
            parts[name] = json.dumps(as_json(compute()))
        return json.loads(parts[name])

    others = {"push": {"wind": 0.6}, "heavy": {"mass": 0.9}}
    sizes = {"robots": ROBOTS, "gates": 2, "whole": 1, "tunings": 2}
    return selftest.run(jax.random.key(0), tuner, state, **sizes, others=others, keep=keep, **options)


@pytest.fixture(scope="module")
def parts():
    return {}


@pytest.fixture(scope="module")
def report(parts):
    calls = []
    found = counted(parts, done=lambda *now: calls.append(now))
    assert calls == [(number, 8) for number in range(1, 9)]
    return found


def test_a_test_that_was_interrupted_goes_on_to_the_same_numbers(report, parts):
    again = dict(parts)
    for name in ("gate_1", "case_1_robots_0_to_0"):
        del again[name]
    calls = []
    assert as_json(counted(again, done=lambda *now: calls.append(now))) == as_json(report)
    assert again == parts
    # One whole tuning says how far it is.
    assert [number for number, _ in calls] == [1, 2, 4, 5, 6, 8]


def test_robots_inside_pass_and_robots_outside_do_not(report):
    assert report.alarms.of == 24
    assert report.alarms.share < 0.2
    assert report.unusable == {}
    accepted = 24 - report.alarms.hits
    for name in ("friction", "mass"):
        assert report.outside[name].share > 0.7
        assert report.outside[name].hits <= report.noticed[name].hits
        assert (report.identified[name].hits, report.identified[name].of) == (accepted, accepted)
        assert sum(of for _, of in report.identified[name].by_gate) == accepted
        assert report.error[name] < report.interval[name] < 0.2
    for rate in report.others.values():
        assert rate.share > 0.9
    assert report.covered.share > 0.7


def test_what_the_robot_does_not_show_is_said(report):
    assert report.identified["colour"].share < 0.3
    assert report.outside["colour"].share < 0.3
    assert "colour: not identifiable" in selftest.summary(report)


def test_whole_tunings_say_how_they_end(report):
    for first, last in (report.tuned[INSIDE], report.tuned["heavy"]):
        # A mass beyond the first box is found by widening.
        assert first.verdicts == {"accept": 1}
        assert first.held.of == first.covered.of == 1
        assert last.error["mass"] < 0.1
    # No parameter stands in for a push.
    for one in report.tuned["push"]:
        assert "accept" not in one.verdicts
        assert one.held == Rate(0, 0)
    assert "tuning 2, heavy: 1 accept, truth in the distribution: 1 of 1" in selftest.summary(report)


def test_whole_tunings_side_by_side_end_as_one_after_another():
    # Of few episodes a regression is all rounding, and so are ranks of a model that hardly learnt.
    tuner, state = machine(dataclasses.replace(toys.TINY, episodes=128))
    tuner = dataclasses.replace(tuner, verify=covers_all)
    sizes = {"robots": 2, "whole": 3, "tunings": 2}

    def rows(lanes, calls):
        parts = {}
        keep = lambda name, compute: parts.setdefault(name, compute())  # noqa: E731
        done = lambda number, total: calls.append((number, total))  # noqa: E731
        selftest.run(jax.random.key(0), tuner, state, **sizes, lanes=lanes, keep=keep, done=done)
        return [row for name, part in parts.items() if "case" in name for robot in part["robots"] for row in robot]

    calls = []
    alone, together = rows(1, []), rows(2, calls)
    assert len(alone) == len(together) == 6
    # A gate call and six tunings, of two robots and then of one.
    assert calls == [(number, 7) for number in (1, 3, 5, 6, 7)]
    for one, other in zip(alone, together, strict=True):
        assert one["verdict"] == other["verdict"] == Verdict.ACCEPT
        np.testing.assert_allclose(one["errors"], other["errors"], atol=1e-4)
    # Robots and tunings are not mixed up.
    assert np.ptp([row["errors"] for row in together], axis=0).max() > 0.05


def test_whole_tunings_may_end_with_measured_states():
    slider = toys.Slider(noise=0.0)
    tuner = Tuner(
        config=dataclasses.replace(toys.TINY, held_out_sets=99, min_radius=0.01),
        train_policy=keep,
        simulate=slider.simulate,
        verify=covers_all,
        replay=slider.replay(),
    )
    state = tuner.init(toys.policy(), toys.uniform({"friction": 0.0, "mass": 0.0}, 0.2), knobs())
    found = selftest.run(jax.random.key(0), tuner, state, robots=2, whole=1, others={"push": {"wind": 0.6}})
    assert {name: tunings[0].verdicts for name, tunings in found.tuned.items()} == {
        INSIDE: {"accept": 1},
        "push": {"unexplained": 1},
    }
    assert max(found.tuned[INSIDE][0].error.values()) < 1e-3


def test_a_tuning_is_counted_by_its_verdict_box_and_intervals():
    row = {"verdict": Verdict.ACCEPT, "held": True, "covered": False, "errors": np.array([0.1, 0.3])}
    rows = [row, row | {"covered": True, "errors": np.array([0.2, 0.3])}, row | {"verdict": Verdict.UNEXPLAINED}]
    one = robots._tuned(rows, ("friction", "mass"))
    assert one.verdicts == {"accept": 2, "unexplained": 1}
    assert (one.held, one.covered) == (Rate(2, 2), Rate(1, 2))
    assert one.error == {"friction": 0.1, "mass": 0.3}


def test_robots_without_intervals_are_not_counted_as_misses():
    errors, known = np.array([[0.1, 0.3], [0.1, 0.3], [0.1, 0.3]]), np.array([True, True])
    intervals = np.array([[0.2, 0.4], [0.2, 0.1], [0.2, np.nan]])
    covers = robots._covers(errors, intervals, known)
    np.testing.assert_array_equal(covers, [1.0, 0.0, np.nan])
    assert robots._told(covers) == Rate(1, 2)
    assert robots._told(covers[None, :2]) == Rate(1, 2, ((1, 2),))
    # A coordinate that is not identifiable needs none.
    assert robots._covers(errors[2], intervals[2], np.array([True, False])) == 1.0


def test_sets_that_tell_nothing_are_counted_apart():
    """Robots of a case that fall at once; the walk of the others goes on."""
    tuner, state = machine()

    def simulate(key, policy, coords):
        episodes = toys.Slider().simulate(key, policy, coords)
        falls = (coords["mass"] > 0.8)[:, None] & (jnp.arange(60) >= 20)
        return episodes.replace(alive=episodes.alive & ~falls)

    tuner = dataclasses.replace(tuner, simulate=simulate)
    others = {"push": {"wind": 0.6}, "falls": {"mass": 0.9}}
    found = selftest.run(jax.random.key(0), tuner, state, robots=ROBOTS, others=others)
    assert found.unusable == {"falls": ROBOTS}
    assert found.others["falls"].of == 0
    assert np.isnan(found.others["falls"].share)
    assert found.alarms.of == found.others["push"].of == ROBOTS
    assert f"falls: {ROBOTS} sets are not comparable or not finite" in selftest.summary(found)


def test_gates_that_differ_count_for_fewer_robots():
    assert Rate(20, 40).independent == 40
    # As chance has it, or less.
    assert Rate(20, 40, ((10, 20), (10, 20))).independent == 40
    # Each gate rejects all of its robots or none, so four gates are four draws at most.
    assert Rate(40, 80, ((20, 20), (0, 20), (20, 20), (0, 20))).independent < 4
    assert Rate(0, 40, ((0, 20), (0, 20))).independent == 40


def test_a_bound_that_leaves_no_room_outside_is_left_out():
    cases = robots._outside(toys.uniform({"friction": 0.1, "mass": 0.0}, 0.2, 0.45))
    np.testing.assert_allclose(cases["mass"]["mass"], [-0.4, 0.4], rtol=1e-6)
    np.testing.assert_allclose(cases["friction"]["friction"], [-0.3], rtol=1e-6)
    assert robots._outside(toys.uniform({"mass": 0.0}, 0.2, 0.3)) == {}


@pytest.mark.parametrize(("robots", "gates", "tunings"), [(1, 1, 1), (2, 0, 1), (2, 1, 0)])
def test_a_test_of_nothing_is_refused(robots, gates, tunings):
    got = f"robots, gates, tunings: got {robots}, {gates} and {tunings}, expected at least 2, 1 and 1"
    with pytest.raises(ValueError, match=got):
        selftest.run(jax.random.key(0), *machine(), robots=robots, gates=gates, tunings=tunings)
    with pytest.raises(ValueError, match="lanes: got 0, expected 1 or more"):
        selftest.run(jax.random.key(0), *machine(), lanes=0)


def test_a_simulator_that_cannot_be_traced_is_refused():
    tuner, state = machine()
    host = HostTuner(config=CONFIG, simulate=tuner.simulate)
    with pytest.raises(ValueError, match="tuner: got HostTuner, expected a Tuner, whose simulate JAX can trace"):
        selftest.run(jax.random.key(0), host, state, robots=2)
