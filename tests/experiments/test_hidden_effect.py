"""What a corrected model is worth: policies trained without and with an effect that the robot has."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import experiments
from envs import logs
from envs.biteno import constants
from envs.targets import recorded
from experiments import expected, export, robot_stub
from experiments.checkpoint import write_json
from experiments.robot_folder import request

LATE_S = 0.02
WALKS, WALK_S = 10, 10.0
ROOT = Path(experiments.__file__).parent.parent


def learnt(out, *options):
    """The policy that a round leaves, of a run whose robot falls whatever it is asked."""
    command = [sys.executable, "-m", "experiments.sim2real", "--out", str(out), "--rounds", "1", "--force"]
    command += ["--method", "dr", "--radius", "0.1", *options]
    robot = [sys.executable, "-m", "experiments.robot_stub", "--folder", str(out), "--body.transport-s", str(LATE_S)]
    # Tests compile in haste, which is not worth it here.
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    out.mkdir()
    walks = subprocess.Popen(robot, cwd=ROOT, env=environment)
    try:
        subprocess.run(command, cwd=ROOT, env=environment, check=True)
    finally:
        walks.terminate()
        walks.wait()
    return out / "round_001" / "learner"


def worth(policy):
    """Return and share of falls in the robot."""
    place = policy.parent / "worth"
    export.main(export.Args(policy=str(policy), out=place / "policy"))
    request(place, WALKS, WALK_S, 99)
    robot_stub.answer(place, robot_stub.Robot(robot_stub.Body(transport_s=LATE_S)), 0)
    steps = round(WALK_S / constants.POLICY_DT_S)
    walks = recorded.episodes(logs.read(place / "log"), steps, most=1)
    return expected.measured(recorded.beginning(walks, WALKS, steps))


@pytest.mark.slow
def test_a_policy_that_knows_the_effect_walks_where_the_other_falls(tmp_path):
    model = tmp_path / "model"
    model.mkdir()
    shutil.copy(constants.MODEL_PATH, model / "model.xml")
    late = {joint: {"seconds": LATE_S} for joint in constants.JOINTS}
    write_json(model / "effects.json", {"effects": {"command_delay": late}})
    without = worth(learnt(tmp_path / "without"))
    with_it = worth(learnt(tmp_path / "with", "--model", str(model)))
    print(f"without: {without}\nwith: {with_it}")
    assert np.isfinite(without["return"])
    assert without["fall_rate"] >= 0.8
    assert with_it["fall_rate"] <= 0.2
    assert with_it["return"] > 2 * without["return"]
