"""The guides' programs run as they are printed, with less data and training, and come closer to the truth."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import pytest
import toys

from jaxtune import tuner
from jaxtune.tuner import TunerConfig

GUIDES = Path(tuner.__file__).parent / "guides"
# Enough to see a torso that is 1.4 times as heavy.
SMALL = TunerConfig(
    episodes=160,
    held_out_sets=19,
    spm=replace(toys.SPM, window=50, train_steps=400),
    dvm=replace(toys.DVM, train_steps=100),
)


def run(guide, monkeypatch):
    """Runs the only program of a guide, and returns its variables."""
    monkeypatch.setattr(tuner, "TunerConfig", lambda: SMALL)
    monkeypatch.setattr(jax, "jit", toys.long_jit)
    (code,) = re.findall(r"```python\n(.*?)```", (GUIDES / guide).read_text(), re.DOTALL)
    scope = {}
    exec(compile(code, guide, "exec"), scope)
    return scope


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_gymnasium_environment_is_tuned(monkeypatch):
    pytest.importorskip("gymnasium", reason="needs the extra test")
    scope = run("gymnasium.md", monkeypatch)
    info = scope["info"]
    assert info.verdicts[int(info.calls) - 1] == 0
    found = scope["from_coords"](scope["TABLE"], scope["state"].dist.centre)
    for name, truth in scope["robot"].items():
        assert abs(found[name] - truth) < abs(1.0 - truth) / 2
