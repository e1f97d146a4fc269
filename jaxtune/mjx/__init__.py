"""Physical parameters of MuJoCo and MJX models, and simulated episodes of environments that have other values of them.

A table says which parameters may be wrong (say the mass of both shanks): an `Entry` for each, of which `mass`, `field`,
`strength`, `friction` and `action_delay` make the usual ones. `Simulator` takes an environment and such a table, and
gives `jaxtune.tuner` all that it needs:

    sim = Simulator(env, steps=150, parameters={"torso": mass("torso", bounds=(0.4, 2.5))})
    machine = Tuner(config=TunerConfig(), train_policy=tuner.keep, simulate=sim.simulate(act))

Beneath it, `apply` changes the fields of an `mjx.Model` inside `jit`, `vmap` or `grad`, and recomputes the fields that
depend on them (`set_const` lists them; lengths of tendons, cameras and lights stay as they were). `apply_mujoco` does
the same to a model of MuJoCo C. `to_coords` and `from_coords` translate between physical values (`Params`) and the
coordinates that the tuner searches (`Coords`).

This package is the only one in jaxtune that imports MuJoCo; the tuner does without it.
"""

from jaxtune.mjx.derived_fields import set_const
from jaxtune.mjx.entry import Entry
from jaxtune.mjx.environments import model_of, with_model
from jaxtune.mjx.episodes import Robot, replay, rollout
from jaxtune.mjx.parameters import (
    Params,
    apply,
    apply_mujoco,
    check,
    distribution,
    from_coords,
    nominal,
    select,
    to_coords,
)
from jaxtune.mjx.rows import action_delay, field, friction, mass, parameters_of, strength
from jaxtune.mjx.simulator import Simulator
from jaxtune.mjx.training import TrainingBatch

__all__ = [
    "Entry",
    "Params",
    "Robot",
    "Simulator",
    "TrainingBatch",
    "action_delay",
    "apply",
    "apply_mujoco",
    "check",
    "distribution",
    "field",
    "friction",
    "from_coords",
    "mass",
    "model_of",
    "nominal",
    "parameters_of",
    "replay",
    "rollout",
    "select",
    "set_const",
    "strength",
    "to_coords",
    "with_model",
]
