"""The cases of the blind benchmark: which robots, effects and severities, and how many of each, by size."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from envs.biteno import constants
from envs.effects import LIBRARY
from experiments.discovery.blind_robots import OUTSIDE
from experiments.discovery.scores import SEVERITIES

ARM = Path(__file__).parents[1] / "arm.xml"
"""The two-joint arm that is the example of a user's own robot."""

SIZE_BOUNDS = {
    "coulomb": (0.01, 10.0),
    "viscous": (0.01, 20.0),
    "stribeck": (0.01, 20.0),
    "load_friction": (0.01, 0.8),
    "command_delay": (0.001, 0.04),
    "target_slew": (20.0, 0.3),
    "gain_error": (0.98, 0.3),
    "deadband": (0.001, 0.15),
    "torque_speed": (0.1, 20.0),
    "torque_limit": (60.0, 0.5),
    "torque_lag": (0.001, 0.06),
    "torque_scale": (0.98, 0.3),
    "backlash": (0.001, 0.15),
    "compliance": (5000.0, 10.0),
    "armature": (0.001, 0.5),
    "link_mass": (1.02, 3.0),
    "com_offset": (0.001, 0.12),
    "payload": (0.01, 4.0),
    "encoder_bias": (0.0005, 0.2),
    "sensor_delay": (0.001, 0.04),
    "sensor_lag": (0.001, 0.06),
    "drag": (0.1, 100.0),
    "constant_push": (0.01, 15.0),
    "joint_spring": (0.01, 50.0),
    "cogging": (0.02, 15.0),
    "temperature_fade": (0.02, 0.9),
    "detent": (0.1, 500.0),
    "loose_foot": (0.01, 1.5),
}
"""Sizes between which a severity is searched, in the unit of the effect's first parameter. The harmless size is first,
so for a limit or a stiffness it is the larger one."""


@dataclass(frozen=True)
class Case:
    """One robot of the benchmark with its hidden effect; its place and size are drawn by `Bench.truth`."""

    number: int
    """Position in the shuffled list of cases; it names the files."""
    effect: str | None
    """Name of the hidden effect; None hides nothing."""
    severity: float
    """Intended size of the effect's trace in the log, in floor units; zero if nothing is hidden."""


@dataclass(frozen=True)
class Size:
    """One size of the benchmark: the robot, the length of its logs, and how often what is hidden."""

    model: str
    """Name of a built-in robot, or path of an MJCF file."""
    joints: tuple[str, ...]
    """Names of the joints, in the log's order."""
    gains: tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
    """kp in Nm/rad, kd in Nm s/rad and torque limit in Nm, one for every joint."""
    runs: int
    """Number of runs in a log."""
    seconds: float
    """Length of a run in s."""
    hidden: tuple[tuple[str, float], ...]
    """Effects of the library that are hidden, a case each, with their severity in floor units."""
    empty: int
    """Number of cases that hide nothing, to count false alarms."""
    outside: tuple[tuple[str, float], ...]
    """Effects outside the library, a case each, with their severity; the right answer is `unnamed`."""
    null_logs: int
    """Number of simulated null logs, which set the noise floor and the thresholds."""


def _spread(names: Sequence[str], count: int) -> tuple[tuple[str, float], ...]:
    """Pairs effects in turn with severities in turn, one on in every round of the effects."""
    size, rounds = len(names), len(SEVERITIES)
    return tuple((names[i % size], SEVERITIES[(i + i // size) % rounds]) for i in range(count))


# Where velocities lag they are not compared, so such a log has no severity beside one without the effect. How the base
# is mounted is no effect of the robot, and has no joint to be found at.
_HIDDEN = tuple(name for name, row in LIBRARY.items() if not row.needs and row.on != "robot" and name != "velocity_lag")
_ARM = (str(ARM), ("shoulder", "elbow"), ((40.0, 20.0), (2.0, 0.8), (15.0, 15.0)))
_BITENO = ("biteno", constants.JOINTS, ((60.0,) * 6, (2.0,) * 6, (60.0,) * 6))
SIZES = {
    "smoke": Size(
        *_ARM, 6, 2.0, (("coulomb", 15.0), ("command_delay", 15.0), ("payload", 15.0), ("torque_scale", 15.0)), 2, (), 6
    ),
    "arm": Size(*_ARM, 6, 3.0, _spread(_HIDDEN, 46), 20, _spread(OUTSIDE[:3], 9), 20),
    "standard": Size(*_BITENO, 6, 3.0, _spread(_HIDDEN, 48), 40, _spread(OUTSIDE, 10), 20),
    "full": Size(
        *_BITENO,
        12,
        5.0,
        tuple((name, severity) for name in _HIDDEN for severity in SEVERITIES for _ in range(5)),
        100,
        _spread(OUTSIDE, 24),
        40,
    ),
}
"""Sizes by the name that `--size` takes: `smoke` for CI, `arm` for an hour, `standard` for a night on a CPU, `full` for
a GPU or a few nights."""
