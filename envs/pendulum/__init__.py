"""A servo that turns a pendulum: the bench for one joint."""

from pathlib import Path

MODEL_PATH = Path(__file__).parent / "model.xml"
JOINTS = ("hinge",)
