"""Records of the walking task: its settings, the robot's state, and what an engine is given and answers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import chex
import jax

from envs.biteno import constants


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Settings of the walking task; defaults are the paper's where it has one.

    Checked by `Biteno`, which raises a ValueError naming the field.
    """

    physics: Literal["exact", "fast"] = "exact"
    """`exact`: 10 sub-steps of 1 ms. `fast`: 5 of 2 ms with fewer solver iterations; policies trained with it walk at 1
    ms as well."""
    base: Literal["stand", "raibert"] = "stand"
    """What an action is added to: the standing pose, or Raibert's reference."""
    action_scale: float = 0.25
    """Joint target in rad per unit of action."""
    noise: float = 0.0
    """Factor on the observation noise of `sensing.NOISE`; zero is none."""
    weights: Mapping[str, float] = field(default_factory=lambda: dict(constants.WALKING))
    """Trained reward: weight of every term of Table I."""
    shaping: Mapping[str, float] = field(default_factory=lambda: dict(constants.SHAPING))
    """Trained reward: weight of terms beside Table I (`rewards.shaping`)."""
    termination_cost: float = 1.0
    """Subtracted from the trained reward at a fall."""
    episode_s: float = 20.0
    """Time limit of an episode."""
    command_s: float = 5.0
    """Time between two commands."""
    command_max: tuple[float, float, float] = (1.0, 0.3, 0.8)
    """Largest command forward in m/s, sideways in m/s, turning in rad/s."""
    zero_command_share: float = 0.1
    """Share of commands that are zero."""
    push_mps: float = 0.0
    """Speed that a push adds to the trunk, in a random horizontal direction."""
    push_s: float = 4.0
    """Time between two pushes."""


@chex.dataclass(frozen=True)
class State:
    """One robot between two policy steps: everything that the next step depends on, and what the last one earned."""

    qpos: jax.Array  # [13]
    qvel: jax.Array  # [12]
    qacc_warmstart: jax.Array  # [12] accelerations from which the solver starts
    command: jax.Array  # [3] m/s, m/s, rad/s, of the next step
    phase: jax.Array  # [2] cycles
    action: jax.Array  # [6], the last one, clipped
    joint_error: jax.Array  # [6] rad, last target less the joint's reading
    obs: jax.Array  # [40], from which the policy chooses the next action
    reward: jax.Array  # trained reward
    score: jax.Array  # reward under the weights of Table I
    done: jax.Array  # 1 where the robot fell or is not finite
    not_finite: jax.Array  # 1 where the simulation broke
    steps: jax.Array  # policy steps since the reset
    terms: dict  # unweighted terms of Table I, and of the shaping that has a weight
    key: jax.Array
    memory: dict = field(default_factory=dict)  # of effects, by name (`envs.corrected`); empty for the nominal robot


@chex.dataclass(frozen=True)
class Drive:
    """Joint targets of one policy step, as an action sets them.

    `Biteno.drive` makes it. An engine reads `targets`; `Biteno.settle` reads the other fields.
    """

    action: jax.Array  # [6] clipped
    target: jax.Array  # [6] rad, as the policy means it
    targets: jax.Array  # [substeps, 6] rad, that act at each sub-step: within the joints' ranges, after the delay
    reference: jax.Array  # [6] rad, Raibert's q*


@chex.dataclass(frozen=True)
class Motion:
    """Where an engine leaves the robot after a policy step.

    Every engine must return one (`Biteno.simulate`, `envs.targets.host.Engine`); `Biteno.settle` reads it.
    """

    qpos: jax.Array  # [13] m, quaternion (w, x, y, z) and rad, in MuJoCo's order
    qvel: jax.Array  # [12] m/s in the world, rad/s in the trunk, rad/s
    qacc_warmstart: jax.Array  # [12]; zeros where the engine keeps its own
    torque: jax.Array  # [6] Nm, of the last sub-step
    foot_force: jax.Array  # [2, 3] N, world frame, of the floor on each foot in the last sub-step
    memory: dict = field(default_factory=dict)  # of effects, by name, as in `State`
