"""What all commands share: the command line, sizes of runs, checkpoints, report pages and plots.

No module here knows a particular command, so that `walking`, `discovery` and `robot` can all stand on it.
"""
