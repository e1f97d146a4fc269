"""Measures how much a wrong parameter costs a policy that was not tuned: `python -m experiments.gaps --out DIR`.

If an untuned policy loses nothing, tuning has nothing to gain, so look here first. Friction, mass and motor strength
vary one at a time in MJX, and the policy walks under the task's own commands.
"""

from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from rich.table import Table

from envs.biteno import constants
from envs.targets.mjx import MjxTarget
from experiments.common import checkpoint, compiler, files, plots
from experiments.common.cli import bars, console, run
from experiments.common.config import preset
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from experiments.walking.quality import quality
from jaxtune import devices
from jaxtune.mjx import parameters

SWEEPS = {
    "friction": (("foot_friction",), (0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.9, 1.2)),
    "mass": (("trunk_mass", "abductor_mass", "thigh_mass", "shank_mass"), (0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 1.75, 2.0)),
    "motor": (("torque_scale",), (0.4, 0.5, 0.6, 0.75, 0.9, 1.0, 1.2)),
}
"""By sweep, the parameters that share one value, and the values: coefficients of friction, multiples of nominal mass
and multiples of nominal torque."""

SHOWN = {
    "return": "return of 20 s (at most 70)",
    "speed_error_mps": "speed error, m/s",
    "slip_mps": "slip, m/s",
    "falls_per_20s": "falls in 20 s",
}
"""Columns of the table and panels of the picture."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Lets a policy walk with wrong friction, mass and motor strength, and measures what that costs."""

    out: Path = Path("runs/gaps")
    """Folder of gaps.json and gaps.png."""
    policy: str = "walk"
    """Policy: walk (ships with the package), or a folder of experiments.train."""
    preset: str = "cpu"
    """Preset that the policy was trained with; it fixes the network and the length of an episode: smoke, cpu or gpu."""
    episodes: int = 32
    """Number of full-length episodes (20 s; 0.8 s with smoke) for every value of every parameter."""
    seed: int = 0
    """Random seed of commands and resets, the same for all values, so that they compare."""


def points(friction: float) -> list[tuple[str, float, dict[str, float]]]:
    """Lists the points of all sweeps, with the physical values of the simulator at each.

    Args:
      friction: the nominal coefficient; friction sweeps in coefficients, the others in multiples of nominal.

    Returns:
      (sweep, value, physical values by name) for every point.
    """
    return [
        (sweep, value, dict.fromkeys(names, value / friction if sweep == "friction" else value))
        for sweep, (names, values) in SWEEPS.items()
        for value in values
    ]


def main(args: Args) -> None:
    """Lets the policy walk at every point, prints a table, and writes gaps.json and gaps.png.

    Raises:
      ValueError: an option is wrong, or the policy cannot be loaded.
    """
    compiler.set_up(preset(args.preset).xla_flags)
    if args.episodes < 1:
        raise ValueError(f"episodes: got {args.episodes}, expected 1 or more")
    checkpoint.check_writable(args.out)
    sizes = preset(args.preset)
    entries = parameters.select(constants.ENTRIES, [name for names, _ in SWEEPS.values() for name in names])
    learner = Learner(sizes, entries)
    policy = starting_policy(args.policy, learner)
    nominal = parameters.nominal(entries)
    friction = float(learner.robot.mj_model.geom(constants.FEET[0]).friction[0])
    rows = points(friction)
    key, steps = jax.random.PRNGKey(args.seed), round(sizes.task.episode_s / constants.POLICY_DT_S)

    # Parameters are arguments, so that one compiled program serves all points.
    @devices.on_all
    @jax.jit
    def walk(policy, params):
        return MjxTarget(robot=learner.robot, params=params).record(key, learner.act(policy), args.episodes, steps)

    results = []
    with bars() as progress:
        for sweep, value, params in progress.track(rows, description="walking"):
            params = {name: np.float32(number) for name, number in (nominal | params).items()}
            results.append({"sweep": sweep, "value": value, **quality(*jax.device_get(walk(policy, params)))})

    table = Table(title=f"{args.policy}, untuned")
    for column in ("varied", "value", *SHOWN.values()):
        table.add_column(column, justify="right")
    for row in results:
        table.add_row(row["sweep"], f"{row['value']:g}", *(f"{row[name]:.2f}" for name in SHOWN))
    console.print(table)
    files.write_json(args.out / "gaps.json", {"args": args, "rows": results, "versions": checkpoint.versions()})
    plots.gaps(args.out / "gaps.png", results, SHOWN, {"friction": friction, "mass": 1.0, "motor": 1.0})


if __name__ == "__main__":
    run(main, Args)
