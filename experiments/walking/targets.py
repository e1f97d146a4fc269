"""The simulators that can be the target of a tuning or an evaluation, by the name that `--target` takes."""

from collections.abc import Callable, Mapping

from envs.biteno import Biteno
from envs.targets import mujoco_c
from envs.targets.mjx import MjxTarget
from envs.targets.protocol import Target


def _bullet(robot: Biteno, params: Mapping[str, float]) -> Target:
    # Imported late, because PyBullet is an optional dependency.
    from envs.targets import bullet

    return bullet.target(robot, params)


TARGETS: dict[str, Callable[[Biteno, Mapping[str, float]], Target]] = {
    "mjx": lambda robot, params: MjxTarget(robot=robot, params=params),
    "mujoco_c": mujoco_c.target,
    "bullet": _bullet,
}
"""Functions `(robot, physical values by name) -> target`, by engine: MJX, MuJoCo C, or PyBullet (extra `bullet`).
All three share one observation function, PD law and reward."""
