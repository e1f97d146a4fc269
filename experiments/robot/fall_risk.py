"""Estimates how many of a robot's next walks will end in a fall, before they are requested.

A fall may break a robot, so the simulated fall rate alone is used only under two conditions. The gate has accepted the
last log, and in the tuned simulator the policy that walked falls about as often as it did on the robot. Otherwise the
expected rate is at least the measured one.
"""

from scipy.stats import binom

from envs.targets.recorded import Recorded, whole
from experiments.robot.records import Measured, Prediction, Suspicion, Tuning
from experiments.walking.learner import summarise_walks

_SURPRISE = 0.2
"""Smallest p-value at which measured falls count as agreeing with simulation. It is large because a handful of walks
can refute little: to trust a wrong simulator may cost a robot, to doubt a right one costs a few walks."""


def summarise_log(recorded: Recorded, steps: int, control_s: float, suspected: tuple[Suspicion, ...] = ()) -> Measured:
    """Summarises the walks of a log: return, falls, power, and records that end too early.

    Args:
      recorded: episodes of the log.
      steps: policy steps of a walk as it was requested.
      control_s: length of a policy step in s.
      suspected: findings of the log doctor, which are passed on to the report.
    """
    walks, power = whole(recorded, steps)
    means = summarise_walks(walks, power)
    return Measured(
        mean_return=float(means["return"]),
        fall_rate=float(means["fall_rate"]),
        power_w=float(means["power_w"]),
        episodes=len(walks.fell),
        seconds=float(walks.alive.sum()) * control_s,
        cut_short=int((~walks.alive[:, -1] & ~walks.fell).sum()),
        suspected=suspected,
    )


def surprise(measured: Measured, simulated: Prediction) -> float:
    """Returns the probability of as many falls as were measured, or more, if the tuned simulator were right.

    It is the binomial tail `P(X >= k)`, `X ~ Binomial(n, p)`, where k of the n measured walks fell. The simulated rate
    is p = (falls + 1) / (episodes + 2), Laplace's rule of succession: a few simulated walks without a fall do not make
    falls impossible.

    Args:
      measured: the robot's walks.
      simulated: walks of the same policy in the tuned simulator.
    """
    rate = (simulated.fall_rate * simulated.episodes + 1) / (simulated.episodes + 2)
    return float(binom.sf(measured.ended_early - 1, measured.episodes, rate))


def fall_risk(predicted: Prediction, measured: Measured | None = None, tuning: Tuning | None = None) -> float:
    """Returns the share of the next walks that are expected to end in a fall, which decides whether they are requested.

    If the gate has accepted the last log and its falls agree with the tuned simulator, this is the simulated rate.
    Otherwise it is the larger of the simulated and the measured rate; a record that is cut short counts as a fall.
    Before anything was measured, only the simulated rate is available.

    Args:
      predicted: simulated walks of the policy that is to walk.
      measured: the last walks of the robot, if there were any.
      tuning: what was learnt from them.

    Returns:
      A share between 0 and 1.
    """
    if measured is None or tuning is None:
        return predicted.fall_rate
    if tuning.verdict == "accept" and surprise(measured, tuning.explained) >= _SURPRISE:
        return predicted.fall_rate
    return max(predicted.fall_rate, measured.ended_early / measured.episodes)
