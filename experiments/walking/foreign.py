"""Robots of other projects, with a table and a policy each, on which `experiments.robots_bench` counts.

`cheetah` is the `CheetahRun` of MuJoCo Playground and `hopper` is Brax's. Both are traced by JAX and learn with PPO, as
in `experiments.train`. `half_cheetah` is Gymnasium's, which JAX cannot trace. Its policy is linear and learns by random
search (Mania et al. 2018), since a user of Gymnasium brings a policy that this project knows nothing of.
"""

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.config import Preset
from experiments.walking.learner import Learner
from experiments.walking.policies import starting_policy
from experiments.walking.robots import kind
from jaxtune import devices
from jaxtune.host import HostTuner, one_by_one
from jaxtune.mjx import Entry, Simulator, action_delay, apply_mujoco, field, friction, mass, parameters, strength
from jaxtune.tuner import Info, TunerState
from jaxtune.types import Trajectory

PACKAGES = {"cheetah": "mujoco_playground", "hopper": "brax", "half_cheetah": "gymnasium"}
"""Robots, and the packages that they come from."""
_LEG = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
_MASS, _JOINT, _MOTOR, _GRIP = (0.4, 2.5), (0.3, 3.0), (0.4, 2.0), (0.3, 3.0)  # bounds of multipliers
_RUNNER = {
    "torso": mass("torso", bounds=_MASS),
    "damping": field("dof_damping", joints=_LEG, bounds=_JOINT),
    "gear": strength(_LEG, bounds=_MOTOR),
    "friction": friction(bounds=_GRIP),
}


def cheetah() -> Simulator:
    """Makes Playground's `CheetahRun`, with a table of four multipliers and a delay."""
    from mujoco_playground import registry

    env = registry.load("CheetahRun", config_overrides={"impl": "jax"})
    return Simulator(env, 150, _RUNNER | {"delay": action_delay(bounds_s=(0.0, 0.03))})


def hopper() -> Simulator:
    """Makes Brax's `hopper`, with a table of four multipliers."""
    from brax import envs

    table = {
        "torso": mass("torso", bounds=_MASS),
        "leg": mass(("thigh", "leg", "foot"), bounds=_MASS),
        "damping": field("dof_damping", joints=("thigh_joint", "leg_joint", "foot_joint"), bounds=_JOINT),
        "gear": strength(None, bounds=_MOTOR),
    }
    return Simulator(envs.get_environment("hopper", backend="mjx"), 150, table)


class World(Protocol):
    """A robot that is tuned to itself with other parameters."""

    entries: Mapping[str, Entry]

    def policy(self, out: Path) -> Any:
        """Trains the policy, or reads what an earlier call kept in the folder `out`."""

    def measure(self, key: jax.Array, policy: Any, truth: Mapping[str, float]) -> Trajectory:
        """Plays a measured set with true physical values."""

    def tune(self, key: jax.Array, state: TunerState, measured: Trajectory) -> tuple[TunerState, Info]:
        """Does one tuning."""


class Traced:
    """A robot that JAX traces.

    Args:
      function: of this module, that makes it.
      sizes: of training and tuning.
    """

    def __init__(self, function: str, sizes: Preset):
        robot = kind(f"{__file__}:{function}")
        self._learner = Learner(sizes, robot.entries, kind=robot)
        self.entries = robot.entries
        self.tune = devices.on_all(jax.jit(self._learner.tuner().tune))
        self._simulate = devices.on_all(jax.jit(self._learner.simulate))

    def policy(self, out: Path) -> Any:
        return starting_policy("scratch", self._learner, out)

    def measure(self, key: jax.Array, policy: Any, truth: Mapping[str, float]) -> Trajectory:
        coords = parameters.to_coords(self.entries, truth)
        count = self._learner.preset.tuner.set_episodes
        return self._simulate(key, policy, {name: jnp.full(count, value) for name, value in coords.items()})


@dataclass(frozen=True)
class _Search:
    """Sizes of the random search that trains the linear policy.

    Attributes:
      steps: length of an episode in control steps.
      directions: tried in every round, each of them forwards and backwards.
      best: directions that an update uses.
      step_size: length of a step, per unit of return's standard deviation.
      noise: size of what is tried.
    """

    steps: int = 200
    directions: int = 8
    best: int = 4
    step_size: float = 0.02
    noise: float = 0.05


class HalfCheetah:
    """Gymnasium's `HalfCheetah-v5`.

    Args:
      sizes: of tuning; the search for a policy has half as many updates as PPO has for other robots.
    """

    entries = _RUNNER

    def __init__(self, sizes: Preset):
        import gymnasium

        self._env = gymnasium.make("HalfCheetah-v5").unwrapped
        self._nominal = self._env.model
        self._sizes = sizes
        self._simulate = one_by_one(self._play_coords)
        self.tune = HostTuner(config=sizes.tuner, simulate=self._simulate).tune

    def policy(self, out: Path) -> np.ndarray:
        kept = out / "policy.npy"
        if not kept.exists():
            out.mkdir(parents=True, exist_ok=True)
            np.save(kept, self._train())
        return np.load(kept)

    def measure(self, key: jax.Array, policy: np.ndarray, truth: Mapping[str, float]) -> Trajectory:
        coords, count = parameters.to_coords(self.entries, truth), self._sizes.tuner.set_episodes
        return self._simulate(key, policy, {name: np.full(count, value) for name, value in coords.items()})

    def _play_coords(self, seed: int, policy: np.ndarray, coords: Mapping[str, float]) -> dict[str, list]:
        steps = min(150, self._sizes.episode_steps)
        return self._play(seed, policy, parameters.from_coords(self.entries, coords), steps)

    def _play(self, seed: int, policy: np.ndarray, robot: Mapping[str, float], steps: int) -> dict[str, list]:
        self._env.model = apply_mujoco(self._nominal, robot, self.entries)
        observation, _ = self._env.reset(seed=seed)
        episode = {"observation": [observation], "action": [], "reward": [], "terminated": []}
        for _ in range(steps):
            episode["action"].append(np.tanh(policy @ episode["observation"][-1]))
            observation, reward, terminated, _, _ = self._env.step(episode["action"][-1])
            for name, value in (("observation", observation), ("reward", reward), ("terminated", terminated)):
                episode[name].append(value)
        return episode

    def _train(self) -> np.ndarray:
        search, rng = _Search(), np.random.default_rng(0)
        sizes = self._env.action_space.shape[0], self._env.observation_space.shape[0]

        def returned(policy: np.ndarray, seed: int) -> float:
            return sum(self._play(seed, policy, {}, search.steps)["reward"])

        policy = np.zeros(sizes)
        for update in range(max(1, self._sizes.scratch_updates // 2)):
            tried = search.noise * rng.standard_normal((search.directions, *sizes))
            gains = np.array([[returned(policy + sign * one, update) for sign in (1, -1)] for one in tried])
            best = np.argsort(-gains.max(axis=1))[: search.best]
            slope = np.tensordot(gains[best, 0] - gains[best, 1], tried[best] / search.noise, 1) / search.best
            policy = policy + search.step_size * slope / gains[best].std()
        return policy


def check(name: str) -> None:
    """Checks that a robot can be made.

    Raises:
      ValueError: it is not in `PACKAGES`, or its package is not installed.
    """
    if name not in PACKAGES:
        raise ValueError(f"robots: got '{name}', expected some of {', '.join(PACKAGES)}")
    if importlib.util.find_spec(PACKAGES[name]) is None:
        raise ValueError(f"robots: got '{name}', but its package {PACKAGES[name]} is not installed")


def world(name: str, sizes: Preset) -> World:
    """Makes one of the robots in `PACKAGES`."""
    return HalfCheetah(sizes) if name == "half_cheetah" else Traced(name, sizes)
