"""What is wrong with a command is said before anything is compiled, and a run goes on where it stopped."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments import sim2sim, sweep
from experiments.common import checkpoint, files, plots
from experiments.common.cli import bars
from experiments.common.config import PRESETS, tell_limits
from experiments.walking import comparison
from experiments.walking.cases import CASES, errors
from experiments.walking.robots import BITENO


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("case", "wind", "friction, mass"),
        ("methods", ("ours", "magic"), "ours, spm, dr, oracle"),
        ("methods", (), "methods: got none"),
        ("preset", "huge", "smoke, cpu, gpu"),
        ("parameters", "left_arm_mass", "foot_friction"),
        ("parameters", "foot_friction", "case 'mass'"),
        ("update", "guess", "posterior, vote"),
        ("radius", -0.2, "-0.2"),
        ("dr_radius", float("nan"), "nan"),
        ("start", 0.0, "0.0"),
        ("start", 0.01, "0.2 to 5"),
        ("seeds", (), "none"),
        ("seeds", (0, -1), "-1"),
        ("threshold", float("inf"), "inf"),
        ("widen_factor", 0.9, "0.9"),
        ("step_size", -1.0, "-1.0"),
        ("level", 1.5, "1.5"),
        ("level", 0.995, "0.99 or less with 99 simulated sets"),
    ],
)
def test_bad_input_is_named(field, value, named, monkeypatch):
    monkeypatch.setattr(jax, "jit", lambda *_, **__: pytest.fail("compiled something"))
    with pytest.raises(ValueError, match=field) as error:
        sim2sim.check(sim2sim.Args(**{field: value}))
    assert named in str(error.value)


@pytest.mark.parametrize("options", [{"update": "vote"}, {"methods": ("spm", "dr")}], ids=str)
def test_states_that_nobody_would_read_are_refused(options):
    with pytest.raises(ValueError, match="states: got true, expected method ours with the update posterior"):
        sim2sim.check(sim2sim.Args(states=True, **options))
    sim2sim.check(sim2sim.Args(states=True))


def test_errors_of_offsets_are_in_half_widths_of_their_bounds():
    entries = BITENO.chosen("trunk_mass,action_delay_s")
    low, high = entries["action_delay_s"].bounds
    truth = {"trunk_mass": 0.8, "action_delay_s": 0.01}
    found = errors(entries, {"trunk_mass": 1.0, "action_delay_s": 0.0}, truth)
    assert found["trunk_mass"] == pytest.approx(0.25)
    assert found["action_delay_s"] == pytest.approx(0.01 / (0.5 * (high - low)))


def test_sweep_checks_every_combination():
    with pytest.raises(ValueError, match="radius"):
        sweep.check(sweep.Args(radii=(0.2, -0.1)))


def test_sweep_lanes_are_all_combinations():
    args = sweep.Args(
        step_sizes=(0.1, 0.2, 0.3), widen_factors=(1.5, 2.0), radii=(0.2,), levels=(0.9, 0.95), seeds=(0, 1)
    )
    grid = sweep.lanes(args)
    assert grid.shape == (3, 2, 1, 2, 2, 5)
    np.testing.assert_allclose(grid[2, 1, 0, 1, 1], [0.3, 2.0, 0.2, 0.95, 1.0])
    assert len(np.unique(grid.reshape(-1, 5), axis=0)) == 24


def test_target_is_nominal_over_start():
    entries = BITENO.chosen("legs6")
    truth = CASES["mass"].true_params(entries, start=0.5)
    assert truth["left_thigh_mass"] == 2.0
    assert truth["foot_friction"] == 1.0
    assert CASES["friction"].true_params(entries, start=1.5)["foot_friction"] == pytest.approx(2 / 3)


def test_folder_of_another_config_is_refused(tmp_path):
    checkpoint.open_run(tmp_path / "run", {"radius": 0.2, "sizes": {"epochs": 40}})
    checkpoint.open_run(tmp_path / "run", {"radius": 0.2, "sizes": {"epochs": 40}})
    with pytest.raises(ValueError, match=r"out: .*config\.sizes\.epochs is 40 there, expected 50"):
        checkpoint.open_run(tmp_path / "run", {"radius": 0.2, "sizes": {"epochs": 50}})


def test_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match=r"out: .*not empty"):
        checkpoint.open_run(tmp_path, {})


def _lines(name, seed):
    errors = [{"foot_friction": 0.0, "left_thigh_mass": error} for error in (0.5, 0.2)]
    call = {
        "verdicts": ["widen", "accept"],
        "radius": [0.2, 0.3],
        "novelty": [9.0, 1.0],
        "threshold": [2.0, 2.0],
        "p_value": [0.025, 0.5],
        "measured_falls": 1,
        "not_finite": 0,
        "identifiable": {"foot_friction": False, "left_thigh_mass": True},
    }
    common = {"method": name, "seed": seed}
    return [
        {**common, "tuning": 0, "return": 30.0, "falls": 9, "param_error": errors[0], "seconds": 1.0},
        {**common, "tuning": 1, "return": 40.0, "falls": 2, "param_error": errors[1], "seconds": 2.0, **call},
    ]


def test_summary_has_the_promised_keys(tmp_path):
    settings = {"case": "mass", "start": 0.5, "preset": "cpu", "seeds": [0, 1]}
    results = {"ours": [{"lines": _lines("ours", seed), "measured_episodes": 5} for seed in range(2)]}
    summary = comparison.summarise(settings, results, ("left_thigh_mass",))
    ours = summary["methods"]["ours"]
    assert summary["case"] == "mass"
    assert ours["return_start"] == [30.0, 30.0]
    assert ours["return_end"] == [40.0, 40.0]
    assert ours["param_error_start"] == [[0.0, 0.5], [0.0, 0.5]]
    assert ours["param_error_end"] == [[0.0, 0.2], [0.0, 0.2]]
    assert ours["verdicts"] == [["widen", "accept"]] * 2
    assert ours["radius"] == [[0.2, 0.3]] * 2
    assert ours["real_episodes"] == [5, 5]
    assert ours["falls_in_target"] == [2, 2]
    plots.sim2sim(tmp_path, results, ("left_thigh_mass",), 40)
    assert {path.name for path in tmp_path.iterdir()} == {
        "return.png",
        "param_error.png",
        "param_error_each.png",
        "gate.png",
    }


def test_sets_that_fit_badly_together_are_said(capsys):
    settings = {"case": "mass", "start": 0.5, "preset": "cpu", "seeds": [0, 3], "truth": ()}
    lines = [_lines("ours", seed) for seed in (0, 3)]
    lines[0][1:] = [lines[0][1] | {"misfit_p_value": 0.06}] * 5
    lines[1][1:] = [lines[1][1] | {"misfit_p_value": value} for value in (0.9, None, 0.06)]
    results = {"ours": [{"lines": one, "measured_episodes": 5} for one in lines]}
    summary = comparison.summarise(settings, results, ())
    bad, good = summary["methods"]["ours"]["misfit_p_value"]
    assert bad < 0.01 and good > 0.1
    comparison.show(Console(width=200), summary, results)
    text = capsys.readouterr().out
    assert "ours, seed 0: the sets of all tunings together fit worse" in text and "seed 3:" not in text


def test_finished_pairs_are_not_run_again(tmp_path, monkeypatch):
    runner = object.__new__(sim2sim.Runner)
    runner._args = sim2sim.Args(out=tmp_path)
    runner._learner = type("Learner", (), {"preset": PRESETS["smoke"]})
    runner._contenders = {"ours": comparison.Contender(None, None, None, 1)}
    calls = []

    def tunings(self, name, seed):
        calls.append((name, seed))
        yield from _lines(name, seed)

    monkeypatch.setattr(sim2sim.Runner, "_tunings", tunings)
    with bars() as progress:
        first = runner("ours", 0, progress)
        again = runner("ours", 0, progress)
        runner("ours", 1, progress)
    assert first == again
    assert calls == [("ours", 0), ("ours", 1)]
    logged = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["seed"] for line in logged] == [0, 0, 1, 1]


def test_json_has_no_nan():
    @dataclasses.dataclass
    class Thing:
        value: float
        array: np.ndarray

    written = files.as_json(Thing(float("nan"), np.array([1.0, np.inf])))
    assert written == {"value": None, "array": [1.0, None]}


def test_a_size_that_cannot_call_a_robot_unexplained_says_so(capsys):
    tell_limits(PRESETS["cpu"])
    assert not capsys.readouterr().out
    tell_limits(PRESETS["smoke"])
    assert "note: 19 simulated sets are too few to call a robot unexplained; that takes 99" in capsys.readouterr().out
