"""The guides' programs run as they are printed, with less data and training, and come closer to the truth."""

import re
import sys
import types
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import sled
import toys

from jaxtune import tuner
from jaxtune.tuner import TunerConfig

GUIDES = Path(tuner.__file__).parent / "guides"
# Enough to see a torso that is 1.4 times as heavy.
SMALL = TunerConfig(
    episodes=160,
    held_out_sets=19,
    dvm=replace(toys.DVM, train_steps=100),
)


def run(guide, monkeypatch, small=SMALL, programs=slice(-1, None)):
    """Runs the last program of a guide, or those that go on from each other, and returns their variables."""
    monkeypatch.setattr(tuner, "TunerConfig", lambda **sizes: replace(small, **sizes))
    # Options of the compiler are for the program as a whole, not for what is jitted in it.
    jit, whole = jax.jit, ("tune", "run")
    monkeypatch.setattr(
        jax, "jit", lambda f, **options: (toys.long_jit if getattr(f, "__name__", "") in whole else jit)(f, **options)
    )
    code = "\n".join(re.findall(r"```python\n(.*?)```", (GUIDES / guide).read_text(), re.DOTALL)[programs])
    scope = {}
    exec(compile(code, guide, "exec"), scope)
    info = scope["info"]
    assert info.verdicts[int(info.calls) - 1] == 0
    return scope


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_gymnasium_environment_is_tuned(monkeypatch):
    pytest.importorskip("gymnasium", reason="needs the extra test")
    scope = run("gymnasium.md", monkeypatch, programs=slice(1))
    found = scope["from_coords"](scope["TABLE"], scope["state"].dist.centre)
    for name, truth in scope["robot"].items():
        assert abs(found[name] - truth) < abs(1.0 - truth) / 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_gymnasium_environment_is_tuned_from_its_states(monkeypatch):
    pytest.importorskip("gymnasium", reason="needs the extra test")
    scope = run("gymnasium.md", monkeypatch, programs=slice(None))
    found = scope["from_coords"](scope["TABLE"], scope["state"].dist.centre)
    for name, truth in scope["robot"].items():
        assert abs(found[name] - truth) < 2e-3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
def test_a_brax_environment_is_tuned(monkeypatch):
    scope = run("brax.md", monkeypatch)
    found = scope["sim"].physical(scope["state"].dist)
    assert abs(found["motor"]["value"] - 0.8) < 0.1
    assert 1.0 < found["pole"]["value"] < 2.0


@pytest.mark.slow
def test_a_playground_environment_is_tuned(monkeypatch):
    pytest.importorskip("mujoco_playground", reason="needs the extra playground")
    scope = run("playground.md", monkeypatch)
    found = scope["sim"].physical(scope["state"].dist)
    assert abs(found["torso"]["value"] - 1.4) < 0.2


@pytest.mark.slow
def test_logs_alone_are_tuned_to(monkeypatch, tmp_path):
    sim = sled.simulator()
    robot = types.ModuleType("my_robot")
    robot.simulator, robot.policy = sled.simulator, 3.0
    robot.act = lambda policy, obs, key: jax.numpy.sin(policy * (1.0 + 9.0 * obs[:1])) + 0.5
    truth = {"mass": 1.4}
    walks = sim.measure(robot.act, truth, 5)(jax.random.key(3), robot.policy)
    (tmp_path / "log").mkdir()
    for number, (obs, action) in enumerate(zip(walks.obs, walks.action, strict=True)):
        time = sim.env.dt * np.arange(sim.steps)
        np.savez(tmp_path / "log" / f"run_{number}.npz", **{"t": time, "obs": obs, "action.push": action[:, 0]})
    (tmp_path / "log" / "meta.yaml").write_text("robot: my robot\nrate_hz: 50\njoints: [push]\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "my_robot", robot)
    scope = run("logs.md", monkeypatch)
    found = scope["sim"].physical(scope["state"].dist)
    # Strength and mass trade against each other in all but what friction and start show.
    assert abs(found["mass"]["value"] / found["strength"]["value"] - 1.4) < 0.15


def written(page):
    """Lines of a page's first program that are neither empty nor imports."""
    first, *_ = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    return [line for line in first.splitlines() if line.strip() and not line.startswith(("import ", "from "))]


def test_the_readmes_example_is_the_guides_and_short():
    glue, guide = written(GUIDES.parents[1] / "README.md"), written(GUIDES / "playground.md")
    assert "sim = Simulator(" in glue
    assert [line for line in glue if line not in guide] == []
    # The names of the joints are left out there; the rest is the policy and a robot that stands in for the user's.
    (names,) = [line for line in guide if line.startswith("LEG = ")]
    assert names not in glue
    assert len([*glue, names]) <= 20


def test_a_gymnasium_target_takes_few_lines():
    assert len(written(GUIDES / "gymnasium.md")) <= 25
