"""What a round predicted, measured and expects, as typed records.

The files of a run (`prediction.json`, `measured.json`, `tuning.json`, `summary.json`) hold these records in JSON;
`experiments.common.checkpoint.as_json` and `from_json` convert. Whether a robot may walk is decided by them alone.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class WalkMeans:
    """Means over walks, simulated or measured, so that a prediction and its measurement have the same fields."""

    mean_return: float = field(metadata={"key": "return"})
    """Of a walk, under the weights of Table I."""
    fall_rate: float
    """Share of walks that end in a fall."""
    power_w: float
    """Mechanical power while the robot is on its feet."""


@dataclass(frozen=True, kw_only=True)
class Prediction(WalkMeans):
    """Simulated walks of a policy on robots drawn from a distribution: what the robot's walks should be like."""

    episodes: int
    """Number of simulated walks."""


@dataclass(frozen=True, kw_only=True)
class Suspicion:
    """Something that the log doctor suspects, once for all runs that share it."""

    sentence: str
    """What is suspected, for a person."""
    runs: tuple[str, ...]
    """Names of the runs."""


@dataclass(frozen=True, kw_only=True)
class Measured(WalkMeans):
    """How the robot walked: means over the walks that it was asked for, and what the log doctor suspects of them."""

    episodes: int
    """Number of walks."""
    seconds: float
    """Time that the robot was on its feet, summed over the walks."""
    cut_short: int
    """Walks whose record ends before its time and not in a fall; they may have been falls."""
    suspected: tuple[Suspicion, ...] = ()
    """What the log doctor suspects."""

    @property
    def ended_early(self) -> int:
        """Number of walks that fell, or whose record is cut short."""
        return round(self.fall_rate * self.episodes) + self.cut_short


@dataclass(frozen=True, kw_only=True)
class Moved:
    """A parameter before and after a tuning, in physical values: multiples of nominal, or offsets with a unit."""

    before: float
    after: float
    low: float | None
    """Lower end of the calibrated interval; None where no set was accepted, or the interval leaves the simulated
    box."""
    high: float | None
    """Upper end of the interval."""


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """What a round's tuning did: every call of the gate, the update, and the tuned simulator's own prediction."""

    verdicts: tuple[str, ...]
    """Of every gate call; the last one is how the tuning ended."""
    radius: tuple[float, ...]
    """Largest radius at every call, in coordinates."""
    novelty: tuple[float | None, ...]
    threshold: tuple[float | None, ...]
    p_value: tuple[float | None, ...]
    uncovered: tuple[float | None, ...]
    """Share of measured windows without a simulated neighbour."""
    elbo: tuple[float | None, ...]
    step: dict[str, float | None]
    """Of the centre, in radii."""
    interval: dict[str, float | None]
    """Half width, in radii."""
    identifiable: dict[str, bool]
    spm_loss: float | None
    measured_falls: int
    not_finite: int
    training: dict[str, float]
    moved: dict[str, Moved]
    compared_s: float
    """How much of every walk was compared."""
    explained: Prediction
    """The same policy in the tuned simulator."""

    @property
    def verdict(self) -> str | None:
        """How the tuning ended; None where the gate was never asked (a method without a gate)."""
        return self.verdicts[-1] if self.verdicts and self.p_value[-1] is not None else None

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Parameters of which an accepted log says no more than was known before it."""
        if self.verdict != "accept":
            return ()
        return tuple(name for name, known in self.identifiable.items() if not known)


@dataclass(frozen=True, kw_only=True)
class Round:
    """One round, from the prediction before the robot walked to the one for its next walks."""

    index: int = field(metadata={"key": "round"})
    predicted: Prediction
    """Of the policy that walked, before it walked."""
    measured: Measured
    tuning: Tuning
    next_predicted: Prediction = field(metadata={"key": "next"})
    """Of the policy that was trained in what the tuning left."""
    expected_falls: float
    """Share of the next walks that are expected to end in a fall (`experiments.robot.fall_risk`)."""
