"""Walking policies: how they are trained and loaded, the simulators they walk in, and measures of how well they walk.

`learner` is the centre: it gives the tuner its functions. `cases`, `targets` and `comparison` set up tuning from one
simulator to another.
"""
