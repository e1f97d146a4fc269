import json
import shutil
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from experiments import gpu_bench
from experiments.common.config import PRESETS
from experiments.walking import memory
from experiments.walking.learner import Learner
from experiments.walking.robots import BITENO


@pytest.fixture
def fake(monkeypatch):
    """Parts that note that they ran, in the place of commands that take minutes."""
    script = "import json, sys; open(sys.argv[1], 'a').write(sys.argv[2] + '\\n'); sys.exit(int(sys.argv[3]))"
    codes = dict.fromkeys(("speed", "policy", "tunings_cached"), 0)

    def commands(sizes, out):
        return {part: ["-c", script, str(out / "ran.txt"), part, str(code)] for part, code in codes.items()}

    monkeypatch.setattr(gpu_bench, "commands", commands)
    monkeypatch.setattr(
        gpu_bench,
        "RESULTS",
        {
            "speed": lambda out: {"exact": 2.0, "fast": 5.0},
            "policy": lambda out: {"without_s": 3.0},
            "tunings_cached": lambda out: {"seconds": 4.0},
        },
    )
    monkeypatch.setattr(gpu_bench, "_PYTHON", [sys.executable])
    return codes


def test_finished_parts_are_not_run_again(fake, tmp_path, capsys):
    args = gpu_bench.Args(out=tmp_path / "out", preset="smoke", parts=tuple(fake))
    fake["policy"] = 3
    with pytest.raises(ValueError, match="'policy' ended with code 3"):
        gpu_bench.main(args)
    fake["policy"] = 0
    gpu_bench.main(args)
    assert (args.out / "ran.txt").read_text().split() == ["speed", "policy", "policy", "tunings_cached"]
    summary = json.loads((args.out / "summary.json").read_text())
    assert {name: part["found"] for name, part in summary["parts"].items()}["policy"] == {"without_s": 3.0}
    assert "500,000" in capsys.readouterr().out


@pytest.fixture
def kept(tmp_path):
    """Results that its commands wrote, as they are kept in the repository, where the benchmark looks for them."""
    package = Path(gpu_bench.__file__).parent
    files = {
        "bench/speed.json": "results/speed.json",
        "bench/profile.json": "results/profile.json",
        "policy/curve.json": "policies/walk/curve.json",
        "walk/evaluation.json": "results/walk_mjx/evaluation.json",
        "tunings/metrics.jsonl": "results/main_command/metrics.jsonl",
    }
    for place, source in files.items():
        (tmp_path / place).parent.mkdir(exist_ok=True)
        shutil.copy(package / source, tmp_path / place)
    return tmp_path


def test_what_its_commands_wrote_is_read(kept):
    found = {part: gpu_bench.RESULTS[part](kept) for part in ("speed", "policy", "walk", "tunings", "profile")}
    assert found["speed"]["fast"] > found["speed"]["exact"] > 1e3
    policy = found["policy"]
    assert policy["steps"] == json.loads((kept / "policy" / "curve.json").read_text())["curve"][-1]["steps"]
    assert 0 < policy["without_s"] < policy["with_compilation_s"]
    assert found["walk"]["grid"]["touchdowns_per_s"] > 0
    tunings = found["tunings"]
    assert tunings["tunings"] == 5
    assert 0 < tunings["before_the_first_s"] < tunings["seconds"]
    assert found["profile"]["simulated episodes"]["run_s"] > 0


def test_every_part_has_a_command_whose_result_can_be_read(tmp_path):
    assert set(gpu_bench.commands("gpu", tmp_path)) == set(gpu_bench.RESULTS) == set(gpu_bench.Args().parts)


def test_compilation_is_left_out_also_after_an_interruption(tmp_path):
    # A minute of compilation at first, and again after the third of five equal lines.
    seconds = np.cumsum([70.0, 10.0, 10.0, 70.0, 10.0])
    curve = [{"steps": 100 * number, "seconds": end} for number, end in enumerate(seconds, 1)]
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "curve.json").write_text(json.dumps({"curve": curve}))
    found = gpu_bench.RESULTS["policy"](tmp_path)
    assert found == {"steps": 500, "with_compilation_s": 170.0, "without_s": 50.0}


def test_a_container_may_have_less_memory_than_its_machine(monkeypatch, tmp_path):
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(memory, "_LIMIT", limit)
    machine = memory.available()
    for text, expected in (("max", machine), (str(2**28), 2**28 / len(jax.local_devices()))):
        limit.write_text(f"{text}\n")
        assert memory.available() == expected


def test_a_run_that_does_not_fit_into_memory_is_refused(monkeypatch):
    learner = Learner(PRESETS["cpu"], BITENO.chosen(None))
    memory.check(learner)
    some, many = memory.needed(learner), memory.needed(Learner(PRESETS["gpu"], BITENO.chosen(None)))
    assert all(many[name] > 4 * some[name] for name in ("training", "tuning"))
    monkeypatch.setattr(memory, "available", lambda: 1.05 * some["tuning"])
    with pytest.raises(ValueError, match=r"preset: tuning takes about 0\.187 GiB"):
        memory.check(learner)
    monkeypatch.setattr(memory, "available", lambda: 10 * some["tuning"])
    memory.check(learner)
    with pytest.raises(ValueError, match=r"lanes: tuning takes .* 64 runs side by side"):
        memory.check(learner, lanes=64)
    # XLA's analysis of so many sets of five episodes of BITeno, in GiB.
    for sets, analysed in ((40, 0.217), (360, 0.393)):
        assert memory.needed(learner, sets=sets)["scoring"] / 2**30 == pytest.approx(analysed, rel=0.15)
    monkeypatch.setattr(memory, "available", lambda: 0.3 * 2**30)
    with pytest.raises(ValueError, match=r"preset: scoring takes about 0\.3\d* GiB"):
        memory.check(learner, sets=360)
