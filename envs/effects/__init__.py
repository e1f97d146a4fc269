"""The library of effects that a model may lack, one file per family.

An effect is a row (`jaxtune.types.Effect`) of a family's `ROWS`. To add one, add a row; whatever works with the library
finds it there. An effect that enters the model names the model's fields, or is a function that changes it
(`jaxtune.types.Effect`). Every other effect is a function
`act(values, signal, now, memory) -> (signal, memory)` of the signal at one stage between the target and the reading of
a joint; `now` is `envs.chain.Now`. The stages act in the order of this drawing, the effects of one stage in the order
of their rows:

    target -command-> -error-> controller -torque-> motor -transmission-> joint -sensor-> readings
                                          friction, bristle, wrench --^

    motor's constants -back_emf-> its braking
    motor ahead of its joint -encoder-> what sensors see of that
    motor -torque_reading-> recorded torque

The stage `transmission` may take friction and damping from the joint, for they may be the motor's.

Values of zero leave the signal unchanged, so an effect is absent where its values are zero. That is why limits and
stiffnesses enter `act` as reciprocals, and ratios as logarithms.

Bounds, priors and sizes in the rows are coordinates (`jaxtune.types.Parameter`): in the unit that ends the parameter's
name, or in units of its `scale` where it has one; logarithms for ratios, reciprocals for limits and stiffnesses.
"""

from envs.effects import actuator, contact, external, inertia, joint_friction, nominal, sensing, transmission
from envs.effects.learned import LEARNED
from envs.effects.presliding import PRESLIDING
from envs.effects.transmission import JOINT_ENCODER, JOINT_LOG

LIBRARY = {
    row.name: row
    for family in (joint_friction, actuator, transmission, inertia, sensing, contact, external)
    for row in family.ROWS
}
"""All effects that can be named, by name."""

NOMINAL = {row.name: row for row in nominal.ROWS}
"""Rows that are fitted under every hypothesis and cannot be named as missing, by name."""

EVERY = {**NOMINAL, **LIBRARY, **{row.name: row for row in (PRESLIDING, JOINT_ENCODER, JOINT_LOG, LEARNED)}}
"""All rows, in the order in which they act."""
