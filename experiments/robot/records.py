"""Typed records of what a round predicted, measured and learnt.

The files of a run (`prediction.json`, `measured.json`, `tuning.json`, `summary.json`) hold these records as JSON;
`experiments.common.files.as_json` and `from_json` convert. The decision whether a robot may walk uses nothing
else.
"""

from dataclasses import dataclass, field

from jaxtune.explain import DOUBTFUL, Combination


@dataclass(frozen=True, kw_only=True)
class WalkMeans:
    """Means over walks, the same for simulated and measured ones, so that they compare."""

    mean_return: float | None = field(metadata={"key": "return"})
    """Return of a walk, BITeno's with the reward weights of the paper's Table I; None where no reward was recorded."""
    fall_rate: float
    """Share of walks that end in a fall."""
    power_w: float | None
    """Mechanical power in W while the robot is on its feet; None where it is not known."""


@dataclass(frozen=True, kw_only=True)
class Prediction(WalkMeans):
    """A policy's simulated walks on robots drawn from a distribution, which predict the robot's walks."""

    episodes: int
    """Number of simulated walks."""


@dataclass(frozen=True, kw_only=True)
class Suspicion:
    """A suspicion of the log doctor, such as a flipped sign, listed once for all runs that share it."""

    sentence: str
    """The suspicion as a sentence for a person."""
    runs: tuple[str, ...]
    """Names of the runs that share it."""


@dataclass(frozen=True, kw_only=True)
class Measured(WalkMeans):
    """Summary of a robot's log: how it walked, and what is suspicious in its records."""

    episodes: int
    """Number of walks."""
    seconds: float
    """Time in s that the robot was on its feet, summed over the walks."""
    cut_short: int
    """Number of records that end too early although no fall was seen. They may have been falls."""
    suspected: tuple[Suspicion, ...] = ()
    """Suspicions of the log doctor."""

    @property
    def ended_early(self) -> int:
        """Number of walks that fell or whose record is cut short, which is how many count as falls."""
        return round(self.fall_rate * self.episodes) + self.cut_short


@dataclass(frozen=True, kw_only=True)
class Moved:
    """A parameter before and after a tuning, in physical values (mostly multiples of nominal)."""

    before: float
    after: float
    low: float | None
    """Lower end of the calibrated 90 % interval. None if no set was accepted, or if the interval reaches past the
    simulated range."""
    high: float | None
    """Upper end of the interval."""


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """How much of a signal no parameters explain, in multiples of what is usual."""

    times: float
    """Over the whole motion: `jaxtune.misfits.Misfits.channels`."""
    phases: tuple[float | None, ...]
    """Of its mean in each phase: of the gait, from the beginning of the left foot's stance on, or of the compared time
    if the robot has no clock; None where it did not stand so long."""


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """What a round's tuning did: every call of the gate, the update, and the tuned simulator's own prediction."""

    verdicts: tuple[str, ...]
    """Verdict of every gate call; the last one says how the tuning ended."""
    radius: tuple[float, ...]
    """Largest radius of any parameter at every call, in coordinates."""
    novelty: tuple[float | None, ...]
    """How unlike simulated sets the measured one is at every call: 0 for the median of them, 1 for one in ten."""
    threshold: tuple[float | None, ...]
    """Novelty above which the gate rejects, at every call."""
    p_value: tuple[float | None, ...]
    """Conformal p-value at every call; None for a method without a gate."""
    comparable: tuple[bool, ...]
    """Whether there was enough to compare, at every call."""
    cover: tuple[float | None, ...]
    """The four excesses of `jaxtune.gate.calibrated_gate` at every call; the largest is the novelty."""
    lost: tuple[float | None, ...]
    misfit: tuple[float | None, ...]
    beyond: tuple[float | None, ...]
    uncovered: tuple[float | None, ...]
    """Share of measured windows without a simulated neighbour, at every call."""
    elbo: tuple[float | None, ...]
    """Evidence lower bound that the verification model reached in training, in nats per window, at every call."""
    step: dict[str, float | None]
    """How far the centre moved, by parameter, in radii."""
    interval: dict[str, float | None]
    """Half width of the interval, by parameter, in radii."""
    identifiable: dict[str, bool]
    """Whether the log narrows a parameter down."""
    weak: tuple[str, ...]
    """Parameters whose estimates err by more than half of what no data would leave."""
    together: tuple[Combination, ...]
    """Sums of such parameters that are known better, in coordinates."""
    update_loss: float | None
    """How badly the update's model fits (`jaxtune.update.UpdateInfo.loss`)."""
    fit_p_value: float | None
    """Conformal p-value of misfit and reach in the distribution that was read last."""
    misfit_p_value: float | None
    """That of misfit alone; at most 0.01 where the verdict is `unexplained`."""
    replay_p_value: float | None
    """Conformal p-value of misfit from measured states; None where a log does not hold them."""
    past_p_value: float | None
    """That of what contradicts earlier rounds; None where they said nothing."""
    pooled: bool
    """Whether earlier rounds count in the estimate."""
    replayed: bool
    """Whether the estimate was found from measured states."""
    measured_falls: int
    """Number of falls in the part of the walks that was compared."""
    not_finite: int
    """Number of episodes with values that are not finite."""
    training: dict[str, float]
    """Metrics of the policy's training; empty here, because a round trains after its tuning."""
    moved: dict[str, Moved]
    """Every parameter before and after."""
    compared_s: float
    """How many seconds of every walk were compared, from its start."""
    misfits: dict[str, Misfit]
    """Signals that no parameters explain, the worst first; none unless the log was rejected or is doubtful."""
    explained: Prediction
    """Prediction for the policy that walked, in the tuned simulator; it should agree with the measurement."""

    @property
    def verdict(self) -> str | None:
        """How the tuning ended; None for a method without a gate."""
        return self.verdicts[-1] if self.verdicts and self.p_value[-1] is not None else None

    @property
    def doubtful(self) -> bool:
        """Whether an accepted log fits so badly in the distribution that was read last that estimates are in doubt."""
        return self.verdict == "accept" and self.fit_p_value is not None and self.fit_p_value <= DOUBTFUL

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Parameters that an accepted log does not narrow down; they stay where they were."""
        if self.verdict != "accept":
            return ()
        return tuple(name for name, known in self.identifiable.items() if not known)


@dataclass(frozen=True, kw_only=True)
class Round:
    """One round, from the prediction before the robot walked to the prediction for its next walks."""

    index: int = field(metadata={"key": "round"})
    """Number of the round, from 0."""
    predicted: Prediction
    """Prediction for the policy that walked, made before it walked."""
    measured: Measured
    """How the robot walked."""
    tuning: Tuning
    """What was learnt from these walks."""
    next_predicted: Prediction = field(metadata={"key": "next"})
    """Prediction for the next walks, with the policy that was trained in the tuned distribution."""
    expected_falls: float
    """Share of the next walks that are expected to end in a fall (`experiments.robot.fall_risk`)."""
