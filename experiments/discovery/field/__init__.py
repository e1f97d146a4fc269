"""The benchmark of robots that discovery has not met: every case is another robot, motion, noise and generator.

`robots` and `motions` draw the robots and what they do, `plants` simulates their bodies in three engines, `playing`
adds controller, friction and sensors, `forms_*` hold every effect in the formula of one generator, `severity` finds how
large an effect must be, `cases` says what is hidden how often, and `bench` writes, answers and scores.

Nothing here imports `envs.effects`, `envs.chain` or `envs.rig`: a benchmark that shares formulas with the fitter
measures the sharing.
"""
