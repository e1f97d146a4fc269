"""Models of robots with other parameters, for the implementation of MJX that simulates them.

MuJoCo Warp has some fields once for all robots, and none of the stages that make derived fields. So the fields of its
robots are computed by MJX's JAX implementation.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import mujoco
from mujoco import mjx

from jaxtune.mjx import parameters
from jaxtune.mjx.derived_fields import DERIVED
from jaxtune.mjx.entry import Entry
from jaxtune.mjx.parameters import Params


@dataclass(frozen=True)
class Engine:
    """A nominal model, and a table of what may differ from it between robots.

    Attributes:
      env: the environment that has it. For Warp it needs the MuJoCo model in `mj_model`.
      model: the nominal one, in the implementation that simulates.
      table: the parameters, by name.
    """

    env: Any
    model: mjx.Model
    table: Mapping[str, Entry]

    @property
    def is_warp(self) -> bool:
        """Whether MuJoCo Warp simulates."""
        return getattr(self.model, "impl", None) == mjx.Impl.WARP

    def check(self) -> None:
        """Checks that the table can change the model, and that robots side by side may differ in what it changes.

        Raises:
          ValueError: a parameter cannot.
        """
        parameters.check(self.nominal, self.table)
        if not self.is_warp:
            return
        for name, entry in self.table.items():
            for changed in sorted(set(entry.field_names) - set(self.written(self.table))):
                raise ValueError(
                    f"parameter '{name}', fields: got '{changed}', which MJX's Warp implementation has once for all "
                    "robots; expected another field, or an environment with impl='jax'"
                )

    @cached_property
    def nominal(self) -> mjx.Model:
        """The nominal model in the implementation whose stages JAX traces, which make the derived fields."""
        if not self.is_warp:
            return self.model
        source = getattr(self.env, "mj_model", None)
        if not isinstance(source, mujoco.MjModel):
            raise ValueError(
                f"env: got {type(self.env).__name__} with a model of impl='warp' but no mj_model, expected the MjModel "
                "that it was made of, or impl='jax'"
            )
        made = mjx.put_model(source, impl="jax")
        # What was changed after the model was made counts.
        return made.tree_replace(self._fields_of(self.model))

    def robot(self, params: Params) -> mjx.Model:
        """Makes the model that has these physical values; those that are left out are nominal."""
        model = parameters.apply(self.nominal, params, self.table)
        return self.model.tree_replace(self._fields_of(model)) if self.is_warp else model

    def written(self, table: Mapping[str, Entry]) -> tuple[str, ...]:
        """Lists the fields that differ between robots: those of a table, and what follows from them."""
        every = {*DERIVED, *(changed for entry in table.values() for changed in entry.field_names)}
        if self.is_warp:
            # Warp reads neither the diagonal of the inertia nor its mean.
            from mujoco.mjx.warp import types

            every = {name for name in every if types._BATCH_DIM["Model"].get(name.replace(".", "__"))}
        return tuple(sorted(every))

    def _fields_of(self, model: mjx.Model) -> dict[str, jax.Array]:
        return {name: value_of(model, name) for name in self.written(self.table)}


def value_of(model: mjx.Model, path: str) -> jax.Array:
    """Reads a field of a model by its path, such as `stat.meaninertia`."""
    for name in path.split("."):
        model = getattr(model, name)
    return model
