"""Writes a policy that a robot's computer can run without JAX: `python -m experiments.export --out DIR`.

`policy.onnx` is the network from observation to action, with its normaliser. `policy.npz` holds the same numbers for
`player.py`, which is copied beside them. Both contain, as JSON under `meta`, what a robot needs around the network: the
observation's layout and scales, the gait clock, the reference that an action is added to, joints, gains and rate.
"""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.cli import console, run
from experiments.common.config import chosen, preset
from experiments.robot.policy_files import export
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy


@dataclass(frozen=True, kw_only=True)
class Args:
    """Exports a policy to ONNX and NumPy, so that a robot's computer can run it without JAX."""

    out: Path
    """Folder of policy.onnx, policy.npz and player.py."""
    policy: str = "walk"
    """Policy: walk (ships with the package) or a folder of experiments.train."""
    preset: str = "cpu"
    """Preset that the policy was trained with: smoke, cpu or gpu."""


def main(args: Args) -> None:
    """Loads the policy and writes the three files.

    Raises:
      ValueError: the policy cannot be loaded, or the package `onnx` is not installed.
    """
    sizes = preset(args.preset)
    # Loading needs a learner, and a learner needs a parameter table; the exported files depend on none of it.
    learner = Learner(sizes, chosen("foot_friction"))
    export(args.out, starting_policy(args.policy, learner).learner, sizes)
    console.print(f"wrote policy.onnx, policy.npz and player.py to {args.out}")


if __name__ == "__main__":
    run(main, Args)
