"""A servo that turns a pendulum: the model of the bench on which single motors are measured (`envs.logs.xl330`)."""

from pathlib import Path

MODEL_PATH = Path(__file__).parent / "model.xml"
JOINTS = ("hinge",)
