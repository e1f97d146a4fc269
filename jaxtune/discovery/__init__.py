"""Names what a simulator lacks, or says that nothing or something unnamed does.

`workflow.discover` is the driver; the steps are those of the modules beside it. Everything is generic in the simulator,
a function of a vector of coordinates that is zero for the nominal model.
"""
