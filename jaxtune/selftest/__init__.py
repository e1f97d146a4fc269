"""The self-test: what would a tuning tell of this robot, walked by this policy for so many episodes?

Before a robot walks, simulated robots of known parameters are measured in its place:

    report = selftest.run(jax.random.key(0), machine, state, others={"torque": {"torque_scale": -0.29}})
    print(selftest.summary(report))

It counts how often the gate rejects robots that the distribution could have drawn (false alarms), robots that lie
outside it by one radius in one coordinate, and robots of which something else is different (power); how far estimates
are off, and how often the intervals of all coordinates hold together (coverage). A parameter whose power is low is one
that this walk does not show: walk differently, or for more episodes.
"""

from jaxtune.selftest.report import INSIDE, Rate, SelfTest, Tuned, summary, whole_tunings
from jaxtune.selftest.robots import Keep, run

__all__ = ["INSIDE", "Keep", "Rate", "SelfTest", "Tuned", "run", "summary", "whole_tunings"]
