"""Rounds with a robot that answers through log files, the policy files that it plays, and a robot that stands in."""
