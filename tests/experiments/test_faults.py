"""Commands that are killed before or after any of their steps on the disk; what they compute is a stub."""

import sys
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from faults import check_every_kill

from experiments import discovery_bench, gpu_bench, robots_bench, sim2sim, sweep
from experiments.common import checkpoint, compiler, files, plots
from experiments.common.config import PRESETS
from experiments.discovery import benchmark, investigate
from experiments.discovery.field.bench import FieldBench
from experiments.walking.comparison import Contender
from experiments.walking.robots import BITENO


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Nothing is compiled, drawn or looked up."""
    monkeypatch.setattr(compiler, "set_up", lambda *_: None)
    monkeypatch.setattr(checkpoint, "versions", dict)
    for name in ("sim2sim", "sweep", "recovery", "confusion"):
        monkeypatch.setattr(plots, name, lambda *_: None)


@pytest.fixture
def learner(monkeypatch):
    """The learner of a sweep or a comparison of BITeno, which learns nothing."""
    entries = BITENO.chosen(None)
    made = SimpleNamespace(preset=PRESETS["smoke"], entries=entries, robot=None)
    made.play = made.step = lambda *_: None
    for command in (sim2sim, sweep):
        monkeypatch.setattr(command, "Learner", lambda *_, **__: made)
        monkeypatch.setattr(command, "policy_of_run", lambda *_: lambda _: None)
        monkeypatch.setattr(command.memory, "check", lambda *_: None)
    return made


def test_a_comparison(learner, monkeypatch, tmp_path):
    def tunings(self, name, seed):
        for tuning in range(2):
            errors = dict.fromkeys(learner.entries, 0.5 / (1 + tuning + seed))
            line = {"method": name, "seed": seed, "tuning": tuning, "return": 30.0 + tuning, "falls": seed}
            line |= {"param_error": errors, "measured_falls": 0, "not_finite": 0, "seconds": float(tuning)}
            call = {"verdicts": ["accept"], "identifiable": dict.fromkeys(learner.entries, True)}
            call |= {field: [0.5] for field in ("radius", "novelty", "threshold", "p_value")}
            yield line | (call if tuning else {})

    contender = Contender(SimpleNamespace(), None, None, 1)
    monkeypatch.setattr(sim2sim, "contenders", lambda *_, **__: {"ours": contender, "dr": contender})
    monkeypatch.setattr(sim2sim.Runner, "_tunings", tunings)
    command = lambda out: sim2sim.main(sim2sim.Args(out=out, preset="smoke", seeds=(0, 3)))  # noqa: E731
    # Config, four pairs, summary and metrics: three steps each.
    assert check_every_kill(monkeypatch, tmp_path, command) == 2 * 3 * 7


def test_a_sweep(learner, monkeypatch, tmp_path):
    def results(learner, truth, off, rows):
        return {name: np.asarray(rows).sum(axis=-1).tolist() for name in sweep.RESULTS}

    monkeypatch.setattr(sweep, "lane", lambda *_: lambda settings: settings)
    monkeypatch.setattr(sweep.devices, "on_all", lambda program: lambda rows: (rows,))
    monkeypatch.setattr(sweep, "_results", results)
    command = lambda out: sweep.main(sweep.Args(out=out, preset="smoke", seeds=(0,), lanes=10))  # noqa: E731
    # Config, three pieces and summary.
    assert check_every_kill(monkeypatch, tmp_path, command) == 2 * 3 * 5


def test_a_benchmark_of_robots(monkeypatch, tmp_path):
    def tuned(world, args, policy, seed):
        names = {"mass": 0.1 + seed}
        line = {"verdict": "accept", "calls": 1, "seconds": 1.0, "error": names, "identifiable": {"mass": True}}
        line |= {"estimate": names, "low": {"mass": 0.0}, "high": {"mass": 9.0}}
        before = {"seed": seed, "truth": names, "in_first_box": {"mass": True}, "error_before": {"mass": 0.3}}
        return before | {"tunings": [line, line]}

    monkeypatch.setattr(robots_bench.foreign, "check", lambda name: None)
    world = SimpleNamespace(policy=lambda place: place.mkdir(parents=True, exist_ok=True))
    monkeypatch.setattr(robots_bench.foreign, "world", lambda *_: world)
    monkeypatch.setattr(robots_bench, "tuned", tuned)
    command = lambda out: robots_bench.main(robots_bench.Args(out=out, preset="smoke", seeds=(0, 1)))  # noqa: E731
    # Config, three robots with two seeds each, and summary.
    assert check_every_kill(monkeypatch, tmp_path, command) == 2 * 3 * 8


@dataclass(frozen=True)
class Asked:
    """What a discovery is asked to do."""

    whole_runs: object = None


@pytest.fixture
def found(monkeypatch):
    """A discovery in three steps, each of which is kept, and what it writes of the result."""

    def discover(problem, *, saved, save, say):
        steps = saved["steps"] if saved else []
        while len(steps) < 3:
            steps = [*steps, len(steps) ** 2]
            save({"steps": steps})
        return SimpleNamespace(model=steps)

    def write_model(folder, spec, rig, model):
        folder.mkdir(parents=True, exist_ok=True)
        files.write_json(folder / "effects.json", {"model": model})

    summary = {"verdict": "named", "effects": [{"name": "coulomb"}], "parameter_changes": []}
    monkeypatch.setattr(investigate, "read_logs", lambda *_: (None, None))
    monkeypatch.setattr(
        investigate, "build_question", lambda *_: SimpleNamespace(problem=Asked(), rig=None, sensed=False)
    )
    monkeypatch.setattr(investigate.workflow, "discover", discover)
    monkeypatch.setattr(investigate, "free_runs", lambda *_: {})
    monkeypatch.setattr(
        investigate, "summarise", lambda question, log, path, result: summary | {"sum": sum(result.model)}
    )
    monkeypatch.setattr(investigate, "details", lambda question, result, free: {"model": result.model})
    monkeypatch.setattr(investigate.corrected, "save", write_model)


def test_a_discovery(found, monkeypatch, tmp_path):
    command = lambda out: investigate.investigate([tmp_path], out)  # noqa: E731
    # Three steps, model, details, summary.
    assert check_every_kill(monkeypatch, tmp_path, command) == 2 * 3 * 6


def test_a_case_that_counts_as_answered_has_all_its_files(found, monkeypatch, tmp_path):
    def in_order(path, value):
        if path.name == "summary.json":
            assert (path.parent / "details.json").exists() and (path.parent / "model" / "effects.json").exists()
        files.write_json(path, value)

    monkeypatch.setattr(investigate, "write_json", in_order)
    investigate.investigate([tmp_path], tmp_path / "answer")
    assert (tmp_path / "answer" / "summary.json").exists()


def test_a_benchmark_of_discovery(found, monkeypatch, tmp_path):
    def write(self, case):
        self.truth_path(case).parent.mkdir(parents=True, exist_ok=True)
        files.write_json(self.truth_path(case), {"effects": [], "number": case.number})
        return self.out / "logs" / benchmark.name_of(case)

    monkeypatch.setattr(FieldBench, "write", write)
    monkeypatch.setattr(benchmark, "read_logs", lambda *_: (None, None))
    monkeypatch.setattr(benchmark.gate, "check", lambda *_: None)
    monkeypatch.setattr(benchmark, "score", lambda truth, answer: truth | {"verdict": answer["verdict"], "asked": 5.0})
    monkeypatch.setattr(benchmark, "tally", lambda rows: [{"of": len(rows)}])
    monkeypatch.setattr(benchmark, "page", lambda identity, cases, rows, lines: f"{len(rows)} of {cases}\n")
    monkeypatch.setattr(discovery_bench, "shown", lambda lines: [])

    def command(out):
        discovery_bench.main(discovery_bench.Args(out=out, size="field_smoke", limit=2))

    # Config; for two cases the truth, three steps, model, details, summary, scores and page; the last two once more.
    assert check_every_kill(monkeypatch, tmp_path, command) == 2 * 3 * (1 + 2 * 9 + 2)


def test_a_benchmark_of_a_gpu(monkeypatch, tmp_path):
    parts = ("speed", "policy")
    monkeypatch.setattr(gpu_bench, "commands", lambda sizes, out: {part: ["-c", ""] for part in parts})
    monkeypatch.setattr(gpu_bench, "RESULTS", {part: lambda out: {"seconds": 1.0} for part in parts})
    monkeypatch.setattr(gpu_bench, "_PYTHON", [sys.executable])
    monkeypatch.setattr(gpu_bench, "_table", lambda found: "")
    monkeypatch.setattr(gpu_bench.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=0))
    command = lambda out: gpu_bench.main(gpu_bench.Args(out=out, preset="smoke", parts=parts))  # noqa: E731
    # Config, two parts, summary.
    assert check_every_kill(monkeypatch, tmp_path, command) == 2 * 3 * 4
