"""Writes a policy that a robot's computer can run without JAX: `python -m experiments.export --out DIR`.

`policy.onnx` is the network from observation to action, with its normaliser. `policy.npz` holds the same numbers for
`network.py`, which is copied beside them and needs only NumPy. Both contain, as JSON under `meta`, what a robot needs
around the network: rate and layout of the observation, and for BITeno scales, gait clock, the reference that an action
is added to, joints and gains. BITeno's files include `player.py`, which does all of that.
"""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.cli import console, run
from experiments.common.config import preset
from experiments.robot.policy_files import export
from experiments.walking.learner import Learner
from experiments.walking.policies import default_policy, starting_policy
from experiments.walking.robots import kind


@dataclass(frozen=True, kw_only=True)
class Args:
    """Exports a policy to ONNX and NumPy, so that a robot's computer can run it without JAX."""

    out: Path
    """Folder of policy.onnx, policy.npz, network.py and, for biteno, player.py."""
    robot: str = "biteno"
    """Robot and task: biteno, go2, playground:NAME (an environment of MuJoCo Playground) or playground-warp:NAME (the
    same by MuJoCo Warp), or path/to/file.py:function, which returns a jaxtune.mjx.Simulator or an environment."""
    policy: str | None = None
    """Policy: walk (biteno's, ships with the package) or a folder of experiments.train."""
    preset: str = "cpu"
    """Preset that the policy was trained with: smoke, cpu or gpu."""


def main(args: Args) -> None:
    """Loads the policy and writes the files.

    Raises:
      ValueError: the policy cannot be loaded, or the package `onnx` is not installed.
    """
    robot = kind(args.robot)
    # Loading needs a learner, and a learner needs a parameter table; the exported files depend on none of it.
    learner = Learner(preset(args.preset), robot.chosen(next(iter(robot.entries))), kind=robot)
    policy = args.policy or default_policy(robot)
    if policy == "scratch":
        raise ValueError(f"policy: got {args.policy}, expected a folder of experiments.train --robot {args.robot}")
    export(args.out, starting_policy(policy, learner).learner, learner)
    files = ", ".join(sorted(file.name for file in args.out.iterdir()))
    console.print(f"{args.out} holds {files}", markup=False)


if __name__ == "__main__":
    run(main, Args)
