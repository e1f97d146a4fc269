"""Rounds with a robot that answers through log files, the policy files that it runs, and a simulated stand-in for it.

`transfer` is a whole run, `rounds` plays one round after the other, and `records` holds what they measured and predict.
"""
