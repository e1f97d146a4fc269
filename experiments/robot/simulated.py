"""A stand-in for a robot of another hand: its own simulation with hidden parameters, which answers through logs."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.logs import Log, Run
from experiments.common.config import Preset, named_values
from experiments.walking.robots import Kind
from jaxtune.mjx import nominal
from jaxtune.network import Network


class SimulatedRobot:
    """A robot that walks with exported policies and records what they observe and do, as a real one would.

    Args:
      kind: the robot.
      truth: physical values, as name=value; those that are left out are nominal.

    Raises:
      ValueError: a name or value is not in the robot's table.
    """

    def __init__(self, kind: Kind, truth: Sequence[str]):
        self._kind = kind
        self._robot = kind.make(Preset(), kind.entries, None)
        values = nominal(kind.entries) | named_values("truth", truth, kind.entries)
        # Values that the compiler does not know, or it would compute every field of the model while it compiles.
        self._params = {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}
        self._reset, self._move = jax.jit(self._robot.reset), jax.jit(lambda *args: self._robot.move(*args)[0])

    load = staticmethod(Network)
    """Loads an exported policy."""

    def log(self, meta: Mapping[str, Any], runs: tuple[Run, ...]) -> Log:
        """Makes the log of walks with a policy that has this `meta`; actions have their numbers as names."""
        return Log(
            robot=self._kind.name,
            base="free",
            rate_hz=meta["rate_hz"],
            joints=tuple(f"action_{number}" for number in range(meta["action"])),
            policy={"rate_hz": meta["rate_hz"]},
            runs=runs,
        )

    def walk(self, name: str, policy: Network, seconds: float, rng: np.random.Generator) -> tuple[Run, bool]:
        """Walks once.

        Args:
          name: of the run.
          policy: the exported policy.
          seconds: length of the walk, if the robot does not fall.
          rng: of everything random.

        Returns:
          What the policy observed and did, and the reward of each step, until the motors are switched off after a fall;
          and whether there was one.
        """
        state = self._reset(self._params, jax.random.PRNGKey(rng.integers(2**31)))
        rows, fell = [], False
        for _ in range(round(seconds / self._kind.control_s)):
            obs = np.asarray(self._robot.observed(state.obs), float)
            action = policy(obs)
            state = self._move(self._params, state, jnp.asarray(action, jnp.float32))
            rows.append((obs, action, float(state.score), 1.0))
            fell = bool(state.done)
            if fell:
                rows.append((obs, action, 0.0, 0.0))
                break
        obs, action, reward, enabled = (np.array(values) for values in zip(*rows, strict=True))
        run = Run(
            name=name,
            condition=name,
            split=None,
            controller=None,
            time=np.arange(len(rows)) * self._kind.control_s,
            signals={"obs": obs, "action": action, "enabled": enabled},
            other={"reward": reward},
        )
        return run, fell
