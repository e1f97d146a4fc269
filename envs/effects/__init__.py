"""The library of effects that a model may lack, one file per family.

An effect is a row (`jaxtune.types.Effect`) of a family's `ROWS`; a row added there is found by everything that works
with the library. An effect that enters the model names the model's fields. Every other effect is a function
`act(values, signal, now, memory) -> (signal, memory)` of the signal at one stage between the target and the reading of
a joint; `now` is `envs.chain.Now`. The stages, and within each stage the rows, act in this order:

    target -command-> -error-> controller -torque-> motor -transmission-> joint -sensor-> readings
                                                   friction, wrench --^

A value that enters `act` is zero where the effect is not there, and then the signal passes unchanged.
"""

from envs.effects import actuator, contact, external, inertia, joint_friction, sensing, transmission

RESIDUAL = external.RESIDUAL
"""The torque that stands for whatever the library has no name for; not a hypothesis (`envs.effects.external`)."""

LIBRARY = {
    row.name: row
    for family in (joint_friction, actuator, transmission, inertia, sensing, contact, external)
    for row in family.ROWS
}
"""All effects that can be named, by name."""

EVERY = {**LIBRARY, RESIDUAL.name: RESIDUAL}
"""The library and the residual torque, in the order in which they act."""
