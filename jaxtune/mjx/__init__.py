"""Physical parameters of MuJoCo and MJX models: which may be wrong, and the model that has other values of them.

A user writes a table of `Entry` rows, one for every parameter (say the mass of both shanks), and calls `apply` with new
values. `apply` changes the fields of an `mjx.Model` inside `jit`, `vmap` or `grad`, and recomputes the fields that
depend on them (`set_const` lists them; tendons, cameras and lights stay as they were). `apply_mujoco` does the same to
a model of MuJoCo C. `to_coords` and `from_coords` translate between physical values (`Params`) and the coordinates that
`jaxtune.tuner` searches (`Coords`).

    model = apply(mjx.put_model(mujoco_model), {"shank_mass": 1.2}, table)

This package is the only one in jaxtune that imports MuJoCo; the tuner does without it.
"""

from jaxtune.mjx.derived_fields import set_const
from jaxtune.mjx.parameters import (
    Entry,
    Params,
    apply,
    apply_mujoco,
    from_coords,
    nominal,
    select,
    to_coords,
)

__all__ = ["Entry", "Params", "apply", "apply_mujoco", "from_coords", "nominal", "select", "set_const", "to_coords"]
