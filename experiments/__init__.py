"""The commands of jaxtune, one module each: `python -m experiments` lists them.

What commands share is in four packages: `common` (command line, configs, checkpoints, reports and plots), `walking`
(policies of BITeno and the simulators that they walk in), `discovery` (from measured logs to names of missing effects)
and `robot` (rounds with a robot that answers through files). A command imports packages and never another command.
"""

import contextlib
import io
import signal
import sys

# The imports of a command take seconds, in which Ctrl-C would print a long traceback or be swallowed by JAX. It ends
# the command at once instead, until `experiments.common.cli.run` can say how to go on.
if f"-m {__name__}." in " ".join(sys.orig_argv) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

# MJX prints two lines about an optional engine (warp) on its first import; they would head every command's output.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401
