"""Commands in processes of their own, and whether two runs of them found the same."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np

from experiments.common.config import PRESETS
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from experiments.walking.robots import kind

ROOT = Path(__file__).parents[1]
ROBOT = f"{ROOT / 'tests' / 'sled.py'}:simulator"
# A checkpoint after every chunk of updates, not every minute.
TRAIN = "from experiments.walking import policies; policies._KEEP_S = 0.0; from experiments import train as command"
SIM2SIM = "from experiments import sim2sim as command"
SIM2REAL = "from experiments import sim2real as command"
DISCOVER = "from experiments import discover as command"
STUB = "from experiments import robot_stub as command"


def start(imports, options, environment=None):
    code = f"import sys; {imports}; from experiments.common.cli import run; run(command.main, command.Args)"
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code, *options],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def end(process):
    error = process.communicate()[1].decode()
    assert process.returncode == 0, error


def same(found, expected, rounding=0.0):
    """Whether two results are equal, numbers to a rounding, but for what depends on the clock."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for name in expected.keys() - {"seconds", "wall_s", "versions", "out", "args"}:
            same(found[name], expected[name], rounding)
    elif isinstance(expected, list):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            same(*pair, rounding)
    elif isinstance(expected, float):
        np.testing.assert_allclose(found, expected, rtol=rounding, atol=rounding)
    else:
        assert found == expected


def read(path):
    return json.loads(path.read_text())


def networks(policy):
    """Arrays of a policy of the test robot, all that training goes on with."""
    robot = kind(ROBOT)
    learner = Learner(PRESETS["smoke"], robot.chosen(None), kind=robot)
    return [np.asarray(leaf) for leaf in jax.tree.leaves(starting_policy(str(policy), learner).learner)]
