"""A servo that turns a pendulum: the model of a bench on which single motors are measured.

`envs.logs.read_xl330` reads public recordings of such a bench.
"""

from pathlib import Path

MODEL_PATH = Path(__file__).parent / "model.xml"
JOINTS = ("hinge",)
