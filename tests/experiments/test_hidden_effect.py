"""What a corrected model is worth: policies trained without and with an effect that the robot has.

The stand-in's targets arrive 10 ms late, beside all else that it has and the simulator has not; the model is the one
that discovery wrote after it had hung.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import experiments
from envs import logs
from envs.biteno import constants
from envs.targets import recorded
from experiments import expected, export, robot_stub
from experiments.robot_folder import request

WALKS, WALK_S = 20, 10.0
PACKAGE = Path(experiments.__file__).parent
FOUND = PACKAGE / "results" / "stand_in" / "found" / "model"


def learnt(out, *options):
    """The policy that a round leaves, trained on from the one that ships, masses as they are."""
    command = [sys.executable, "-m", "experiments.sim2real", "--out", str(out), "--rounds", "1", "--force"]
    command += ["--method", "dr", "--radius", "0.1", *options]
    robot = [sys.executable, "-m", "experiments.robot_stub", "--folder", str(out)]
    # Tests compile in haste, which is not worth it here.
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    out.mkdir()
    walks = subprocess.Popen(robot, cwd=PACKAGE.parent, env=environment)
    try:
        subprocess.run(command, cwd=PACKAGE.parent, env=environment, check=True)
    finally:
        walks.terminate()
        walks.wait()
    return out / "round_001" / "learner"


def worth(policy):
    """Return and share of falls in the robot."""
    place = policy.parent / "worth"
    export.main(export.Args(policy=str(policy), out=place / "policy"))
    request(place, WALKS, WALK_S, 99)
    robot_stub.answer(place, robot_stub.Robot(robot_stub.Body()), 0)
    steps = round(WALK_S / constants.POLICY_DT_S)
    walks = recorded.episodes(logs.read(place / "log"), steps, most=1)
    return expected.measured(recorded.beginning(walks, WALKS, steps))


@pytest.mark.slow
def test_a_policy_that_knows_the_effect_walks_where_the_other_falls(tmp_path):
    without = worth(learnt(tmp_path / "without"))
    with_it = worth(learnt(tmp_path / "with", "--model", str(FOUND)))
    print(f"without: {without}\nwith: {with_it}")
    assert with_it["fall_rate"] <= 0.1
    assert without["fall_rate"] >= with_it["fall_rate"] + 0.2
    assert with_it["return"] > 1.2 * without["return"]
