"""Finds what a simulator lacks, from measured logs: a named effect, nothing, or something that has no name.

`workflow.discover` is the door: from a `problem.Problem` (a simulator, hypotheses about what it lacks, measured
segments) to a `result.Result` (a verdict, the corrected model and its proof). `workflow` loops over `step.step`, a pure
function from one `state.State` to the next; the modules beside it are its parts. Everything is generic in the
simulator, a function of a vector of coordinates that is zero for the nominal model.
"""
