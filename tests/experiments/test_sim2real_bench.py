"""The benchmark with the stand-in robot, and what a corrected model is worth to it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import experiments
from experiments import sim2real_bench
from experiments.common import compiler
from experiments.robot import transfer
from experiments.sim2real_bench import Args, evaluate, stand_in, transfer_of

PACKAGE = Path(experiments.__file__).parent
# What discovery wrote from the suspended stand-in's log.
FOUND = PACKAGE / "results" / "stand_in" / "found" / "model"


class Enough(Exception):
    """Enough is known."""


def test_every_method_learns_in_the_model_that_was_found_from_a_policy_of_the_nominal_one(tmp_path, monkeypatch):
    args = Args(out=tmp_path, preset="smoke", walk_s=0.8, model=FOUND)
    assert {transfer_of(args, name, 0).model for name in sim2real_bench.METHODS} == {FOUND}
    prepared = []

    def prepare(args, programs, seed):
        prepared.append(programs)
        raise Enough

    # Flags are for a process of its own.
    monkeypatch.setattr(compiler, "set_up", lambda flags: None)
    monkeypatch.setattr(transfer, "compile_programs", lambda args: args.model)
    monkeypatch.setattr(sim2real_bench, "prepare", prepare)
    for model in (FOUND, None):
        with pytest.raises(Enough):
            sim2real_bench.main(Args(out=tmp_path / str(model is None), preset="smoke", walk_s=0.8, model=model))
    assert prepared == [None, None]


def learnt(out, *options):
    """The policy that a round leaves, trained on from the one that ships, masses as they are."""
    command = [sys.executable, "-m", "experiments.sim2real", "--out", str(out), "--rounds", "1", "--force"]
    command += ["--method", "dr", "--radius", "0.1", "--timeout-s", "120", *options]
    # Tests compile in haste, which is not worth it here.
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    with stand_in(out):
        subprocess.run(command, cwd=PACKAGE.parent, env=environment, check=True)
    return out / "round_001" / "learner"


@pytest.mark.slow
def test_a_policy_trained_in_the_model_that_was_found_walks_better(tmp_path):
    args = Args(out=tmp_path, evaluation=40)
    programs = transfer.compile_programs(transfer_of(args, "ours", 0))
    without = evaluate(args, programs, learnt(tmp_path / "without"))
    with_it = evaluate(args, programs, learnt(tmp_path / "with", "--model", str(FOUND)))
    print(f"without: {without}\nwith: {with_it}")
    falls, fewer = (round(args.evaluation * one.fall_rate) for one in (without, with_it))
    assert fewer <= 0.1 * args.evaluation
    assert falls >= fewer + 0.5 * args.evaluation
    assert with_it.mean_return > 2 * without.mean_return
