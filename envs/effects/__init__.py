"""What a model may lack: the library, one file per family.

An effect is a row of a family's `ROWS`; a new row is found by everything that works with the library. Effects of the
model name its fields; the others are functions of one signal on its way from the target to what is read of the joint,
in the order in which the rows stand:

    target -command-> -error-> controller -torque-> motor -transmission-> joint -sensor-> readings
                                                   friction, wrench --^
"""

from envs.effects import actuator, contact, external, inertia, joint_friction, sensing, transmission

RESIDUAL = external.RESIDUAL

LIBRARY = {
    row.name: row
    for family in (joint_friction, actuator, transmission, inertia, sensing, contact, external)
    for row in family.ROWS
}
"""Rows by name."""

EVERY = {**LIBRARY, RESIDUAL.name: RESIDUAL}
"""The library, and the torque that has no name, in the order in which they act."""
