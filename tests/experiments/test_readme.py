"""The README's promises that can be run."""

import re
from pathlib import Path

import jax
import toys

README = (Path(__file__).parents[2] / "README.md").read_text()


def test_embedding_example_finds_the_friction(monkeypatch):
    # The example learns for long enough to be compiled well.
    monkeypatch.setattr(jax, "jit", toys.long_jit)
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert sum(bool(line.strip()) for line in code.splitlines()) < 20
    scope = {}
    exec(code, scope)
    # The example's target has a friction of 0.8 in log space and its tuner starts at 0.
    assert abs(float(scope["state"].dist.centre["friction"]) - 0.8) < 0.1
