"""How many of a robot's next walks are expected to end in a fall, and whether simulation may be believed about it.

Falls are what a robot pays with, so simulation alone counts only where it has earned it: where the gate has accepted
the last log, and where the tuned simulator has the policy that walked fall about as often as it did. Elsewhere what
was measured is expected again.
"""

from scipy.stats import binom

from envs.biteno import constants
from envs.targets.recorded import Recorded, whole
from experiments.robot.records import Measured, Prediction, Suspicion, Tuning
from experiments.walking.learner import summarise_walks

_SURPRISE = 0.2
"""Smallest p-value at which measured falls agree with simulation. It is large because a handful of walks can rule out
little: believing a simulator that they merely fail to contradict may cost a robot, doubting it costs one walk."""


def summarise_log(recorded: Recorded, steps: int, suspected: tuple[Suspicion, ...] = ()) -> Measured:
    """Summarises the walks of a log, each to its own end.

    Args:
      recorded: episodes of the log.
      steps: policy steps that a walk was asked to last.
      suspected: what the log doctor says of the log.
    """
    walks, power = whole(recorded, steps)
    means = summarise_walks(walks, power)
    return Measured(
        mean_return=float(means["return"]),
        fall_rate=float(means["fall_rate"]),
        power_w=float(means["power_w"]),
        episodes=len(walks.fell),
        seconds=float(walks.alive.sum()) * constants.POLICY_DT_S,
        cut_short=int((~walks.alive[:, -1] & ~walks.fell).sum()),
        suspected=suspected,
    )


def surprise(measured: Measured, simulated: Prediction) -> float:
    """Returns the probability of as many falls as were measured, or more, if the tuned simulator were right.

    A binomial tail, `P(X >= k)` for `X ~ Binomial(n, p)` with the k falls of n walks. The simulated rate p is Laplace's
    `(falls + 1) / (episodes + 2)`, because few simulated walks without a fall do not make falls impossible.
    """
    rate = (simulated.fall_rate * simulated.episodes + 1) / (simulated.episodes + 2)
    return float(binom.sf(measured.ended_early - 1, measured.episodes, rate))


def fall_risk(predicted: Prediction, measured: Measured | None = None, tuning: Tuning | None = None) -> float:
    """Returns the share of the next walks that are expected to end in a fall.

    Where the gate has accepted the last log and its falls agree with the tuned simulator, that is the simulated rate.
    Else it is the larger of the simulated and the measured rate; a record that is cut short counts as a fall. Before
    anything was measured there is nothing but simulation.

    Args:
      predicted: simulated walks of the policy that is to walk.
      measured: the last walks of the robot, if there were any.
      tuning: what was learnt from them.
    """
    if measured is None or tuning is None:
        return predicted.fall_rate
    if tuning.verdict == "accept" and surprise(measured, tuning.explained) >= _SURPRISE:
        return predicted.fall_rate
    return max(predicted.fall_rate, measured.ended_early / measured.episodes)
